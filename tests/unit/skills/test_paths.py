"""The path planner: never through an obstacle, never without saying why."""

import math
from itertools import pairwise

import msgspec
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from appliance.skills._lib import paths
from appliance.skills.sites import load_site

coordinate = st.floats(0.0, 60.0, allow_nan=False, width=32)
point = st.tuples(coordinate, coordinate)


@st.composite
def boxes(draw: st.DrawFn) -> paths.Rectangle:
    """A rectangle from a few centimetres to 25 m a side."""
    x, y = draw(point)
    width, height = draw(st.floats(0.05, 25.0)), draw(st.floats(0.05, 25.0))
    return paths.Rectangle(f"box {x:.0f} {y:.0f}", x, x + width, y, y + height)


def strictly_inside(box: paths.Rectangle, at: paths.Point, margin: float = 1e-6) -> bool:
    """Whether a point is inside a box by more than rounding."""
    return box.x0 + margin < at[0] < box.x1 - margin and box.y0 + margin < at[1] < box.y1 - margin


def crosses(box: paths.Rectangle, one: paths.Point, other: paths.Point) -> bool:
    """Whether any of many points of a leg is inside: a check that shares nothing with the planner's own."""
    steps = max(2, math.ceil(math.dist(one, other) / 0.02))
    return any(
        strictly_inside(box, (one[0] + (other[0] - one[0]) * k / steps, one[1] + (other[1] - one[1]) * k / steps))
        for k in range(steps + 1)
    )


@settings(max_examples=60, deadline=None)
@given(start=point, goal=point, closed=st.lists(boxes(), max_size=8))
def test_a_way_never_crosses_an_obstacle(start: paths.Point, goal: paths.Point, closed: list[paths.Rectangle]) -> None:
    """A way ends at the goal and no leg of it is inside a closed area; else the planner says that there is none."""
    assume(not any(box.holds(start) or box.holds(goal) for box in closed))
    try:
        way = paths.plan(start, goal, closed)
    except paths.NoPath as none:
        told = (none.message.split(" (")[0], bool(none.remedy))
        assert told == ("no way from", True)
        return
    assert way[-1] == goal
    for one, other in pairwise([start, *way]):
        assert not any(crosses(box, one, other) for box in closed)


@settings(max_examples=60, deadline=None)
@given(inside=st.tuples(st.floats(0.001, 0.999), st.floats(0.001, 0.999)), other=point, box=boxes())
def test_start_or_goal_in_an_obstacle_is_named(
    inside: tuple[float, float], other: paths.Point, box: paths.Rectangle
) -> None:
    """A start or a goal inside a closed area is refused with the area's name and a remedy."""
    at = (box.x0 + (box.x1 - box.x0) * inside[0], box.y0 + (box.y1 - box.y0) * inside[1])
    assume(box.holds(at) and not box.holds(other))
    with pytest.raises(paths.NoPath, match="the goal is inside") as caught:
        paths.plan(other, at, [box])
    assert repr(box.name) in caught.value.message
    assert caught.value.remedy
    with pytest.raises(paths.NoPath, match="the robot is inside"):
        paths.plan(at, other, [box])


@settings(max_examples=40, deadline=None)
@given(start=point, goal=point)
def test_with_nothing_in_between_it_is_one_straight_leg(start: paths.Point, goal: paths.Point) -> None:
    """Where the view is free, the way is the goal alone."""
    assert paths.plan(start, goal, []) == [goal]


@pytest.mark.thorough
def test_every_place_of_the_demo_s_site_reaches_every_other() -> None:
    """All places of the warehouse are joined by ways with clearance from racks, few turns and no great detours."""
    site = msgspec.to_builtins(load_site("warehouse"))
    closed = paths.rectangles([*site["obstacles"], *site["forbidden"]])
    spots = [(place["x"], place["y"]) for place in site["places"].values()]
    for start in spots:
        for goal in spots:
            way = paths.plan(start, goal, closed)
            assert len(way) <= 5
            assert paths.length([start, *way]) <= 1.6 * math.dist(start, goal) + 12
            for one, other in pairwise([start, *way]):
                assert not any(crosses(box, one, other) for box in closed)


def test_a_wall_with_a_gap_is_passed_through_the_gap() -> None:
    """A door of 2 m in a wall of 100 m is found, and the way keeps its clearance from the door posts."""
    wall = [paths.Rectangle("west", 0, 49, 50, 51), paths.Rectangle("east", 51, 100, 50, 51)]
    fence = [paths.Rectangle("left", -1, 0, 0, 100), paths.Rectangle("right", 100, 101, 0, 100),
             paths.Rectangle("south", -1, 101, -1, 0), paths.Rectangle("north", -1, 101, 100, 101)]  # fmt: skip
    way = paths.plan((10, 10), (10, 90), [*wall, *fence])
    assert way[-1] == (10, 90)
    through = [at for at in way if 49 < at[0] < 51]
    assert through
    assert all(box.gap(at) >= paths.CLEARANCE_M - 1e-6 for at in through for box in wall)


def test_a_robot_that_stands_close_to_a_rack_may_leave_it() -> None:
    """A start within the clearance is no dead end: the clearance shrinks for that one obstacle."""
    rack = paths.Rectangle("rack", 0, 10, 0, 1)
    way = paths.plan((5, 1.1), (5, -5), [rack])
    for one, other in pairwise([(5.0, 1.1), *way]):
        assert not crosses(rack, one, other)


def test_a_walled_in_goal_is_no_path() -> None:
    """Where walls close all around the goal, the planner says so."""
    ring = [paths.Rectangle("a", 0, 10, 0, 1), paths.Rectangle("b", 0, 10, 9, 10),
            paths.Rectangle("c", 0, 1, 0, 10), paths.Rectangle("d", 9, 10, 0, 10)]  # fmt: skip
    with pytest.raises(paths.NoPath, match="no way from"):
        paths.plan((20, 20), (5, 5), ring)


def test_a_position_that_is_none_is_refused() -> None:
    """NaN from a robot without a fix is refused before anything is computed."""
    with pytest.raises(paths.NoPath, match="no position"):
        paths.plan((math.nan, 0.0), (1.0, 1.0), [])


VECTORS = {"east": (1.0, 0.0), "west": (-1.0, 0.0), "north": (0.0, 1.0), "south": (0.0, -1.0)}


def runs_against(aisle: paths.OneWay, one: paths.Point, other: paths.Point) -> bool:
    """Whether a leg is in an aisle somewhere and goes against it: by a check of its own."""
    x, y = VECTORS[aisle.direction]
    return (other[0] - one[0]) * x + (other[1] - one[1]) * y < -0.01 and crosses(aisle.area, one, other)


@settings(max_examples=80, deadline=None)
@given(
    start=point,
    goal=point,
    closed=st.lists(boxes(), max_size=4),
    aisles=st.lists(st.builds(paths.OneWay, boxes(), st.sampled_from(sorted(VECTORS))), min_size=1, max_size=5),
)
def test_a_way_never_runs_against_a_one_way_aisle(
    start: paths.Point, goal: paths.Point, closed: list[paths.Rectangle], aisles: list[paths.OneWay]
) -> None:
    """No leg does, nor crosses an obstacle; else the planner names the aisles that are in the way."""
    assume(not any(box.holds(start) or box.holds(goal) for box in closed))
    assume(math.dist(start, goal) > paths.NUDGE_M)
    try:
        way = paths.plan(start, goal, closed, aisles=aisles)
    except paths.NoPath as none:
        named = any(repr(each.area.name) in none.message for each in aisles)
        told = (" but against " in none.message, bool(none.remedy))
        assert told == (named, True)
        return
    assert way[-1] == goal
    for one, other in pairwise([start, *way]):
        assert not any(crosses(box, one, other) for box in closed)
        assert not any(runs_against(each, one, other) for each in aisles)


def lanes() -> list[paths.OneWay]:
    """Return two lanes side by side between the racks: the south one to the east, the north one to the west."""
    south, north = paths.Rectangle("lane 1", 10, 30, 10, 12), paths.Rectangle("lane 2", 10, 30, 12, 14)
    return [paths.OneWay(south, "east"), paths.OneWay(north, "west")]


def test_each_way_has_its_lane() -> None:
    """There and back lead through other lanes."""
    racks = [paths.Rectangle("rack a", 10, 30, 0, 10), paths.Rectangle("rack b", 10, 30, 14, 24)]
    there = paths.plan((5.0, 12.0), (35.0, 12.5), racks, aisles=lanes())
    back = paths.plan((35.0, 12.5), (5.0, 12.0), racks, aisles=lanes())
    inside = [[y for x, y in way if 10 < x < 30] for way in (there, back)]
    assert all(y <= 12.0 for y in inside[0])
    assert all(y >= 12.0 for y in inside[1])


def test_a_robot_just_beyond_its_goal_turns_round() -> None:
    """Half a metre against an aisle is no way through it; more leads round."""
    aisles = [paths.OneWay(paths.Rectangle("aisle", 0, 40, 0, 4), "east")]
    assert paths.plan((20.4, 2.0), (20.0, 2.0), [], aisles=aisles) == [(20.0, 2.0)]
    assert len(paths.plan((22.0, 2.0), (20.0, 2.0), [], aisles=aisles)) > 1


def test_an_aisle_without_another_way_back_is_named() -> None:
    """A dead end that is one-way: who is in it finds no way out."""
    walls = [paths.Rectangle("south", 10, 30, 0, 10), paths.Rectangle("north", 10, 30, 12, 24),
             paths.Rectangle("end", 30, 32, 0, 24)]  # fmt: skip
    aisles = [paths.OneWay(paths.Rectangle("aisle 3", 10, 30, 10, 12), "east")]
    assert paths.plan((5.0, 11.0), (28.0, 11.0), walls, aisles=aisles)
    with pytest.raises(paths.NoPath, match="but against 'aisle 3', one-way to the east") as none:
        paths.plan((28.0, 11.0), (5.0, 11.0), walls, aisles=aisles)
    assert "one_way" in none.value.remedy
