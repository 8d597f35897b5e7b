"""What keys cost: the same work with mutual TLS, access control and signatures, and without, in turns in one run.

    get         a record from its owner, through any of three gateways: TLS and access control
    put         a durable record with two more copies: these, and three signed requests (ours, and one for each copy)
    round_trip  a verb of another gateway that changes nothing and is not signed
    elsewhere   a run ordered at a gateway that has no container, served warm by another: signed twice

Two fleets of gateway processes, alike but for their keys, are asked by turns, so that whatever else the machine does
comes to both alike.
"""

import asyncio
import contextlib
import tempfile
import time
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

from appliance.errors import PoolError
from appliance.model import Phase, keyspace
from appliance.model.plane_api import MemberAsk
from appliance.model.roles import Role
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from workshop import keyring
from workshop.bench import fleet
from workshop.bench.dht import live
from workshop.bench.dht.node import NodeOptions
from workshop.bench.figures import ratio, summary
from workshop.bench.fleet import Progress
from workshop.bench.pooled import PAUSE_S, fleet_name

NODES = 3
_BLOCK = 25
"""Operations of one side before it is the other's turn."""
_WARM = 2
"""Turns of each side before any that counts."""
SIDES = ("plain", "secured")


async def run(count: int, starts: int, *, image: str, progress: Progress) -> dict[str, Any]:
    """Measure `count` gets, puts and round trips, and `starts` warm starts elsewhere (0: none).

    Returns:
        For each kind `plain` and `secured`: count, p50, p90, p99, max in ms; `ratio` of their medians.

    Raises:
        SwiftbotError: a gateway did not answer, or a run was served in another phase.
    """
    times = await _records(count, progress)
    if starts:
        times |= await _starts(starts, image, progress)
    result: dict[str, Any] = {}
    for kind, sides in times.items():
        summaries = {side: summary(each) for side, each in sides.items()}
        result[kind] = summaries | {"ratio": ratio(summaries["secured"].get("p50"), summaries["plain"].get("p50"))}
    return result


async def _records(count: int, progress: Progress) -> dict[str, dict[str, list[float]]]:
    kinds = ("put", "get", "round_trip")
    times: dict[str, dict[str, list[float]]] = {kind: {side: [] for side in SIDES} for kind in kinds}
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="swiftbot-security-")))
        planes = {
            side: await stack.enter_async_context(_nodes(folder / side, secured=side == "secured")) for side in SIDES
        }
        progress(f"{count} puts, gets and round trips on {NODES} gateways with keys and {NODES} without")
        turns = _WARM + max(1, count // _BLOCK)
        for turn in range(turns):
            for side in SIDES if turn % 2 else reversed(SIDES):
                found = await _turn(planes[side], turn)
                if turn >= _WARM:
                    for kind, each in found.items():
                        times[kind][side] += each
    return times


async def _turn(plane: Plane, turn: int) -> dict[str, list[float]]:
    """One block of each kind, asked by one gateway; in milliseconds."""
    found: dict[str, list[float]] = {"put": [], "get": [], "round_trip": []}
    others = sorted(plane.members() - {plane.gateway})
    for number in range(_BLOCK):
        key = f"note/{turn}-{number}"
        began = time.perf_counter()
        await plane.dht.write(key, b"x" * 400, expected=None)
        put = time.perf_counter()
        await plane.dht.read(key)
        read = time.perf_counter()
        await plane.rpc.call(others[number % len(others)], keyspace.MEMBER, MemberAsk(gateway=plane.gateway))
        asked = time.perf_counter()
        for kind, took_s in (("put", put - began), ("get", read - put), ("round_trip", asked - read)):
            found[kind].append(took_s * 1e3)
    return found


@asynccontextmanager
async def _nodes(folder: Path, *, secured: bool) -> AsyncGenerator[Plane]:
    """Gateways as processes with records and nothing else, and one more of them in this process."""
    name, protocol = fleet_name(), "tls" if secured else "tcp"
    peers = {f"g{number}": f"{protocol}/127.0.0.1:{free_port()}" for number in range(NODES)}
    if secured:
        keyring.issue(folder / "keys", name, gateways=dict.fromkeys(peers, "127.0.0.1"))

    def keys(gateway: str) -> str:
        return str(keyring.file_of(folder / "keys", Role.GATEWAY, gateway)) if secured else ""

    async with AsyncExitStack() as stack:
        for gateway, listen in list(peers.items())[1:]:
            options = NodeOptions(
                fleet=name, gateway=gateway, folder=str(folder / gateway), listen=listen, connect=(), members=1,
                peers=peers, keys=keys(gateway),
            )  # fmt: skip
            await stack.enter_async_context(live.node_process(options))
        config = PlaneConfig(listen=(peers["g0"],), peers=peers, keys=keys("g0"))
        plane = await Plane.open(config, fleet=name, gateway="g0", data_dir=folder / "g0")
        stack.push_async_callback(plane.close)
        async with asyncio.timeout(live.LINE_S):
            while len(plane.members()) < NODES or not plane.dht.settling.reconciled():  # noqa: ASYNC110 - no single event says so
                await asyncio.sleep(0.02)
        yield plane


async def _starts(count: int, image: str, progress: Progress) -> dict[str, dict[str, list[float]]]:
    """Runs ordered where no container is, served warm by the other gateway."""
    pools = {"gw-1": PoolConfig(floor={}, memory_mb=64), "gw-2": PoolConfig(floor={image: 2}, capacity=2)}
    times: dict[str, list[float]] = {side: [] for side in SIDES}
    async with contextlib.AsyncExitStack() as stack:
        orders: dict[str, fleet.Orders] = {}
        for side in SIDES:
            running = fleet.running(pools, image=image, progress=progress, secured=side == "secured")
            _, orders[side] = await stack.enter_async_context(running)
        for side in SIDES:
            for _ in range(_WARM):
                await _start(orders[side])
        progress(f"{count} runs ordered at a gateway without containers, with keys and without")
        for _ in range(count):
            for side in SIDES:
                times[side].append(await _start(orders[side]))
    return {"elsewhere": times}


async def _start(orders: fleet.Orders) -> float:
    outcome = await orders.run("gw-1")
    if outcome.problem or outcome.phase != Phase.REMOTE_WARM.value:
        raise PoolError(f"a run ordered at gw-1 was {outcome.problem or outcome.phase}, not warm elsewhere")
    await asyncio.sleep(PAUSE_S)  # the container's state is published before the next search
    return outcome.started_ms
