"""One-way aisles on the shared floor: ways keep to them, also round others and when a robot gives way."""

import math
from itertools import pairwise

from hypothesis import assume, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.floor.decide import Body, Floor, Go, Trip, Wait
from appliance.model import Aisle, Box, Site
from appliance.model.floor import Point
from appliance.skills._lib import paths
from tests.unit.floor.test_stretches import SIZE, floors

VECTORS = {"east": (1.0, 0.0), "west": (-1.0, 0.0), "north": (0.0, 1.0), "south": (0.0, -1.0)}


@st.composite
def aisles(draw: st.DrawFn) -> Aisle:
    """Draw an aisle somewhere in the yard."""
    x, y = draw(st.integers(2, 30)), draw(st.integers(2, 20))
    wide, high = draw(st.integers(2, 8)), draw(st.integers(2, 8))
    return Aisle(name=f"{x} {y}", x=(x, x + wide), y=(y, y + high), one_way=draw(st.sampled_from(sorted(VECTORS))))  # pyright: ignore[reportArgumentType]


def against(way: tuple[Point, ...], aisle: Aisle) -> bool:
    """Whether a leg runs against an aisle that it is in."""
    x, y = VECTORS[aisle.one_way]
    area = paths.Rectangle(aisle.name, *aisle.x, *aisle.y).grown(-0.01)
    return any(
        (end[0] - start[0]) * x + (end[1] - start[1]) * y < -0.01 and area.cuts(start[:2], end[:2])
        for start, end in pairwise(way)
    )


@settings(max_examples=80, deadline=None)
@given(floors(), st.lists(aisles(), min_size=1, max_size=3))
def test_no_way_runs_against_an_aisle(drawn: tuple[Floor, dict[str, Body], Trip], drawn_aisles: list[Aisle]) -> None:
    """Neither to where the robot wants to go nor to where it gives way."""
    before, seen, trip = drawn
    points = (seen["a"].at, *trip.points)
    assume(not trip.flies)  # drones are not bound by aisles
    assume(all(math.dist(start, end) > paths.NUDGE_M for start, end in pairwise(points)))
    floor = Floor(replace(before.site, aisles=tuple(drawn_aisles)))
    step = floor.decide(trip, seen)
    refuge = next(iter(floor.refuges(trip, seen)), None)
    for go in (step, refuge):
        if isinstance(go, Go):
            assert not any(against(go.way, aisle) for aisle in drawn_aisles)


def test_what_cannot_be_reached_is_said() -> None:
    """A command whose only way runs against an aisle is not sent."""
    fence = Box(name="fence", x=(0.0, 40.0), y=(0.0, 4.0))
    floor = Floor(Site(fence=fence, aisles=(Aisle(name="aisle", x=(10.0, 20.0), y=(0.0, 4.0), one_way="west"),)))
    me = Body(robot="a", at=(5.0, 2.0, 0.0), size=SIZE)
    trip = Trip(robot="a", task="t", command="t/1", points=((30.0, 2.0, 0.0),))
    step = floor.decide(trip, {"a": me})
    assert isinstance(step, Wait)
    assert step.why == "finds no way to (30, 2) that keeps to the one-way aisles"
    assert isinstance(floor.decide(replace(trip, flies=True, points=((30.0, 2.0, 9.0),)), {"a": me}), Go)


def test_an_aisle_that_is_narrower_than_the_robot_is_told() -> None:
    """When the gateway starts."""
    site = Site(aisles=(Aisle(name="aisle", x=(10.0, 20.0), y=(0.0, 0.7), one_way="west"),))
    assert "aisle is 0.7 m wide: a robot of 0.4 m radius is wider" in Floor(site).problems(0.4)
