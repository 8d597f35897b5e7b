"""Site metres and the globe."""

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Box, Site
from appliance.model.site import (
    GRAZE_M,
    bearing_deg,
    blocked_leg,
    core,
    crosses,
    inside,
    rings,
    to_globe,
    to_site,
    turn_deg,
)

METRES = st.floats(-10_000.0, 10_000.0)


@given(
    latitude=st.floats(-80.0, 80.0),
    longitude=st.floats(-180.0, 180.0),
    x=METRES,
    y=METRES,
    z=st.floats(-100.0, 500.0),
)
def test_round_trip(latitude: float, longitude: float, x: float, y: float, z: float) -> None:
    """A site point taken to the globe and back is the same point, also on the date line."""
    site = Site(latitude_deg=latitude, longitude_deg=longitude)
    back = to_site(site, *to_globe(site, x, y, z))
    assert math.dist(back, (x, y, z)) < 1e-4


def test_a_degree_is_as_long_as_geodesy_says() -> None:
    """At 45 degrees a degree of latitude is 111,131.8 m and one of longitude 78,846.8 m (WGS 84 tables)."""
    site = Site(latitude_deg=45.0, longitude_deg=10.0, altitude_m=0.0)
    _, north, _ = to_site(site, 46.0, 10.0, 0.0)
    east, _, _ = to_site(site, 45.0, 11.0, 0.0)
    assert north == pytest.approx(111_131.8, abs=1.0)
    assert east == pytest.approx(78_846.8, abs=1.0)


@pytest.mark.parametrize(("x", "y", "bearing"), [(0, 1, 0), (1, 0, 90), (0, -1, 180), (-1, 0, 270)])
def test_bearings_are_the_compass(x: float, y: float, bearing: float) -> None:
    """Bearings count clockwise from north."""
    assert bearing_deg(x, y) == pytest.approx(bearing)


@given(current=st.floats(0, 360), wanted=st.floats(0, 360))
def test_turns_are_short_and_arrive(current: float, wanted: float) -> None:
    """A turn is at most half a circle and ends at the wanted heading."""
    turn = turn_deg(current, wanted)
    assert -180.0 <= turn <= 180.0
    assert math.isclose(math.cos(math.radians(current + turn)), math.cos(math.radians(wanted)), abs_tol=1e-6)


@given(
    st.tuples(st.floats(-5, 15), st.floats(-5, 15)),
    st.tuples(st.floats(-5, 15), st.floats(-5, 15)),
)
def test_a_leg_crosses_a_box_if_a_point_of_it_is_inside(start: tuple[float, float], end: tuple[float, float]) -> None:
    """The clipping agrees with looking at many points of the leg."""
    box = Box(name="b", x=(2.0, 6.0), y=(3.0, 7.0))
    points = [
        (start[0] + (end[0] - start[0]) * part / 400, start[1] + (end[1] - start[1]) * part / 400)
        for part in range(401)
    ]
    if any(inside(box, *point, margin=-0.06) for point in points):
        assert crosses(box, start, end)
    if not any(inside(box, *point, margin=0.1) for point in points):
        assert not crosses(box, start, end)


def test_a_robot_may_drive_out_of_the_box_it_stands_in() -> None:
    """A box that holds the start blocks nothing; the next one does, and is named with its leg."""
    boxes = (Box(name="own", x=(0, 2), y=(0, 2)), Box(name="other", x=(5, 6), y=(0, 2)))
    assert blocked_leg(boxes, (1, 1), [(3, 1)]) is None
    assert blocked_leg(boxes, (1, 1), [(3, 1), (8, 1)]) == (1, boxes[1])
    back = Box(name="back", x=(5, 6), y=(5, 6))
    assert blocked_leg((boxes[0], back), (1, 1), [(3, 1), (3, 3), (-1, -1)]) == (2, boxes[0])


def test_an_edge_may_be_grazed_and_a_wall_may_not_be_passed() -> None:
    """Up to five centimetres, or a quarter of what is narrower than twenty; a leg that ends in a wall meets it too."""
    for width in (10.0, 0.2, 0.1, 0.01, 1e-6):
        wall = Box(name="wall", x=(5.0, 5.0 + width), y=(0.0, 10.0))
        assert not crosses(wall, (5.0, -5.0), (5.0, 15.0)), width
        assert crosses(wall, (0.0, 5.0), (20.0, 5.0)), width
        assert crosses(wall, (0.0, 5.0), (5.0 + width / 2, 5.0)), width
        assert crosses(wall, (5.0 + width / 2, -5.0), (5.0 + width / 2, 15.0)), width
        assert not crosses(wall, (0.0, 5.0), (5.0, 5.0)), width


_METRES = st.floats(-40, 40).map(lambda metres: round(metres, 3))


@given(
    width=st.floats(1e-6, 3.0),
    at=_METRES,
    ends=st.tuples(st.floats(0.0, 60.0), st.floats(0.0, 60.0)),
    across=st.tuples(_METRES, _METRES),
    upright=st.booleans(),
)
def test_no_wall_is_so_thin_that_a_leg_gets_through(
    width: float, at: float, ends: tuple[float, float], across: tuple[float, float], upright: bool
) -> None:
    """A robot on one side of a wall, wherever, that goes to the other side, at whatever angle, is stopped by it."""

    def turned(along: float, beside: float) -> tuple[float, float]:
        return (along, beside) if upright else (beside, along)

    thin, wide = (at, at + width), (-41.0, 41.0)
    wall = Box(name="wall", x=thin if upright else wide, y=wide if upright else thin)
    one, other = turned(at - ends[0], across[0]), turned(at + width + ends[1], across[1])
    assert crosses(wall, one, other)
    assert crosses(wall, other, one)
    assert blocked_leg([wall], one, [one, other]) == (1, wall)
    # On its own side it is free.
    assert not crosses(wall, one, turned(at, across[1]))


_COORDINATE = st.integers(-200, 200).map(lambda tenths: Fraction(tenths, 10))


@given(
    corners=st.tuples(_COORDINATE, _COORDINATE),
    size=st.tuples(st.integers(1, 4000), st.integers(1, 4000)),
    start=st.tuples(_COORDINATE, _COORDINATE),
    end=st.tuples(_COORDINATE, _COORDINATE),
)
def test_a_leg_meets_a_box_as_exact_arithmetic_has_it(
    corners: tuple[Fraction, Fraction],
    size: tuple[int, int],
    start: tuple[Fraction, Fraction],
    end: tuple[Fraction, Fraction],
) -> None:
    """With fractions, by which side of the leg the corners lie on; what touches within a micrometre is left open."""
    box = Box(
        name="box",
        x=(float(corners[0]), float(corners[0] + Fraction(size[0], 1000))),
        y=(float(corners[1]), float(corners[1] + Fraction(size[1], 1000))),
    )

    def meets(slack: Fraction) -> bool:
        within = core(box, GRAZE_M)
        (x0, x1), (y0, y1) = ((Fraction(low) + slack, Fraction(high) - slack) for low, high in (within.x, within.y))
        if x0 > x1 or y0 > y1:
            return False
        (ax, ay), (bx, by) = start, end
        if max(ax, bx) < x0 or min(ax, bx) > x1 or max(ay, by) < y0 or min(ay, by) > y1:
            return False
        sides = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for x in (x0, x1) for y in (y0, y1)]
        return min(sides) <= 0 <= max(sides)

    found = crosses(box, (float(start[0]), float(start[1])), (float(end[0]), float(end[1])))
    if meets(Fraction(1, 10**6)):
        assert found
    if not meets(-Fraction(1, 10**6)):
        assert not found


@given(
    box=st.tuples(_METRES, st.floats(0.001, 20), _METRES, st.floats(0.001, 20)),
    centre=st.tuples(_METRES, _METRES),
    radius=st.floats(1.0, 60.0),
)
def test_a_circle_meets_a_box_if_a_point_of_it_is_inside(
    box: tuple[float, float, float, float], centre: tuple[float, float], radius: float
) -> None:
    """Agrees with looking at many points of the circle; a post that falls between two of them is found as well."""
    area = Box(name="b", x=(box[0], box[0] + box[1]), y=(box[2], box[2] + box[3]))
    points = [
        (centre[0] + radius * math.cos(math.tau * part / 720), centre[1] + radius * math.sin(math.tau * part / 720))
        for part in range(720)
    ]
    found = rings(area, centre, radius)
    if any(inside(core(area, GRAZE_M), *point, margin=-1e-9) for point in points):
        assert found
    if not any(inside(area, *point, margin=math.tau * radius / 720) for point in points):
        assert not found
