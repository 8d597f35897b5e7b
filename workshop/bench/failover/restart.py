"""One of eight gateways is stopped and started again, many times: how soon it is back in the ring.

Its own clock tells how long after its session was open it has its store, shows its token, and answers for its keys with
its shard reconciled. Another gateway, through which the benchmark looks, tells when it sees the token and has an answer
to a read of a key that is the restarted one's. The start of the whole process, Python and its modules included, stands
beside it.
"""

import asyncio
import signal
import time
from functools import partial
from typing import Any, Literal

from msgspec import Struct

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import DeadlineError, SwiftbotError, UnreachableError
from appliance.llm.settings import LlmConfig
from appliance.model import keyspace
from appliance.model.plane_api import KeyAsk, RecordChange
from appliance.plane.ring import Ring
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from workshop import local_fleet
from workshop.bench.chaos.arena import Arena, Progress, loopback
from workshop.bench.failover.takeover import LogTail
from workshop.bench.figures import summary
from workshop.bench.pooled import fleet_name, workspace

GOAL_MS = 31.0
STEP_S = 60.0
"""For a gateway to end, or to come back."""
STAGES = ("linked_ms", "present_ms", "fetched_ms", "joined_ms", "reconciled_ms")


class Options(Struct, frozen=True, kw_only=True):
    """What to measure."""

    gateways: int = 8
    rounds: int = 20
    records: int = 200
    """In the ring, so that there is something to compare."""
    how: Literal["stop", "kill"] = "stop"
    lease_ms: int = 1000
    secured: bool = False


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure; all processes have ended afterwards.

    Returns:
        `own`: ms after the session was open, on the gateway's own clock; `seen`: as another gateway has it; `process`:
        ms after the process was started.
    """
    with workspace() as folder:
        base = GatewayConfig(
            id="gw-1", llm=LlmConfig(tiers=("rules",)), plane=PlaneConfig(lease_ms=options.lease_ms), drain_s=5.0
        )
        arena = Arena(
            fleet=fleet_name(), directory=folder, base=base,
            sites=loopback(options.gateways, secured=options.secured),
            pool=PoolConfig(mode="cold", floor={}, capacity=1),
        )  # fmt: skip
        try:
            await arena.start_all(progress=progress, ready=0)
            # Only gateways ask each other for what is measured.
            asked = arena.names[1]
            async with await arena.client([arena.sites[asked].endpoint], gateway=asked) as client:
                return await _measure(options, arena, client, progress)
        finally:
            await arena.stop(progress=progress)


async def _measure(options: Options, arena: Arena, client: FleetClient, progress: Progress) -> dict[str, Any]:
    other, victim = arena.names[1], arena.names[-1]
    for number in range(options.records):
        change = RecordChange(key=f"bench/{number}", value=b"x" * 400)
        await client.plane.rpc.call(other, keyspace.RECORD_WRITE, change)
    ring = Ring(arena.names, virtual_nodes=PlaneConfig().virtual_nodes)
    owned = next(key for at in range(10**6) if ring.owner(key := f"key/{at}") == victim)
    own: dict[str, list[float]] = {stage: [] for stage in STAGES}
    seen: dict[str, list[float]] = {"token_ms": [], "answers_ms": []}
    process: dict[str, list[float]] = {"session_ms": [], "reconciled_ms": [], "up_ms": []}
    came = asyncio.Event()
    at = dict[str, float]()

    def on_token(_: str, alive: bool) -> None:
        at["came" if alive else "went"] = time.monotonic()
        came.set()

    watch = client.plane.session.watch_alive(client.plane.keys(keyspace.GATEWAY_ALIVE, victim), on_token)
    for number in range(options.rounds):
        await _end(arena, victim, options.how)
        await _until(came, lambda: at.get("went", 0.0) > at.get("came", 0.0), f"{victim} is still seen")
        tail = LogTail(arena.directory / "logs" / f"{victim}.log")
        spawned = time.monotonic()
        arena.start(victim)
        await _until(came, partial(_later, at, spawned), f"{victim} is not seen")
        answered = await _answer(client, victim, owned)
        back = await tail.until(lambda line: line.get("event") == "back in the ring", "back in the ring", wait_s=STEP_S)
        opened = float(back["session_opened_s"])
        for stage in STAGES:
            own[stage].append(float(back[stage]))
        seen["token_ms"].append((at["came"] - opened) * 1e3)
        seen["answers_ms"].append((answered - opened) * 1e3)
        await tail.until(lambda line: line.get("event") == "gateway is up", "gateway is up", wait_s=STEP_S)
        up = time.monotonic()
        process["session_ms"].append((opened - spawned) * 1e3)
        process["reconciled_ms"].append((opened - spawned) * 1e3 + float(back["reconciled_ms"]))
        process["up_ms"].append((up - spawned) * 1e3)
        progress(
            f"{number + 1} of {options.rounds}: back {back['reconciled_ms']:.1f} ms after its session was open, "
            f"up {process['up_ms'][-1]:.0f} ms after the process was started"
        )
    watch.close()
    return {
        "gateways": options.gateways,
        "records": options.records,
        "how": options.how,
        "lease_ms": options.lease_ms,
        "goal_ms": GOAL_MS,
        "own": {stage: summary(times) for stage, times in own.items()},
        "seen": {what: summary(times) for what, times in seen.items()},
        "process": {what: summary(times) for what, times in process.items()},
    }


def _later(at: dict[str, float], spawned: float) -> bool:
    return at.get("came", 0.0) > spawned


async def _end(arena: Arena, name: str, how: Literal["stop", "kill"]) -> None:
    if how == "kill":
        await arena.kill(name)
        return
    arena.signal(name, signal.SIGTERM)
    await local_fleet.end([arena.processes[name]], grace_s=STEP_S)


async def _until(event: asyncio.Event, so: Any, problem: str) -> None:
    try:
        async with asyncio.timeout(STEP_S):
            while not so():
                event.clear()
                await event.wait()
    except TimeoutError:
        raise DeadlineError(f"{problem} after {STEP_S:g} s") from None


async def _answer(client: FleetClient, gateway: str, key: str) -> float:
    """When a gateway answers for a key that is its own."""
    give_up = time.monotonic() + STEP_S
    while True:
        try:
            await client.plane.rpc.call(gateway, keyspace.DHT_READ, KeyAsk(key), timeout_s=5.0)
        except UnreachableError:
            await asyncio.sleep(0.001)
        except SwiftbotError:
            raise
        else:
            return time.monotonic()
        if time.monotonic() > give_up:
            raise DeadlineError(f"{gateway} does not answer for {key}")
