"""A partition of a real fleet: both halves go on, and when they meet the records merge and doubled runs are ended.

Gateways are clients of two routers whose only link goes through a relay of the test, which cuts it and mends it.
"""

import asyncio
import contextlib
import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

import pytest
from fleets import RULES
from moving_bench import counting, ended, pretty, write_skills
from msgspec.structs import replace
from relays import Relay, router

from appliance import config as configuration
from appliance.client import Endpoint, FleetClient
from appliance.config import GatewayConfig
from appliance.model import Approval, Notice, TaskRecord, TaskState, keyspace
from appliance.model.task_api import TaskAsk
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import remove_fleet
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from appliance.tasks.settings import MigrationConfig, TasksConfig

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(600)]

LEASE_MS = 5000
"""A loaded machine keeps processes waiting for seconds; the cut itself breaks the links, which is seen at once."""
NAMES = ("gw-1", "gw-2", "gw-3", "gw-4")


@asynccontextmanager
async def process(folder: Path, name: str, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A process of the command line, its output in a file, ended afterwards."""
    with (folder / f"{name}.log").open("ab") as log:
        it = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "appliance.cli", *arguments, stdout=log, stderr=log
        )
    try:
        yield it
    finally:
        with contextlib.suppress(ProcessLookupError):
            it.terminate()
        try:
            async with asyncio.timeout(40):
                await it.wait()
        except TimeoutError:
            it.kill()
            await it.wait()


@asynccontextmanager
async def halves(folder: Path) -> AsyncIterator[tuple[Relay, FleetClient, FleetClient]]:
    """Two gateways at each of two routers; a client at each router."""
    fleet = f"p{os.getpid()}-{time.monotonic_ns() % 100000}"
    one, other, between = free_port(), free_port(), free_port()
    relay = Relay(between, one)
    skills = write_skills(folder)
    async with contextlib.AsyncExitStack() as stack:
        stack.push_async_callback(partial(remove_fleet, fleet, volumes=True))
        await relay.mend()
        stack.push_async_callback(relay.cut)
        ends = [f"tcp/127.0.0.1:{port}" for port in (one, other)]
        await stack.enter_async_context(router(ends[0], lease_ms=LEASE_MS))
        await stack.enter_async_context(router(ends[1], f"tcp/127.0.0.1:{between}", lease_ms=LEASE_MS))
        for number, name in enumerate(NAMES):
            config = GatewayConfig(
                id=name,
                fleet=fleet,
                llm=RULES,
                data_dir=str(folder / name),
                skills=(str(skills),),
                drain_s=1.0,
                keep_containers=False,
                plane=PlaneConfig(mode="client", connect=(ends[number // 2],), lease_ms=LEASE_MS),
                pool=PoolConfig(floor={"base": 1}, capacity=6),
                tasks=TasksConfig(migration=MigrationConfig(cpu_high=0.0)),
            )
            path = folder / f"{name}.toml"
            path.write_text(configuration.dump(config))
            await stack.enter_async_context(process(folder, name, "gateway", "--config", str(path)))
        clients = [await stack.enter_async_context(FleetClient(Endpoint(fleet=fleet, connect=(end,)))) for end in ends]
        await until_seen(clients[0], set(NAMES), ready=1)
        await until_seen(clients[1], set(NAMES), ready=1)
        yield relay, clients[0], clients[1]


async def until_seen(client: FleetClient, names: set[str], *, ready: int = 0) -> None:
    """Wait until a client sees these gateways and no others."""
    async with asyncio.timeout(150):
        while True:
            known = client.plane.registry.gateways
            if client.plane.members() == names and all(
                name in known and known[name].ready + known[name].running >= ready for name in names
            ):
                return
            await asyncio.sleep(0.1)


async def test_both_halves_go_on_and_meet_again(tmp_path: Path) -> None:
    """Tasks that run while the link is cut end once; each half takes new ones; doubled runs are ended and told of."""
    async with halves(tmp_path) as (relay, here, there):
        notices: asyncio.Queue[Notice] = asyncio.Queue()
        here.on_notice(notices)
        tasks = [f"t-cut-{number}" for number in range(6)]
        for task in tasks:
            await here.submit(counting(task, steps=250, step_s=0.1))
        async with asyncio.timeout(60):
            while sum(each.running for each in here.plane.registry.gateways.values()) < len(tasks):
                await asyncio.sleep(0.1)
        await relay.cut()
        await until_seen(here, set(NAMES[:2]))
        await until_seen(there, set(NAMES[2:]))
        # Each half finishes what is new there.
        for client, task in ((here, "t-here"), (there, "t-there")):
            await client.submit(counting(task, steps=3))
            assert (await ended(client, task)).state is TaskState.SUCCEEDED
        # Each takes over what the other coordinated, and repeats what ran there.
        async with asyncio.timeout(60):
            while not any([await doubled(here, there, task) for task in tasks]):
                await asyncio.sleep(0.2)
        await relay.mend()
        await until_seen(here, set(NAMES))
        await until_seen(there, set(NAMES))
        for task in (*tasks, "t-here", "t-there"):
            last = await ended(here, task)
            assert last.state is TaskState.SUCCEEDED, pretty(last)
            assert last.subtasks[0].result, pretty(last)
        # Nothing of the version that lost goes on, and all gateways have the same records.
        async with asyncio.timeout(60):
            while any(each.running or each.queue for each in here.plane.registry.gateways.values()):
                await asyncio.sleep(0.2)
            while True:
                found = [await here.task(task) for task in tasks]
                splits = [split for each in found for split in each.splits]
                if all(split.settled for split in splits) and any("doubled" in split.note for split in splits):
                    break
                await asyncio.sleep(0.2)
        async with asyncio.timeout(60):
            while [await here.task(task) for task in tasks] != [await there.task(task) for task in tasks]:
                await asyncio.sleep(0.2)
        told = [notices.get_nowait() for _ in range(notices.qsize())]
        assert any("partition" in each.text for each in told), told


async def doubled(here: FleetClient, there: FleetClient, task: str) -> bool:
    """Whether a task has a run of its own in each half."""
    one, other = await here.task(task), await there.task(task)
    return one.subtasks[0].gateway in NAMES[:2] and other.subtasks[0].gateway in NAMES[2:]


async def asked_of(client: FleetClient, task: str) -> dict[str, TaskState]:
    """Return what each gateway that a client sees answers of a task."""
    members = sorted(client.plane.members())
    answers = [await client.plane.rpc.call(name, keyspace.TASK, TaskAsk(id=task)) for name in members]
    return dict(zip(members, (each.state for each in answers), strict=True))


async def test_what_one_half_decides_is_what_all_answer_once_they_meet(tmp_path: Path) -> None:
    """Plans that wait when the link is cut: approved, cancelled, or both; then all gateways say the same of each.

    Nobody goes on waiting for an approval that was given; who cancelled what the other half has finished hears of it.
    """
    async with halves(tmp_path) as (relay, here, there):
        here.operator, there.operator = "ann", "bob"
        notices: asyncio.Queue[Notice] = asyncio.Queue()
        here.on_notice(notices)
        tasks = {f"t-{kind}-{number}": kind for kind in ("approved", "cancelled", "both") for number in range(4)}
        waiting: dict[str, TaskRecord] = {}
        for task in tasks:
            await here.submit(replace(counting(task, steps=2), approval=Approval.ALWAYS))
            waiting[task] = await here.planned(task)
            assert waiting[task].state is TaskState.PROPOSED
        await relay.cut()
        await until_seen(here, set(NAMES[:2]))
        await until_seen(there, set(NAMES[2:]))
        for task, kind in tasks.items():
            if kind != "approved":
                await here.cancel(task)
            if kind != "cancelled":
                proposal = waiting[task].proposal
                assert proposal is not None
                await there.approve(task, plan_hash=proposal.hash)
                assert (await ended(there, task)).state is TaskState.SUCCEEDED
        for task, kind in tasks.items():
            assert (await here.task(task)).state is (TaskState.PROPOSED if kind == "approved" else TaskState.CANCELLED)
        await relay.mend()
        await until_seen(here, set(NAMES))
        await until_seen(there, set(NAMES))
        expected = {
            task: TaskState.CANCELLED if kind == "cancelled" else TaskState.SUCCEEDED for task, kind in tasks.items()
        }
        async with asyncio.timeout(60):
            for task, state in expected.items():
                while set((await asked_of(here, task)).values()) != {state}:
                    await asyncio.sleep(0.1)
            told: set[str] = set()
            lost = {task for task, kind in tasks.items() if kind == "both"}
            while told != lost:
                notice = await notices.get()
                if "the cancel of task" in notice.text:
                    assert notice.to == "ann", notice
                    told.add(notice.task)
        for task, state in expected.items():
            assert set((await asked_of(there, task)).values()) == {state}, "and it stays so"
