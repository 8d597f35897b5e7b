"""Four gateways whose runs can be moved, with the skills and the waiting that the benchmarks of moves share."""

import asyncio
import tempfile
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import PoolError, SwiftbotError
from appliance.llm.settings import LlmConfig
from appliance.model import Plan, Subtask, SubtaskState, TaskRecord, TaskRequest
from appliance.pool.settings import PoolConfig
from appliance.tasks.settings import MigrationConfig, TasksConfig
from workshop import local_fleet
from workshop.bench.pooled import fleet_name, write_skill
from workshop.local_fleet import Order

Progress = Callable[[str], None]

SKILL, STATEFUL = "bench_saves", "bench_state"
GATEWAYS = 4
PATIENCE_S = 120.0
_MORE = """checkpoints = true
timeout_s = 600

[params.seconds]
type = "number"
required = true

[params.bytes]
type = "integer"
required = false

[params.saves_every]
type = "integer"
required = false

[params.megabytes]
type = "integer"
required = false
"""
_SAVES = """
import time


def run(ctx):
    state = ctx.resume or {"done_s": 0.0}
    state["pad"] = "x" * int(ctx.params.get("bytes", 0))
    every, steps = int(ctx.params.get("saves_every", 0)), 0
    while state["done_s"] < float(ctx.params["seconds"]):
        time.sleep(0.02)
        state["done_s"] += 0.02
        steps += 1
        if ctx.checkpoint_due() or (every and steps % every == 0):
            ctx.checkpoint(state)
    return {}
"""
_STATE = """
import os
import time


def run(ctx):
    state, folder = ctx.resume or {"done_s": 0.0}, ctx.volume("bench")
    large = folder / "large"
    if not large.exists():
        large.write_bytes(os.urandom(int(ctx.params["megabytes"]) * 2**20))
    with (folder / "small").open("a") as file:
        print(ctx.attempt, file=file)
    while state["done_s"] < float(ctx.params["seconds"]):
        time.sleep(0.02)
        state["done_s"] += 0.02
        if ctx.checkpoint_due():
            ctx.checkpoint(state)
    return {}
"""


@asynccontextmanager
async def fleet(
    pool: PoolConfig, *, migration: MigrationConfig | None = None, progress: Progress
) -> AsyncGenerator[FleetClient]:
    """Four gateways that know the skills; gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
        skills = write_skill(Path(folder), "base", skill=SKILL, handler=_SAVES, more=_MORE)
        write_skill(
            Path(folder), "base", skill=STATEFUL, handler=_STATE, more='volumes = ["bench"]\nfile_mb = 1024\n' + _MORE
        )
        order = Order(
            fleet=fleet_name(),
            directory=Path(folder) / "fleet",
            gateways=GATEWAYS,
            mavlink=0,
            zenoh=0,
            base=GatewayConfig(
                llm=LlmConfig(tiers=("rules",)),
                id="gw-1",
                skills=(str(skills),),
                tasks=TasksConfig(migration=migration or MigrationConfig(overload=False)),
            ),
            pool=pool,
        )
        state = await local_fleet.up(order, progress=progress, timeout_s=PATIENCE_S)
        try:
            async with FleetClient(state.endpoint) as client:
                await client.gateway()
                yield client
        finally:
            await local_fleet.down(order.directory, progress=progress, volumes=True)


def task_of(task: str, skill: str, group: tuple[str, ...] = (), **params: Any) -> TaskRequest:
    """A task of one subtask; `group`: it may run on these gateways alone."""
    plan = Plan(domain="coordination", subtasks=(Subtask(id="s1", skill=skill, params=params),))
    return TaskRequest(instruction="bench", id=task, plan=plan, group=group)


async def running(client: FleetClient, task: str, *, any_of: list[str] | None = None) -> None:
    """Wait until a task's run, or one of several, works."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            for each in any_of or [task]:
                record = await client.task(each)
                if any(subtask.state is SubtaskState.RUNNING for subtask in record.subtasks):
                    return
                if record.state.final:
                    raise PoolError(f"{each} {record.state}: {record.failure.message if record.failure else ''}")
            await asyncio.sleep(0.002)


async def ended(client: FleetClient, task: str) -> TaskRecord:
    """Wait for a task's end."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                record = await client.task(task)
            except SwiftbotError:
                await asyncio.sleep(0.1)
                continue
            if record.state.final:
                return record
            await asyncio.sleep(0.01)
