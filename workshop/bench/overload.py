"""What moves by overload are good for: the same work on four real gateways with and without them, in one run.

`crowd`: all runs come while one gateway alone takes any; the others join then. Runs that merely wait are passed on by
their gateway whether moves are on or off (`tasks.elsewhere`), so there is little left for moves to do.

`held`: long runs, which could be anywhere, have all containers of one gateway when short ones come that may run only
there (their submitter says so, as for what needs that gateway's devices). Nobody can pass those on; only moving away
what works, with its checkpoint, makes room for them.

Waits are from handing a task in to the first line of its handler, the makespan from the first task handed in to the end
of the last, both as a client of the fleet sees them.
"""

import asyncio
import time
from collections.abc import Sequence
from typing import Any

from msgspec import Struct

from appliance.client import FleetClient
from appliance.errors import DeadlineError, PoolError
from appliance.model import RunEvent, RunEventKind, TaskRecord, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig
from appliance.tasks.settings import MigrationConfig
from workshop.bench.figures import ratio, summary
from workshop.bench.moving import PATIENCE_S, SKILL, Progress, fleet, task_of

SAVES_EVERY = 25
"""Steps of 20 ms between the checkpoints of the long runs."""


class Options(Struct, frozen=True, kw_only=True):
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


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
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


async def _crowd(watched: "_Watched", options: Options) -> dict[str, Any]:
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


async def _held(watched: "_Watched", options: Options) -> dict[str, Any]:
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
        self._watch = client.plane.session.subscribe_typed(client.plane.keys.run(), RunEvent, self._on_event)

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
