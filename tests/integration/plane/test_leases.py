"""Leases granted by a majority on real sessions: one holder, expiry, renewal, restarts, and who may not grant."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import msgspec
import pytest

from appliance.errors import ConfigError, ConflictError, PayloadError, RefusedError, UnreachableError
from appliance.model import keyspace
from appliance.model.plane_api import LeaseAsk
from appliance.plane import leases
from appliance.plane.leases import Lease
from appliance.plane.node import STORE_FILE, Plane
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio

KEY = "floor/aisle-3"


class Fleet:
    """Gateways in this process that all grant leases."""

    def __init__(self, folder: Path, ports: list[int], **settings: object) -> None:
        self.folder = folder
        self.endpoints = [f"tcp/127.0.0.1:{port}" for port in ports]
        self.voters = [f"g{number}" for number in range(len(ports))]
        self.settings = settings
        self.planes: dict[int, Plane] = {}

    async def start(self, number: int) -> Plane:
        """Start one gateway and wait until all that are there see it."""
        own = {
            "listen": (self.endpoints[number],),
            "peers": {f"g{each}": endpoint for each, endpoint in enumerate(self.endpoints)},
            "voters": self.voters,
        }
        config = msgspec.convert({**own, **self.settings}, PlaneConfig)
        plane = await Plane.open(config, fleet="leases", gateway=f"g{number}", data_dir=self.folder / f"g{number}")
        self.planes[number] = plane
        while not all(len(each.members()) == len(self.planes) for each in self.planes.values()):
            await asyncio.sleep(0.01)
        return plane

    async def stop(self, *numbers: int) -> None:
        """Stop some."""
        for number in numbers:
            await self.planes.pop(number).close()


@contextlib.asynccontextmanager
async def _fleet(folder: Path, ports: list[int], **settings: object) -> AsyncIterator[Fleet]:
    made = Fleet(folder, ports, **settings)
    try:
        yield made
    finally:
        await made.stop(*tuple(made.planes))


@pytest.fixture
async def fleet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Fleet]:
    """Three gateways, all grantors of every key."""
    async with _fleet(tmp_path, free_ports(3)) as made:
        for number in range(3):
            await made.start(number)
        yield made


async def test_one_holder_at_a_time(fleet: Fleet) -> None:
    """While one has a lease all others are refused, in the same gateway too; given back, it is the next one's."""
    one, two, _ = fleet.planes.values()
    lease = await one.leases.acquire(KEY, ttl_s=30)
    assert 0 < lease.left_s < 30
    for plane in fleet.planes.values():
        with pytest.raises(ConflictError, match=lease.holder):
            await plane.leases.acquire(KEY, ttl_s=30)
    other = await two.leases.acquire("floor/aisle-4", ttl_s=30)
    assert other.left_s > 0
    await one.leases.release(lease)
    assert (await two.leases.acquire(KEY, ttl_s=30)).fence > lease.fence


async def test_of_many_that_contend_one_at_a_time_has_it(fleet: Fleet) -> None:
    """Askers at all gateways take turns: never two inside, each gets in, and fences rise."""
    inside: list[Lease] = []
    fences: list[int] = []

    async def enter(plane: Plane) -> None:
        while True:
            try:
                lease = await plane.leases.acquire(KEY, ttl_s=30)
            except ConflictError:
                await asyncio.sleep(0.01)
                continue
            inside.append(lease)
            assert len(inside) == 1
            fences.append(lease.fence)
            await asyncio.sleep(0)
            inside.remove(lease)
            await plane.leases.release(lease)
            return

    async with asyncio.TaskGroup() as group:
        for plane in fleet.planes.values():
            for _ in range(4):
                group.create_task(enter(plane))
    assert len(fences) == 12
    assert fences == sorted(set(fences))


async def test_a_lease_ends_and_a_renewed_one_does_not(fleet: Fleet) -> None:
    """A renewed lease outlasts its first time; one that has ended is the next asker's, and cannot be renewed."""
    one, two, _ = fleet.planes.values()
    lease = await one.leases.acquire(KEY, ttl_s=0.5)
    renewed = await one.leases.renew(lease, ttl_s=2.0)
    assert renewed.holder == lease.holder
    assert renewed.fence > lease.fence
    while lease.left_s:
        await asyncio.sleep(0.02)
    with pytest.raises(ConflictError, match="has ended"):
        await one.leases.renew(lease, ttl_s=1.0)
    newer: Lease | None = None
    while newer is None:
        with contextlib.suppress(ConflictError):
            newer = await two.leases.acquire(KEY, ttl_s=30)
    assert renewed.left_s == 0
    with pytest.raises(ConflictError):
        await one.leases.renew(renewed, ttl_s=1.0)


async def test_a_minority_grants_nothing(fleet: Fleet) -> None:
    """With one of three grantors away leases go on; with two away there are none, and nothing is renewed."""
    lease = await fleet.planes[0].leases.acquire(KEY, ttl_s=30)
    await fleet.stop(2)
    lease = await fleet.planes[0].leases.renew(lease, ttl_s=30)
    await fleet.planes[1].leases.acquire("floor/other", ttl_s=30)
    await fleet.stop(1)
    with pytest.raises(UnreachableError, match="2 are needed"):
        await fleet.planes[0].leases.acquire("floor/third", ttl_s=30)
    with pytest.raises(UnreachableError, match="2 are needed"):
        await fleet.planes[0].leases.renew(lease, ttl_s=30)
    assert lease.left_s > 0


async def test_restarted_grantors_grant_nothing_that_may_be_held(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """All are restarted while a lease lasts: none before the longest lease is over, then one of a higher fence."""
    lease = await fleet.planes[0].leases.acquire(KEY, ttl_s=30)
    monkeypatch.setattr(leases, "LONGEST_S", 3.0)
    await fleet.stop(0, 1, 2)
    for number in range(3):
        await fleet.start(number)
    with pytest.raises(UnreachableError):
        await fleet.planes[1].leases.acquire(KEY, ttl_s=1)
    newer: Lease | None = None
    while newer is None:
        with contextlib.suppress(UnreachableError):
            newer = await fleet.planes[1].leases.acquire(KEY, ttl_s=1)
    assert newer.fence > lease.fence


async def test_who_lost_its_fences_grants_nothing(fleet: Fleet) -> None:
    """A grantor whose file was damaged grants nothing, after its next restart neither: the other two are a majority."""
    await fleet.planes[0].leases.release(await fleet.planes[0].leases.acquire(KEY, ttl_s=30))
    await fleet.stop(2)
    path = fleet.folder / "g2" / STORE_FILE
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    path.write_bytes(b"no database" * 1000)
    await fleet.start(2)
    lease = await fleet.planes[2].leases.acquire(KEY, ttl_s=30)
    await fleet.planes[2].leases.release(lease)
    await fleet.stop(0)
    with pytest.raises(UnreachableError, match="2 are needed"):
        await fleet.planes[2].leases.acquire(KEY, ttl_s=30)
    await fleet.stop(2)
    await fleet.start(2)
    with pytest.raises(UnreachableError, match="2 are needed"):
        await fleet.planes[2].leases.acquire(KEY, ttl_s=30)


async def test_who_asks_wrongly_is_refused(fleet: Fleet) -> None:
    """Other voters than configured, leases out of bounds, fences that would use up the numbers: refused and counted."""
    one, two, _ = fleet.planes.values()
    ask = LeaseAsk(key=KEY, holder="x", fence=1, ttl_s=1.0, voters=one.leases.digest)
    with pytest.raises(RefusedError, match="other voters"):
        await one.rpc.call("g1", keyspace.LEASE_GRANT, msgspec.structs.replace(ask, voters="0"))
    with pytest.raises(PayloadError, match="fence"):
        await one.rpc.call("g1", keyspace.LEASE_GRANT, msgspec.structs.replace(ask, fence=2**52))
    assert two.session.refused["malformed gw/g1/rpc/lease_grant"] == 1
    for ttl_s in (0.0, 31.0):
        with pytest.raises(ConfigError):
            await one.leases.acquire(KEY, ttl_s=ttl_s)
    assert await one.leases.acquire(KEY, ttl_s=1)


async def test_without_voters_there_are_no_leases(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Where the configuration names no voters the answer says which setting is missing."""
    async with _fleet(tmp_path, free_ports(1), voters=()) as fleet:
        plane = await fleet.start(0)
        with pytest.raises(ConfigError, match=r"plane\.voters"):
            await plane.leases.acquire(KEY, ttl_s=1)
