"""How fast a pool fills: from empty to N ready containers, by how many are started at the same time."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from msgspec.structs import replace

from appliance.pool.settings import PoolConfig
from workshop.bench import pooled


async def run(
    containers: int = 8,
    at_once: Sequence[int] = (1, 2, 4),
    *,
    image: str = "base",
    config: PoolConfig | None = None,
    progress: Callable[[str], None],
) -> dict[str, Any]:
    """Fill a pool of `containers` with so many starts `at_once` each.

    Returns:
        By `starts_at_once`: `filled_s` from the pool's start (its connection to Podman included) to the last
        container ready, `first_s` to the first, `containers_per_s`, and `podman_requests` per container.

    Raises:
        PrerequisiteError: containers do not start.
    """
    config = config or PoolConfig()
    result: dict[str, Any] = {"containers": containers, "image": image, "default": config.starts_at_once}
    for starts in at_once:
        progress(f"refill: {containers} containers, {starts} at once")
        engine = pooled.WatchedEngine(config.podman_url)
        filling = replace(
            config,
            mode="local",
            floor={image: containers},
            capacity=containers,
            memory_mb=max(config.memory_mb, containers * config.container_memory_mb),
            starts_at_once=starts,
        )
        began = time.monotonic()
        async with pooled.pool(filling, image, make_engine=lambda engine=engine: engine) as it:
            await pooled.warm(it, image, 1)
            first_s = time.monotonic() - began
            await pooled.warm(it, image, containers)
            filled_s = time.monotonic() - began
            requests = engine.requests.total()
        result[f"starts_at_once_{starts}"] = {
            "filled_s": round(filled_s, 3),
            "first_s": round(first_s, 3),
            "containers_per_s": round(containers / filled_s, 2),
            "podman_requests": round(requests / containers, 2),
        }
    return result
