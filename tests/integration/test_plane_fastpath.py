"""The ordinary write, ordered where it comes, between real gateways; and each way in which it turns out otherwise."""

import asyncio
import contextlib
import sqlite3
import threading
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from plane_fleet import Fleet, fleet_of, until

from appliance.errors import ConflictError, PrerequisiteError, SwiftbotError
from appliance.plane import commits
from appliance.plane.messages import StoreAsk
from appliance.plane.node import Plane
from appliance.plane.rows import put_row
from appliance.plane.versions import Record, Write

pytestmark = pytest.mark.anyio


@pytest.fixture
async def fleet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Fleet]:
    """Three gateways that see each other and have made the ways to each other."""
    async with fleet_of(tmp_path, free_ports(3)) as made:
        for number in range(3):
            await made.start(number)
        await made.settled()
        await until(lambda: all(_ways(plane) == 2 for plane in made.planes.values()))
        yield made


def _ways(plane: Plane) -> int:
    others = plane.members() - {plane.gateway}
    return sum(plane.rpc.known_way(name, "dht_store") is not None for name in others)


def _ordered(plane: Plane, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The threads on which writes are ordered without the event loop."""
    threads = list[int]()
    decide_now = plane.store.decide_now

    def noted(*args: Any, **kwargs: Any) -> Record | None:
        record = decide_now(*args, **kwargs)
        if record is not None:
            threads.append(threading.get_ident())
        return record

    monkeypatch.setattr(plane.store, "decide_now", noted)
    return threads


async def _copies(fleet: Fleet, key: str) -> list[bytes]:
    found = [await plane.store.record(key) for plane in fleet.planes.values()]
    return [record.value for record in found if record is not None]


async def test_writes_are_ordered_where_they_come(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """One from elsewhere on a thread of Zenoh's, one's own in place: all copies are there when it is acknowledged."""
    owner, other = fleet.planes[1], fleet.planes[0]
    threads = _ordered(owner, monkeypatch)

    async def never(asked: Write) -> None:
        raise AssertionError(asked)

    monkeypatch.setattr(owner.dht.ordering, "order", never)
    key = fleet.owned_by(1)
    version = await other.dht.write(key, b"1", expected=None)
    assert await _copies(fleet, key) == [b"1"] * 3
    version = await owner.dht.write(key, b"2", expected=version)
    assert await _copies(fleet, key) == [b"2"] * 3
    assert len(threads) == 2
    assert threads[0] != threads[1] == threading.get_ident()
    await other.dht.remove(key, expected=version)
    assert await other.dht.read(key) is None
    assert not owner.dht.ordering.fast._under_way


async def test_a_gateway_alone_keeps_nothing_of_what_is_done(
    tmp_path: Path, free_ports: Callable[..., list[int]]
) -> None:
    """Nobody else has a copy, so that a commit ends a write on the spot, before its order has returned."""
    async with fleet_of(tmp_path, free_ports(1)) as fleet:
        plane = await fleet.start(0)
        await fleet.settled()
        decide_now = plane.store.decide_now

        def slow(*args: Any, **kwargs: Any) -> Record | None:
            record = decide_now(*args, **kwargs)
            plane.store.wake()
            time.sleep(0.02)
            return record

        plane.store.decide_now = slow
        for number in range(5):
            asked = Write(key=f"task/{number}", value=b"1", write="w")
            assert await plane.dht._write(asked) == {"g0": 1}
            assert plane.dht.ordering._lately.of(asked.key, "w") == (True, {"g0": 1})
        assert not plane.dht.ordering.fast._under_way


async def test_what_is_not_ordinary_goes_by_the_loop(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Conflicts, unknown versions and large values: the same answers, from the event loop."""
    owner, other = fleet.planes[1], fleet.planes[0]
    threads = _ordered(owner, monkeypatch)
    key, large = fleet.owned_by(1), fleet.owned_by(1)
    version = await other.dht.write(key, b"1", expected=None)
    assert len(threads) == 1
    for stale in (None, {"g1": 7}, {"g9": 1}):
        with pytest.raises(ConflictError):
            await other.dht.write(key, b"2", expected=stale)
    await other.dht.write(large, b"x" * 30_000, expected=None)
    assert len(threads) == 1
    assert await _copies(fleet, large) == [b"x" * 30_000] * 3
    # Asked again with the same id it is done already.
    asked = Write(key=key, value=b"3", expected=version, write="mine")
    assert await other.dht._write(asked) == await other.dht._write(asked) == {"g1": 2}
    assert len(threads) == 2


async def test_a_copy_that_is_too_large_for_a_message_is_there_as_well(fleet: Fleet) -> None:
    """Many have written the record, and their names make its copies large: they go as queries, before it is done."""
    owner, key = fleet.planes[1], fleet.owned_by(1)
    version = {f"{'w' * 58}{number:03}": 1 for number in range(200)}
    for plane in fleet.planes.values():
        await plane.dht.keep(Record(key=key, value=b"0", version=version, write="theirs"))
    value = b"x" * 15_000
    assert await owner.dht.write(key, value, expected=version) == version | {"g1": 1}
    assert await _copies(fleet, key) == [value] * 3
    assert not owner.session.refused


@pytest.mark.parametrize("value", [b"1", b"x" * 30_000])
async def test_a_write_that_is_asked_for_again_is_done_once(fleet: Fleet, value: bytes) -> None:
    """Its answer was lost, another's write followed: asked again it is told as done, with the version that it made."""
    key = fleet.owned_by(1)
    asked = Write(key=key, value=value, expected=None, write="mine")
    assert await fleet.planes[0].dht._write(asked) == {"g1": 1}
    later = await fleet.planes[2].dht.write(key, b"theirs", expected={"g1": 1})
    assert await fleet.planes[0].dht._write(asked) == {"g1": 1}
    assert (await fleet.planes[0].dht.read(key) or Record(key="")).version == later
    with pytest.raises(ConflictError):
        await fleet.planes[0].dht._write(Write(key=key, value=value, expected=None, write="another"))


async def test_one_of_many_writers_wins(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty writers at three gateways count up one record, on all threads at once: none is lost or doubled."""
    key = fleet.owned_by(1)
    threads = _ordered(fleet.planes[1], monkeypatch)
    await fleet.planes[0].dht.write(key, b"0", expected=None)

    async def add(plane: Plane) -> None:
        while True:
            record = await plane.dht.read(key)
            assert record is not None
            try:
                await plane.dht.write(key, str(int(record.value) + 1).encode(), expected=record.version)
            except ConflictError:
                continue
            return

    await asyncio.gather(*(add(plane) for plane in fleet.planes.values() for _ in range(10)))
    assert await _copies(fleet, key) == [b"30"] * 3
    assert len(set(threads)) > 1


async def test_a_write_that_a_later_one_overtakes_is_done(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its replicas hold the later one when they are given it: the writer hears that it is done, and no conflict."""
    owner, key, held = fleet.planes[1], fleet.owned_by(1), list[Callable[[], object]]()
    ask_here = owner.rpc.ask_here

    def late(way: Any, gateway: str, verb: str, payload: bytes, on_reply: Any) -> int | None:
        if len(held) < 2:
            held.append(lambda: ask_here(way, gateway, verb, payload, on_reply))
            return 0
        return ask_here(way, gateway, verb, payload, on_reply)

    monkeypatch.setattr(owner.rpc, "ask_here", late)
    writing = asyncio.create_task(owner.dht.write(key, b"first", expected=None))
    while (first := await fleet.planes[0].dht.read(key)) is None:
        await asyncio.sleep(0.001)
    later = await fleet.planes[2].dht.write(key, b"second", expected=first.version)
    for send in held:
        send()
    assert await writing == first.version
    assert await _copies(fleet, key) == [b"second"] * 3
    assert (await fleet.planes[2].dht.read(key) or Record(key="")).version == later


@pytest.mark.parametrize("local", [True, False])
async def test_a_silent_replica_holds_up_a_write_for_a_moment(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, *, local: bool
) -> None:
    """Then it is acknowledged without it, and the replica is offered the record again."""
    owner, silent, key = fleet.planes[1], fleet.planes[2], fleet.owned_by(1)

    def nothing(asked: StoreAsk, answer: object) -> bool:
        return True

    served = silent.rpc._verbs._served["dht_store"]  # pyright: ignore[reportOptionalMemberAccess]
    with monkeypatch.context() as patched:
        patched.setattr(served, "_at_once", nothing)
        began = asyncio.get_running_loop().time()
        await (owner if local else fleet.planes[0]).dht.write(key, b"1", expected=None)
        took = asyncio.get_running_loop().time() - began
    assert took >= owner.config.replica_timeout_s
    assert not owner.session._asking._direct._waiting
    while await _copies(fleet, key) != [b"1"] * 3:
        await asyncio.sleep(0.01)
    # The way is looked at anew, and the next one is ordinary again.
    threads = _ordered(owner, monkeypatch)
    for number in range(2):
        await fleet.planes[0].dht.write(fleet.owned_by(1), str(number).encode(), expected=None)
    assert threads


@pytest.mark.parametrize("answered", [b"not json", b'{"record": 7}', b""])
async def test_a_replica_that_answers_nonsense_is_counted(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, answered: bytes
) -> None:
    """The write stands; what is no answer is counted, and an empty one has the replica asked again as a query."""
    owner, odd, key = fleet.planes[1], fleet.planes[2], fleet.owned_by(1)

    def nonsense(payload: bytes, answer: Any) -> bool:
        answer(answered, None)
        return True

    served = odd.rpc._verbs._served["dht_store"]  # pyright: ignore[reportOptionalMemberAccess]
    with monkeypatch.context() as patched:
        patched.setattr(served, "_at_once", nonsense)
        version = await fleet.planes[0].dht.write(key, b"1", expected=None)
    assert version == {"g1": 1}
    assert owner.session.refused.get("malformed answer dht_store", 0) == (1 if answered else 0)
    assert (await fleet.planes[0].dht.read(key) or Record(key="")).value == b"1"


async def test_a_replica_that_knows_more_is_heard(fleet: Fleet) -> None:
    """It holds what was written on the other side of a cut: both become one, and the writer hears of a conflict."""
    owner, replica, key = fleet.planes[1], fleet.planes[2], fleet.owned_by(1)
    apart = Record(key=key, value=b"zzz", version={"g2": 3}, write="theirs")
    await replica.dht.keep(apart)
    with pytest.raises(ConflictError, match="written elsewhere too"):
        await fleet.planes[0].dht.write(key, b"aaa", expected=None)
    found = await fleet.planes[0].dht.read(key)
    assert found is not None
    assert (found.value, found.version) == (b"zzz", {"g1": 1, "g2": 3})
    assert await owner.dht.write(key, b"next", expected=found.version) == {"g1": 2, "g2": 3}


@pytest.mark.parametrize("writer", [0, 1])
async def test_a_disk_that_fails_is_told(fleet: Fleet, monkeypatch: pytest.MonkeyPatch, writer: int) -> None:
    """The writer hears why; the next decision on the key rests on what the replicas may have."""
    key = fleet.owned_by(1)
    broken = fleet.planes[1].store._commits

    def full(db: sqlite3.Connection, record: Record) -> None:
        if db is not None and threading.current_thread() is broken._thread:
            raise sqlite3.OperationalError("database or disk is full")
        put_row(db, record)

    with monkeypatch.context() as patched:
        patched.setattr(commits, "put_row", full)
        with pytest.raises(PrerequisiteError, match="is full"):
            await fleet.planes[writer].dht.write(key, b"1", expected=None)
        await asyncio.sleep(0.1)
    with pytest.raises(ConflictError):  # two disks have it: it is not lost, and not written a second time
        await fleet.planes[0].dht.write(key, b"2", expected=None)
    found = await fleet.planes[0].dht.read(key)
    assert found is not None
    assert found.value == b"1"
    await fleet.planes[0].dht.write(key, b"3", expected=found.version)
    assert await _copies(fleet, key) == [b"3"] * 3


async def test_who_waits_hears_that_a_gateway_stops(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write under way ends with an error or is done by the next owner; nothing is waited for without end."""
    owner, key, another = fleet.planes[1], fleet.owned_by(1), fleet.owned_by(1)

    def never(*_: Any) -> int:
        return 0

    monkeypatch.setattr(owner.rpc, "ask_here", never)
    own = asyncio.create_task(owner.dht.write(key, b"1", expected=None))
    others = asyncio.create_task(fleet.planes[0].dht.write(another, b"2", expected=None))
    await until(lambda: len(owner.dht.ordering.fast._under_way) == 2)
    await fleet.stop(1)
    assert not owner.dht.ordering.fast._under_way
    # Its own writer asks again until all is closed: it may still be done.
    with contextlib.suppress(SwiftbotError):
        assert await asyncio.wait_for(own, 10) == {"g1": 1}
    # The next owner has not heard of it, and does it.
    assert await asyncio.wait_for(others, 10) == {fleet.planes[0].ring.owner(another): 1}
