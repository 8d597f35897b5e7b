"""What others may send that is wrong but well-formed: clocks far off, forged and outdated versions, another fleet."""

import asyncio
import contextlib
import datetime as dt
import itertools
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import msgspec
import pytest
import zenoh

from appliance.errors import ConflictError, PayloadError
from appliance.model import GatewayStatus, encode, keyspace
from appliance.model.plane_api import KeyAsk, Record, StoreAsk
from appliance.plane.node import Plane
from appliance.plane.records import descends
from appliance.plane.session import Message, Session, Wire
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


async def _until(condition: Callable[[], object]) -> None:
    """Wait until something is so; the test's own timeout bounds it."""
    while not condition():
        await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def _planes(folder: Path, ports: list[int], *fleets: str) -> AsyncIterator[list[Plane]]:
    """Two gateways, g0 and g1, for each fleet, all linked with each other."""
    ends = [f"tcp/127.0.0.1:{port}" for port in ports]
    planes: list[Plane] = []
    try:
        for at, fleet in enumerate(fleets):
            for number in range(2):
                own = 2 * at + number
                config = PlaneConfig(listen=(ends[own],), connect=tuple(end for end in ends if end != ends[own]))
                data = folder / f"{fleet}-{number}"
                planes.append(await Plane.open(config, fleet=fleet, gateway=f"g{number}", data_dir=data))
        await _until(lambda: all(len(each.members()) == 2 and each.dht.settling.reconciled() for each in planes))
        yield planes
    finally:
        for plane in planes:
            await plane.close()


async def test_two_fleets_on_one_network_do_not_meet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Gateways of two fleets with the same ids, linked with each other: each fleet has its own members and records."""
    async with _planes(tmp_path, free_ports(4), "north", "south") as planes:
        for plane in planes:
            assert plane.members() == {"g0", "g1"}
        for number in range(20):
            for plane, value in ((planes[0], b"north"), (planes[2], b"south")):
                await plane.dht.write(f"task/{number}", value, expected=None)
        for number in range(20):
            for plane, value in zip(planes, (b"north", b"north", b"south", b"south"), strict=True):
                record = await plane.dht.read(f"task/{number}")
                assert record is not None
                assert record.value == value
        planes[0].registry.publish_status(GatewayStatus(id="g0", fleet="north"))
        await _until(lambda: "g0" in planes[1].registry.gateways)
        assert not planes[3].registry.gateways
        assert all(not plane.session.refused for plane in planes)


async def test_gateways_of_one_id_that_meet_later_are_told_apart(
    tmp_path: Path, free_ports: Callable[..., list[int]]
) -> None:
    """Two of one id that could not see each other meet: both count it, one has to go, and no record is lost.

    The other way round, by an id that is taken when it joins, is `test_an_id_that_is_taken_is_refused`.
    """
    ends = [f"tcp/127.0.0.1:{port}" for port in free_ports(3)]
    async with contextlib.AsyncExitStack() as stack:

        async def join(number: int, name: str, connect: tuple[str, ...]) -> Plane:
            config = PlaneConfig(
                listen=(ends[number],), connect=connect, lease_ms=500, join_wait_s=0.0, anti_entropy_s=0.5
            )  # fmt: skip
            plane = await Plane.open(config, fleet="f", gateway=name, data_dir=tmp_path / str(number))
            stack.push_async_callback(plane.close)
            return plane

        # The third links the two, and is not there yet.
        same = [await join(number, "g0", (ends[2],)) for number in range(2)]
        for number, plane in enumerate(same):
            await plane.dht.write(f"task/{number}", b"x", expected=None)
        going = [asyncio.create_task(plane.displaced()) for plane in same]

        async def speak() -> None:
            for turn in itertools.count():
                for number, plane in enumerate(same):
                    load = turn % 2 / 2
                    status = GatewayStatus(id="g0", fleet="f", load=load, started_ns=5 - number, pid=number + 1)
                    plane.registry.publish_status(status)
                await asyncio.sleep(0.1)

        third = await join(2, "g2", ())
        speaking = asyncio.create_task(speak())
        try:
            await _until(lambda: all(plane.session.refused.get("another gateway with this id") for plane in same))
        finally:
            speaking.cancel()
        await going[0]
        assert not going[1].done()
        assert "give each gateway an id of its own" in str(going[0].result())
        going[1].cancel()
        await same[0].close()
        await _until(lambda: third.members() == same[1].members() == {"g0", "g2"})
        for number in range(2):
            # The one that stays hears of what the other had at its next comparison.
            while await third.dht.read(f"task/{number}") is None:
                await asyncio.sleep(0.05)


async def test_a_status_that_nobody_answers_for_displaces_nobody(
    tmp_path: Path, free_ports: Callable[..., list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Statuses of another process, as a program that plays a log puts them: its key is asked, and only it answers."""
    async with _planes(tmp_path, free_ports(2), "f") as (one, other):
        asked, query_all = asyncio.Event(), one.session.query_all

        async def noted(expr: str, payload: bytes, *, timeout_s: float) -> list[Message]:
            answers = await query_all(expr, payload, timeout_s=timeout_s)
            assert len(answers) == 1
            asked.set()
            return answers

        monkeypatch.setattr(one.session, "query_all", noted)
        one.registry.publish_status(GatewayStatus(id="g0", fleet="f", started_ns=2, pid=2))
        while not asked.is_set():
            status = GatewayStatus(id="g0", fleet="f", started_ns=1, pid=1)
            other.session.publish(keyspace.STATUS, status, "g0")
            await asyncio.sleep(0.1)
        await _until(lambda: one.registry.namesakes is not None and one.registry.namesakes._asking is None)
        assert one.registry.namesakes is not None
        assert not one.registry.namesakes.displaced.is_set()
        assert not one.session.refused


async def test_a_gateway_whose_version_does_not_fit_goes(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """The one that came later, with what is to be upgraded; the other stays and counts it."""
    async with _planes(tmp_path, free_ports(2), "f") as (one, other):
        own = GatewayStatus(id="g1", fleet="f", started_ns=9, pid=1)
        other.registry.publish_status(own)
        goes = asyncio.create_task(other.displaced())
        stays = asyncio.create_task(one.displaced())
        # What a newer version, which was there first, says of itself, with fields that this one does not know.
        newer = GatewayStatus(id="g0", fleet="f", version="3.0", protocol=3, oldest_protocol=2, started_ns=1, pid=1)
        text = msgspec.json.decode(encode(newer), type=dict[str, object]) | {"later": {"a": [1]}}
        key = one.session.keys(keyspace.STATUS, "g0")
        async with asyncio.timeout(60):
            while not goes.done():
                one.session.put(key, encode(text))
                await asyncio.sleep(0.1)
        error = goes.result()
        assert "speaks protocol 3" in error.message
        assert "upgrade this gateway" in error.remedy
        assert other.session.refused["incompatible gateway"]
        assert not stays.done()
        stays.cancel()


@pytest.mark.parametrize("hours", [1, -1])
async def test_a_clock_that_is_an_hour_off(tmp_path: Path, free_ports: Callable[..., list[int]], hours: int) -> None:
    """Facts stamped an hour ahead or behind are believed all the same, later ones replace them, and writes go on."""
    async with _planes(tmp_path, free_ports(2), "f") as (one, other):
        off = Session(Wire(other.config, "f", one.session._wire.raw, asyncio.get_running_loop()))
        when = dt.datetime.now(dt.UTC) + dt.timedelta(hours=hours)
        stamp = zenoh.Timestamp(when, one.session._wire.raw.new_timestamp().get_id())
        status = GatewayStatus(id="g0", fleet="f", load=0.25)
        off._wire.raw.put(off.keys(keyspace.STATUS, "g0"), encode(status), timestamp=stamp)
        await _until(lambda: "g0" in other.registry.gateways)
        one.registry.publish_status(GatewayStatus(id="g0", fleet="f", load=0.75))
        await _until(lambda: other.registry.gateways["g0"].load == 0.75)
        version = await one.dht.write("task/1", b"1", expected=None)
        assert descends(await other.dht.write("task/1", b"2", expected=version), version)


async def test_outdated_and_forged_versions_lose_nothing(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Older copies change nothing, forged ones are resolved like any other, impossible ones are refused and counted."""
    async with _planes(tmp_path, free_ports(2), "f") as (one, other):
        first = await one.dht.write("task/1", b"1", expected=None)
        second = await one.dht.write("task/1", b"2", expected=first)
        old = StoreAsk(Record(key="task/1", value=b"1", version=first, write="w"))
        answer = await one.rpc.call("g1", keyspace.DHT_STORE, old)
        assert answer.record is not None
        assert answer.record.version == second
        aside = Record(key="task/1", value=b"0", version={"g9": 7}, write="x")
        told = (await one.rpc.call("g1", keyspace.DHT_STORE, StoreAsk(aside), direct=True)).record
        assert told is not None
        assert told.value == b"2"
        assert descends(told.version, second)
        assert descends(told.version, aside.version)
        for version in ({}, {"g0": 0}, {"g0": -1}, {"g0": 2**53}, {"no name": 1}, {f"g{n}": 1 for n in range(300)}):
            for direct in (False, True):
                ask = StoreAsk(Record(key="task/1", value=b"", version=version))
                with pytest.raises(PayloadError):
                    await one.rpc.call("g1", keyspace.DHT_STORE, ask, direct=direct)
        assert other.session.refused["malformed gw/g1/rpc/dht_store"] == 12
        with pytest.raises(ConflictError):
            await other.dht.write("task/1", b"3", expected={"g0": 2**40})
        read = await other.dht.read("task/1")
        assert read is not None
        assert read.value == b"2"


async def test_a_version_without_room_is_said_so_and_the_record_stays(
    tmp_path: Path, free_ports: Callable[..., list[int]]
) -> None:
    """A forged count that no write can follow: the writer gets an error from any gateway, and the old value stands."""
    async with _planes(tmp_path, free_ports(2), "f") as planes:
        version = {"g0": 2**53 - 1, "g1": 2**53 - 1}
        ask = StoreAsk(Record(key="task/1", value=b"1", version=version, write="x"))
        for plane, other in ((planes[0], "g1"), (planes[1], "g0")):
            await plane.rpc.call(other, keyspace.DHT_STORE, ask)
        for plane in planes:
            with pytest.raises(PayloadError, match="cannot be changed any more"):
                await plane.dht.write("task/1", b"2", expected=version)
            read = await plane.dht.read("task/1")
            assert read is not None
            assert (read.value, read.version) == (b"1", version)


async def test_what_is_not_known_is_kept(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """A value is bytes to the plane: fields of a later version come back as they were written, also when copies met."""
    async with _planes(tmp_path, free_ports(2), "f") as (one, _):
        value = b'{"id":"t-1","of_a_later_version":{"deep":[1,2,{"x":null}]}}'
        await one.dht.write("task/t-1", value, expected=None)
        aside = Record(key="task/t-1", value=b"", version={"g9": 1}, write="x")
        await one.rpc.call("g1", keyspace.DHT_STORE, StoreAsk(aside))
        body = b'{"key":"task/t-1","later":{"a":1}}'
        found = await one.session.query(one.keys(keyspace.RPC, "g1", "dht_read"), body, timeout_s=5)
        assert b'"record"' in found
        answer = await one.rpc.call("g1", keyspace.DHT_READ, KeyAsk("task/t-1"))
        assert answer.record is not None
        assert answer.record.value == value
