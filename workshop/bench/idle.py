"""What gateways that have nothing to do cost: resident memory and CPU of the daemons, without a language model.

Real gateway processes with an empty pool (their containers cost memory by what runs in them), and their recorder beside
them as it would be; measured from outside once they know each other.
"""

import asyncio
import tempfile
from pathlib import Path
from typing import Any

import psutil
from msgspec import Struct

from appliance.config import GatewayConfig
from appliance.llm.settings import LlmConfig
from appliance.pool.settings import PoolConfig
from workshop.bench.chaos.arena import Arena, Progress, loopback
from workshop.bench.pooled import fleet_name

GOAL_MB = 150.0
CALM_S = 5.0
"""What is done once after a start, reading catalogues and the like, is over by then."""


class Options(Struct, frozen=True, kw_only=True):
    """What to measure."""

    gateways: tuple[int, ...] = (1, 3)
    seconds: float = 20.0


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure fleets of these sizes, one after the other; all processes have ended afterwards.

    Returns:
        For each size, of the gateway that takes most: `rss_mb`, `cpu_percent` of a core, `threads`, `descriptors`.
    """
    result: dict[str, Any] = {"goal_mb": GOAL_MB, "seconds": options.seconds}
    for count in options.gateways:
        result[f"gateways_{count}"] = await _measure(count, options.seconds, progress)
    return result


async def _measure(count: int, seconds: float, progress: Progress) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
        arena = Arena(
            fleet=fleet_name(), directory=Path(folder), sites=loopback(count),
            base=GatewayConfig(id="gw-1", llm=LlmConfig(tiers=("rules",)), drain_s=5.0),
            pool=PoolConfig(mode="cold", floor={}, capacity=4),
        )  # fmt: skip
        try:
            await arena.start_all(progress=progress, ready=0)
            await asyncio.sleep(CALM_S)
            progress(f"{count} gateways idle for {seconds:g} s")
            found = [psutil.Process(each.pid) for each in arena.processes.values()]
            before = [_cpu_s(each) for each in found]
            await asyncio.sleep(seconds)
            used = [_cpu_s(each) - was for each, was in zip(found, before, strict=True)]
            return {
                "rss_mb": round(max(each.memory_info().rss for each in found) / 2**20, 1),
                "cpu_percent": round(max(used) / seconds * 100, 2),
                "threads": max(each.num_threads() for each in found),
                "descriptors": max(each.num_fds() for each in found),
            }
        finally:
            await arena.stop(progress=progress)


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system
