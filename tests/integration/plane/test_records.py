"""Replicated records on real sessions: compare-and-set, repair, versions made apart, removal, what is refused."""

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import msgspec
import pytest
from plane_fleet import Fleet, fleet_of

from appliance.errors import ConflictError, PayloadError, SwiftbotError, UnreachableError
from appliance.model import keyspace
from appliance.model.plane_api import Record, Write
from appliance.plane.node import Plane
from appliance.plane.records import descends
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


@pytest.fixture
async def fleet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Fleet]:
    """Three gateways that see each other."""
    async with fleet_of(tmp_path, free_ports(3)) as made:
        for number in range(3):
            await made.start(number)
        await made.settled()
        yield made


async def test_a_record_is_written_once_and_read_anywhere(fleet: Fleet) -> None:
    """A write through any gateway is on every replica's disk when it returns; stale writers conflict."""
    one, two, three = fleet.planes.values()
    for owner in range(3):
        key = fleet.owned_by(owner)
        version = await one.dht.write(key, b"1", expected=None)
        assert version == {f"g{owner}": 1}
        for plane in fleet.planes.values():
            assert (await plane.store.record(key)) is not None
            read = await plane.dht.read(key)
            assert read is not None
            assert (read.value, read.version) == (b"1", version)
            assert plane.dht.owns(key) == (plane.gateway == f"g{owner}")
        newer = await two.dht.write(key, b"2", expected=version)
        assert descends(newer, version)
        for stale in (None, version, {"g9": 1}):
            with pytest.raises(ConflictError):
                await three.dht.write(key, b"3", expected=stale)
        await three.dht.remove(key, expected=newer)
        assert await one.dht.read(key) is None
        assert key not in [record.key for record in await one.dht.local("task/")]
        assert descends(await two.dht.write(key, b"4", expected=None), newer)
    assert await one.dht.read("task/none") is None


async def test_a_write_that_a_later_one_overtakes_is_done(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its replicas hold the later one when they are given it: the writer hears that it is done, and no conflict."""
    owner, key, gate = fleet.planes[1], fleet.owned_by(1), asyncio.Event()
    begin = owner.dht._pushing.begin

    class Late:
        """A push that waits."""

        def __init__(self, gateway: str, record: Record) -> None:
            self.gateway, self.record = gateway, record

        async def done(self) -> Record | None:
            """What came of it."""
            await gate.wait()
            return await begin(self.gateway, self.record).done()

        def end(self) -> None:
            """Nothing to end."""

    def push(gateway: str, record: Record, *, durable: bool = True) -> object:
        return Late(gateway, record) if record.value == b"first" else begin(gateway, record, durable=durable)

    monkeypatch.setattr(owner.dht._pushing, "begin", push)
    writing = asyncio.create_task(owner.dht.write(key, b"first", expected=None))
    while (first := await fleet.planes[0].dht.read(key)) is None:
        await asyncio.sleep(0.01)
    later = await fleet.planes[2].dht.write(key, b"second", expected=first.version)
    gate.set()
    assert await writing == first.version
    for plane in fleet.planes.values():
        held = await plane.store.record(key)
        assert held is not None
        assert (held.value, held.version) == (b"second", later)


async def test_one_of_many_writers_at_many_gateways_wins(fleet: Fleet) -> None:
    """Thirty writers at three gateways increment a counter by read and compare-and-set: none is lost or doubled."""
    key = fleet.owned_by(1)
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
    for plane in fleet.planes.values():
        record = await plane.store.record(key)
        assert record is not None
        assert record.value == b"30"


def _least(key: str, one: Record, other: Record) -> Record:
    return min(one, other, key=lambda record: record.value)


async def test_versions_made_apart_are_resolved_alike(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Gateways that wrote one key without knowing of each other agree on one version once they meet."""
    ports = free_ports(2)
    for number, value in ((0, b"aaa"), (1, b"bbb")):
        async with fleet_of(tmp_path, ports) as apart:
            plane = await apart.start(number)
            await plane.dht.write("task/1", value, expected=None)
    async with fleet_of(tmp_path, ports) as fleet:
        for number in range(2):
            await fleet.start(number, resolver=_least)
        await fleet.settled()
        for plane in fleet.planes.values():
            while (await plane.store.record("task/1") or Record(key="")).version != {"g0": 1, "g1": 1}:
                await asyncio.sleep(0.01)
        first, second = [await plane.store.record("task/1") for plane in fleet.planes.values()]
        assert first == second


async def test_a_missed_copy_is_repaired(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """A replica that lost or never got a copy has it again after the next comparison."""
    async with fleet_of(tmp_path, free_ports(2), anti_entropy_s=0.1) as fleet:
        for number in range(2):
            await fleet.start(number)
        await fleet.settled()
        await fleet.planes[0].dht.write("task/1", b"v", expected=None)
        copy = await fleet.planes[1].store.record("task/1")
        assert copy is not None
        await fleet.planes[1].store.forget(copy)
        while await fleet.planes[1].store.record("task/1") != copy:
            await asyncio.sleep(0.02)


async def test_an_owner_that_is_behind_catches_up_before_it_decides(fleet: Fleet) -> None:
    """An owner that missed a version its writer has seen gets it from a replica instead of refusing."""
    key = fleet.owned_by(0)
    await fleet.planes[0].dht.write(key, b"1", expected=None)
    for number in (1, 2):
        await fleet.planes[number].dht.keep(Record(key=key, value=b"2", version={"g0": 1, "g1": 1}, write="w"))
    version = await fleet.planes[2].dht.write(key, b"3", expected={"g0": 1, "g1": 1})
    assert version == {"g0": 2, "g1": 1}


async def test_a_second_owner_conflicts(fleet: Fleet) -> None:
    """An owner whose replicas hold a version made by another owner conflicts, and all agree afterwards."""
    key = fleet.owned_by(0)
    for number in (1, 2):
        await fleet.planes[number].dht.keep(Record(key=key, value=b"zzz", version={"g1": 1}, write="w"))
    with pytest.raises(ConflictError, match="elsewhere"):
        await fleet.planes[0].dht.write(key, b"aaa", expected=None)
    copies = [await plane.store.record(key) for plane in fleet.planes.values()]
    assert copies[0] is not None
    assert copies[0].value == b"zzz"
    assert copies[0].version == {"g0": 1, "g1": 1}
    assert copies == [copies[0]] * 3


async def test_bad_keys_and_values_are_refused(fleet: Fleet) -> None:
    """Oversize values and impossible keys are refused with the reason, here and at the owner."""
    plane = fleet.planes[0]
    with pytest.raises(PayloadError, match="at most"):
        await plane.dht.write("task/1", b"x" * (plane.config.max_record_bytes + 1), expected=None)
    for key in ("", "a\nb", "x" * 600):
        with pytest.raises(PayloadError):
            await plane.dht.write(key, b"", expected=None)
        with pytest.raises(PayloadError):
            await plane.dht.read(key)
    value = os.urandom(plane.config.max_record_bytes)
    version = await plane.dht.write("task/large", value, expected=None)
    record = await fleet.planes[1].dht.read("task/large")
    assert record is not None
    assert (record.value, record.version) == (value, version)


async def test_malformed_and_oversize_input_on_every_verb(fleet: Fleet) -> None:
    """Every verb the plane serves answers `payload` to what is malformed, oversize or impossible, and goes on."""
    plane = fleet.planes[0]
    foreign = await Session.open(PlaneConfig(mode="client", connect=(fleet.endpoints[0],)), "f")
    verbs = sorted(plane.rpc._handlers)
    impossible = {
        "lease_grant": [
            {"key": "k", "holder": "", "fence": 1, "ttl_s": 1, "voters": ""},
            {"key": "k", "holder": "h", "fence": 0, "ttl_s": 1, "voters": ""},
            {"key": "k", "holder": "h", "fence": 1, "ttl_s": 31, "voters": ""},
        ],
        "lease_release": [{"key": "k", "holder": "h", "fence": 0, "voters": ""}],
        "record_read": [{"key": ""}],
        "record_write": [{"key": "", "value": ""}, {"key": "k", "expected": {"g": 0}}],
        "dht_read": [{"key": ""}],
        "dht_write": [{"key": "", "value": ""}, {"key": "k", "expected": {"g": 0}}, {"key": "k", "value": "&"}],
        "dht_store": [{"record": {"key": "k"}}, {"record": {"key": "k", "version": {"A/": 1}}}],
        "dht_fetch": [{"keys": ["k"] * 5000}],
        "dht_digest": [{"asker": "A/*"}],
        "facts": [],
        "member": [{"gateway": "A/*"}],
        "reopening": [{"gateway": "A/*"}],
        "roster": [],
        "records": [{"prefix": "x" * 600}, {"after": "x" * 600}, {"limit": 0}, {"limit": 10**9}],
        "record_place": [{"key": ""}],
    }
    assert verbs == sorted(impossible)
    for verb in verbs:
        key = plane.keys(keyspace.RPC, "g0", verb)
        for payload in (b"", b"{", b"\xff\xff", b"[]", b"7", b"[" * 50_000):
            with pytest.raises(PayloadError):
                await foreign.query(key, payload, timeout_s=5)
        for body in impossible[verb]:
            with pytest.raises(PayloadError):
                await foreign.query(key, msgspec.json.encode(body), timeout_s=5)
        oversize = b"x" * (plane.config.max_payload_bytes + 1)
        answers = await asyncio.to_thread(
            lambda key=key, oversize=oversize: list(foreign._wire.raw.get(key, payload=oversize, timeout=10))
        )
        assert b'"payload"' in answers[0].err.payload.to_bytes()
        assert plane.session.refused[f"malformed gw/g0/rpc/{verb}"] >= 6
        assert plane.session.refused[f"oversize gw/g0/rpc/{verb}"] == 1
    await foreign.close()
    key = fleet.owned_by(0)
    assert await fleet.planes[1].dht.write(key, b"still works", expected=None)


async def test_a_removal_is_remembered_for_its_time_everywhere(
    tmp_path: Path, free_ports: Callable[..., list[int]]
) -> None:
    """Until then no old copy brings the record back; then every replica forgets it, and a new one is new."""
    async with fleet_of(tmp_path, free_ports(3), anti_entropy_s=0.1) as fleet:
        for number in range(3):
            await fleet.start(number)
        await fleet.settled()
        planes = list(fleet.planes.values())
        version = await planes[0].dht.write("task/1", b"v", expected=None)
        await planes[0].dht.remove("task/1", expected=version)
        old = Record(key="task/1", value=b"v", version=version, write="w")
        for plane in planes:
            kept = await plane.dht.keep(old)
            assert kept.deleted
            # It keeps it from now on for no time at all.
            tidying = plane._reconciler._hand_over
            tidying._config = msgspec.structs.replace(tidying._config, tombstone_hours=0.0)
        for plane in planes:
            while await plane.store.record("task/1") is not None:
                plane._reconciler._changed.set()
                await asyncio.sleep(0.02)
        assert await planes[1].dht.read("task/1") is None
        assert set(await planes[1].dht.write("task/1", b"new", expected=None)) == set(version)


async def test_a_write_meant_for_another_is_refused(fleet: Fleet) -> None:
    """A gateway that does not own a key does not order its writes: it names the owner."""
    key = fleet.owned_by(1)
    with pytest.raises(SwiftbotError, match="belongs to g1"):
        await fleet.planes[0].dht.ordering.order(Write(key=key, value=b"", write="w"))


async def test_a_fleet_that_cannot_be_written_to_says_so(fleet: Fleet) -> None:
    """When the owner answers nothing but errors of its own mind, the write ends within its time with the reason."""
    plane = fleet.planes[0]
    key = fleet.owned_by(1)
    plane.dht._config = msgspec.structs.replace(plane.config, write_timeout_s=0.2)
    fleet.planes[1].rpc.close()
    with pytest.raises(UnreachableError, match="could not be written"):
        await plane.dht.write(key, b"", expected=None)
