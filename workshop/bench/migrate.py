"""How long a move takes, and what it is good for: on four real gateways, beside killing a run and starting it cold.

Times of a move are those of the coordinator, from the request to the first line of the handler on the other gateway;
the run works on until its `write` step, so that what it stands still for is `write` and `start`. The alternative ends
the run and hands its task in again, without warm containers: what it had done is lost besides. What moves by overload
are good for is `overload`'s.
"""

import asyncio
import tempfile
import time
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import DeadlineError, PoolError, SwiftbotError
from appliance.llm.settings import LlmConfig
from appliance.model import (
    Plan,
    RunEvent,
    RunEventKind,
    Subtask,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    keyspace,
)
from appliance.model.task_api import MigrateAsk
from appliance.pool.settings import PoolConfig
from appliance.tasks.settings import MigrationConfig, TasksConfig
from workshop import local_fleet
from workshop.bench.figures import ratio, summary
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


SAVES_EVERY = 25
"""Steps of 20 ms between the checkpoints of the long runs."""


class Overload(Struct, frozen=True, kw_only=True):
    """What the work is."""

    containers: int = 3
    """Of each gateway."""
    runs: int = 12
    """Of the crowd."""
    work_s: float = 2.0
    """What each of them works."""
    long_s: float = 12.0
    """What each of the long runs works; there are as many as the gateway has containers."""
    short: int = 9
    """Short runs that may only be where those are."""
    short_s: float = 1.0


async def overloaded(options: Overload, *, progress: Progress) -> dict[str, Any]:
    """Measure both, without moves by overload and with them; all gateways have ended afterwards.

    Raises:
        PoolError: a task did not succeed.
        DeadlineError: one did not end in time.
    """
    result: dict[str, Any] = {"containers a gateway": options.containers}
    for on in (False, True):
        how = "moves on" if on else "moves off"
        # Gateways of one machine share its processors: what another one takes is no overload of this one.
        config = MigrationConfig(overload=on, above_s=0.5, settle_s=2.0, cpu_high=0.0)
        pool = PoolConfig(floor={"base": 1}, capacity=options.containers, queue=64, queue_wait_s=300.0)
        async with fleet(pool, migration=config, progress=progress) as client:
            watched = _Watched(client)
            progress(f"overload: {options.runs} runs of {options.work_s:g} s come to one gateway; {how}")
            result[f"crowd, {how}"] = await _crowd(watched, options)
            progress(
                f"overload: {options.short} runs of {options.short_s:g} s wait for {options.containers} of "
                f"{options.long_s:g} s; {how}"
            )
            result[f"held, {how}"] = await _held(watched, options)
            watched.close()
    for name in ("crowd", "held"):
        off, on = result[f"{name}, moves off"], result[f"{name}, moves on"]
        result[f"{name}, off / on"] = {
            "makespan": ratio(off["makespan_ms"], on["makespan_ms"]),
            "queue wait p99": ratio(off["queue_wait"]["p99"], on["queue_wait"]["p99"]),
        }
    return result


async def _crowd(watched: "_Watched", options: Overload) -> dict[str, Any]:
    client, (_, others) = watched.client, _gateways(watched.client)
    for gateway in others:
        await client.drain(gateway, 0.0)
    tasks = await watched.submit(
        [task_of(f"crowd-{number}-{time.monotonic_ns()}", SKILL, seconds=options.work_s)
         for number in range(options.runs)]
    )  # fmt: skip
    await watched.started(tasks, 1)
    for gateway in others:
        await client.undrain(gateway)
    return await watched.figures(tasks, waits_of=tasks)


async def _held(watched: "_Watched", options: Overload) -> dict[str, Any]:
    client, (first, others) = watched.client, _gateways(watched.client)
    # A moment of rest: a gateway that received a run lately gives none away.
    await asyncio.sleep(2.5)
    for gateway in others:
        await client.drain(gateway, 0.0)
    long = await watched.submit(
        [task_of(f"long-{number}-{time.monotonic_ns()}", SKILL, seconds=options.long_s, saves_every=SAVES_EVERY)
         for number in range(options.containers)]
    )  # fmt: skip
    await watched.started(long, len(long))
    for gateway in others:
        await client.undrain(gateway)
    short = await watched.submit(
        [task_of(f"short-{number}-{time.monotonic_ns()}", SKILL, group=(first,), seconds=options.short_s)
         for number in range(options.short)]
    )  # fmt: skip
    return await watched.figures([*long, *short], waits_of=short)


def _gateways(client: FleetClient) -> tuple[str, list[str]]:
    """The gateway that the work comes to, and the others."""
    first, *others = sorted(client.plane.members())
    return first, others


class _Watched:
    """Tasks with the moments when a client saw them begin and end."""

    def __init__(self, client: FleetClient) -> None:
        self.client = client
        self._submitted: dict[str, float] = {}
        self._began: dict[str, float] = {}
        self._some = asyncio.Event()
        self._watch = client.plane.session.subscribe_typed(keyspace.RUN_EVENT, self._on_event)

    def _on_event(self, _: str, event: RunEvent | None) -> None:
        if event is not None and event.kind is RunEventKind.STARTED:
            # The first of its starts: a run that is moved does not wait in a queue a second time.
            self._began.setdefault(event.task, time.monotonic())
            self._some.set()

    async def submit(self, requests: Sequence[TaskRequest]) -> list[str]:
        """Hand tasks in, one after the other; returns their ids."""
        for each in requests:
            self._submitted[each.id] = time.monotonic()
            await self.client.submit(each)
        return [each.id for each in requests]

    async def started(self, tasks: Sequence[str], count: int) -> None:
        """Wait until so many of these have begun."""
        try:
            async with asyncio.timeout(PATIENCE_S):
                while sum(task in self._began for task in tasks) < count:
                    self._some.clear()
                    await self._some.wait()
        except TimeoutError:
            raise DeadlineError(f"{count} of {len(tasks)} runs had not begun after {PATIENCE_S:g} s") from None

    async def figures(self, tasks: Sequence[str], *, waits_of: Sequence[str]) -> dict[str, Any]:
        """Wait for all ends, and tell of them."""
        ends = await asyncio.gather(*(self._end(task) for task in tasks))
        begun = min(self._submitted[task] for task in tasks)
        moves = [sum(each.left.startswith("moved from") for each in record.subtasks[0].attempts) for _, record in ends]
        return {
            "makespan_ms": round((max(at for at, _ in ends) - begun) * 1e3, 1),
            "queue_wait": summary([(self._began[task] - self._submitted[task]) * 1e3 for task in waits_of]),
            "runs": len(tasks),
            "moves": sum(moves),
            "most moves of a run": max(moves),
        }

    async def _end(self, task: str) -> tuple[float, TaskRecord]:
        try:
            async with asyncio.timeout(PATIENCE_S):
                record = [each async for each in self.client.watch(task)][-1]
        except TimeoutError:
            raise DeadlineError(f"{task} has not ended after {PATIENCE_S:g} s") from None
        if record.state is not TaskState.SUCCEEDED or task not in self._began:
            raise PoolError(f"{task} {record.state}: {record.failure.message if record.failure else 'never begun'}")
        return time.monotonic(), record

    def close(self) -> None:
        """Watch no more."""
        self._watch.close()


Part = Literal["all", "moves", "overload"]


async def run(
    moves: int = 20, volume_moves: int = 6, megabytes: int = 64, cold: int = 5, *,
    load: Overload | None = None, part: Part = "all", progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure moves with checkpoints of 1 kB and 256 kB and with a volume, the alternative, and an overload.

    Args:
        moves: moves with each size of checkpoint.
        volume_moves: moves with the volume; to a gateway that has none of it, and again.
        megabytes: size of the volume.
        cold: runs that are ended and started again.
        load: what the overload is made of.
        part: only the moves, or only the overload.
        progress: told what is being measured.
    """
    result: dict[str, Any] = {"gateways": GATEWAYS}
    if part != "overload":
        result["megabytes"] = megabytes
        result |= await _all_moves(moves, volume_moves, megabytes, cold, progress)
    if part != "moves":
        result["overload"] = await overloaded(load or Overload(), progress=progress)
    return result


async def _all_moves(
    moves: int, volume_moves: int, megabytes: int, cold: int, progress: Progress
) -> dict[str, Any]:  # fmt: skip
    result: dict[str, Any] = {}
    async with fleet(PoolConfig(floor={"base": 2}), progress=progress) as client:
        for name, size in (("1 kB", 1000), ("256 kB", 255_000)):
            progress(f"migrate: {moves} moves with a checkpoint of {name}")
            result[f"move, checkpoint {name}"] = await _moves(client, SKILL, moves, bytes=size)
        progress(f"migrate: {volume_moves} moves with a volume of {megabytes} MB")
        result[f"move, volume {megabytes} MB"] = await _moves(client, STATEFUL, volume_moves, megabytes=megabytes)
    async with fleet(PoolConfig(mode="cold", floor={}), progress=progress) as client:
        progress(f"migrate: {cold} runs ended and started again")
        result["end, start anew cold"] = summary([await _again(client, number) for number in range(cold)])
    moved = result["move, checkpoint 1 kB"]["took"]
    result["anew / move, p50"] = ratio(result["end, start anew cold"].get("p50"), moved.get("p50"))
    return result


async def _moves(client: FleetClient, skill: str, count: int, **params: Any) -> dict[str, Any]:
    """Move one run `count` times, wherever is closest."""
    task = f"move-{skill.replace('_', '-')}-{time.monotonic_ns()}"
    await client.submit(task_of(task, skill, seconds=3600.0, **params))
    await running(client, task)
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
    await ended(client, task)
    return {
        "took": summary(took),
        **{f"step {step}": summary(times) for step, times in steps.items()},
        "went on from": checkpoints,
    }


async def _again(client: FleetClient, number: int) -> float:
    """End a run that works, hand its task in again; milliseconds from the decision to its first line."""
    task = f"cold-{number}-{time.monotonic_ns()}"
    await client.submit(task_of(task, SKILL, seconds=3600.0))
    await running(client, task)
    began = time.monotonic()
    await client.cancel(task)
    await ended(client, task)
    again = f"{task}-again"
    await client.submit(task_of(again, SKILL, seconds=3600.0))
    await running(client, again)
    took_ms = (time.monotonic() - began) * 1e3
    await client.cancel(again)
    await ended(client, again)
    return took_ms
