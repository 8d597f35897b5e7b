"""Soft stops on one gateway: robots and gateways that were away hold as soon as they are back, while it is in force."""

import asyncio
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.errors import RefusedError
from appliance.model import SoftStop, encode
from appliance.model.robot_api import ResumeRobotsAsk, Standing, StandingAsk, StopAsk
from appliance.robots.authority import soft_stop
from appliance.robots.authority.soft_stop import MOST, RESERVE, STORED, Stopping
from tests.unit.robots.authority.conftest import FakePlane

pytestmark = pytest.mark.anyio


@pytest.fixture
async def known(plane: FakePlane, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Stopping]:
    """Return soft stops that were started with what the plane keeps; its rounds are short."""
    monkeypatch.setattr(soft_stop, "AGAIN_S", (0.0,))
    monkeypatch.setattr(soft_stop, "EVERY_S", 0.01)
    it = Stopping(cast("Any", plane), changed=lambda: None)
    yield it
    await it.close()


async def until(holds: Callable[[], bool]) -> None:
    """Wait until it is so."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.005)


async def rounds(count: int = 5) -> None:
    """Let some rounds pass."""
    for _ in range(count):  # each in a turn of its own, however late it comes
        await asyncio.sleep(soft_stop.EVERY_S)


async def nothing() -> None:
    """Learn nothing from others."""


async def test_a_robot_that_was_away_is_told_when_it_comes(plane: FakePlane, known: Stopping) -> None:
    """However long it was, and again when it was away once more; until the stop is lifted."""
    await known.start()
    plane.robot("r1")
    plane.robot("r2", online=False)
    answer = await known.stop(StopAsk(by="ann"))
    assert answer.robots == ("r1",)
    assert "could not be told; it will be when it is back" in answer.problems["r2"]
    await rounds()
    assert plane.told == ["r1"]
    plane.robot("r2")
    await until(lambda: plane.told == ["r1", "r2"])
    plane.robot("r1", online=False)
    await rounds()
    plane.robot("r1")
    await until(lambda: plane.told == ["r1", "r2", "r1"])
    await known.resume(ResumeRobotsAsk(), nothing)
    plane.robot("r3")
    await rounds()
    assert "r3" not in plane.told


async def test_a_robot_whose_certificate_is_revoked_is_told_to_hold(plane: FakePlane, known: Stopping) -> None:
    """It counts as offline, and may be linked and moving: it gets the stop, and that it holds is not believed."""
    await known.start()
    plane.credentials = SimpleNamespace(barred=frozenset({"r1", "r2"}))
    plane.robot("r1", online=False)
    plane.robot("r2", online=False)
    plane.deaf = {"r2"}
    answer = await known.stop(StopAsk(by="ann"))
    assert "r1" in plane.told
    assert answer.robots == ()
    assert "revoked" in answer.problems["r1"]
    assert "offline" in answer.problems["r2"]


async def test_a_stop_that_was_only_published_reaches_a_revoked_robot(plane: FakePlane, known: Stopping) -> None:
    """The gateway that owns its key tells it."""
    await known.start()
    plane.credentials = SimpleNamespace(barred=frozenset({"r1"}))
    plane.robot("r1", online=False, gateway="")
    await known.merge((SoftStop(id="s1", by="ann"),), ())
    await until(lambda: plane.told == ["r1"])


async def test_a_robot_that_nobody_knows_is_told_when_it_comes(plane: FakePlane, known: Stopping) -> None:
    """Named in a stop, it is a problem of the answer, and no success; when it comes it gets the stop."""
    await known.start()
    answer = await known.stop(StopAsk(by="ann", robots=("r1",)))
    assert answer.robots == ()
    assert "not in the roster and could not be told; it will be if it comes" in answer.problems["r1"]
    plane.robot("r1")
    await until(lambda: plane.told == ["r1"])


async def test_a_robot_that_does_not_confirm_is_told_on(plane: FakePlane, known: Stopping) -> None:
    """It is asked again in each round, and not any more when it has said that it holds."""
    await known.start()
    plane.robot("r1")
    plane.deaf = {"r1"}
    assert "not reached" in (await known.stop(StopAsk(by="ann", robots=("r1",)))).problems["r1"]
    await rounds()
    plane.deaf = set()
    await until(lambda: plane.told == ["r1"])
    await rounds()
    assert plane.told == ["r1"]


@pytest.mark.parametrize(
    "told", [b"hello", b'{"id": "\xff"}', b'{"id":"1","result":' + b'{"a":' * 6000 + b"1" + b"}" * 6001]
)
async def test_a_robot_that_answers_with_anything_keeps_no_other_from_holding(
    told: bytes, plane: FakePlane, known: Stopping
) -> None:
    """Its answer is reported as the problem that it is; the others hold, and it gets the stop again."""
    await known.start()
    plane.robot("r1")
    plane.robot("r2")
    plane.mad["r1"] = told
    answer = await known.stop(StopAsk(by="ann"))
    assert answer.robots == ("r2",)
    assert "it answered with something else" in answer.problems["r1"]
    del plane.mad["r1"]
    plane.told.clear()
    await until(lambda: plane.told == ["r1"])


async def test_a_gateway_that_returns_has_its_robots_hold(plane: FakePlane, known: Stopping) -> None:
    """Stops that it kept are pursued from its start, also for robots that come later; those of others are not."""
    kept = StandingAsk(stops=(SoftStop(id="s", by="ann"),))
    plane.values[STORED] = encode(kept)
    plane.robot("r2", gateway="gw-2")
    await known.start()
    await rounds()
    plane.robot("r1")
    await until(lambda: plane.told == ["r1"])
    plane.robot("r2", gateway="gw-1")
    await until(lambda: plane.told == ["r1", "r2"])


async def test_the_fleet_is_stopped_whatever_is_in_force(plane: FakePlane, known: Stopping) -> None:
    """By the reserve for such stops; and when that is used up, it is stopped already and its robots get it again."""
    await known.start()
    many = [SoftStop(id=f"s{number}", robots=(f"x{number}",)) for number in range(MOST - RESERVE)]
    known.stops.merge(many, ())
    plane.robot("r1")
    for _ in range(RESERVE + 2):
        plane.told.clear()
        assert (await known.stop(StopAsk(by="ann"))).robots == ("r1",)
        assert "r1" in plane.told
    assert len(known.stops.stops) == MOST


async def test_a_stop_of_the_fleet_stays_when_others_lift_theirs(plane: FakePlane, known: Stopping) -> None:
    """With as many stops in force as are kept, another operator's is kept besides; theirs are lifted, it stays."""
    await known.start()
    theirs = [SoftStop(id=f"s{number}", by="ann") for number in range(MOST)]
    known.stops.merge(theirs, ())
    plane.robot("r1")
    answer = await known.stop(StopAsk(by="bob", act="mine"))
    assert "mine" in {each.id for each in answer.stops}
    await known.resume(ResumeRobotsAsk(by="ann", act="r", stops=tuple(each.id for each in theirs)), nothing)
    assert [each.id for each in known.stops.active] == ["mine"]


async def test_a_stop_that_there_is_no_room_for_is_never_taken_for_kept(plane: FakePlane, known: Stopping) -> None:
    """Of one robot, when as many are in force: it is told to hold, and who asked hears that the stop is not kept."""
    await known.start()
    known.stops.merge([SoftStop(id=f"s{number}", robots=(f"x{number}",)) for number in range(MOST - RESERVE)], ())
    plane.robot("r1")
    with pytest.raises(RefusedError, match="is not kept: r1 held once"):
        await known.stop(StopAsk(by="ann", robots=("r1",)))
    assert "r1" in plane.told
    await known.merge((SoftStop(id="elsewhere", by="bob", robots=("r2",)),), ())
    assert plane.refused == ["no room for a soft stop"] * 2
    assert not known.stops.in_force("elsewhere")


async def test_a_gateway_without_room_has_not_confirmed(plane: FakePlane, known: Stopping) -> None:
    """It answers with what it keeps; what is not in there is not kept, whatever it says besides."""
    await known.start()
    full: set[str] = set()

    async def call(member: str, _: object, ask: StandingAsk, *, timeout_s: float) -> Standing:
        assert timeout_s > 0
        return Standing(stops=() if member in full else ask.stops)

    plane.rpc = SimpleNamespace(call=call)
    plane.others = {"gw-2", "gw-3"}
    assert (await known.stop(StopAsk(by="ann", robots=("r1",)))).gateways == ("gw-1", "gw-2", "gw-3")
    full.add("gw-3")
    answer = await known.stop(StopAsk(by="ann"))
    assert (answer.gateways, answer.silent) == (("gw-1", "gw-2"), ("gw-3",))


async def test_only_what_the_operator_has_seen_is_lifted(known: Stopping) -> None:
    """One that came meanwhile stays; the same order, tried again, is done already and lifts nothing more."""
    await known.start()
    await known.stop(StopAsk(by="ann", act="a"))
    await known.stop(StopAsk(by="bob", act="b"))
    ask = ResumeRobotsAsk(by="ann", act="r", stops=("a",))
    assert [each.id for each in (await known.resume(ask, nothing)).stops] == ["b"]
    everything = ResumeRobotsAsk(by="ann", act="q")
    assert (await known.resume(everything, nothing)).stops == ()
    await known.stop(StopAsk(by="bob", act="c"))
    assert [each.id for each in (await known.resume(everything, nothing)).stops] == ["c"]
