"""The planner under load: instructions arrive at one gateway at a fixed rate, whether others are answered or not.

A real gateway in a process of its own is asked over the key space, as operators' tools ask. Every instruction ends in a
plan, in a clear answer that there is none, or in a refusal with the time after which to ask again; what ends in nothing
is lost, and there must be none. Latency is the client's, from when the instruction was due.
"""

import asyncio
import secrets
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import ConfigError, PlanError, RefusedError, SwiftbotError
from appliance.llm.settings import LlmConfig
from appliance.model import PlannerStatus, keyspace
from appliance.model.task_api import PlanAsk
from appliance.pool.settings import PoolConfig
from workshop import local_fleet
from workshop.bench.figures import summary
from workshop.local_fleet import Order

Progress = Callable[[str], None]
PATIENCE_S = 30.0
"""An instruction that has no answer by then is lost."""
INSTRUCTIONS = (
    "go to dock {dock} and wait {n} seconds",
    "go to dock {dock}, wait {n} seconds, then photograph the shelf",
    "fetch the red box from dock {dock} and bring it to the shelf, then wait {n} seconds",
    "photograph the shelf, wait {n} seconds, then return home",
    "go to the aisle, film the shelf for {n} seconds, then return home",
    "go to dock {dock}, count the pallets there, wait {n} seconds, and tell me how many",
    "what is love, {n} times",
    "wait {n} seconds, then go to goal 1 and photograph the door",
    "pick the red box at dock {dock}, place it on the shelf, then wait {n} seconds and notify the operator",
    "photograph the door and wait {n} seconds",
)
"""Plain orders of two to six subtasks and one that is none; a number makes each new, so that no cache answers."""


class Told(Struct, frozen=True, kw_only=True):
    """What became of one instruction."""

    kind: str
    """`plan`, `no plan`, `refused`, or why it was lost."""
    ms: float
    why: str = ""
    retry_after_s: float = 0.0


async def run(
    *,
    rate: float = 20.0,
    seconds: float = 60.0,
    model: str = "",
    config: LlmConfig | None = None,
    progress: Progress = lambda _: None,
) -> dict[str, Any]:
    """Ask one gateway `rate` times a second.

    Args:
        rate: instructions a second.
        seconds: for how long.
        model: folder of a local model; empty: the rules alone.
        config: of the planner; by default the product's own.
        progress: told how far it is.

    Returns:
        `asked`; how many ended how (`plans`, `no_plan`, `refused` with the reasons, `lost`); latency by kind; the
        gateway's own figures after it.

    Raises:
        ConfigError: a rate or time that cannot be measured.
    """
    if not (0 < rate <= 1000 and 0 < seconds <= 3600):
        raise ConfigError("rate is 1 to 1000 instructions a second, for at most an hour")
    llm = replace(config or LlmConfig(), local_model=model)
    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
        order = Order(
            fleet=f"bench-{secrets.token_hex(4)}",
            directory=Path(folder) / "fleet",
            gateways=1,
            mavlink=0,
            zenoh=1,
            base=GatewayConfig(id="gw-1", llm=llm),
            pool=PoolConfig(capacity=1, floor={}),
        )
        state = await local_fleet.up(order, progress=progress)
        try:
            async with FleetClient(state.endpoint) as client:
                gateway = await client.gateway()
                if model:
                    await _until_ready(client, gateway)
                told = await _offer(client, gateway, rate=rate, seconds=seconds, progress=progress)
                await asyncio.sleep(2.5)  # its status is published every two seconds
                known = client.plane.registry.gateways.get(gateway)
        finally:
            await local_fleet.down(order.directory, progress=progress, volumes=True)
    return account(told, rate=rate, seconds=seconds) | {
        "tier": "local" if model else "rules",
        "planner": known.planner if known is not None else None,
        "memory_mb": known.memory_mb if known is not None else None,
    }


def account(told: Sequence[Told], *, rate: float, seconds: float) -> dict[str, Any]:
    """Return what became of all instructions. Pure."""
    kinds = Counter(each.kind for each in told)
    refused = [each for each in told if each.kind == "refused"]
    lost = {kind: count for kind, count in kinds.items() if kind not in ("plan", "no plan", "refused")}
    return {
        "rate": rate,
        "seconds": seconds,
        "asked": len(told),
        "plans": kinds["plan"],
        "no_plan": kinds["no plan"],
        "refused": len(refused),
        "refused_why": dict(Counter(each.why for each in refused).most_common(5)),
        "refused_without_time": sum(not each.retry_after_s for each in refused),
        "lost": sum(lost.values()),
        "lost_why": lost,
        "answered_ms": summary([each.ms for each in told if each.kind in ("plan", "no plan")]),
        "refused_ms": summary([each.ms for each in refused]),
    }


async def _until_ready(client: FleetClient, gateway: str, *, patience_s: float = 120.0) -> None:
    async with asyncio.timeout(patience_s):
        while True:
            known = client.plane.registry.gateways.get(gateway)
            planner: PlannerStatus | None = known.planner if known is not None else None
            if planner is not None and planner.slot is not None and planner.slot.state == "ready":
                return
            await asyncio.sleep(0.2)


async def _offer(client: FleetClient, gateway: str, *, rate: float, seconds: float, progress: Progress) -> list[Told]:
    began = time.monotonic()
    asking: list[asyncio.Task[Told]] = []
    for number in range(max(1, round(rate * seconds))):
        due = began + number / rate
        if (early := due - time.monotonic()) > 0:
            await asyncio.sleep(early)
        turn, which = divmod(number, len(INSTRUCTIONS))
        text = INSTRUCTIONS[which].format(n=2 + turn, dock=1 + turn % 4)
        asking.append(asyncio.create_task(_ask(client, gateway, text, due)))
        if number and number % max(1, round(rate * 10)) == 0:
            done = sum(each.done() for each in asking)
            progress(f"{number} asked in {time.monotonic() - began:.0f} s, {done} answered")
    return list(await asyncio.gather(*asking))


async def _ask(client: FleetClient, gateway: str, text: str, due: float) -> Told:
    kind, why, retry_after_s = "plan", "", 0.0
    try:
        await client.plane.rpc.call(gateway, keyspace.PLAN, PlanAsk(instruction=text), timeout_s=PATIENCE_S)
    except PlanError:
        kind = "no plan"
    except RefusedError as error:
        kind, why, retry_after_s = "refused", error.remedy or error.message, error.retry_after_s
    except SwiftbotError as error:
        kind = f"{error.code}: {error.message}"[:120]
    return Told(kind=kind, ms=1000 * (time.monotonic() - due), why=why, retry_after_s=retry_after_s)
