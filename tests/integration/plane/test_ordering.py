"""Writes as their owner orders them, between real gateways: asked for again, with replicas and a disk that fail."""

import asyncio
import contextlib
import sqlite3
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from plane_fleet import Fleet, fleet_of

from appliance.errors import ConflictError, PrerequisiteError, SwiftbotError
from appliance.model.plane_api import Record, Write
from appliance.plane.node import Plane
from appliance.plane.session import Handler

pytestmark = pytest.mark.anyio


@pytest.fixture
async def fleet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Fleet]:
    """Three gateways that see each other."""
    async with fleet_of(tmp_path, free_ports(3)) as made:
        for number in range(3):
            await made.start(number)
        await made.settled()
        yield made


async def _copies(fleet: Fleet, key: str) -> list[bytes]:
    found = [await plane.store.record(key) for plane in fleet.planes.values()]
    return [record.value for record in found if record is not None]


def _stores(plane: Plane, handler: Handler, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a gateway answer so when it is given a copy."""
    assert plane.rpc._verbs is not None
    monkeypatch.setattr(plane.rpc._verbs._served["dht_store"], "handler", handler)


async def test_a_record_with_many_writers_is_copied(fleet: Fleet) -> None:
    """Their names make its copies larger than a question that may be dropped: they are there before it is done."""
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
    """Its answer was lost, another's write followed: asked again, the answer is "done" with its version."""
    key = fleet.owned_by(1)
    asked = Write(key=key, value=value, expected=None, write="mine")
    assert await fleet.planes[0].dht._write(asked) == {"g1": 1}
    later = await fleet.planes[2].dht.write(key, b"theirs", expected={"g1": 1})
    assert await fleet.planes[0].dht._write(asked) == {"g1": 1}
    assert (await fleet.planes[0].dht.read(key) or Record(key="")).version == later
    with pytest.raises(ConflictError):
        await fleet.planes[0].dht._write(Write(key=key, value=value, expected=None, write="another"))


@pytest.mark.parametrize("writer", [0, 1])
async def test_a_silent_replica_holds_up_a_write_for_a_moment(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, writer: int
) -> None:
    """Then it is acknowledged without it, and the replica is offered the record again."""
    owner, silent, key = fleet.planes[1], fleet.planes[2], fleet.owned_by(1)
    asked = asyncio.Event()

    async def nothing(_: str, __: bytes) -> bytes:
        asked.set()
        await asyncio.Event().wait()
        return b""

    with monkeypatch.context() as patched:
        _stores(silent, nothing, patched)
        await fleet.planes[writer].dht.write(key, b"1", expected=None)
        assert asked.is_set()
        assert await owner.store.record(key) is not None
        assert await silent.store.record(key) is None
    while await _copies(fleet, key) != [b"1"] * 3:
        await asyncio.sleep(0.01)


@pytest.mark.parametrize("answered", [b"not json", b'{"record": 7}'])
async def test_a_replica_that_answers_nonsense_is_counted(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, answered: bytes
) -> None:
    """The write stands, and what is no answer is counted."""
    owner, odd, key = fleet.planes[1], fleet.planes[2], fleet.owned_by(1)

    async def nonsense(_: str, __: bytes) -> bytes:
        return answered

    with monkeypatch.context() as patched:
        _stores(odd, nonsense, patched)
        version = await fleet.planes[0].dht.write(key, b"1", expected=None)
    assert version == {"g1": 1}
    assert owner.session.refused["malformed answer dht_store"] == 1
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


class FullDisk:
    """A connection whose commits fail."""

    def __init__(self, db: Any) -> None:
        self._db = db

    def __getattr__(self, name: str) -> Any:
        return getattr(self._db, name)

    def execute(self, sql: str, *values: Any) -> Any:
        """Fail to commit."""
        if sql == "COMMIT":
            raise sqlite3.OperationalError("database or disk is full")
        return self._db.execute(sql, *values)


@pytest.mark.parametrize("writer", [0, 1])
async def test_a_disk_that_fails_is_told(fleet: Fleet, monkeypatch: pytest.MonkeyPatch, writer: int) -> None:
    """The writer hears why; the next decision on the key rests on what the replicas may have."""
    key = fleet.owned_by(1)
    broken = fleet.planes[1].store._commits
    do = broken._do
    with monkeypatch.context() as patched:
        patched.setattr(broken, "_do", lambda db, batch: do(FullDisk(db), batch))
        with pytest.raises(PrerequisiteError, match="is full"):
            await fleet.planes[writer].dht.write(key, b"1", expected=None)
    while await _copies(fleet, key) != [b"1"] * 2:
        await asyncio.sleep(0.01)
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
    under_way, both = 0, asyncio.Event()

    async def never(_: str, __: bytes) -> bytes:
        nonlocal under_way
        under_way += 1
        if under_way == 4:  # two copies of each
            both.set()
        await asyncio.Event().wait()
        return b""

    with monkeypatch.context() as patched:
        for number in (0, 2):
            _stores(fleet.planes[number], never, patched)
        patched.setattr("appliance.plane.dht._PUSH_AGAIN_S", ())
        own = asyncio.create_task(owner.dht.write(key, b"1", expected=None))
        others = asyncio.create_task(fleet.planes[0].dht.write(another, b"2", expected=None))
        await both.wait()
    await fleet.stop(1)
    # Its own writer asks again until all is closed: it may still be done.
    with contextlib.suppress(SwiftbotError):
        assert await asyncio.wait_for(own, 10) == {"g1": 1}
    # The next owner may have heard of it or not, and does it.
    assert await asyncio.wait_for(others, 10)
