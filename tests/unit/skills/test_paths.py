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
