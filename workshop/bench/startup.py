"""How long a subtask waits for its handler's first line in one gateway: a new container against a warm one.

Cold is not made worse than it has to be: the same image, runner, mounts and hardening as the warm containers,
made by the same code through the same API (`mode = "cold"`), one at a time, each removed afterwards. The figure
in both cases is from asking the pool for a container to the handler's first line, both CLOCK_MONOTONIC of this
machine; `federated` measures runs on other gateways, `actors` the same work in Ray.
"""

import asyncio
import time
from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from appliance.errors import PrerequisiteError
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import image_reference
from workshop.bench import pooled
from workshop.bench.figures import cdf, ratio, summary

Progress = Callable[[str], None]


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
        For `podman_run`, `cold`, `local` and `local_round_trip` (to the result): count, p50, p90, p99, max in
        milliseconds; `cdf` of the same; `podman_requests_meanwhile` by kind, and `podman_calls_per_warm_run` without
        the keeper's sweep, which comes by the clock; and the ratios of the medians to `local`.

    Raises:
        PrerequisiteError: Podman or the image is not there.
        PoolError: a run did not work.
    """
    config = config or PoolConfig()
    progress(f"podman run: {cold} times {image}")
    podman_ms = [await _podman_run(image_reference(image)) for _ in range(cold)]
    progress(f"cold: {cold} new containers of {image}")
    async with pooled.pool(replace(config, mode="cold", floor={}), image) as it:
        cold_ms = [(await pooled.once(it, image, number)).start_ms for number in range(cold)]
    progress(f"local: {count} runs in warm containers")
    engine = pooled.WatchedEngine(config.podman_url)
    # None is replaced while they are measured, so that Podman is asked for nothing but what a warm run needs.
    warm_pool = replace(config, mode="local", floor={image: 2}, capacity=2, max_runs=count + 10)
    async with pooled.pool(warm_pool, image, make_engine=lambda: engine) as it:
        await pooled.warm(it, image, 2)
        await pooled.once(it, image, count)  # the first one pays for lazy imports on this side
        before = engine.requests.copy()
        local: list[pooled.Took] = []
        for number in range(count):
            await asyncio.sleep(pooled.PAUSE_S)
            local.append(await pooled.once(it, image, number))
        asked = engine.requests - before
    times = {
        "podman_run": podman_ms,
        "cold": cold_ms,
        "local": [each.start_ms for each in local],
        "local_round_trip": [each.round_trip_ms for each in local],
    }
    result: dict[str, Any] = {"unit": "ms", "image": image}
    result |= {name: summary(each) for name, each in times.items()}
    result["cdf"] = {name: cdf(each) for name, each in times.items()}
    result["podman_requests_meanwhile"] = dict(asked)
    result["podman_calls_per_warm_run"] = round((asked.total() - asked[pooled.SWEEP]) / count, 3) if count else None
    for name in ("podman_run", "cold"):
        result[f"{name}_over_local"] = ratio(result[name].get("p50"), result["local"].get("p50"))
    return result


async def _podman_run(reference: str) -> float:
    """What a user would do without a pool: `podman run` of the image, to the first line of a Python program."""
    began_ns = time.monotonic_ns()
    process = await asyncio.create_subprocess_exec(
        "podman", "run", "--rm", "--network", "none", "--read-only", "--cap-drop", "all", reference,
        "python3", "-c", "import time; print(time.monotonic_ns())",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        told, problem = await process.communicate()
    except asyncio.CancelledError:
        await process.wait()  # it is half a second from its end, and removes its own container
        raise
    if process.returncode != 0:
        raise PrerequisiteError(
            f"podman run failed: {problem.decode(errors='replace').strip()[-300:]}", remedy="swiftbot doctor tells more"
        )
    return (int(told) - began_ns) / 1e6
