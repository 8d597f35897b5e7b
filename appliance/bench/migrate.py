"""How long a move takes, and what it is good for: on four real gateways, beside killing a run and starting it cold.

Times of a move are those of the coordinator, from the request to the first line of the handler on the other gateway;
the run works on until its `write` step, so that what it stands still for is `write` and `start`. The alternative ends
the run and hands its task in anew, without warm containers: what it had done is lost besides.

The overload: all runs come while one gateway alone takes any, the others join then. Time is from handing in to the end
of each, with and without moves by overload, in mode `local`, where a waiting run stays where it is, and `federated`,
where it is offered elsewhere too.
"""

import asyncio
import tempfile
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Literal

from appliance import local_fleet
from appliance.bench.figures import ratio, summary
from appliance.bench.pooled import fleet_name, write_skill
from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import PoolError, SwiftbotError
from appliance.local_fleet import Order
from appliance.model import Plan, Subtask, SubtaskState, TaskRecord, TaskRequest
from appliance.pool.settings import PoolConfig
from appliance.tasks.migration.api import MigrateAsk
from appliance.tasks.migration.settings import MigrationConfig
from appliance.tasks.settings import TasksConfig

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

[params.megabytes]
type = "integer"
required = false
"""
_SAVES = """
import time


def run(ctx):
    state = ctx.resume or {"done_s": 0.0}
    state["pad"] = "x" * int(ctx.params.get("bytes", 0))
    while state["done_s"] < float(ctx.params["seconds"]):
        time.sleep(0.02)
        state["done_s"] += 0.02
        if ctx.checkpoint_due():
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


async def run(
    moves: int = 30, volume_moves: int = 6, megabytes: int = 64, cold: int = 5, runs: int = 16, work_s: float = 3.0,
    *, overload: bool = True, progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure moves with checkpoints of 1 kB and 256 kB and with a volume, the alternative, and an overload.

    Args:
        moves: moves with each size of checkpoint.
        volume_moves: moves with the volume; to a gateway that has none of it, and again.
        megabytes: size of the volume.
        cold: runs that are ended and started anew.
        runs: runs of the overload.
        work_s: what each of them works.
        overload: whether to measure that at all.
        progress: told what is being measured.
    """
    result: dict[str, Any] = {"gateways": GATEWAYS, "megabytes": megabytes}
    async with _fleet(PoolConfig(floor={"base": 2}), progress=progress) as client:
        for name, size in (("1 kB", 1000), ("256 kB", 255_000)):
            progress(f"migrate: {moves} moves with a checkpoint of {name}")
            result[f"move, checkpoint {name}"] = await _moves(client, SKILL, moves, bytes=size)
        progress(f"migrate: {volume_moves} moves with a volume of {megabytes} MB")
        result[f"move, volume {megabytes} MB"] = await _moves(client, STATEFUL, volume_moves, megabytes=megabytes)
    async with _fleet(PoolConfig(mode="cold", floor={}), progress=progress) as client:
        progress(f"migrate: {cold} runs ended and started anew")
        result["end, start anew cold"] = summary([await _anew(client, number) for number in range(cold)])
    moved = result["move, checkpoint 1 kB"]["took"]
    result["anew / move, p50"] = ratio(result["end, start anew cold"].get("p50"), moved.get("p50"))
    if overload:
        modes: tuple[Literal["local", "federated"], ...] = ("local", "federated")
        for mode in modes:
            for on in (False, True):
                name = f"overload, {mode}, moves {'on' if on else 'off'}"
                progress(f"migrate: {runs} runs of {work_s:g} s on one gateway; {name}")
                result[name] = await _overload(mode, runs, work_s, on=on, progress=progress)
    return result


@asynccontextmanager
async def _fleet(
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
            await local_fleet.down(order.directory, progress=progress)


def _task(task: str, skill: str, **params: Any) -> TaskRequest:
    plan = Plan(domain="coordination", subtasks=(Subtask(id="s1", skill=skill, params=params),))
    return TaskRequest(instruction="bench", id=task, plan=plan)


async def _moves(client: FleetClient, skill: str, count: int, **params: Any) -> dict[str, Any]:
    """Move one run `count` times, wherever is closest."""
    task = f"move-{skill.replace('_', '-')}-{time.monotonic_ns()}"
    await client.submit(_task(task, skill, seconds=3600.0, **params))
    await _running(client, task)
    took: list[float] = []
    steps: dict[str, list[float]] = {}
    checkpoints: dict[str, int] = {}
    for _ in range(count):
        await asyncio.sleep(0.3)
        moved = await client.migrate(MigrateAsk(task=task, subtask="s1"))
        took.append(moved.took_ms if moved.started else float("inf"))
        checkpoints[moved.checkpoint or "none"] = checkpoints.get(moved.checkpoint or "none", 0) + 1
        for step, ms in moved.steps_ms.items():
            steps.setdefault(step, []).append(ms)
    await client.cancel(task)
    await _ended(client, task)
    return {
        "took": summary(took),
        **{f"step {step}": summary(times) for step, times in steps.items()},
        "went on from": checkpoints,
    }


async def _anew(client: FleetClient, number: int) -> float:
    """End a run that works, hand its task in anew; milliseconds from the decision to its first line."""
    task = f"cold-{number}-{time.monotonic_ns()}"
    await client.submit(_task(task, SKILL, seconds=3600.0))
    await _running(client, task)
    began = time.monotonic()
    await client.cancel(task)
    await _ended(client, task)
    again = f"{task}-again"
    await client.submit(_task(again, SKILL, seconds=3600.0))
    await _running(client, again)
    took_ms = (time.monotonic() - began) * 1e3
    await client.cancel(again)
    await _ended(client, again)
    return took_ms


async def _overload(
    mode: Literal["local", "federated"], runs: int, work_s: float, *, on: bool, progress: Progress
) -> dict[str, Any]:
    """All runs come to one gateway of two containers; then the others take runs too."""
    pool = PoolConfig(mode=mode, floor={"base": 1}, capacity=2, queue=64, queue_wait_s=300.0)
    config = MigrationConfig(overload=on, above_s=0.5, settle_s=3.0)
    async with _fleet(pool, migration=config, progress=progress) as client:
        others = sorted(client.plane.members())[1:]
        for gateway in others:
            await client.drain(gateway, 0.0)
        began = time.monotonic()
        tasks = [f"over-{number}-{time.monotonic_ns()}" for number in range(runs)]
        for task in tasks:
            await client.submit(_task(task, SKILL, seconds=work_s))
        await _running(client, tasks[0], any_of=tasks)
        for gateway in others:
            await client.undrain(gateway)

        async def end(task: str) -> tuple[float, TaskRecord]:
            record = await _ended(client, task)
            return (time.monotonic() - began) * 1e3, record

        ends = await asyncio.gather(*(end(task) for task in tasks))
        moved = sum(any(each.left for each in record.subtasks[0].attempts) for _, record in ends)
        away = sum(record.subtasks[0].gateway in others for _, record in ends)
        return {"completion": summary([took for took, _ in ends]), "moved": moved, "ended elsewhere": away}


async def _running(client: FleetClient, task: str, *, any_of: list[str] | None = None) -> None:
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


async def _ended(client: FleetClient, task: str) -> TaskRecord:
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
