"""What a gateway holds of the machine, counted: the figures that must not grow however long it works.

Counted from within the gateway's process, when nothing runs; of Podman, what belongs to one fleet, and the memory of
its service, which other fleets on the machine use as well.
"""

import asyncio
import gc
import os
from pathlib import Path
from typing import Any

import psutil
from msgspec import Struct
from msgspec.structs import asdict

from appliance.pool.engine import LABEL_FLEET, PodmanEngine

SAMPLES = 6
SAMPLE_S = 0.25
"""Probes and pushes come and go in between: the least of a few samples is what stays."""


class Census(Struct, frozen=True, kw_only=True):
    """Counts at one moment of rest; memory in MB."""

    runs: int = 0
    """Runs done by then."""
    containers: int = 0
    conmon: int = 0
    """Podman's monitor processes, one a container."""
    volumes: int = 0
    runner_sockets: int = 0
    """Folders with a runner's socket."""
    descriptors: int = 0
    """Open files of the process, connections among them."""
    children: int = 0
    threads: int = 0
    tasks: int = 0
    """Asyncio tasks."""
    rss_mb: float = 0.0
    podman_rss_mb: float = 0.0
    podman_descriptors: int = 0


COUNTED = ("containers", "conmon", "volumes", "runner_sockets", "descriptors", "children", "threads", "tasks")
"""What must be the same before and after."""
SLACK = {"descriptors": 4, "threads": 4, "tasks": 2}
"""Threads are made when first needed, up to a few, and Podman's have a connection each; a probe may be under way. What
leaks with every run, or with every container, is beyond it after a few hundred runs."""
GROWTH_MB = 8.0
"""Resident memory may grow by so much between a third of the way and the end: allocators keep what they once had."""


async def take(runs: int, *, fleet: str, run_dir: Path, engine: PodmanEngine) -> Census:
    """Count, when the gateway in this process rests."""
    gc.collect()
    own = psutil.Process()
    found: list[tuple[int, int, int, int]] = []
    for _ in range(SAMPLES):
        found.append(
            (
                len(os.listdir("/proc/self/fd")),  # noqa: PTH208 - counted, not opened
                len(await asyncio.to_thread(own.children)),
                own.num_threads(),
                len(asyncio.all_tasks()),
            )
        )
        await asyncio.sleep(SAMPLE_S)
    descriptors, children, threads, tasks = (min(each) for each in zip(*found, strict=True))
    service = await asyncio.to_thread(podman_service)
    return Census(
        runs=runs,
        containers=len(await engine.containers({LABEL_FLEET: fleet})),
        conmon=await asyncio.to_thread(conmons, fleet),
        volumes=await volumes(fleet),
        runner_sockets=await asyncio.to_thread(lambda: sum(1 for _ in run_dir.glob("*/runner.sock"))),
        descriptors=descriptors,
        children=children,
        threads=threads,
        tasks=tasks,
        rss_mb=round(own.memory_info().rss / 2**20, 1),
        podman_rss_mb=round(service.memory_info().rss / 2**20, 1) if service else 0.0,
        podman_descriptors=service.num_fds() if service else 0,
    )


def conmons(fleet: str) -> int:
    """Return how many monitor processes a fleet's containers have; they know their container's name."""
    count = 0
    for process in psutil.process_iter(["name", "cmdline"]):
        line: list[str] = process.info["cmdline"] or []
        count += process.info["name"] == "conmon" and any(each.startswith(f"swiftbot-{fleet}-") for each in line)
    return count


async def volumes(fleet: str) -> int:
    """Return how many volumes a fleet has."""
    process = await asyncio.create_subprocess_exec(
        "podman", "volume", "ls", "--quiet", "--filter", f"label={LABEL_FLEET}={fleet}",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    told, _ = await process.communicate()
    return len(told.split())


def podman_service() -> psutil.Process | None:
    """Return the process that serves this user's API socket, if there is one."""
    for process in psutil.process_iter(["name", "cmdline", "uids"]):
        line: list[str] = process.info["cmdline"] or []
        ours = process.info["name"] == "podman" and process.info["uids"].real == os.getuid()
        if ours and line[1:3] == ["system", "service"]:
            return process
    return None


def compare(counts: list[Census]) -> dict[str, Any]:
    """Return what leaked, by comparing the last census with the first, and whether memory is flat from a third on.

    The first one is taken after the first runs, when everything that is made once has been made.
    """
    first, last = counts[0], counts[-1]
    before, after = asdict(first), asdict(last)
    grown = {name: after[name] - before[name] for name in COUNTED}
    leaks = {name: more for name, more in grown.items() if more > SLACK.get(name, 0)}
    settled = next(each for each in counts if each.runs >= last.runs / 3)
    growth_mb = round(last.rss_mb - settled.rss_mb, 1)
    return {
        "before": before,
        "after": after,
        "leaks": leaks,
        "rss_growth_mb": growth_mb,
        "rss_growth_from_runs": settled.runs,
        "podman_rss_growth_mb": round(last.podman_rss_mb - settled.podman_rss_mb, 1),
        "flat": growth_mb <= GROWTH_MB,
    }
