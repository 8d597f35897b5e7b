"""What is out of use, as gateways know it: at once, after a restart, after a partition, until its time is over."""

from collections.abc import AsyncIterator
from typing import Any

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.closures import keeper
from appliance.closures.keeper import Closures
from appliance.errors import NotFoundError, PayloadError, UnreachableError
from appliance.model import Place, RobotInfo, Site, Word, encode, keyspace
from appliance.model.closures import CloseAsk, Closure, ClosureList, ClosuresAsk, ReopenAsk, closure_id
from appliance.plane.dht import Record
from appliance.plane.events import AuthorityChanged, FleetEvent, RingChanged, Stage
from tests.unit.tasks.fake_plane import FakePlane

pytestmark = pytest.mark.anyio
SITE = Site(places={"dock 2": Place(x=1.0, y=2.0, aliases=("second dock",)), "gate": Place(x=9.0, y=0.0)})


class Clock:
    """A wall clock."""

    now = 10**18

    def __call__(self) -> int:
        """Return the time, Unix nanoseconds."""
        return self.now


@pytest.fixture
def clock() -> Clock:
    """Return one."""
    return Clock()


@pytest.fixture
def plane(monkeypatch: pytest.MonkeyPatch) -> FakePlane:
    """Return a plane of one gateway and a robot; what is over is looked for without pauses."""
    monkeypatch.setattr(keeper, "LOOK_S", 0.01)
    made = FakePlane()
    made.present = {"gw-1"}
    made.registry.robots = {"rover_1": RobotInfo(id="rover_1", kind="zenoh")}
    return made


@pytest.fixture
async def kept(plane: FakePlane, clock: Clock) -> AsyncIterator[Closures]:
    """Return the closures of gw-1."""
    made = of(plane, clock)
    await made.start(lambda _, handler: handler)
    yield made
    await made.close()


def of(plane: FakePlane, clock: Clock) -> Closures:
    """Return the closures of a gateway."""
    real: Any = plane
    return Closures(real, SITE, now_ns=clock)


async def test_a_place_is_closed_and_opened(plane: FakePlane, kept: Closures) -> None:
    """By any of its names, at once; the parts of the gateway and the fleet are told; who did it and why is kept."""
    told: list[FleetEvent] = []
    plane.events.subscribe(Stage.TASKS, told.append)
    closed = await kept.close_ask(CloseAsk(kind="place", name="the second dock", by="ann", why="wet floor"))
    assert closed.name == "dock 2"
    assert kept.places == {"dock 2": "closed by ann: wet floor"}
    assert [each.id for each in plane.session.sent(plane.keys(keyspace.CLOSURE, "*"), Closure)] == ["place.dock-2"]
    assert (await kept.closures(ClosuresAsk(local=True))).closures == (closed,)
    assert await kept.reopen(ReopenAsk(kind="place", name="dock 2", by="bob")) == closed
    assert kept.places == {}
    assert [type(each) for each in told] == [AuthorityChanged, AuthorityChanged]
    with pytest.raises(NotFoundError, match="not closed"):
        await kept.reopen(ReopenAsk(kind="place", name="dock 2"))


async def test_a_robot_in_maintenance(kept: Closures) -> None:
    """It is out of use under its name; others are not."""
    await kept.close_ask(CloseAsk(kind="robot", name="rover_1", by="ann", why="new tyres"))
    assert kept.robot("rover_1") == "in maintenance by ann: new tyres"
    assert kept.robot("rover_2") == ""
    with pytest.raises(NotFoundError, match="not in maintenance"):
        await kept.reopen(ReopenAsk(kind="robot", name="rover_2"))


async def test_it_ends_by_the_clock(plane: FakePlane, clock: Clock, kept: Closures) -> None:
    """At its time nothing is closed any more, the parts are told, and the owner removes the record."""
    told: list[FleetEvent] = []
    plane.events.subscribe(Stage.TASKS, told.append)
    await kept.close_ask(CloseAsk(kind="place", name="gate", until_ns=clock.now + 10**9, by="ann"))
    assert "until" in kept.places["gate"]
    clock.now += 10**9
    assert kept.places == {}
    with anyio.fail_after(10):
        while plane.dht.records or len(told) < 2:
            await anyio.sleep(0.01)


async def test_what_cannot_be_is_refused(clock: Clock, kept: Closures) -> None:
    """An unknown place or robot, with those there are; a time that is over."""
    for ask, error, says in (
        (CloseAsk(kind="place", name="dock 9"), NotFoundError, "dock 9"),
        (CloseAsk(kind="robot", name="rover_9"), NotFoundError, "rover_9"),
        (CloseAsk(kind="place", name="gate", until_ns=clock.now), PayloadError, "is over"),
    ):
        with pytest.raises(error, match=says) as refused:
            await kept.close_ask(ask)
        assert getattr(refused.value, "remedy", "")


async def test_a_gateway_that_starts_beside_a_silent_one_asks_it_again_soon(plane: FakePlane, clock: Clock) -> None:
    """What only that one knows to be out of use is not unknown for longer than it is silent."""
    late = Closure(kind="place", name="gate", by=Word(by="bob", at_ns=2))
    plane.present = {"gw-1", "gw-2"}
    asked = 0

    async def answer(_: str, __: ClosuresAsk) -> ClosureList:
        nonlocal asked
        asked += 1
        if asked < 3:
            raise UnreachableError("it does not answer")
        return ClosureList(closures=(late,))

    plane.rpc.on["closures"] = answer
    made = of(plane, clock)
    await made.start(lambda _, handler: handler)
    try:
        assert not made.places
        with anyio.fail_after(20):
            while not made.places:
                await anyio.sleep(0.01)
    finally:
        await made.close()


async def test_a_gateway_that_starts_learns_from_the_others(plane: FakePlane, clock: Clock) -> None:
    """Also where it holds no copy; the later word counts, and one that does not answer takes nothing away."""
    early, late = (Closure(kind="place", name="gate", by=Word(by=by, at_ns=at)) for by, at in (("ann", 1), ("bob", 2)))
    plane.present = {"gw-1", "gw-2", "gw-3"}
    answers: dict[str, tuple[Closure, ...] | None] = {"gw-2": (late,), "gw-3": (early,)}

    async def answer(gateway: str, ask: ClosuresAsk) -> ClosureList:
        assert ask.local
        found = answers[gateway]
        if found is None:
            raise UnreachableError("gone")
        return ClosureList(closures=found)

    plane.rpc.on["closures"] = answer
    made = of(plane, clock)
    await made.start(lambda _, handler: handler)
    try:
        assert made.places == {"gate": "closed by bob"}
        answers |= {"gw-2": None, "gw-3": ()}
        await made.sync()
        assert made.places == {"gate": "closed by bob"}
        # It was opened while this gateway did not hear: once all answer, it is known.
        answers["gw-2"] = ()
        plane.events.publish(RingChanged())
        with anyio.fail_after(10):
            while made.places:
                await anyio.sleep(0.01)
    finally:
        await made.close()


async def test_a_record_without_an_owner_stays_closed(
    plane: FakePlane, kept: Closures, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While its key moves no gateway counts it as its own: it is dropped only once its record is gone."""
    await kept.close_ask(CloseAsk(kind="place", name="gate", by="ann"))
    plane.dht.mine = False
    await kept.sync()
    assert kept.places == {"gate": "closed by ann"}

    async def unsure(key: str) -> Record | None:
        raise UnreachableError(f"whether there is a record {key} is not known")

    with monkeypatch.context() as away:
        away.setattr(plane.dht, "read", unsure)
        await kept.sync()
    assert kept.places == {"gate": "closed by ann"}
    plane.dht.records.clear()
    await kept.sync()
    assert kept.places == {}


async def test_an_older_word_opens_nothing(plane: FakePlane, kept: Closures) -> None:
    """Puts of two gateways may come in either order."""
    closed = await kept.close_ask(CloseAsk(kind="place", name="gate", by="ann"))
    old = Closure(kind="place", name="gate", by=Word(by="bob", at_ns=1), ended_ns=closed.by.at_ns - 1)
    plane.session.publish(keyspace.CLOSURE, old, old.id)
    assert kept.places == {"gate": "closed by ann"}


async def test_a_record_that_cannot_be_read_closes_nothing_and_breaks_nothing(plane: FakePlane, clock: Clock) -> None:
    """The others are known."""
    good = Closure(kind="place", name="gate", by=Word(by="ann", at_ns=1))
    for name, value in (("place.a", b"{"), (good.id, encode(good))):
        key = keyspace.CLOSURE_RECORD.key(name)
        plane.dht.records[key] = Record(key=key, value=value, version={"gw-1": 1})
    made = of(plane, clock)
    await made.sync()
    assert set(made.places) == {"gate"}


@given(st.integers(0, 3), st.integers(0, 3), st.booleans(), st.booleans())
def test_both_sides_of_a_partition_choose_alike(one_at: int, other_at: int, one_gone: bool, other_gone: bool) -> None:
    """In whatever order they meet; out of use stands against in use, since that moves nothing."""
    records = [
        Record(
            key="closure/place.gate", deleted=gone, version={name: 1}, write=name,
            value=b"" if gone else encode(Closure(kind="place", name="gate", by=Word(by=name, at_ns=at))),
        )
        for name, at, gone in (("a", one_at, one_gone), ("b", other_at, other_gone))
    ]  # fmt: skip
    found = keeper.resolve(*records)
    assert found.value == keeper.resolve(*reversed(records)).value
    assert found.deleted == (one_gone and other_gone)


async def test_a_clock_that_is_put_back_opens_nothing_early(plane: FakePlane, clock: Clock, kept: Closures) -> None:
    """What is asked last counts, though the clock of the gateway says that it came before."""
    hour_ns = 3600 * 10**9
    await kept.close_ask(CloseAsk(kind="place", name="gate", until_ns=clock.now + hour_ns, by="ann"))
    clock.now -= hour_ns
    longer = await kept.close_ask(CloseAsk(kind="place", name="gate", by="bob"))
    clock.now += 3 * hour_ns
    assert kept.places == {"gate": "closed by bob"}
    assert (await kept.closures(ClosuresAsk())).closures == (longer,)


@pytest.mark.parametrize(
    ("one", "other"),
    [("ράμπα", "πύλη"), ("bay 1.5", "bay 1-5"), ("a" * 50 + "1", "a" * 50 + "2"), ("bay (north)", "bay north")],
)
def test_names_of_other_letters_are_told_apart(one: str, other: str) -> None:
    """Else closing one place would replace the closure of another, which robots then go to."""
    assert closure_id("place", one) != closure_id("place", other)
    assert closure_id("place", one) == closure_id("place", one.upper())
    for name in (one, other):
        keyspace.CLOSURE_RECORD.key(closure_id("place", name))


@given(st.text(max_size=80))
def test_every_name_has_a_key(name: str) -> None:
    """Whatever a place is called on a site."""
    key = keyspace.CLOSURE_RECORD.key(closure_id("place", name))
    assert key.count("/") == 1
