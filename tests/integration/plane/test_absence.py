"""What is not found: that there is no record is said by a gateway that knows, never because somebody did not answer."""

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.errors import ConflictError, DeadlineError, PrerequisiteError, UnreachableError
from appliance.model import keyspace
from appliance.model.plane_api import KeyAsk, Record, RecordAsk
from appliance.plane import anti_entropy, dht
from appliance.plane.events import RingChanged, Stage
from appliance.plane.node import Plane
from appliance.plane.ring import Ring
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


async def until(holds: Callable[[], object]) -> None:
    """Wait until something holds; the test's own timeout bounds it."""
    while not holds():
        await asyncio.sleep(0.01)


def key_of(plane: Plane, *holders: str, other_than: str = "") -> str:
    """A key whose first holders are these, in that order."""
    keys = (f"task/{number}" for number in range(200_000))
    return next(key for key in keys if plane.ring.successors(key, len(holders)) == holders and key != other_than)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a loaded machine an owner that answers is late, and that is not what these tests are about."""
    monkeypatch.setattr(dht, "_ATTEMPT_S", 60.0)


@pytest.fixture
async def planes(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[list[Plane]]:
    """Five gateways that know each other and have compared their records."""
    ends = [f"tcp/127.0.0.1:{port}" for port in free_ports(5)]
    made: list[Plane] = []
    try:
        for number, end in enumerate(ends):
            peers = {f"g{each}": other for each, other in enumerate(ends)}
            config = PlaneConfig(listen=(end,), peers=peers)
            folder = tmp_path / f"g{number}"
            made.append(await Plane.open(config, fleet="f", gateway=f"g{number}", data_dir=folder))
        await settled(made)
        yield made
    finally:
        for plane in made:
            await plane.close()


async def settled(planes: list[Plane]) -> None:
    """Wait until each sees all the others and has reconciled with them."""
    await until(lambda: all(len(each.members()) == len(planes) and each.dht.settling.reconciled() for each in planes))


async def only_at(plane: Plane, key: str) -> None:
    """A record that one gateway has: the others were too slow for its write."""
    await plane.dht.keep(Record(key=key, value=b"v", version={plane.gateway: 1}, write="w"))


@pytest.mark.parametrize("replica", [False, True])
@pytest.mark.parametrize("how", ["nobody there", "too late"])
async def test_a_replica_without_a_copy_does_not_speak_for_its_owner(
    planes: list[Plane], monkeypatch: pytest.MonkeyPatch, how: str, *, replica: bool
) -> None:
    """The owner of a key does not answer, and it alone has the record: nobody knows, and that is what is said."""
    asker, owner = planes[0], planes[1]
    key = key_of(asker, "g1", "g2", "g3")
    await only_at(owner, key)
    if how == "nobody there":
        owner.rpc.close()
    else:
        call = asker.rpc.call

        async def late(gateway: str, *rest: Any, **more: Any) -> Any:
            if gateway == "g1":
                raise DeadlineError("no answer in time")
            return await call(gateway, *rest, **more)

        monkeypatch.setattr(asker.rpc, "call", late)
    with pytest.raises(UnreachableError, match="not known"):
        await asker.dht.read(key, replica=replica)
    with pytest.raises(UnreachableError, match="not known"):
        await planes[0].dht._on_record_read(RecordAsk(key=key, replica=replica))
    # A replica that has a copy answers for it.
    await only_at(planes[3], key)
    assert await asker.dht.read(key, replica=replica) is not None


@pytest.mark.parametrize("asker", [0, 1])
async def test_an_owner_whose_disk_fails_keeps_nobody_from_the_other_copies(
    planes: list[Plane], monkeypatch: pytest.MonkeyPatch, asker: int
) -> None:
    """Its own reads and those of others find them; what it alone could say is not known."""
    key = key_of(planes[0], "g1", "g2", "g3")
    absent = key_of(planes[0], "g1", other_than=key)
    await planes[0].dht.write(key, b"v", expected=None)

    async def broken(_: str) -> None:
        raise PrerequisiteError("the disk fails")

    monkeypatch.setattr(planes[1].store, "record", broken)
    found = await planes[asker].dht.read(key)
    assert found is not None
    assert found.value == b"v"
    with pytest.raises(UnreachableError, match="the disk fails"):
        await planes[asker].dht.read(absent)


@pytest.mark.parametrize("replica", [False, True])
async def test_what_its_owner_does_not_have_is_not_there(planes: list[Plane], *, replica: bool) -> None:
    """Through each gateway: there never was one; and there was, until it was removed."""
    for owner in ("g0", "g1", "g2"):
        key = key_of(planes[0], owner)
        for plane in planes:
            assert await plane.dht.read(key, replica=replica) is None
        version = await planes[0].dht.write(key, b"v", expected=None)
        await planes[1].dht.remove(key, expected=version)
        for plane in planes:
            assert await plane.dht.read(key, replica=replica) is None


async def test_a_reader_asks_the_next_owner_when_the_first_is_just_going(
    planes: list[Plane], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is asked while it still counts as there: who follows it knows that there is no record."""
    monkeypatch.setattr(dht, "_APART_S", 3600.0)
    asker, owner = planes[0], planes[1]
    key, asked, call = key_of(asker, "g1", "g2", "g3"), asyncio.Event(), asker.rpc.call

    async def watched(gateway: str, *rest: Any, **more: Any) -> Any:
        try:
            return await call(gateway, *rest, **more)
        except UnreachableError:
            asked.set()
            raise

    monkeypatch.setattr(asker.rpc, "call", watched)
    owner.rpc.close()
    reading = asyncio.create_task(asker.dht.read(key))
    await asked.wait()
    assert not reading.done()
    for plane in planes:
        if plane is not owner:
            plane._membership._seen(plane.keys(keyspace.GATEWAY_ALIVE, "g1"), alive=False)
    assert await reading is None


async def test_an_owner_that_has_not_compared_its_copies_says_so(
    planes: list[Plane], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits for the comparison; when that takes too long it gives what it has, but does not say there is nothing."""
    monkeypatch.setattr(dht, "SETTLE_S", 0.05)
    owner = planes[1]
    missing, there = key_of(owner, "g1", "g2", "g3"), key_of(owner, "g1", "g3", "g2")
    await planes[0].dht.write(there, b"v", expected=None)
    monkeypatch.setattr(owner.dht.settling, "_ring", Ring((), virtual_nodes=owner.config.virtual_nodes))
    for plane in planes:
        with pytest.raises(UnreachableError, match="not compared"):
            await plane.dht.read(missing)
        assert await plane.dht.read(there) is not None
    told = await planes[0].rpc.call("g1", keyspace.DHT_READ, KeyAsk(missing), direct=True)
    assert told.unsure


async def test_a_silent_member_holds_up_no_takeover_and_may_have_what_is_missing(
    planes: list[Plane], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway is lost and one of the others does not answer: its successor goes on without, once, in a bounded time.

    Until that one is heard nothing is said to be nowhere; when it is, what it had newer is taken and told as news.
    """
    successor, silent, lost = planes[0], planes[1], planes[2]
    key = key_of(successor, "g2", "g0", "g1")
    missing = key_of(successor, "g2", "g0", other_than=key)
    version = await successor.dht.write(key, b"before", expected=None)
    speak, comparing = asyncio.Event(), successor._reconciler._comparing
    compare, asked = comparing.compare, list[tuple[tuple[str, ...], float | None]]()

    async def mute(asker: str) -> bool:
        await speak.wait()
        return True

    async def watched(ring: Ring, members: Any, **more: Any) -> Any:
        asked.append((tuple(members), more.get("within_s")))
        return await compare(ring, members, **more)

    monkeypatch.setattr(silent._reconciler._comparing, "_is_seen", mute)
    monkeypatch.setattr(comparing, "compare", watched)
    newer = Record(key=key, value=b"after", version={**version, "g2": 2}, write="w")
    await silent.store.change(key, lambda _: newer)
    news = asyncio.Event()
    await lost.close()
    planes.remove(lost)
    await until(lambda: "g2" not in successor.members() and successor.dht.settling.reconciled())
    losses = [members for members, within_s in asked if within_s is not None]
    assert len(losses) == 1
    assert "g1" in losses[0]
    assert {within_s for _, within_s in asked if within_s is not None} == {anti_entropy.LOSS_S}
    await until(lambda: successor.dht.absence.silent == {"g1"})  # others may be late on a loaded machine
    assert (await successor.dht.read(key) or newer).value == b"before"
    with pytest.raises(UnreachableError, match="g1 may have it"):
        await successor.dht.read(missing)
    successor.events.subscribe(Stage.WATCHERS, lambda event: news.set() if isinstance(event, RingChanged) else None)
    speak.set()
    await news.wait()
    assert not successor.dht.absence.silent
    assert (await successor.dht.read(key) or Record(key="")).value == b"after"
    assert await successor.dht.read(missing) is None


async def test_records_of_many_that_are_lost_at_once_are_not_said_to_be_gone(planes: list[Plane]) -> None:
    """All holders of a key were lost together, as by a cut: nobody knows until they are back.

    What others hold, or might, is answered as ever.
    """
    here = planes[0]
    # The owner among those that are left is this gateway, so that nobody else is asked.
    left = Ring(("g0", "g1"), virtual_nodes=here.config.virtual_nodes)
    keys = [key for key in (f"task/{number}" for number in range(3000)) if left.owner(key) == "g0"]
    away = frozenset({"g2", "g3", "g4"})
    there, missing = [key for key in keys if away == set(here.ring.successors(key, 3))][:2]
    known = next(key for key in keys if "g0" in here.ring.successors(key, 3))
    await planes[1].dht.write(there, b"v", expected=None)
    assert await here.store.record(there) is None
    for name in sorted(away):
        here._membership._seen(here.keys(keyspace.GATEWAY_ALIVE, name), alive=False)
    await until(here.dht.settling.reconciled)
    for key in (there, missing):
        with pytest.raises(UnreachableError, match="may have it"):
            await here.dht.read(key)
    assert await here.dht.read(known) is None
    # What is new is written as ever: both sides of a cut go on.
    await here.dht.write(missing, b"new", expected=None)
    assert await here.dht.read(missing) is not None
    for name in sorted(away):
        here._membership._seen(here.keys(keyspace.GATEWAY_ALIVE, name), alive=True)
    await settled(planes)
    assert (await here.dht.read(there) or Record(key="")).value == b"v"


async def test_a_silent_member_that_has_come_back_holds_up_no_write(
    planes: list[Plane], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway that takes a task over must write: what is newer there is said when that is given to it.

    A read waits for the comparison, and says that nobody knows where there is no copy.
    """
    owner, back = planes[0], planes[1]
    every = (f"task/{number}" for number in range(200_000))
    ours = (key for key in every if owner.ring.successors(key, 2) == ("g0", "g1"))
    same, newer, missing = (next(ours) for _ in range(3))
    versions = {key: await owner.dht.write(key, b"before", expected=None) for key in (same, newer)}
    membership, token = owner._membership, owner.keys(keyspace.GATEWAY_ALIVE, "g1")
    membership._seen(token, alive=False)
    await until(owner.dht.settling.reconciled)

    async def never(*_: Any, **__: Any) -> Any:
        await asyncio.Event().wait()

    monkeypatch.setattr(owner._reconciler._comparing, "compare", never)
    slowly = msgspec.structs.replace(owner.config, replica_timeout_s=60.0)
    monkeypatch.setattr(owner.dht._pushing, "_config", slowly)
    meanwhile = Record(key=newer, value=b"meanwhile", version={**versions[newer], "g1": 1}, write="w")
    await back.dht.keep(meanwhile)
    membership._seen(token, alive=True)
    assert owner.dht.settling.returned == {"g1"}
    monkeypatch.setattr(dht, "SETTLE_S", 3600.0)  # nothing but the shorter wait lets a write through
    await owner.dht.write(same, b"after", expected=versions[same])
    with pytest.raises(ConflictError):
        await owner.dht.write(newer, b"after", expected=versions[newer])
    assert await owner.store.record(newer) == await back.store.record(newer)
    monkeypatch.setattr(dht, "SETTLE_S", 0.05)
    with pytest.raises(UnreachableError, match="not compared"):
        await owner.dht.read(missing)
    assert (await owner.dht.read(same) or meanwhile).value == b"after"
