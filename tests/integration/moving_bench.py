"""A fleet with a skill that counts its steps and saves them, for tests of moves between gateways."""

import asyncio
import os
import sys
import textwrap
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
from fleets import RULES

from appliance import config as configuration
from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.model import Plan, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskRequest
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from appliance.tasks.settings import MigrationConfig, TasksConfig
from workshop import local_fleet
from workshop.local_fleet import Order

COUNTER = """
import time

def run(ctx):
    state = ctx.resume or {"done": 0, "by": []}
    state["by"].append(ctx.attempt)
    pad = "x" * int(ctx.params.get("pad", 0))
    last = int(ctx.params["steps"])
    if ctx.resume:
        last = min(last, state["done"] + int(ctx.params.get("then", last)))
    while state["done"] < last:
        time.sleep(float(ctx.params["step_s"]))
        state["done"] += 1
        ctx.progress(state["done"] / int(ctx.params["steps"]))
        ctx.partial({"done": state["done"]})
        if ctx.checkpoint_due() or state["done"] % 50 == 0:
            ctx.checkpoint({**state, "pad": pad})
    return {"by": state["by"], "resumed_from": (ctx.resume or {}).get("done", 0), "pad": len(pad)}
"""
VOLUME = """
import time
from pathlib import Path

def run(ctx):
    ledger = ctx.volume("ledger") / "lines"
    lines = ledger.read_text().splitlines() if ledger.exists() else []
    first = len(lines)
    filler = ctx.volume("ledger") / "filler"
    size = int(ctx.params.get("mb", 0)) * 2**20
    if size and not filler.exists():
        filler.write_bytes(__import__("os").urandom(size))
    while len(lines) < int(ctx.params["steps"]):
        time.sleep(float(ctx.params["step_s"]))
        lines.append(f"{len(lines)} by {ctx.attempt}")
        with ledger.open("a") as file:
            print(lines[-1], file=file)
        ctx.progress(len(lines) / int(ctx.params["steps"]))
        if ctx.checkpoint_due():
            ctx.checkpoint({"lines": len(lines)})
    return {"lines": lines, "found": first}
"""
ROUNDS = """
from _lib import moves

def run(ctx):
    for lap in range(int(ctx.params["laps"])):
        here = moves.state(ctx)
        to = {"x": round(here.x + (0.6 if lap % 2 else -0.6), 2), "y": round(here.y, 2)}
        ctx.command("goto", timeout_s=60, waypoints=[to], speed_mps=1.5)
        ctx.progress((lap + 1) / int(ctx.params["laps"]), f"lap {lap + 1}")
    return {"laps": lap + 1, "attempt": ctx.attempt}
"""
ROUNDS_MANIFEST = """
id = "go_round"
domain = "navigation"
summary = "Drives to and fro, for tests of moves."
runs = "robot"
uses = ["base"]
image = "base"
cpu = 0.1
memory_mb = 64
timeout_s = 300
retries = 0
verbs = ["goto", "state"]
migratable = "between commands"

[params.laps]
type = "integer"
required = true
"""
MANIFEST = """
id = "{name}"
domain = "coordination"
summary = "Counts steps, for tests of moves."
runs = "compute"
image = "base"
cpu = 0.1
memory_mb = 64
timeout_s = 300
retries = 0
checkpoints = true
{more}

[params.steps]
type = "integer"
required = true

[params.step_s]
type = "number"
required = true

[params.pad]
type = "integer"
required = false

[params.then]
description = "Steps after it was moved: so one that would never end can be moved at leisure, and ends."
type = "integer"
required = false

[params.mb]
type = "integer"
required = false
"""


def write_skills(folder: Path) -> Path:
    """Write the skills `count_up` and `count_in_volume`; returns the folder they are in."""
    for name, handler, more in (
        ("count_up", COUNTER, ""),
        ("count_in_volume", VOLUME, 'volumes = ["ledger"]\nfile_mb = 512'),
    ):
        skill = folder / "skills" / name
        skill.mkdir(parents=True)
        (skill / "handler.py").write_text(textwrap.dedent(handler))
        (skill / "skill.toml").write_text(MANIFEST.format(name=name, more=more))
    rounds = folder / "skills" / "go_round"
    rounds.mkdir()
    (rounds / "handler.py").write_text(ROUNDS)
    (rounds / "skill.toml").write_text(ROUNDS_MANIFEST)
    return folder / "skills"


@asynccontextmanager
async def fleet_of(
    folder: Path, *, gateways: int = 3, pool: PoolConfig | None = None, migration: MigrationConfig | None = None,
    pools: dict[str, PoolConfig] | None = None, drain_s: float = 20.0, rovers: int = 0, sim_rate: float = 1.0,
) -> AsyncIterator[FleetState]:  # fmt: skip
    """A fleet that knows these skills, with so many rovers; ended and cleaned up afterwards."""
    order = Order(
        fleet=f"m{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=folder / "fleet",
        gateways=gateways,
        mavlink=0,
        zenoh=rovers,
        sim_rate=sim_rate,
        pool=pool or PoolConfig(floor={"base": 1}),
        pools=pools or {},
        base=GatewayConfig(
            id="gw-1",
            llm=RULES,
            skills=(str(write_skills(folder)),),
            drain_s=drain_s,
            tasks=TasksConfig(migration=migration or MigrationConfig()),
        ),
    )
    state = await local_fleet.up(order, progress=print, timeout_s=120.0)
    try:
        yield state
    finally:
        await local_fleet.down(order.directory, progress=print, volumes=True)


@asynccontextmanager
async def further_gateway(state: FleetState, name: str, pool: PoolConfig) -> AsyncIterator[None]:
    """One gateway more, with another pool; it is not waited for."""
    folder = Path(state.directory)
    like = configuration.load(folder / state.gateways[0] / "gateway.toml")
    config = msgspec.structs.replace(
        like,
        id=name,
        data_dir=str(folder / name / "data"),
        plane=PlaneConfig(listen=(f"tcp/127.0.0.1:{local_fleet.free_port()}",), connect=state.endpoints),
        pool=pool,
    )
    path = folder / name / "gateway.toml"
    path.parent.mkdir(parents=True)
    path.write_text(configuration.dump(config))
    with (folder / "logs" / f"{name}.log").open("ab") as log:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "appliance.cli", "gateway", "--config", str(path), stdout=log, stderr=log
        )
    try:
        yield
    finally:
        process.terminate()
        async with asyncio.timeout(60):
            await process.wait()


def counting(
    task: str, *, steps: int = 100, step_s: float = 0.05, skill: str = "count_up", count: int = 1, **params: Any
) -> TaskRequest:
    """A task of subtasks that count, beside each other."""
    subtasks = tuple(
        Subtask(id=f"s{number + 1}", skill=skill, params={"steps": steps, "step_s": step_s, **params})
        for number in range(count)
    )
    return TaskRequest(instruction="count", id=task, plan=Plan(domain="coordination", subtasks=subtasks))


async def until_running(
    client: FleetClient, task: str, subtask: str | None = "s1", *, attempt: int = 0
) -> SubtaskRecord:
    """Wait until a subtask (None: any) runs."""
    async with asyncio.timeout(60):
        while True:
            record = await client.task(task)
            running = [each for each in record.subtasks if each.state is SubtaskState.RUNNING]
            found = next((each for each in running if subtask in (None, each.subtask.id)), None)
            if found is not None and found.state is SubtaskState.RUNNING and found.attempt >= attempt:
                return found
            assert not record.state.final, record.failure
            await asyncio.sleep(0.05)


async def ended(client: FleetClient, task: str, *, timeout_s: float = 120.0) -> TaskRecord:
    """Wait for a task's end."""
    last = None
    async with asyncio.timeout(timeout_s):
        async for record in client.watch(task):
            last = record
    assert last is not None
    return last


def pretty(value: object) -> str:
    """For failure messages."""
    return msgspec.json.format(msgspec.json.encode(value), indent=1).decode()
