"""Gateways that know only some of the others: one ring all the same, records found hop by hop."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from appliance.errors import ConflictError, PayloadError
from appliance.model import GatewayStatus
from appliance.plane import bounded
from appliance.plane.node import Plane
from appliance.plane.overlay.lookup import NextAsk
from appliance.plane.overlay.upkeep import MeetAsk, Pace
from appliance.plane.overlay.view import Around, Step
from appliance.plane.ring import Ring
from appliance.plane.router import run_router
from appliance.plane.settings import PlaneConfig

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(300)]

COUNT = 24
VIEW = 16


async def _until(condition: Callable[[], object]) -> None:
    """Wait until something is so; the test's own timeout bounds it."""
    while not condition():
        await asyncio.sleep(0.05)


@contextlib.asynccontextmanager
async def _fleet(folder: Path, port: int) -> AsyncIterator[dict[str, Plane]]:
    """Gateways that are clients of one router and know at most VIEW others."""
    at = f"tcp/127.0.0.1:{port}"
    stop, opened = asyncio.Event(), asyncio.get_running_loop().create_future()
    router = PlaneConfig(mode="router", listen=(at,))
    running = asyncio.create_task(run_router(router, stop=stop, ready=opened.set_result, alive=lambda: None))
    await opened
    planes: dict[str, Plane] = {}
    try:
        for number in range(COUNT):
            config = PlaneConfig(mode="client", connect=(at,), view=VIEW)
            name = f"g{number}"
            planes[name] = await Plane.open(config, fleet="f", gateway=name, data_dir=folder / name)
        yield planes
    finally:
        for plane in planes.values():
            await plane.close()
        stop.set()
        await running


def _neighbours_known(planes: dict[str, Plane]) -> bool:
    """Whether every gateway's two next members are the true ones, and its predecessor too."""
    line = Ring(planes, virtual_nodes=1).names
    for place, name in enumerate(line):
        known = planes[name].members()
        if not {line[place - 1], line[(place + 1) % len(line)], line[(place + 2) % len(line)]} <= known:
            return False
    return True


async def _one_that_is_held_is_missed(planes: dict[str, Plane]) -> None:
    """Whoever is held counts as a member though it is in no view, and is lost when it goes, or is held no more."""
    asker = planes["g0"]
    came, lost = list[str](), list[str]()
    asker.on_member_joined.append(came.append)
    asker.on_member_lost.append(lost.append)
    far = sorted(set(planes) - asker.members())
    one, other = far[0], far[1]
    asker.hold("task/1", frozenset({one, "g0", "nobody"}))
    asker.hold("task/2", frozenset({one, other}))
    await _until(lambda: {one, other} <= asker.members())
    assert "nobody" not in asker.members()
    assert asker.sees("nobody")
    asker.hold("task/2", frozenset())
    await _until(lambda: other not in asker.members() or other in asker._membership._view)
    planes[one].registry.publish_status(GatewayStatus(id=one, fleet="f"))
    await _until(lambda: one in asker.registry.gateways)
    assert one in came
    await planes.pop(one).close()
    await _until(lambda: one in lost)
    assert one not in asker.members()
    asker.hold("task/1", frozenset())


async def test_records_are_found_through_bounded_views(tmp_path: Path, free_port: int) -> None:
    """What one gateway writes any other reads, with r copies at the true owner and its successors; then half leave."""
    async with _fleet(tmp_path, free_port) as planes:
        await _until(lambda: _neighbours_known(planes))
        assert all(len(plane.members()) <= VIEW + 1 for plane in planes.values())
        names = sorted(planes)
        ring = Ring(planes, virtual_nodes=1)
        versions = {}
        for number in range(40):
            key = f"key/{number}"
            versions[key] = await planes[names[number % COUNT]].dht.write(key, b"1", expected=None)
            owner, *others = ring.successors(key, 3)
            assert set(versions[key]) == {owner}
            assert await planes[names[(number + 3) % COUNT]].owner_of(key) == owner
            for holder in (owner, *others):
                assert await planes[holder].store.record(key) is not None
            read = await planes[names[(number + 7) % COUNT]].dht.read(key)
            assert read is not None
            assert read.version == versions[key]
            with pytest.raises(ConflictError):
                await planes[names[(number + 11) % COUNT]].dht.write(key, b"2", expected=None)
        with pytest.raises(PayloadError):
            await planes["g0"].rpc.call("g1", "ring_next", NextAsk("no position"), Step)

        await _one_that_is_held_is_missed(planes)
        for name in sorted(planes)[::6]:
            await planes.pop(name).close()
        await _until(lambda: _neighbours_known(planes))
        left = sorted(planes)
        for number, (key, version) in enumerate(versions.items()):
            read = await planes[left[number % len(left)]].dht.read(key)
            assert read is not None
            assert read.version == version


async def test_a_member_that_is_only_heard_of_is_looked_for(
    tmp_path: Path, free_ports: Callable[..., list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that was killed while others told of it shows no token: it is met, and forgotten, long before its turn."""
    monkeypatch.setattr(bounded, "_TOKEN_S", 0.2)
    ends = [f"tcp/127.0.0.1:{port}" for port in free_ports(2)]
    async with contextlib.AsyncExitStack() as stack:
        planes: list[Plane] = []
        for number, end in enumerate(ends):
            config = PlaneConfig(listen=(end,), connect=tuple(ends[:number]), view=VIEW)
            planes.append(await Plane.open(config, fleet="f", gateway=f"g{number}", data_dir=tmp_path / f"{number}"))
            stack.push_async_callback(planes[-1].close)
        await _until(lambda: all(len(plane.members()) == 2 for plane in planes))
        came, lost = list[str](), list[str]()
        planes[1].on_member_joined.append(came.append)
        planes[1].on_member_lost.append(lost.append)
        membership = planes[1]._membership
        assert isinstance(membership, bounded.BoundedMembership)
        membership._upkeep._pace = Pace(least_s=0.01, most_s=3600.0)
        membership._upkeep.interval_s = 3600.0
        await planes[0].rpc.call("g1", "ring_meet", MeetAsk("killed"), Around)
        await _until(lambda: "killed" in lost)
        assert came == ["killed"]
        assert planes[1].members() == {"g0", "g1"}


async def test_those_that_began_apart_become_one_ring(
    tmp_path: Path, free_ports: Callable[..., list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two that each took themselves for the first, and two rings of two, are one ring once they are linked."""
    monkeypatch.setattr(bounded, "_STRANGERS_S", 1.0)
    ends = [f"tcp/127.0.0.1:{port}" for port in free_ports(5)]
    async with contextlib.AsyncExitStack() as stack:
        planes: dict[str, Plane] = {}

        async def join(number: int, connect: tuple[str, ...]) -> None:
            config = PlaneConfig(listen=(ends[number],), connect=connect, view=VIEW, join_wait_s=0.0)
            planes[f"g{number}"] = await Plane.open(
                config, fleet="f", gateway=f"g{number}", data_dir=tmp_path / f"{number}"
            )
            stack.push_async_callback(planes[f"g{number}"].close)

        # Nobody listens at the last end yet, so none of the first three, and neither pair, sees another.
        await join(0, (ends[4],))
        await join(1, (ends[4], ends[0]))
        await join(2, (ends[4],))
        await join(3, (ends[4], ends[2]))
        await _until(lambda: all(len(plane.members()) == 2 for plane in planes.values()))
        await planes["g0"].dht.write("key/1", b"1", expected=None)
        await planes["g2"].dht.write("key/2", b"2", expected=None)
        await join(4, ())
        await _until(lambda: all(len(plane.members()) == 5 for plane in planes.values()))
        for plane in planes.values():
            for number in (1, 2):
                read = await plane.dht.read(f"key/{number}")
                assert read is not None
                assert read.value == b"%d" % number
