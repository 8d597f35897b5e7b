"""Robots without a goal, that push or follow: what they can reach is reserved, again and again."""

import asyncio
import math
from collections.abc import AsyncIterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.floor import geometry
from appliance.floor.decide import Body, Floor, Trip, Wait
from appliance.floor.keeper import FloorKeeper
from appliance.floor.trips import ROAM_MPS, ROAM_S, trip_of
from appliance.model import Place, Pose, RobotCommand, RobotInfo, RobotLimits, Site
from appliance.model.floor import FloorState, Point
from tests.unit.floor.test_keeper import Fake, drive, fleet, floor, until
from tests.unit.floor.test_stretches import SIZE, SPOTS

__all__ = ["fleet", "floor"]
SITE = Site(places={"dock 1": Place(x=10.0, y=0.0)})
REACH_M = ROAM_S * ROAM_MPS


def order(verb: str, **args: object) -> RobotCommand:
    """Return a command."""
    return RobotCommand(id="t/s1/1", verb=verb, args=dict(args), task="t", attempt=1)


def trip(verb: str, **args: object) -> Trip | None:
    """Return where a command takes a robot that stands at (2, 3)."""
    limits = RobotLimits(speed_mps=1.0)
    info = RobotInfo(id="a", kind="zenoh", pose=Pose(x=2.0, y=3.0), limits=limits)
    return trip_of(order(verb, **args), info, SITE, task="t", takeoff_m=10.0)


def test_where_a_thing_is_pushed_is_a_fixed_way() -> None:
    """Straight to the place; without one, a step to whatever side; to an unknown place the robot says what is wrong."""
    to = trip("push", object="crate", to="dock 1")
    assert to is not None
    assert (to.points, to.fixed) == (((10.0, 0.0, 0.0),), True)
    step = trip("push", object="crate")
    assert step is not None
    assert all(1.0 <= math.dist(each, (2.0, 3.0, 0.0)) <= 1.1 for each in step.points)
    assert trip("push", object="crate", to="nowhere") is None


def test_what_a_robot_that_follows_can_reach_goes_by_its_speed() -> None:
    """By its own limit or by what was asked, and by no more than the floor's."""
    for asked, mps in ((None, 1.0), (0.5, 0.5), (6.0, 1.0)):
        found = trip("follow", target="Rover 2", duration_s=9.0, speed_mps=asked)
        assert found is not None
        assert (found.reach_m, found.beside) == (ROAM_S * mps, "rover_2")


@settings(max_examples=100, deadline=None)
@given(SPOTS, st.lists(st.tuples(SPOTS, st.booleans()), max_size=4), st.floats(0.5, REACH_M))
def test_all_that_it_can_reach_is_asked_for(at: Point, spots: list[tuple[Point, bool]], reach: float) -> None:
    """But for the ground of those that stand, and of the robot that it follows."""
    seen = {"a": Body(robot="a", at=at, size=SIZE)}
    for number, (spot, stands) in enumerate(spots):
        state = None if stands else FloorState(robot=f"b{number}", state="moves", way=(spot, at))
        seen[f"b{number}"] = Body(robot=f"b{number}", at=spot, size=SIZE, stands=stands, state=state)
    roams = Trip(robot="a", task="t", command="t/1", points=(at,), fixed=True, reach_m=reach, beside="b0")
    step = Floor(Site()).decide(roams, seen)
    if isinstance(step, Wait):
        assert seen[step.robot].stands
        assert step.robot != "b0"
        return
    own = geometry.cells((at,), SIZE)
    free = geometry.cells((at,), replace(SIZE, radius_m=SIZE.radius_m + reach)) - own
    for each in seen.values():
        if each.robot != "a" and (each.stands or each.robot == "b0"):
            free -= geometry.cells((each.at, *(each.bound if each.robot == "b0" else ())), SIZE)
    assert step.parts == own | free


pytestmark = pytest.mark.anyio


@pytest.fixture
async def following(floor: FloorKeeper, fleet: Fake) -> AsyncIterator["asyncio.Task[object]"]:
    """A robot that follows another, 5 m ahead of it."""
    fleet.put("b", 5.0)
    fleet.held_up.clear()
    going = drive(floor, fleet, order("follow", target="b", duration_s=30.0))
    await until(lambda: bool(fleet.sent))
    yield going
    going.cancel()
    await asyncio.gather(going, return_exceptions=True)


async def test_the_ground_around_a_follower_moves_with_it(following: object, fleet: Fake) -> None:
    """Nobody else gets it; what lies behind is free again; it is sent no faster than was reserved for."""
    assert fleet.sent[0].args["speed_mps"] == ROAM_MPS
    assert not fleet.free("0,-8,0")
    assert not fleet.free("0,0,8")
    fleet.put("b", 13.0)
    fleet.put("a", 8.0)
    await until(lambda: fleet.free("0,-8,0"))
    assert not fleet.free("0,20,0")


async def test_a_follower_stops_at_ground_that_another_has(following: object, floor: FloorKeeper, fleet: Fake) -> None:
    """At once, with the reason; it goes on for the rest of its time when that is free."""
    ahead = frozenset({"0,15,3"})  # 2.9 m from where it is going to be
    assert (await floor.claim("c", ahead)).lease is not None
    fleet.put("a", 5.0)
    await until(lambda: fleet.stopped == ["t/s1/1"])
    assert "waits for c, which has its way" in fleet.notes
    fleet.put("a", 0.0)
    await until(lambda: len(fleet.sent) == 2)
    assert fleet.sent[1].id == "t/s1/1~2"
    assert fleet.sent[1].args["duration_s"] < 30.0


async def test_a_follower_stops_before_one_that_stands_in_its_way(following: object, fleet: Fake) -> None:
    """Between it and the robot that it follows."""
    fleet.put("c", 2.0)
    await until(lambda: fleet.stopped == ["t/s1/1"])
    assert any("waits for c" in each for each in fleet.notes)


async def test_a_push_waits_for_who_stands_where_it_goes(floor: FloorKeeper, fleet: Fake) -> None:
    """And is begun when the way is free."""
    fleet.put("b", 5.0)
    going = drive(floor, fleet, order("push", object="crate", to="dock 1"))
    await until(lambda: any("waits for b to move out of the way" in each for each in fleet.notes))
    assert fleet.sent == []
    fleet.put("b", 5.0, 9.0)
    assert (await going).failure is None
    assert [each.id for each in fleet.sent] == ["t/s1/1"]
