"""What a large preloaded heap costs at a start: forks of a zygote that holds it, in real containers.

Four figures a heap: the fork itself (as the zygote measures it, after each run, ahead of the next order); the start
of a run whose child was forked ahead; the start when the next order comes at once, so that the fork is in its way;
and beside them a plain Python process that loads the same before it can begin. No pool is in between: orders go
straight to the runner's socket, on the connection that a pool would use.
"""

import asyncio
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import anyio

from appliance.errors import PoolError
from appliance.model import RunRequest
from appliance.pool.container import PooledContainer
from appliance.pool.engine import EngineFacts, PodmanEngine, remove_fleet
from appliance.pool.runs import order
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter
from appliance.pool.volumes import ALONE
from appliance.skills.catalogue import load_catalogue
from workshop.bench.figures import summary
from workshop.bench.pooled import SKILL, fleet_name, need_of, write_skill

KINDS = ("objects", "buffers")
REST_S = 0.02
"""Between runs, for the child that is forked ahead to be ready."""
_HANDLER = """
import os


def resident_mb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def preload(ctx):
    size_mb, kind = {size_mb}, "{kind}"
    if kind == "buffers":
        return [bytearray(os.urandom(2**20)) for _ in range(size_mb)]
    held, until = [], resident_mb() + size_mb
    while size_mb and resident_mb() < until:
        held += [{{"id": each, "name": f"place {{each}}", "at": (each * 0.5, each * 2.0)}} for each in range(2000)]
    return held


def run(ctx):
    return {{}}
"""


async def run(
    count: int = 200,
    sizes_mb: Sequence[int] = (0, 50, 200),
    *,
    image: str = "base",
    plain: int = 3,
    config: PoolConfig | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure starts with heaps of Python objects and of large buffers.

    Args:
        count: runs of each kind of start and heap.
        sizes_mb: sizes of the heap, MB.
        image: image of the containers.
        plain: starts of a plain Python process with the same heap.
        config: pool settings to start from.
        progress: told what is being measured.

    Returns:
        `heaps`: for each kind and size `fork`, `ahead`, `at_once` and `python`, each with count, p50, p90, p99 and max
        in milliseconds; `container_ms`, what the container took to be ready; and `rss_mb`.

    Raises:
        PoolError, PrerequisiteError, UnreachableError: a container did not start, or a run did not work.
    """
    heaps: list[dict[str, Any]] = []
    for kind in KINDS:
        for size_mb in sizes_mb:
            progress(f"{size_mb} MB of {kind}: {count} runs, {plain} plain processes")
            handler = _HANDLER.format(size_mb=size_mb, kind=kind)
            figures = await _container(handler, size_mb, count, image, config or PoolConfig())
            python_ms = [await _plain(handler) for _ in range(plain)]
            heaps.append({"kind": kind, "size_mb": size_mb, **figures, "python": summary(python_ms)})
    return {"unit": "ms", "image": image, "heaps": heaps}


async def _container(handler: str, size_mb: int, count: int, image: str, config: PoolConfig) -> dict[str, Any]:
    more = f"preload_mb = {size_mb * 2 + 16}\npreload_s = 60\n"
    fleet = fleet_name()
    engine = PodmanEngine(config.podman_url)
    try:
        with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
            starter = Starter(
                # Loading has its part of the time for a start, and is rehearsed: 200 MB of objects take seconds.
                PoolConfig(start_timeout_s=120.0, podman_url=config.podman_url, runtime=config.runtime),
                gateway="bench",
                fleet=fleet,
                run_dir=Path(folder) / "run",
                data_dir=Path(folder) / "data",
                catalogue=load_catalogue([write_skill(Path(folder), image, handler=handler, more=more)]),
                site={},
                refused=Counter(),
                on_death=lambda _: None,
                state=ALONE,
            )
            await starter.open()
            container = starter.new(image)
            facts: EngineFacts = await engine.facts()
            await starter.start(container, engine, facts)
            try:
                return await _measure(container, image, count)
            finally:
                await starter.remove(container, engine)
    finally:
        engine.close()
        await remove_fleet(fleet, volumes=True, url=config.podman_url)


async def _measure(container: PooledContainer, image: str, count: int) -> dict[str, Any]:
    if reason := container.problems.get(f"preload {SKILL}"):
        raise PoolError(f"the heap was not loaded: {reason}", remedy="see docs/skills.md, Load beforehand")
    ahead_ms: list[float] = []
    fork_ms: list[float] = []
    for number in range(count):
        await anyio.sleep(REST_S)
        ahead_ms.append(await _start(container, image, number))
        fork_ms.append(float((await container.ping(timeout_s=10.0))["fork_ms"]))
    at_once_ms = [await _start(container, image, count + number) for number in range(count)]
    return {
        "fork": summary(fork_ms),
        "ahead": summary(ahead_ms),
        "at_once": summary(at_once_ms),
        "container_ms": round(container.info.cold_ms or 0.0),
        "rss_mb": container.rss_mb,
    }


async def _start(container: PooledContainer, image: str, number: int) -> float:
    """Run once; returns milliseconds from sending the order to the handler's first line."""
    request = RunRequest(
        task="bench", subtask=f"n{number}", attempt=1, skill=SKILL, need=need_of(image), deadline_s=10.0
    )
    began_ns = time.monotonic_ns()
    connection = await container.begin(order(request))
    started_ns, last = 0, ""
    try:
        while (frame := await connection.receive()) is not None:
            started_ns = frame["at"] if frame["ev"] == "started" else started_ns
            last = str(frame.get("message", frame["ev"]))
    finally:
        connection.close()
    if not started_ns or last != "result":
        raise PoolError(f"run {number} did not work: {last or 'it never started'}")
    await container.refill()
    return (started_ns - began_ns) / 1e6


async def _plain(handler: str) -> float:
    """Start a Python process that loads the same first; returns milliseconds to its first line."""
    text = f"{handler}\nimport time\nheld = preload(None)\nprint(time.monotonic_ns())\n"
    began_ns = time.monotonic_ns()
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-S", "-c", text, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    told, problem = await process.communicate()
    if process.returncode != 0:
        raise PoolError(f"a plain process failed: {problem.decode(errors='replace').strip()[-300:]}")
    return (int(told) - began_ns) / 1e6
