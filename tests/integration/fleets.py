"""Local fleets for tests: real processes under a name of their own, ended and cleaned up afterwards."""

import asyncio
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.llm.settings import LlmConfig
from appliance.model.alerts import Alert
from appliance.pool.settings import PoolConfig
from workshop import local_fleet
from workshop.local_fleet import Order

RULES = LlmConfig(tiers=("rules",))
"""Where plans are not what a test is about: the same words always give the same plan, and no gateway loads a model."""
INTERRUPTIBLE = ("env", "--default-signal=INT")
"""Before a command that a test interrupts: where tests run in the background of a shell, what they start ignores it."""
PLAIN = GatewayConfig(id="base", llm=RULES)


@asynccontextmanager
async def fleet_in(folder: Path, **order: Any) -> AsyncIterator[FleetState]:
    """Run a fleet whose files are in a folder; `order` is as `local_fleet.Order` has it, without MAVLink."""
    wanted = Order(
        fleet=f"t{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=folder / "fleet",
        **{"mavlink": 0, "pool": PoolConfig(floor={"base": 1}), "base": PLAIN} | order,
    )
    state = await local_fleet.up(wanted, progress=print, timeout_s=90.0)
    try:
        yield state
    finally:
        await local_fleet.down(wanted.directory, progress=print, volumes=True)


def where(fleet: FleetState) -> tuple[str, ...]:
    """Return the options that name a fleet."""
    return "--dir", fleet.directory, "--fleet", fleet.fleet


async def command(*words: str, by: str = "cora") -> tuple[int, str, str]:
    """Run the real command without a terminal; returns exit code, output, errors."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli", *words,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        env=os.environ | {"SWIFTBOT_OPERATOR": by},
    )  # fmt: skip
    out, err = await process.communicate()
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


async def swiftbot(fleet: FleetState, *words: str) -> tuple[int, str, str]:
    """Run the real command on a fleet; returns exit code, output, errors."""
    return await command(*words, *where(fleet))


def kill(fleet: FleetState, name: str) -> None:
    """End a process of a fleet at once."""
    os.kill(next(each.pid for each in fleet.processes if each.name == name), signal.SIGKILL)


async def alerts_until(client: FleetClient, holds: Callable[[dict[str, Alert]], bool]) -> dict[str, Alert]:
    """Wait until the alerts are so; returns them by id."""
    found: dict[str, Alert] = {}
    try:
        async with asyncio.timeout(60.0):
            while True:
                found = {each.id: each for each in (await client.alerts()).alerts}
                if holds(found):
                    return found
                await asyncio.sleep(0.2)
    except TimeoutError:
        pytest.fail(f"the alerts are {sorted(found)}")
