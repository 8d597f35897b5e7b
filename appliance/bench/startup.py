"""How long a subtask waits for its handler's first line: a new container against a warm one.

Cold is not made worse than it has to be: the same image, runner, mounts and hardening as the warm containers,
made by the same code through the same API (`mode = "cold"`), one at a time, each removed afterwards. The figure
in both cases is `started.at - entry of Pool.run`, both CLOCK_MONOTONIC of this machine; `federated` measures runs on
another gateway.
"""

import asyncio
import math
import secrets
import tempfile
import time
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
from msgspec.structs import replace

from appliance.errors import PoolError, PrerequisiteError
from appliance.model import ContainerState, Need, RunEvent, RunEventKind, RunRequest, Site
from appliance.pool.pool import Call, Pool
from appliance.pool.selection import Candidate
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import image_reference, load_catalogue

WARM_UP_S = 60.0
SKILL = "bench_nothing"
_MANIFEST = """
id = "bench_nothing"
domain = "coordination"
summary = "Do nothing, to measure how long it takes to begin."
runs = "compute"
image = "{image}"
cpu = 0.1
memory_mb = 64
"""
Progress = Callable[[str], None]


def summary(times_ms: Sequence[float]) -> dict[str, Any]:
    """Return count, p50, p90, p99 (nearest rank) and max of startups, milliseconds."""
    ordered = sorted(times_ms)

    def at(part: float) -> float:
        return round(ordered[max(0, math.ceil(part * len(ordered)) - 1)], 3)

    if not ordered:
        return {"count": 0}
    return {"count": len(ordered), "p50": at(0.5), "p90": at(0.9), "p99": at(0.99), "max": round(ordered[-1], 3)}


async def run(
    count: int = 100,
    cold: int = 5,
    *,
    image: str = "base",
    config: PoolConfig | None = None,
    progress: Progress = lambda _: None,
) -> dict[str, Any]:
    """Measure startup, cold and warm, in one run on this machine.

    Args:
        count: warm runs.
        cold: cold runs; each makes a container.
        image: image of the containers.
        config: pool settings to start from.
        progress: told what is being measured.

    Returns:
        For `podman_run`, `cold` and `local`: count, p50, p90, p99, max in milliseconds; and the ratios of the
        medians to `local`.

    Raises:
        PrerequisiteError: Podman or the image is not there.
        PoolError: a run did not work.
    """
    config = config or PoolConfig()
    progress(f"podman run: {cold} times {image}")
    podman_ms = [await _podman_run(image_reference(image)) for _ in range(cold)]
    progress(f"cold: {cold} new containers of {image}")
    async with _pool(replace(config, mode="cold", floor={}), image) as pool:
        cold_ms = [await _startup(pool, image, number) for number in range(cold)]
    progress(f"local: {count} runs in warm containers")
    async with _pool(replace(config, mode="local", floor={image: 2}, capacity=2), image) as pool:
        await _warm(pool, image, 2)
        await _startup(pool, image, count)  # the first one pays for lazy imports on this side
        local_ms = [await _startup(pool, image, number) for number in range(count)]
    result: dict[str, Any] = {
        "unit": "ms",
        "image": image,
        "podman_run": summary(podman_ms),
        "cold": summary(cold_ms),
        "local": summary(local_ms),
    }
    if cold_ms and local_ms:
        result["podman_run_over_local"] = round(result["podman_run"]["p50"] / result["local"]["p50"], 1)
        result["cold_over_local"] = round(result["cold"]["p50"] / result["local"]["p50"], 1)
    return result


async def _podman_run(reference: str) -> float:
    """What a user would do without a pool: `podman run` of the image, to the first line of a Python program."""
    began_ns = time.monotonic_ns()
    process = await asyncio.create_subprocess_exec(
        "podman", "run", "--rm", "--network", "none", "--read-only", "--cap-drop", "all", reference,
        "python3", "-c", "import time; print(time.monotonic_ns())",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    told, problem = await process.communicate()
    if process.returncode != 0:
        raise PrerequisiteError(
            f"podman run failed: {problem.decode(errors='replace').strip()[-300:]}", remedy="swiftbot doctor tells more"
        )
    return (int(told) - began_ns) / 1e6


def write_skill(folder: Path, image: str) -> Path:
    """Write the skill that does nothing; returns the folder of skills it is in."""
    skill = folder / "skills" / SKILL
    skill.mkdir(parents=True)
    (skill / "skill.toml").write_text(_MANIFEST.format(image=image))
    (skill / "handler.py").write_text("def run(ctx):\n    return {}\n")
    return skill.parent


@asynccontextmanager
async def _pool(config: PoolConfig, image: str) -> AsyncGenerator[Pool]:
    """A pool of its own fleet, with a skill that does nothing, gone afterwards."""

    async def nobody(need: Need) -> list[Candidate]:
        del need
        return []

    async def nothing(call: Call) -> dict[str, Any]:
        raise PoolError(f"{call.name} is not served here")

    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
        skills = write_skill(Path(folder), image)
        pool = Pool(
            config,
            gateway="bench",
            fleet=f"bench-{secrets.token_hex(4)}",
            run_dir=Path(folder) / "run",
            catalogue=load_catalogue([skills]),
            site=Site(),
            find_remote=nobody,
            on_call=nothing,
            on_change=lambda _: None,
        )
        await pool.start()
        try:
            if pool.problem:
                raise PrerequisiteError(pool.problem, remedy="swiftbot doctor tells more")
            yield pool
        finally:
            await pool.stop(keep_containers=False)


async def _warm(pool: Pool, image: str, count: int) -> None:
    until = time.monotonic() + WARM_UP_S
    while sum(each.state is ContainerState.READY and each.image == image for each in pool.containers()) < count:
        if time.monotonic() > until or pool.problem:
            raise PrerequisiteError(pool.problem or f"{count} containers of {image} did not start in {WARM_UP_S:g} s")
        await anyio.sleep(0.02)


async def _startup(pool: Pool, image: str, number: int) -> float:
    """Run the skill that does nothing once; returns its startup in milliseconds."""
    need = Need(image=image, cpu=0.1, memory_mb=64)
    request = RunRequest(task="bench", subtask=f"n{number}", attempt=1, skill=SKILL, need=need, deadline_s=10.0)
    started: list[float] = []

    def note(event: RunEvent) -> None:
        if event.kind is RunEventKind.STARTED and event.startup_ms is not None:
            started.append(event.startup_ms)

    decision = await pool.select(need, allow_remote=False)
    final = await pool.run(request, decision, note)
    if final.kind is not RunEventKind.SUCCEEDED or not started:
        reason = final.failure.message if final.failure else "it never started"
        raise PoolError(f"run {number} did not work: {reason}")
    return started[0]
