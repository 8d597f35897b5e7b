"""Reads and writes with a quorum on real sessions: one chain of changes, minorities refuse, restarts remember."""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import msgspec
import pytest

from appliance.errors import ConfigError, ConflictError, RefusedError, SwiftbotError, UnreachableError
from appliance.plane.messages import Found, RecordAsk, RecordChange, Written
from appliance.plane.node import STORE_FILE, Plane
from appliance.plane.quorum.messages import AcceptAsk, PrepareAsk, VoteAsk, Voted
from appliance.plane.quorum.register import Ballot
from appliance.plane.settings import PlaneConfig
from appliance.plane.versions import Record, descends

pytestmark = pytest.mark.anyio


class Fleet:
    """Gateways in this process that all vote; three of them on each key."""

    def __init__(self, folder: Path, ports: list[int], **settings: object) -> None:
        self.folder = folder
        self.endpoints = [f"tcp/127.0.0.1:{port}" for port in ports]
        self.voters = [f"g{number}" for number in range(len(ports))]
        self.settings: dict[str, object] = {"write_timeout_s": 1.0, **settings}
        self.planes: dict[int, Plane] = {}

    async def start(self, number: int, **settings: object) -> Plane:
        """Start one gateway and wait until all that are there see it."""
        own = {
            "listen": (self.endpoints[number],),
            "peers": {f"g{each}": endpoint for each, endpoint in enumerate(self.endpoints)},
            "voters": self.voters,
        }
        config = msgspec.convert({**own, **self.settings, **settings}, PlaneConfig)
        plane = await Plane.open(config, fleet="quorum", gateway=f"g{number}", data_dir=self.folder / f"g{number}")
        self.planes[number] = plane
        while not all(
            len(each.members()) == len(self.planes) and each.dht.settling.reconciled() for each in self.planes.values()
        ):
            await asyncio.sleep(0.01)
        return plane

    async def stop(self, *numbers: int) -> None:
        """Stop some."""
        for number in numbers:
            await self.planes.pop(number).close()


@pytest.fixture
async def fleet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Fleet]:
    """Three gateways, all voters of every key."""
    async with _fleet(tmp_path, free_ports(3)) as made:
        for number in range(3):
            await made.start(number)
        yield made


@contextlib.asynccontextmanager
async def _fleet(folder: Path, ports: list[int], **settings: object) -> AsyncIterator[Fleet]:
    made = Fleet(folder, ports, **settings)
    try:
        yield made
    finally:
        await made.stop(*tuple(made.planes))


async def test_what_was_acknowledged_is_read(fleet: Fleet) -> None:
    """A write with a quorum is read with a quorum at every gateway, and plainly soon; stale writers conflict."""
    one, two, three = fleet.planes.values()
    assert await one.dht.read("task/1", quorum=True) is None
    version = await one.dht.write("task/1", b"1", expected=None, quorum=True)
    for plane in fleet.planes.values():
        read = await plane.dht.read("task/1", quorum=True)
        assert read is not None
        assert (read.value, read.version) == (b"1", version)
    newer = await two.dht.write("task/1", b"2", expected=version, quorum=True)
    assert descends(newer, version)
    for stale in (None, version, {"g9": 1}):
        with pytest.raises(ConflictError):
            await three.dht.write("task/1", b"3", expected=stale, quorum=True)
    for plane in fleet.planes.values():
        while (record := await plane.store.record("task/1")) is None or record.version != newer:
            await asyncio.sleep(0.01)
    await three.dht.remove("task/1", expected=newer, quorum=True)
    assert await one.dht.read("task/1", quorum=True) is None
    assert descends(await two.dht.write("task/1", b"4", expected=None, quorum=True), newer)


async def test_of_many_writers_each_counts_once(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Writers at five gateways increment a counter while one voter is stopped and started: none is lost or doubled."""
    async with _fleet(tmp_path, free_ports(5), write_timeout_s=10.0) as fleet:
        for number in range(5):
            await fleet.start(number)
        voters = fleet.planes[0].dht.voters("task/n")
        assert len(voters) == 3
        first = int(voters[0][1:])
        await fleet.planes[0].dht.write("task/n", b"0", expected=None, quorum=True)
        counted = unsure = 0

        async def add(number: int) -> None:
            nonlocal counted, unsure
            for _ in range(8):
                while True:
                    dht = fleet.planes[number].dht
                    try:
                        record = await dht.read("task/n", quorum=True)
                        assert record is not None
                        value = b"%d" % (int(record.value) + 1)
                        await dht.write("task/n", value, expected=record.version, quorum=True)
                    except ConflictError:
                        continue
                    except UnreachableError:
                        unsure += 1
                    else:
                        counted += 1
                    break

        async def restart() -> None:
            await fleet.stop(first)
            await fleet.start(first)

        await asyncio.gather(*(add(number) for number in range(5) if number != first), restart())
        record = await fleet.planes[first].dht.read("task/n", quorum=True)
        assert record is not None
        assert counted <= int(record.value) <= counted + unsure
        assert counted + unsure == 32


async def test_a_minority_refuses(fleet: Fleet) -> None:
    """With two of a key's three voters away nothing is read or written with a quorum; plain reads still answer."""
    version = await fleet.planes[0].dht.write("task/1", b"1", expected=None, quorum=True)
    while await fleet.planes[2].dht.read("task/1") is None:
        await asyncio.sleep(0.01)
    await fleet.stop(1, 2)
    alone = fleet.planes[0].dht
    with pytest.raises(UnreachableError, match="no majority"):
        await alone.write("task/1", b"2", expected=version, quorum=True)
    with pytest.raises(UnreachableError, match="no majority"):
        await alone.read("task/1", quorum=True)
    assert await alone.read("task/1") is not None
    await fleet.start(1)
    read = await alone.read("task/1", quorum=True)
    assert read is not None
    assert read.value in {b"1", b"2"}
    assert await alone.write("task/1", b"3", expected=read.version, quorum=True)


async def test_a_majority_goes_on_and_the_third_learns(fleet: Fleet) -> None:
    """What two of three voters wrote while the third was away is read through it on its return."""
    version = await fleet.planes[0].dht.write("task/1", b"1", expected=None, quorum=True)
    for number in range(3):
        await fleet.stop(number)
        some = next(iter(fleet.planes.values()))
        version = await some.dht.write("task/1", b"v%d" % number, expected=version, quorum=True)
        back = await fleet.start(number)
        read = await back.dht.read("task/1", quorum=True)
        assert read is not None
        assert (read.value, read.version) == (b"v%d" % number, version)


async def test_votes_outlive_a_restart_of_all(fleet: Fleet) -> None:
    """All voters are stopped and started: the register is what it was, and its next change descends from it."""
    version = await fleet.planes[1].dht.write("task/1", b"1", expected=None, quorum=True)
    await fleet.stop(0, 1, 2)
    for number in (2, 1, 0):
        await fleet.start(number)
    read = await fleet.planes[0].dht.read("task/1", quorum=True)
    assert read is not None
    assert read.version == version
    assert descends(await fleet.planes[2].dht.write("task/1", b"2", expected=version, quorum=True), version)


async def test_a_plain_record_may_be_read_with_a_quorum(fleet: Fleet) -> None:
    """A key that was written plainly is read with a quorum, and can be changed with one from there."""
    version = await fleet.planes[0].dht.write("task/1", b"plain", expected=None)
    read = await fleet.planes[1].dht.read("task/1", quorum=True)
    assert read is not None
    assert read.value == b"plain"
    newer = await fleet.planes[2].dht.write("task/1", b"next", expected=version, quorum=True)
    assert descends(newer, version)
    while (record := await fleet.planes[0].dht.read("task/1")) is None or record.value != b"next":
        await asyncio.sleep(0.01)


async def test_who_cannot_vote_says_why(fleet: Fleet) -> None:
    """Other voters than configured, ballots that would use up the numbers, records of another key: refused, counted."""
    one, two, _ = fleet.planes.values()
    digest = one._voting.voter.digest
    call = one.rpc.call
    with pytest.raises(RefusedError, match="other voters"):
        await call("g1", "quorum_vote", VoteAsk(key="k", voters="0"), Voted)
    forged = PrepareAsk(key="k", ballot=Ballot(2**52, "x"), voters=digest)
    with pytest.raises(SwiftbotError, match="ballot"):
        await call("g1", "quorum_prepare", forged, Voted)
    ask = AcceptAsk(key="k", ballot=Ballot(1, "x"), record=Record(key="other", version={"a": 1}), voters=digest)
    with pytest.raises(SwiftbotError, match="other"):
        await call("g1", "quorum_accept", ask, Voted)
    assert two.session.refused["malformed gw/g1/rpc/quorum_prepare"] == 1
    assert two.session.refused["malformed gw/g1/rpc/quorum_accept"] == 1
    assert await one.dht.write("k", b"1", expected=None, quorum=True)


async def test_programs_read_and_write_through_any_gateway(fleet: Fleet) -> None:
    """The verbs `record_read` and `record_write` do what the doors in the code do; the same write id is done once."""
    call = fleet.planes[0].rpc.call
    for quorum in (True, False):
        key = f"task/{quorum}"
        change = RecordChange(key=key, value=b"1", quorum=quorum, write="mine")
        version = (await call("g1", "record_write", change, Written)).version
        assert (await call("g2", "record_write", change, Written)).version == version
        with pytest.raises(ConflictError):
            await call("g1", "record_write", RecordChange(key=key, value=b"2", quorum=quorum), Written)
        found = (await call("g2", "record_read", RecordAsk(key, quorum), Found)).record
        assert found is not None
        assert (found.value, found.version) == (b"1", version)
        gone = RecordChange(key=key, deleted=True, expected=version, quorum=quorum)
        await call("g2", "record_write", gone, Written)
        assert (await call("g1", "record_read", RecordAsk(key, quorum), Found)).record is None


async def test_without_voters_a_quorum_is_refused(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Where the configuration names no voters the answer says which setting is missing."""
    async with _fleet(tmp_path, free_ports(1), voters=()) as fleet:
        plane = await fleet.start(0)
        with pytest.raises(ConfigError, match=r"plane\.voters"):
            await plane.dht.read("k", quorum=True)
        with pytest.raises(ConfigError, match=r"plane\.voters"):
            await plane.dht.write("k", b"", expected=None, quorum=True)


async def test_who_lost_its_promises_does_not_vote(fleet: Fleet) -> None:
    """A voter whose file was damaged comes back without a vote: the other two are a majority, alone it is none."""
    version = await fleet.planes[0].dht.write("task/1", b"1", expected=None, quorum=True)
    await fleet.stop(2)
    path = fleet.folder / "g2" / STORE_FILE
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    path.write_bytes(b"no database" * 1000)
    await fleet.start(2)
    version = await fleet.planes[2].dht.write("task/1", b"2", expected=version, quorum=True)
    await fleet.stop(0)
    with pytest.raises(UnreachableError):
        await fleet.planes[2].dht.write("task/1", b"3", expected=version, quorum=True)
    await fleet.stop(2)
    again = await fleet.start(2)
    with pytest.raises(UnreachableError):
        await again.dht.read("task/1", quorum=True)


async def test_removed_registers_are_forgotten_when_all_agree(fleet: Fleet) -> None:
    """No row of a removed key is left once its time has passed and every voter has it; while one is away all keep it.

    The key can be written again, and what its voters forgot outlives a restart.
    """
    planes = fleet.planes
    version = await planes[0].dht.write("lock/1", b"1", expected=None, quorum=True)
    await planes[0].dht.write("lock/2", b"2", expected=None, quorum=True)
    await fleet.stop(2)
    await planes[0].dht.remove("lock/1", expected=version, quorum=True)
    late = time.time_ns() + 10**9
    for _ in range(3):
        for plane in planes.values():
            assert await plane._forgetting.forget(late) == 0
    await fleet.start(2)

    async def rows() -> set[str]:
        found = [await plane.store.scan("quorum") for plane in planes.values()]
        return {key for each in found for key, _ in each if key not in ("quorum-floor", "quorum/lock/2")}

    assert await planes[0]._forgetting.forget(0) == 0
    async with asyncio.timeout(60):
        while await rows():
            for plane in planes.values():
                await plane._forgetting.forget(time.time_ns() + 10**9)
            await asyncio.sleep(0.05)
    assert await planes[1].dht.read("lock/1", quorum=True) is None
    for number in (0, 1, 2):
        await fleet.stop(number)
        await fleet.start(number)
    late_accept = AcceptAsk(
        key="lock/1", ballot=Ballot(1, "g0:late"), voters=planes[0]._voting.voter.digest,
        record=Record(key="lock/1", value=b"1", version={"g0": 1}),
    )  # fmt: skip
    for number in (0, 1, 2):
        told = await planes[0].rpc.call(f"g{number}", "quorum_accept", late_accept, Voted)
        assert not told.granted
    assert await planes[0].dht.read("lock/1", quorum=True) is None
    await planes[2].dht.write("lock/1", b"again", expected=None, quorum=True)
    for plane in planes.values():
        assert await plane._forgetting.forget(late + 10**12) == 0
        record = await plane.dht.read("lock/1", quorum=True)
        assert record is not None
        assert record.value == b"again"
