"""Robots that were lost keep their ground and their way: others go round them, or say what helps."""

import math

from hypothesis import assume, given, settings
from hypothesis import strategies as st

from appliance.floor import geometry
from appliance.floor.decide import Body, Floor, Go, Trip, Wait
from appliance.floor.geometry import Size
from appliance.floor.settings import FloorConfig
from appliance.floor.sight import STATE_S, Sight
from appliance.model import Box, Place, Pose, RobotInfo, Site
from appliance.model.floor import FloorState, Point

SIZE = Size(radius_m=0.4, height_m=1.5, margin_m=0.15)
FENCE = Box(name="fence", x=(0.0, 40.0), y=(0.0, 30.0))
YARD = Site(places={"yard": Place(x=20.0, y=15.0), "dock 1": Place(x=35.0, y=15.0)}, fence=FENCE)
FORGET = "`swiftbot robots forget b`"
SPOTS = st.tuples(st.floats(2.0, 38.0), st.floats(2.0, 28.0), st.just(0.0))


def lost(at: Point, *way: Point, place: str = "", task: str = "u") -> Body:
    """Return robot b as it is seen when it is lost, on a way or where it stands."""
    state = FloorState(robot="b", task=task, state="stands", way=(at, *way) if way else (), place=place)
    return Body(robot="b", at=at, size=SIZE, fresh=False, state=state)


def left(body: Body) -> frozenset[str]:
    """Return the cells that a lost robot may still have reserved."""
    return geometry.cells((body.at, *body.bound), body.size)


def decide(start: Point, goal: Point, body: Body, site: Site = YARD, task: str = "t") -> Go | Wait:
    """Return what robot a does that wants to go somewhere."""
    me = Body(robot="a", at=start, size=SIZE)
    trip = Trip(robot="a", task=task, command="t/1", points=(goal,))
    return Floor(site).decide(trip, {"a": me, "b": body})


@settings(max_examples=150, deadline=None)
@given(SPOTS, SPOTS, SPOTS, SPOTS)
def test_a_way_leads_round_all_that_a_lost_robot_has_reserved(start: Point, goal: Point, at: Point, end: Point) -> None:
    """Whenever start and goal are off it, in an open yard: nothing is asked for that those who grant would refuse."""
    body = lost(at, end)
    apart = 2 * SIZE.kept_m + 2 * geometry.CELL_M
    assume(all(geometry.from_way(each[:2], (at, end)) >= apart for each in (start, goal)))
    # Between it and the fence there may be no room.
    assume(all(min(x, 40.0 - x, y, 30.0 - y) >= apart for x, y, _ in (at, end)))
    step = decide(start, goal, body)
    assert isinstance(step, Go)
    assert step.parts.isdisjoint(left(body))


@settings(max_examples=100, deadline=None)
@given(st.floats(0.85, 3.0), st.floats(0.0, math.tau))
def test_a_robot_beside_a_lost_one_can_leave(apart: float, angle: float) -> None:
    """Cells of its own ground that the lost one has reserved too are not asked for."""
    body = lost((20.0, 15.0, 0.0))
    start = (20.0 + apart * math.cos(angle), 15.0 + apart * math.sin(angle), 0.0)
    step = decide(start, (20.0 + 9.0 * math.cos(angle), 15.0 + 9.0 * math.sin(angle), 0.0), body)
    assert isinstance(step, Go)
    assert step.parts.isdisjoint(left(body))


@settings(max_examples=100, deadline=None)
@given(st.floats(19.3, 20.7), st.floats(14.3, 15.7), SPOTS)
def test_a_stand_in_stands_beside_the_lost_robot(x: float, y: float, start: Point) -> None:
    """At a place for several, where no cell is shared with it, nor on the way there."""
    assume(max(abs(start[0] - 20.0), abs(start[1] - 15.0)) > 4.0)
    body = lost((x, y, 0.0))
    step = decide(start, (20.0, 15.0, 0.0), body)
    assert isinstance(step, Go)
    assert step.place == "yard"
    assert step.parts.isdisjoint(left(body))
    assert math.dist(step.way[-1], (20.0, 15.0, 0.0)) <= 2.0


def test_a_stand_in_of_the_same_task_stands_beside_where_the_lost_robot_goes() -> None:
    """Also at a place for one, since both are of one task."""
    body = lost((30.0, 15.0, 0.0), (35.0, 15.0, 0.0), place="dock 1", task="t")
    step = decide((35.0, 25.0, 0.0), (35.0, 15.0, 0.0), body)
    assert isinstance(step, Go)
    assert step.parts.isdisjoint(left(body))


def test_a_place_for_one_is_waited_for_with_the_remedy() -> None:
    """Whether the lost robot stands there, or was on its way."""
    way = (30.0, 15.0, 0.0), (35.0, 15.0, 0.0)
    step = decide((2.0, 2.0, 0.0), way[1], lost(way[1]))
    assert isinstance(step, Wait)
    assert "b, which was lost at dock 1" in step.why
    assert FORGET in step.why
    step = decide((2.0, 2.0, 0.0), way[1], lost(*way, place="dock 1"))
    assert isinstance(step, Wait)
    assert "b, which was lost on its way to dock 1" in step.why
    assert FORGET in step.why


def test_an_aisle_that_it_stands_across_is_waited_for_with_the_remedy() -> None:
    """There is no way round: the wait names the robot and how to forget it."""
    walls = tuple(Box(name=f"wall {y}", x=(10.0, 30.0), y=y) for y in ((0.0, 14.0), (16.0, 30.0)))
    step = decide((5.0, 15.0, 0.0), (35.0, 15.0, 0.0), lost((20.0, 15.0, 0.0)), Site(fence=FENCE, obstacles=walls))
    assert isinstance(step, Wait)
    assert step.robot == "b"
    assert FORGET in step.why


def test_where_it_may_have_left_those_who_grant_are_asked() -> None:
    """A way that only its reservation closes is asked for: it may be over."""
    walls = tuple(Box(name=f"wall {y}", x=(10.0, 30.0), y=y) for y in ((0.0, 14.0), (16.0, 30.0)))
    body = lost((32.0, 20.0, 0.0), (32.0, 15.0, 0.0), (8.0, 15.0, 0.0))
    step = decide((5.0, 15.0, 0.0), (35.0, 12.0, 0.0), body, Site(fence=FENCE, obstacles=walls))
    assert isinstance(step, Go)
    refused = Floor(Site(fence=FENCE)).refused(step, "b", "0,40,30", {"b": body}, ended=True)
    assert "b, which was lost on its way here" in refused.why
    assert FORGET in refused.why


def test_what_it_only_waited_for_is_not_reserved() -> None:
    """A robot that is lost while it waits keeps the ground that it stands on, and no way."""
    sight = Sight(FloorConfig())
    info = RobotInfo(id="b", kind="zenoh", pose=Pose(x=20.0, y=15.0))
    sight.observe(info, 0.0)
    way = ((20.0, 15.0, 0.0), (35.0, 15.0, 0.0))
    told = FloorState(robot="b", state="waits", way=way), FloorState(robot="b", state="moves", way=way)
    for state, bound in zip(told, ((), way), strict=True):
        sight.hear(state, 0.0)
        body = sight.bodies(STATE_S + 1.0)["b"]
        assert body.lost
        assert body.bound == bound
