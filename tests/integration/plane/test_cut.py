"""Gateways at two routers whose link is cut: what both sides write meets, and no lease is granted twice."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest
from relays import Relay, router

from appliance.errors import ConflictError, SwiftbotError, UnreachableError
from appliance.model import VersionVector, keyspace
from appliance.model.plane_api import KeyAsk, Record
from appliance.plane.node import Plane
from appliance.plane.records import descends
from appliance.plane.settings import PlaneConfig

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(120)]

NAMES = ("g0", "g1", "g2", "g3", "g4")
"""The first three at one router, the others at the other."""


async def until(holds: Callable[[], object]) -> None:
    """Wait until something holds; the test's own timeout bounds it."""
    while not holds():
        await asyncio.sleep(0.02)


@asynccontextmanager
async def halves(folder: Path, ports: list[int]) -> AsyncIterator[tuple[Relay, list[Plane]]]:
    """Five gateways that all see each other, and the link in their middle."""
    one, other, between = ports
    relay = Relay(between, one)
    async with AsyncExitStack() as stack:
        await relay.mend()
        stack.push_async_callback(relay.cut)
        ends = [f"tcp/127.0.0.1:{port}" for port in (one, other)]
        await stack.enter_async_context(router(ends[0]))
        await stack.enter_async_context(router(ends[1], f"tcp/127.0.0.1:{between}"))
        planes: list[Plane] = []
        for number, name in enumerate(NAMES):
            config = PlaneConfig(mode="client", connect=(ends[number // 3],), voters=NAMES)
            planes.append(await Plane.open(config, fleet="cut", gateway=name, data_dir=folder / name))
            stack.push_async_callback(planes[-1].close)
        await together(planes)
        yield relay, planes


async def together(*groups: list[Plane]) -> None:
    """Wait until the planes of each group see each other and nobody else, and have compared their records."""
    for planes in groups:
        names = {plane.gateway for plane in planes}
        await until(
            lambda planes=planes, names=names: all(
                plane.members() == names and plane.dht.settling.reconciled() for plane in planes
            )
        )


async def test_records_of_both_sides_meet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Both sides of a cut write on; healed, all replicas are equal and descend from every acknowledged write."""
    keys = [f"note/{number}" for number in range(12)]
    async with halves(tmp_path, free_ports(3)) as (relay, planes):
        for key in keys[:8]:
            await planes[0].dht.write(key, b"before", expected=None)
        await relay.cut()
        await together(planes[:3], planes[3:])
        acknowledged: dict[str, list[VersionVector]] = {key: [] for key in keys}
        values: dict[str, set[bytes]] = {key: {b"before"} for key in keys}

        async def change(plane: Plane, key: str, value: bytes) -> None:
            values[key].add(value)
            try:
                record = await plane.dht.read(key)
            except UnreachableError:
                record = None  # its copies are on the other side, so a new one is made here
            try:
                version = await plane.dht.write(key, value, expected=None if record is None else record.version)
            except ConflictError:
                return
            acknowledged[key].append(version)

        for key in keys:
            await change(planes[1], key, b"one side")
            await change(planes[4], key, b"other side")
        assert sum(len(versions) for versions in acknowledged.values()) > len(keys)
        await relay.mend()
        await together(planes)
        for key in keys:
            while (record := await _agreed(planes, key)) is None:
                await asyncio.sleep(0.05)
            assert record.value in values[key]
            assert all(descends(record.version, version) for version in acknowledged[key])


async def _agreed(planes: list[Plane], key: str) -> Record | None:
    """The record that all replicas of a key hold; None: they differ, or one does not answer."""
    try:
        copies = [
            (await planes[0].rpc.call(name, keyspace.DHT_READ, KeyAsk(key))).record
            if name != planes[0].gateway
            else await planes[0].store.record(key)
            for name in planes[0].ring.successors(key, 3)
        ]
    except SwiftbotError:
        return None
    return copies[0] if all(copy == copies[0] for copy in copies) else None


async def test_two_sides_of_a_cut_never_both_have_a_lease(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Of each key only the side with most of its grantors grants a lease; healed, the other hears who has it."""
    async with halves(tmp_path, free_ports(3)) as (relay, planes):
        await relay.cut()
        await together(planes[:3], planes[3:])
        here, there = planes[1], planes[4]
        keys = [f"aisle/{number}" for number in range(200)]
        most_here = [key for key in keys if sum(name in NAMES[:3] for name in here.leases.grantors(key)) >= 2]
        most_there = [key for key in keys if key not in most_here]
        sides = dict.fromkeys(most_here[:3], True) | dict.fromkeys(most_there[:3], False)
        assert len(sides) == 6
        leases = {}
        for key, ours in sides.items():
            asker, other = (here, there) if ours else (there, here)
            leases[key] = asker, await asker.leases.acquire(key, ttl_s=30)
            with pytest.raises(UnreachableError, match="2 are needed"):
                await other.leases.acquire(key, ttl_s=30)
        await relay.mend()
        await together(planes)
        for key, (asker, lease) in leases.items():
            other = there if asker is here else here
            with pytest.raises(ConflictError, match=lease.holder):
                await other.leases.acquire(key, ttl_s=30)
            await asker.leases.release(lease)
            newer = await other.leases.acquire(key, ttl_s=30)
            assert newer.fence > lease.fence
