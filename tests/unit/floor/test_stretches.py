"""Stretches of ways on any floor: where they end, what they reserve, and what is left of the way."""

import math
import random

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.floor import geometry
from appliance.floor.decide import Body, Floor, Go, Trip
from appliance.floor.geometry import Size
from appliance.floor.mover import Mover
from appliance.model import Box, Place, Site
from appliance.model.floor import FloorState, Point

SIZE = Size(radius_m=0.4, height_m=1.5, margin_m=0.1)
SPOTS = st.tuples(st.floats(1.0, 39.0), st.floats(1.0, 29.0), st.just(0.0))
WAYS = st.lists(SPOTS, min_size=2, max_size=4)


@st.composite
def floors(draw: st.DrawFn) -> tuple[Floor, dict[str, Body], Trip]:
    """Draw a site with racks, robots on their ways or waiting for one, and where robot `a` wants to go.

    All drive, or all fly at one height and `a` takes off.
    """
    height = draw(st.sampled_from((0.0, 0.0, 10.0)))
    racks = draw(st.lists(st.tuples(st.integers(1, 8), st.integers(1, 5)), max_size=6, unique=True))
    site = Site(
        places={"dock 1": Place(x=35.0, y=25.0)},
        fence=Box(name="fence", x=(0.0, 40.0), y=(0.0, 30.0)),
        obstacles=tuple(
            Box(name=f"rack {x} {y}", x=(4.0 * x, 4.0 * x + 2), y=(4.0 * y, 4.0 * y + 3)) for x, y in racks
        ),
    )
    seen = {"a": Body(robot="a", at=draw(SPOTS), size=SIZE)}
    for number, flat in enumerate(draw(st.lists(WAYS, max_size=4))):
        way = [(x, y, height) for x, y, _ in flat]
        cut = draw(st.integers(2, len(way)))
        moves = draw(st.booleans())
        state = FloorState(
            robot=f"b{number}",
            state="moves" if moves else "waits",
            ticket=number + 1,
            way=tuple(way[:cut] if moves else way),
            wants=tuple(way[cut:]) if moves else (),
        )
        seen[state.robot] = Body(robot=state.robot, at=way[0], size=SIZE, state=state, stands=not moves)
    points = [(x, y, height) for x, y, _ in draw(st.lists(SPOTS, min_size=1, max_size=2))]
    if height:
        points.insert(0, (*seen["a"].at[:2], height))
    return Floor(site), seen, Trip(robot="a", task="t", command="t/1", points=tuple(points), flies=height > 0.0)


def near(points: tuple[Point, ...], others: tuple[Point, ...]) -> bool:
    """Whether two lists of points are the same but for rounding."""
    return len(points) == len(others) and all(
        math.dist(one, other) < 0.01 for one, other in zip(points, others, strict=True)
    )


@settings(max_examples=150, deadline=None)
@given(floors())
def test_a_stretch_ends_where_it_blocks_no_other(drawn: tuple[Floor, dict[str, Body], Trip]) -> None:
    """Clear of all other robots, of the ways that they are on or want, and with the rest of the way behind it."""
    floor, seen, trip = drawn
    step = floor.decide(trip, seen)
    if not isinstance(step, Go):
        return
    assert geometry.cells(step.way, SIZE) <= step.parts
    if step.ends:
        assert math.dist(step.way[-1], trip.points[-1]) < 0.01 or step.place
        return
    end = step.way[-1][:2]
    for other in seen.values():
        if other.robot != "a":
            assert other.state is not None
            way = (*other.state.way, *other.state.wants)
            assert geometry.from_way(end, way) >= 2 * SIZE.kept_m
    assert not any(part.startswith("place/") for part in step.parts)
    mover = Mover(floor, trip)
    mover.started(step)
    mover.arrived()
    assert near(mover.trip.points, (*step.wants[:-1], trip.points[-1]))


@settings(max_examples=150, deadline=None)
@given(floors(), st.randoms(use_true_random=False))
def test_who_is_refused_a_part_stops_before_it(
    drawn: tuple[Floor, dict[str, Body], Trip], chance: random.Random
) -> None:
    """The stretch up to there does not have that part, has no other cells than the way, and is a shorter one."""
    floor, seen, trip = drawn
    step = floor.decide(trip, seen)
    if not isinstance(step, Go):
        return
    part = chance.choice(sorted(step.parts))
    nearer = floor.up_to(step, part, trip, seen)
    if nearer is None:
        return
    assert part not in nearer.parts
    assert nearer.parts <= step.parts
    assert not nearer.ends
    assert geometry.length(nearer.way) < geometry.length(step.way)


@settings(max_examples=200, deadline=None)
@given(WAYS, WAYS, st.floats(0.1, 3.0))
def test_ways_meet_where_a_point_of_one_is_near_the_other(one: list[Point], other: list[Point], apart: float) -> None:
    """As points every few centimetres find it."""
    pieces = [geometry.ahead(one, each * geometry.length(one) / 400)[-1] for each in range(401)]
    least = min(geometry.from_way(piece[:2], other) for piece in pieces)
    step = geometry.length(one) / 400
    found = geometry.ways_meet(one, other, apart)
    assert found or least >= apart - 1e-6
    assert not found or least < apart + step
