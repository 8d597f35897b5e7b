"""How long a start takes when the warm container is on another gateway: two gateways as processes, over Zenoh.

`gw-1` has no container of the image and may not keep one; `gw-2` keeps some warm. Run orders go to `gw-1`, which
finds the container (phase 2) and passes the run on. The figure is measured by the one who ordered, as a
coordinator does: order sent to `started` event received, so it holds the search, both hops and the way back.
The same orders sent to `gw-2` directly are the comparison: what the search and the extra hop cost.
"""

import asyncio
import secrets
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from appliance import local_fleet
from appliance.bench import startup
from appliance.bench.startup import SKILL, summary, write_skill
from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import DeadlineError, PoolError
from appliance.local_fleet import Order
from appliance.model import Need, Phase, RunAccepted, RunEvent, RunEventKind, RunRequest
from appliance.pool.settings import PoolConfig

PAUSE_S = 0.02
"""Between runs, so that the container's state has been told before the next search."""


async def run(count: int, *, image: str, progress: Callable[[str], None]) -> dict[str, Any]:
    """Measure `count` starts each way.

    Returns:
        `federated` and `ordered` (the same without search and extra hop): count, p50, p90, p99, max in ms.

    Raises:
        PoolError: a run did not work, or was served in another phase than the one measured.
    """
    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
        skills = write_skill(Path(folder), image)
        order = Order(
            fleet=f"bench-{secrets.token_hex(4)}",
            directory=Path(folder) / "fleet",
            gateways=2,
            mavlink=0,
            zenoh=0,
            base=GatewayConfig(id="gw-1", skills=(str(skills),)),
            pools={"gw-1": PoolConfig(floor={}), "gw-2": PoolConfig(floor={image: 3}, capacity=3)},
        )
        state = await local_fleet.up(order, progress=progress)
        try:
            async with FleetClient(state.endpoint) as client:
                orders = _Orders(client, image)
                for gateway in ("gw-1", "gw-2"):
                    await orders.measure(gateway, "warm-up")
                direct = [await orders.measure("gw-2", f"d{number}") for number in range(count)]
                remote = [await orders.measure("gw-1", f"r{number}") for number in range(count)]
        finally:
            await local_fleet.down(order.directory, progress=progress)
    for phase, times in ((Phase.LOCAL_WARM, direct), (Phase.REMOTE_WARM, remote)):
        wrong = [found for _, found in times if found is not phase]
        if wrong:
            raise PoolError(f"{len(wrong)} of {count} runs were {wrong[0]}, not {phase}")
    return {"federated": summary([ms for ms, _ in remote]), "ordered": summary([ms for ms, _ in direct])}


async def run_all(count: int, cold: int, *, image: str, progress: Callable[[str], None]) -> dict[str, Any]:
    """Measure cold, local and federated starts in one run on this machine; keys as `startup.run` and `run`."""
    result = await startup.run(count, cold, image=image, progress=progress)
    progress(f"federated: {count} runs in warm containers of another gateway")
    result |= await run(count, image=image, progress=progress)
    if cold:
        result["cold_over_federated"] = round(result["cold"]["p50"] / result["federated"]["p50"], 1)
    return result


class _Orders:
    """Sends run orders and hears of their starts."""

    def __init__(self, client: FleetClient, image: str) -> None:
        self._client = client
        self._need = Need(image=image, cpu=0.1, memory_mb=64)
        self._events: asyncio.Queue[tuple[float, RunEvent]] = asyncio.Queue()
        client.plane.session.subscribe_typed(client.plane.keys.run("bench"), RunEvent, self._take)

    def _take(self, key: str, event: RunEvent | None) -> None:
        del key
        if event is not None:
            self._events.put_nowait((time.monotonic(), event))

    async def measure(self, gateway: str, name: str) -> tuple[float, Phase | None]:
        """Run the skill that does nothing once; returns its start in milliseconds and its phase."""
        request = RunRequest(task="bench", subtask=name, attempt=1, skill=SKILL, need=self._need, deadline_s=10.0)
        request = replace(request, subtask=f"{name}-{gateway}")
        sent = time.monotonic()
        answer = asyncio.ensure_future(self._client.plane.rpc.call(gateway, "run", request, RunAccepted))
        started_ms, phase = 0.0, None
        try:
            async with asyncio.timeout(10):
                while True:
                    at, event = await self._events.get()
                    if event.subtask != request.subtask:
                        continue
                    if event.kind is RunEventKind.STARTED:
                        started_ms, phase = (at - sent) * 1e3, event.phase
                    elif event.kind is RunEventKind.SUCCEEDED:
                        break
                    elif event.kind is RunEventKind.FAILED:
                        raise PoolError(f"{name}: {event.failure.message if event.failure else 'failed'}")
        except TimeoutError:
            raise DeadlineError(f"run {name} on {gateway} told nothing") from None
        finally:
            await asyncio.gather(answer, return_exceptions=True)
        await asyncio.sleep(PAUSE_S)
        return started_ms, phase
