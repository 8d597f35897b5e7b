"""Local fleets for tests: real processes under a name of their own, ended and cleaned up afterwards."""

import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.llm.settings import LlmConfig
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
