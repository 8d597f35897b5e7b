"""How a gateway's daemon ends: told to stop, it drains; where another has its id it goes at once, with an error."""

import asyncio
import os
import signal
from typing import Any

import pytest

from appliance import gateway as daemon
from appliance import process
from appliance.errors import ConfigError, Exit
from appliance.plane.membership import displaced

pytestmark = pytest.mark.anyio


class Fake:
    """In place of a gateway, and of its plane: what was done with it."""

    def __init__(self) -> None:
        self.plane = self
        self.supervisor = process.Supervisor()
        self.taken = asyncio.Event()
        self.started = asyncio.Event()
        self.stopped: list[bool] = []

    def made(self, _: object) -> "Fake":
        """Stand in for the class."""
        return self

    async def displaced(self) -> ConfigError:
        """Wait until another has its id."""
        await self.taken.wait()
        return displaced("gw-1")

    async def start(self) -> None:
        """Note it."""
        self.started.set()

    async def stop(self, *, at_once: bool) -> None:
        """Note how."""
        self.taken.set()  # what comes while it stops changes nothing any more
        await asyncio.sleep(0)
        self.stopped.append(at_once)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Fake:
    """The daemon's gateway."""
    it = Fake()
    monkeypatch.setattr(daemon, "Gateway", it.made)
    for each in ("ready", "stopping"):
        monkeypatch.setattr(process, each, lambda: None)
    return it


async def test_told_to_stop_it_drains(fake: Fake) -> None:
    """SIGTERM ends it without an error."""
    config: Any = None
    running = asyncio.create_task(daemon.run(config))
    await fake.started.wait()
    os.kill(os.getpid(), signal.SIGTERM)
    await running
    assert fake.stopped == [False]


async def test_where_another_has_its_id_it_goes(fake: Fake) -> None:
    """It stops at once, and the error, which no supervisor retries, says what to do."""
    config: Any = None
    running = asyncio.create_task(daemon.run(config))
    await fake.started.wait()
    fake.taken.set()
    with pytest.raises(ConfigError, match="give each gateway an id of its own") as raised:
        await running
    assert raised.value.exit_code is Exit.USAGE
    assert fake.stopped == [True]


async def test_a_root_task_that_breaks_ends_the_process(fake: Fake) -> None:
    """Its error is raised after everything has stopped, for the service manager to start it again."""

    async def broken() -> None:
        raise RuntimeError("a defect")

    config: Any = None
    running = asyncio.create_task(daemon.run(config))
    await fake.started.wait()
    fake.supervisor.start("status", broken())
    with pytest.raises(RuntimeError, match="a defect"):
        await running
    assert fake.stopped == [True]


async def test_root_tasks_are_cancelled_in_reverse_order() -> None:
    """The last that was started ends first; one that was stopped before is not touched again."""
    ended: list[str] = []

    async def work(name: str) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(name)

    supervisor = process.Supervisor()
    stops = [supervisor.start(name, work(name)) for name in ("watchdog", "status", "retention")]
    await asyncio.sleep(0)
    await stops[1]()
    await supervisor.close()
    assert ended == ["status", "retention", "watchdog"]
