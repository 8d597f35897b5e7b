"""How long a start takes as the one who orders it sees it: four gateways as processes, over Zenoh.

    gw-1  has no container and no room for one: it must find one elsewhere (`federated`, phase 2: run there)
    gw-2  keeps two warm: what is ordered there runs there (`ordered`)
    gw-3  keeps one warm
    gw-4  makes a new one for each run (`cold_ordered`)

From sending the order to the `started` event received, as a coordinator does it. `ordered` beside `federated` shows
what the search and the extra hop cost.
"""

import asyncio
from typing import Any

from appliance.errors import PoolError
from appliance.model import Phase
from appliance.pool.settings import PoolConfig
from workshop.bench import actors, fleet, startup
from workshop.bench.figures import cdf, ratio, summary
from workshop.bench.fleet import Progress
from workshop.bench.pooled import PAUSE_S


async def run(count: int, cold: int, *, image: str, progress: Progress) -> dict[str, Any]:
    """Measure `count` warm starts each way, and `cold` cold ones.

    Returns:
        `federated`, `ordered`, `cold_ordered`: count, p50, p90, p99, max in ms; `cdf` of each.

    Raises:
        PoolError: a run did not work, or was served in another phase than the one measured.
    """
    pools = {
        "gw-1": PoolConfig(floor={}, memory_mb=64),
        "gw-2": PoolConfig(floor={image: 2}, capacity=2),
        "gw-3": PoolConfig(floor={image: 1}, capacity=1),
        "gw-4": PoolConfig(floor={}, mode="cold"),
    }
    ways = (
        ("ordered", "gw-2", count, Phase.LOCAL_WARM),
        ("federated", "gw-1", count, Phase.REMOTE_WARM),
        ("cold_ordered", "gw-4", cold, Phase.COLD),
    )
    times: dict[str, list[float]] = {}
    async with fleet.running(pools, image=image, progress=progress) as (_, orders):
        for gateway in ("gw-1", "gw-2"):
            await orders.run(gateway)  # pays for what is made the first time
        for name, gateway, number, phase in ways:
            progress(f"{name}: {number} runs ordered at {gateway}")
            times[name] = [await _measure(orders, gateway, phase) for _ in range(number)]
    result: dict[str, Any] = {name: summary(each) for name, each in times.items()}
    return result | {"cdf": {name: cdf(each) for name, each in times.items()}}


async def _measure(orders: fleet.Orders, gateway: str, phase: Phase) -> float:
    outcome = await orders.run(gateway)
    if outcome.problem or outcome.phase != phase.value:
        raise PoolError(f"a run ordered at {gateway} was {outcome.problem or outcome.phase}, not {phase}")
    await asyncio.sleep(PAUSE_S)  # the container's state is published before the next search
    return outcome.started_ms


async def run_all(count: int, cold: int, *, image: str, ray: bool, progress: Progress) -> dict[str, Any]:
    """Measure cold, local and federated starts and Ray's actors, in one run on this machine.

    Returns:
        What `startup.run`, `run` and (as `ray`) `actors.run` return, and the ratios of the medians.
    """
    result = await startup.run(count, cold, image=image, progress=progress)
    there = await run(count, cold, image=image, progress=progress)
    result["cdf"] |= there.pop("cdf")
    result |= there
    result["cold_over_federated"] = ratio(result["cold_ordered"].get("p50"), result["federated"].get("p50"))
    if ray:
        result["ray"] = await actors.run(count, cold, progress=progress)
        result |= actors.compare(result)
    return result
