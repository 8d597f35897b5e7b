"""Records on real sessions while gateways come, go, stand still and lose sight of each other."""

import asyncio
import random
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from plane_fleet import Fleet, fleet_of, until

from appliance.errors import ConfigError, ConflictError, RefusedError
from appliance.model import keyspace
from appliance.model.plane_api import Record, StoreAsk, Write
from appliance.plane.events import Lost, RingChanged, Stage
from appliance.plane.node import STORE_FILE, Plane
from appliance.plane.records import descends
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store

pytestmark = pytest.mark.anyio


def on_lost(plane: Plane, tell: Callable[[str], object]) -> None:
    """Call `tell` with the name of each gateway that is lost."""
    plane.events.subscribe(Stage.WATCHERS, lambda event: tell(event.gateway) if isinstance(event, Lost) else None)


def on_ring_change(plane: Plane, tell: Callable[[], object]) -> None:
    """Call `tell` after each `RingChanged`."""
    plane.events.subscribe(Stage.WATCHERS, lambda event: tell() if isinstance(event, RingChanged) else None)


@pytest.fixture
async def fleet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Fleet]:
    """Three gateways that see each other."""
    async with fleet_of(tmp_path, free_ports(3)) as made:
        for number in range(3):
            await made.start(number)
        await made.settled()
        yield made


async def test_the_rest_of_a_start_waits_until_the_shard_is_compared(fleet: Fleet) -> None:
    """A gateway that was restarted is back once it answers for its keys; a caller that waits for that may give up."""
    key = fleet.owned_by(1)
    await fleet.planes[0].dht.write(key, b"kept", expected=None)
    await fleet.stop(1)
    plane = await fleet.start(1)
    assert not await plane.until_back(0.0)
    assert await plane.until_back(60.0)
    assert plane.dht.settling.reconciled()
    assert plane.milestones["reconciled"] >= plane.milestones["joined"]
    found = await plane.dht.read(key)
    assert found is not None
    assert found.value == b"kept"


async def test_the_successor_takes_over(fleet: Fleet) -> None:
    """When the owner leaves, another gateway owns its records, has them, and orders their writes."""
    keys = [fleet.owned_by(2) for _ in range(20)]
    versions = {key: await fleet.planes[0].dht.write(key, key.encode(), expected=None) for key in keys}
    told: list[frozenset[str]] = []
    lost: list[str] = []
    on_ring_change(fleet.planes[0], lambda: told.append(fleet.planes[0].members()))
    on_lost(fleet.planes[0], lost.append)
    await fleet.stop(2)
    for key in keys:
        version = await fleet.planes[1].dht.write(key, b"next", expected=versions[key])
        assert descends(version, versions[key])
        record = await fleet.planes[0].dht.read(key)
        assert record is not None
        assert record.value == b"next"
    await until(lambda: told == [frozenset({"g0", "g1"})])
    assert lost == ["g2"]


async def test_a_joiner_has_its_records_before_it_is_told(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """A gateway that joins has every record it now owns when `RingChanged` is published, and answers for them."""
    async with fleet_of(tmp_path, free_ports(2)) as fleet:
        first = await fleet.start(0)
        versions = {f"task/{n}": await first.dht.write(f"task/{n}", b"x" * n, expected=None) for n in range(200)}
        await first.dht.remove("task/7", expected=versions.pop("task/7"))
        joiner = await fleet.start(1)
        had: list[int] = []

        def told() -> None:
            had.append(len(joiner.members()))

        on_ring_change(joiner, told)
        await until(lambda: had)
        assert had[-1] == 2
        assert {record.key: record.version for record in await joiner.dht.local("task/")} == versions
        gone = await joiner.store.record("task/7")
        assert gone is not None
        assert gone.deleted
        for key, version in versions.items():
            await joiner.dht.write(key, b"", expected=version)


async def test_nothing_is_lost_while_gateways_come_and_go(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Four gateways with two replicas; each in turn is stopped and started under writes: no record is lost."""
    async with fleet_of(tmp_path, free_ports(4), replicas=2) as fleet:
        for number in range(4):
            await fleet.start(number)
        await fleet.settled()
        written: dict[str, int] = {}
        stopping = asyncio.Event()

        async def write() -> None:
            while not stopping.is_set():
                key = f"task/{random.randrange(60)}"  # noqa: S311 - any of sixty
                plane = fleet.planes[0]
                record = await plane.dht.read(key)
                value = 1 if record is None else int(record.value) + 1
                try:
                    await plane.dht.write(key, str(value).encode(), expected=None if record is None else record.version)
                except ConflictError:
                    continue
                written[key] = value
                await asyncio.sleep(0.002)

        writing = asyncio.create_task(write())
        for number in (1, 2, 3):
            await fleet.stop(number)
            await fleet.settled()
            await asyncio.sleep(0.1)
            await fleet.start(number)
            await fleet.settled()
        stopping.set()
        await writing
        assert len(written) > 20
        for key, value in written.items():
            record = await fleet.planes[3].dht.read(key)
            assert record is not None
            assert int(record.value) == value
        # Copies end up on the two replicas of each key, and nowhere else.
        ring = fleet.planes[0].ring
        for key in written:
            while {n for n, plane in fleet.planes.items() if await plane.store.record(key)} != {
                int(name[1:]) for name in ring.successors(key, 2)
            }:
                for plane in fleet.planes.values():
                    plane._reconciler._changed.set()
                await asyncio.sleep(0.02)


async def test_a_restarted_gateway_has_its_shard(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """A lone gateway that is stopped and started has all its records and goes on counting their versions."""
    async with fleet_of(tmp_path, free_ports(1)) as fleet:
        plane = await fleet.start(0)
        version = await plane.dht.write("task/1", b"1", expected=None)
        await plane.store.put("run/1", b"kept")
        await fleet.stop(0)
        plane = await fleet.start(0)
        assert await plane.store.get("run/1") == b"kept"
        assert await plane.dht.write("task/1", b"2", expected=version) == {"g0": 2}


async def test_a_gateway_that_was_away_catches_up(fleet: Fleet) -> None:
    """What was written, rewritten and removed while a gateway was away is so on its return."""
    keys = [fleet.owned_by(2) for _ in range(30)]
    versions = {key: await fleet.planes[0].dht.write(key, b"old", expected=None) for key in keys}
    await fleet.stop(2)
    await fleet.settled()
    for key in keys[:10]:
        versions[key] = await fleet.planes[1].dht.write(key, b"new", expected=versions[key])
    for key in keys[10:20]:
        await fleet.planes[1].dht.remove(key, expected=versions.pop(key))
    back = await fleet.start(2)
    await fleet.settled()
    assert {record.key: record.version for record in await back.dht.local("task/")} == versions
    assert (await back.dht.read(keys[0]) or Record(key="")).value == b"new"
    assert await back.dht.read(keys[15]) is None


async def test_a_damaged_file_is_filled_again_from_the_replicas(fleet: Fleet) -> None:
    """A gateway whose file was destroyed starts with an empty one and gets its records back."""
    keys = [fleet.owned_by(1) for _ in range(10)]
    versions = {key: await fleet.planes[0].dht.write(key, b"v", expected=None) for key in keys}
    await fleet.stop(1)
    (fleet.folder / "g1" / STORE_FILE).write_bytes(b"not a database" * 100)
    back = await fleet.start(1)
    await fleet.settled()
    assert back.store.set_aside is not None
    assert {record.key: record.version for record in await back.dht.local("task/")} == versions


async def test_a_request_waits_until_whoever_has_come_back_was_compared_with(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that was away may have ordered writes meanwhile: the owner answers for what they share when it has them."""
    one, other = fleet.planes[0], fleet.planes[1]
    key = next(key for at in range(10_000) if one.ring.successors(key := f"task/{at}", 2) == ("g0", "g1"))
    version = await one.dht.write(key, b"before", expected=None)
    membership, comparing, token = one._membership, one._reconciler._comparing, one.keys(keyspace.GATEWAY_ALIVE, "g1")
    membership._seen(token, alive=False)
    while not one.dht.settling.reconciled():
        await asyncio.sleep(0.01)
    held, compare = asyncio.Event(), comparing.compare

    async def slow(*asked: Any, **more: Any) -> Any:
        await held.wait()
        return await compare(*asked, **more)

    monkeypatch.setattr(comparing, "compare", slow)
    newer = Record(key=key, value=b"meanwhile", version={**version, "g1": 1}, write="w")
    await other.rpc.call("g1", keyspace.DHT_STORE, StoreAsk(newer))
    membership._seen(token, alive=True)
    reading = asyncio.create_task(one.dht.read(key))
    await asyncio.sleep(0.2)
    assert not reading.done()
    held.set()
    record = await reading
    assert record is not None
    assert record.value == b"meanwhile"
    assert not one.dht.settling.returned


async def test_an_id_that_is_taken_is_refused(fleet: Fleet) -> None:
    """A second gateway with the id of one that is there is refused, and disturbs nothing."""
    config = PlaneConfig(connect=(fleet.endpoints[0],), lease_ms=200)
    with pytest.raises(ConfigError, match="named g1 is already"):
        await Plane.open(config, fleet="f", gateway="g1", data_dir=fleet.folder / "second")
    assert fleet.planes[0].members() == {"g0", "g1", "g2"}
    store = await Store.open(fleet.folder / "second" / STORE_FILE)
    await store.close()


async def test_a_token_that_got_lost_is_shown_again(fleet: Fleet) -> None:
    """A gateway whose token another has lost though they are linked shows one more; nobody else takes it for gone."""
    lost: list[str] = []
    for number in (0, 2):
        on_lost(fleet.planes[number], lost.append)
    first, third = fleet.planes[1], fleet.planes[2]
    third._membership._seen(first.keys(keyspace.GATEWAY_ALIVE, "g1"), alive=False)
    assert lost == ["g1"]
    for again in (1, 2):
        first._reconciler._changed.set()
        await until(lambda: third.members() == {"g0", "g1", "g2"})
        await fleet.settled()
        assert await third.session.alive_now(first.keys(keyspace.GATEWAY_ALIVE_AGAIN, "g1")) == [
            first.keys(keyspace.GATEWAY_ALIVE_AGAIN, "g1", str(again))
        ]
        if again == 1:
            third._membership._seen(first.keys(keyspace.GATEWAY_ALIVE_AGAIN, "g1", "1"), alive=False)
    assert lost == ["g1", "g1"]
    await fleet.stop(1)
    await until(lambda: lost[2:] == ["g1", "g1"])
    assert fleet.planes[0].members() == third.members() == {"g0", "g2"}


async def test_gateways_that_lost_each_others_tokens_meet_again(fleet: Fleet) -> None:
    """Two gateways that both lost the other's token though they are linked find each other at the next comparison."""
    first, third = fleet.planes[1], fleet.planes[2]
    third._membership._seen(first.keys(keyspace.GATEWAY_ALIVE, "g1"), alive=False)
    first._membership._seen(first.keys(keyspace.GATEWAY_ALIVE, "g2"), alive=False)
    await until(lambda: first.dht.settling.reconciled() and third.dht.settling.reconciled())
    assert first.members() == {"g0", "g1"}
    first._reconciler._changed.set()
    await fleet.settled()
    assert third.members() == first.members() == {"g0", "g1", "g2"}


async def test_a_gateway_that_stood_still_orders_nothing_until_it_knows(fleet: Fleet) -> None:
    """An owner that stood still refuses writes sent before, has missed ones before it answers, then owns as before."""
    plane = fleet.planes[2]
    pulse = plane._pulse
    key = fleet.owned_by(2)
    version = await plane.dht.write(key, b"before", expected=None)
    missed = Record(key=key, value=b"after", version={**version, "g0": 1}, write="w")
    for number in (0, 1):
        await fleet.planes[number].dht.keep(missed)
    told = asyncio.Event()
    on_ring_change(plane, told.set)
    pulse._last -= plane.config.lease_ms / 1e3
    assert await plane.dht.read(key) == missed
    assert plane.dht.settling.reconciled()
    await told.wait()
    pulse._until = float("inf")
    stale = Write(key=key, value=b"stale", expected=version, write="stale")
    with pytest.raises(RefusedError, match="stood still"):
        await plane.dht.ordering.order(stale)
    writing = asyncio.create_task(fleet.planes[0].dht.write(key, b"next", expected=missed.version))
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(asyncio.shield(writing), 0.2)
    pulse._until = 0.0
    assert await writing == {"g0": 1, "g2": 2}


async def test_two_fleets_on_one_network_keep_their_tasks_apart(free_port: int, tmp_path: Path) -> None:
    """Gateways of two fleets on one Zenoh network, one id in both: neither sees the other's records or members."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    one = await Plane.open(PlaneConfig(listen=(endpoint,)), fleet="one", gateway="gw-1", data_dir=tmp_path / "one")
    other = await Plane.open(PlaneConfig(connect=(endpoint,)), fleet="two", gateway="gw-1", data_dir=tmp_path / "two")
    try:
        async with asyncio.timeout(20):
            while not (one.session.linked and other.session.linked):
                await asyncio.sleep(0.01)
        await one.dht.write("task/t-1", b"of one", expected=None)
        await other.dht.write("task/t-1", b"of two", expected=None)
        for plane, value in ((one, b"of one"), (other, b"of two")):
            record = await plane.dht.read("task/t-1")
            assert record is not None
            assert record.value == value
            assert plane.members() == {"gw-1"}
        assert await one.dht.read("task/t-2") is None
    finally:
        await one.close()
        await other.close()
