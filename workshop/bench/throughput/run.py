"""Trivial subtasks through a fleet of four gateways, as many as it can, and what happens when a worker is killed.

A closed loop: so many subtasks are wanted at any time. They come as tasks of four that do not depend on each other,
handed in with their plan, each of which is a record in the DHT, placed, run in a warm container, and written to its end
before it counts. Ray's tasks beside it are function calls in worker processes of one machine: no records, no isolation.
"""

import asyncio
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from msgspec import Struct

from appliance.client import FleetClient
from appliance.errors import DeadlineError, PoolError, SwiftbotError
from appliance.model import Plan, Subtask, SubtaskState, TaskRecord, TaskRequest, TaskState, keyspace
from appliance.pool.settings import PoolConfig
from workshop.bench import actors
from workshop.bench.chaos.arena import Arena, Progress, loopback
from workshop.bench.figures import ratio, summary
from workshop.bench.pooled import fleet_name, write_skill
from workshop.bench.throughput.sampled import FILE

SKILL = "bench_nothing"
RECOVER = "bench_recover"
WIDTH = 4
"""Subtasks of a task; none waits for another."""
WARM_UP_S = 2.0
PATIENCE_S = 60.0
_RECOVER = """
import time


def run(ctx):
    if ctx.attempt == 1:
        time.sleep(60)
    return {"attempt": ctx.attempt}
"""


class Options(Struct, frozen=True, kw_only=True):
    """What is measured."""

    gateways: int = 4
    containers: int = 3
    """Kept ready by each gateway."""
    parallel: tuple[int, ...] = (1, 4, 8, 16, 32)
    """Subtasks wanted at any time; one measurement each."""
    seconds: float = 8.0
    kills: int = 5
    ray: bool = True
    profile: bool = True


@asynccontextmanager
async def _fleet(options: Options, *, progress: Progress) -> AsyncGenerator[tuple[Arena, FleetClient]]:
    folder = _folder()
    skills = write_skill(folder, "base", handler="def run(ctx):\n    return {}\n")
    write_skill(folder, "base", skill=RECOVER, handler=_RECOVER)
    arena = Arena(
        fleet=fleet_name(),
        directory=folder,
        sites=loopback(options.gateways),
        pool=PoolConfig(floor={"base": options.containers}, capacity=options.containers + 1),
        skills=skills,
        command=(sys.executable, "-m", "workshop.bench.throughput.sampled")
        if options.profile
        else (sys.executable, "-m", "appliance.cli", "gateway", "--config"),
        recorder=False,
    )
    try:
        await arena.start_all(progress=progress, ready=options.containers)
        async with await arena.client() as client:
            yield arena, client
    finally:
        await arena.stop(progress=progress)


def _folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="swiftbot-throughput-"))


class Load:
    """Tasks handed in and followed to their ends."""

    def __init__(self, client: FleetClient) -> None:
        self._client = client
        self._open: dict[str, asyncio.Future[TaskRecord]] = {}
        self._number = 0
        self._prefix = f"b{os.getpid()}-{time.monotonic_ns() % 100_000}-"
        plane = client.plane
        plane.session.subscribe_typed(keyspace.TASK_UPDATE, self._told)

    def _told(self, key: str, record: TaskRecord | None) -> None:
        del key
        waiting = self._open.get(record.id) if record is not None else None
        if record is not None and record.state.final and waiting is not None and not waiting.done():
            waiting.set_result(record)

    async def one(self, width: int, skill: str = SKILL) -> TaskRecord:
        """Hand a task in and wait for its end.

        Raises:
            PoolError: it did not succeed.
            DeadlineError: it has not ended after a minute.
        """
        self._number += 1
        task = f"{self._prefix}{self._number}"
        plan = Plan(
            domain="coordination", subtasks=tuple(Subtask(id=f"s{each + 1}", skill=skill) for each in range(width))
        )
        waiting: asyncio.Future[TaskRecord] = asyncio.get_running_loop().create_future()
        self._open[task] = waiting
        try:
            await self._client.submit(TaskRequest(instruction="do nothing", id=task, plan=plan))
            async with asyncio.timeout(PATIENCE_S):
                record = await waiting
        except TimeoutError:
            raise DeadlineError(f"task {task} has not ended after {PATIENCE_S:g} s") from None
        finally:
            del self._open[task]
        if record.state is not TaskState.SUCCEEDED:
            raise PoolError(f"task {task} has {record.state}: {record.failure.message if record.failure else '?'}")
        return record

    async def flood(self, parallel: int, seconds: float) -> dict[str, Any]:
        """Keep so many subtasks wanted for a while; returns how many ended a second, and how long tasks took."""
        width = min(WIDTH, parallel)
        begin = time.monotonic() + WARM_UP_S
        end = begin + seconds
        took: list[float] = []
        ended = 0
        startup: list[float] = []

        async def keep_going() -> None:
            nonlocal ended
            while (sent := time.monotonic()) < end:
                record = await self.one(width)
                now = time.monotonic()
                if begin <= now < end:
                    ended += width
                    took.append((now - sent) * 1e3)
                    startup.extend(each.startup_ms for each in record.subtasks if each.startup_ms is not None)

        async with asyncio.TaskGroup() as group:
            for _ in range(parallel // width):
                group.create_task(keep_going())
        return {"subtasks_per_s": round(ended / seconds, 1), "task": summary(took), "startup": summary(startup)}


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure throughput, the profile, recovery after kills, and Ray's throughput and recovery.

    Returns:
        `throughput` by parallelism; `recovery`: kill of a worker to the end of its task, ms; `profile` by gateway;
        `ray` the same two, or `missing`; `against_ray`: ratios.

    Raises:
        PoolError, DeadlineError: something did not work.
    """
    throughput: dict[str, Any] = {}
    async with _fleet(options, progress=progress) as (arena, client):
        load = Load(client)
        for _ in range(2 * options.gateways):
            await load.one(WIDTH)  # pays for what is made the first time
        for parallel in options.parallel:
            throughput[str(parallel)] = await load.flood(parallel, options.seconds)
            progress(f"{parallel} at a time: {throughput[str(parallel)]['subtasks_per_s']} subtasks/s")
        recovery = [await _kill_worker(load, client) for _ in range(options.kills)]
        progress(f"recovery: {', '.join(f'{each:.0f}' for each in recovery)} ms")
    result: dict[str, Any] = {
        "gateways": options.gateways,
        "containers_per_gateway": options.containers,
        "throughput": throughput,
        "recovery": summary(recovery),
    }
    if options.profile:
        result["profile"] = _profiles(arena)
    shutil.rmtree(arena.directory, ignore_errors=True)
    if options.ray:
        result["ray"] = await _ray(options, progress=progress)
        result |= _compare(result)
    return result


def _profiles(arena: Arena) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in arena.names:
        path = arena.directory / name / "data" / FILE
        found[name] = json.loads(path.read_bytes()) if path.exists() else {"missing": "it was not ended in time"}
    return found


async def _kill_worker(load: Load, client: FleetClient) -> float:
    """Kill the container in which a subtask runs; returns milliseconds from then to the end of its task."""
    running: asyncio.Queue[TaskRecord] = asyncio.Queue()
    plane = client.plane

    def told(key: str, record: TaskRecord | None) -> None:
        del key
        if record is not None and any(
            each.state is SubtaskState.RUNNING and each.attempt == 1 and each.subtask.skill == RECOVER
            for each in record.subtasks
        ):
            running.put_nowait(record)

    closer = plane.session.subscribe_typed(keyspace.TASK_UPDATE, told)
    ending = asyncio.create_task(load.one(1, RECOVER))
    try:
        async with asyncio.timeout(PATIENCE_S):
            container = (await running.get()).subtasks[0].container
        pid = await _pid_of(container)
        killed = time.monotonic()
        os.kill(pid, signal.SIGKILL)
        await ending
        return (time.monotonic() - killed) * 1e3
    finally:
        closer.close()
        ending.cancel()


async def _pid_of(container: str) -> int:
    """Return the process id of a container's first process, as the machine sees it."""
    process = await asyncio.create_subprocess_exec(
        "podman", "ps", "--filter", f"label=swiftbot.id={container}", "--format", "{{.Pid}}",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    out, problem = await process.communicate()
    if process.returncode or not out.strip().isdigit():
        raise PoolError(f"container {container}: {problem.decode(errors='replace')[:200]}")
    return int(out)


async def _ray(options: Options, *, progress: Progress) -> dict[str, Any]:
    python = actors.find_python()
    if python is None:
        progress(f"Ray is not installed: {actors.REMEDY}")
        return {"missing": "Ray is not installed", "remedy": actors.REMEDY}
    progress("Ray: the same")
    with tempfile.TemporaryDirectory(prefix="swiftbot-ray-") as folder:
        arguments = ("throughput", str(options.seconds), str(options.kills), folder, *map(str, options.parallel))
        async with actors.side(python, arguments, folder) as process:
            wait_s = actors.WAIT_S + (options.seconds + 5.0) * len(options.parallel) + 20.0 * options.kills
            found = {each: await actors.line(process, each, wait_s) for each in ("ready", "throughput", "recovery")}
    return {
        "version": found["ready"]["version"],
        "throughput": {name: {"tasks_per_s": round(rate, 1)} for name, rate in found["throughput"]["rates"].items()},
        "recovery": summary(found["recovery"]["times_ms"]),
    }


def _compare(result: dict[str, Any]) -> dict[str, Any]:
    ray: dict[str, Any] = result["ray"]
    if "throughput" not in ray:
        return {}
    return {
        "against_ray": {
            "recovery_ours_over_ray": ratio(result["recovery"].get("p50"), ray["recovery"].get("p50")),
            **{
                f"throughput_ours_over_ray_at_{parallel}": ratio(
                    ours["subtasks_per_s"], ray["throughput"].get(parallel, {}).get("tasks_per_s")
                )
                for parallel, ours in result["throughput"].items()
            },
        }
    }


def parallels(asked: Sequence[int]) -> tuple[int, ...]:
    """Return parallelisms that can be had: below the width any, from it on whole tasks."""
    for each in asked:
        if each < 1 or (each > WIDTH and each % WIDTH):
            raise SwiftbotError(f"{each} at a time", remedy=f"use 1 to {WIDTH}, or a multiple of {WIDTH}")
    return tuple(asked)
