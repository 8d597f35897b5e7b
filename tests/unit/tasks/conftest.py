"""A small fake of a gateway's surroundings: records, RPC, messages and a pool in memory, under the test's control.

They exist so that the shells (driver, executor, calls, manager) are tested where things go wrong: lost answers,
records that move on, gateways that vanish, without processes, sockets or containers. The fakes are in `fake_plane`,
`fake_pool` and `fake_context`, what tests begin with in `sample_records`.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest

from appliance.model import RunEventKind, RunRequest, TaskRecord, encode, keyspace
from appliance.skills.catalogue import Catalogue
from appliance.tasks.coordinator import Coordinator
from appliance.tasks.events import Event, OperatorAsked, RunReported
from appliance.tasks.machine import Transition
from appliance.tasks.records import task_key
from appliance.tasks.settings import TasksConfig
from tests.unit.tasks.fake_context import FAST, FakeContext
from tests.unit.tasks.fake_plane import FakePlane
from tests.unit.tasks.fake_pool import FakePool
from tests.unit.tasks.sample_records import CATALOGUE, accepted, event, plan_of


class Bench:
    """A driver on fakes, and what a test does with it."""

    plan_of = staticmethod(plan_of)

    def __init__(self) -> None:
        self.plane = FakePlane()
        self.context = FakeContext(self.plane)
        self.coordinator: Coordinator | None = None
        self.task: asyncio.Task[None] | None = None

    async def start(self, record: TaskRecord | None = None, **more: Any) -> Coordinator:
        """Write the record and drive it."""
        record = record or accepted()
        key = task_key(record.id)
        old = self.plane.dht.records.get(key)
        version = await self.plane.dht.write(key, encode(record), expected=old.version if old else None)
        self.coordinator = Coordinator(cast("Any", self.context), record, version, on_change=lambda _: None, **more)
        self.task = asyncio.create_task(self.coordinator.run())
        return self.coordinator

    async def ordered(self) -> tuple[str, RunRequest]:
        """Wait for the next run order."""
        return await asyncio.wait_for(self.context.orders.get(), 60)

    def tell(self, request: RunRequest, kind: RunEventKind, *, gateway: str = "gw-1", **fields: Any) -> None:
        """Have a run tell something."""
        assert self.coordinator is not None
        self.coordinator.put(RunReported(event(request, kind, gateway=gateway, **fields)))

    def say(self, news: Event) -> None:
        """Hand in news."""
        assert self.coordinator is not None
        self.coordinator.put(news)

    async def order(self, ask: Any) -> TaskRecord:
        """Give an operator's order; returns the record as written with it, or raises why it was not taken."""
        assert self.coordinator is not None
        outcome: asyncio.Future[TaskRecord] = asyncio.get_running_loop().create_future()
        self.coordinator.put(OperatorAsked(ask=ask, outcome=outcome))
        return await asyncio.wait_for(outcome, 60)

    async def until(self, holds: Callable[[TaskRecord], bool]) -> TaskRecord:
        """Wait until the record is so."""
        assert self.coordinator is not None
        async with asyncio.timeout(60):
            while not holds(self.coordinator.record):
                await asyncio.sleep(0.005)
        return self.coordinator.record

    async def end(self) -> TaskRecord:
        """Wait for the driver's end; returns its record."""
        assert self.task is not None
        assert self.coordinator is not None
        await asyncio.wait_for(self.task, 60)
        return self.coordinator.record

    def transitions(self, task: str = "t-1") -> list[Transition]:
        """The transitions that were published."""
        return self.plane.session.sent(self.plane.keys(keyspace.TRANSITION, task), Transition)

    def stored(self, task: str = "t-1") -> TaskRecord:
        """The record as written."""
        return msgspec.json.decode(self.plane.dht.records[task_key(task)].value, type=TaskRecord)


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    """A driver's bench; the driver is ended afterwards."""
    made = Bench()
    yield made
    if made.task is not None:
        made.task.cancel()
        await asyncio.gather(made.task, return_exceptions=True)


@pytest.fixture
def plane() -> FakePlane:
    """Return a plane in memory."""
    return FakePlane()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder for files."""
    return tmp_path


@pytest.fixture
def pool() -> FakePool:
    """Return a pool that does what the test says."""
    return FakePool()


@pytest.fixture
def tasks_config() -> TasksConfig:
    """Return a configuration with short waits."""
    return FAST


@pytest.fixture
def catalogue() -> Catalogue:
    """Return a catalogue with one skill, `work`."""
    return CATALOGUE
