"""Site metres and the globe."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Box, Site
from appliance.model.geo import bearing_deg, blocked_leg, crosses, inside, to_globe, to_site, turn_deg

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
