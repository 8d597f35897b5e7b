"""Cells that robots sweep, and what is left of a way."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.floor import geometry
from appliance.floor.geometry import CELL_M, Size
from appliance.model.floor import Point

SIZE = Size(radius_m=0.4, height_m=1.5, margin_m=0.1)
numbers = st.floats(-8.0, 8.0, allow_nan=False).map(lambda value: round(value, 3))
points = st.tuples(numbers, numbers, st.just(0.0))
ways = st.lists(points, min_size=1, max_size=4).map(tuple)


def along(way: tuple[Point, ...], steps: int = 40) -> list[tuple[float, float]]:
    """Return points on a way."""
    if len(way) == 1:
        return [way[0][:2]]
    return [
        (one[0] + step / steps * (other[0] - one[0]), one[1] + step / steps * (other[1] - one[1]))
        for one, other in pairwise(way)
        for step in range(steps + 1)
    ]


@given(ways)
def test_all_that_a_robot_touches_is_among_its_cells(way: tuple[Point, ...]) -> None:
    """No point within its radius of its way lies in a cell that is not reserved."""
    cells = geometry.cells(way, SIZE)
    for x, y in along(way):
        for turn in range(8):
            px = x + SIZE.kept_m * 0.999 * math.cos(turn * math.tau / 8)
            py = y + SIZE.kept_m * 0.999 * math.sin(turn * math.tau / 8)
            assert f"0,{math.floor(px / CELL_M)},{math.floor(py / CELL_M)}" in cells


@given(ways, ways)
def test_no_cell_in_common_means_far_enough_apart(one: tuple[Point, ...], other: tuple[Point, ...]) -> None:
    """Two robots whose reservations are disjoint are never nearer than the sum of their radii."""
    if geometry.cells(one, SIZE).isdisjoint(geometry.cells(other, SIZE)):
        assert all(geometry.from_way(point, other) >= 2 * SIZE.radius_m for point in along(one))


@given(ways)
def test_the_pieces_of_a_way_are_the_way(way: tuple[Point, ...]) -> None:
    """All pieces together have all cells of the way, and end at its length."""
    pieces = geometry.sweep(way, SIZE)
    assert frozenset[str]().union(*(cells for _, cells in pieces)) >= geometry.cells(way, SIZE)
    assert pieces[-1][0] == pytest.approx(geometry.length(way))


def test_one_above_the_other() -> None:
    """A drone that flies over a rover has none of its cells; one that lands has."""
    rover = geometry.cells(((0.0, 0.0, 0.0), (4.0, 0.0, 0.0)), SIZE)
    drone = Size(radius_m=0.5, height_m=0.5, margin_m=0.5)
    assert geometry.cells(((0.0, 0.0, 10.0), (4.0, 0.0, 10.0)), drone).isdisjoint(rover)
    assert geometry.cells(((2.0, 0.0, 10.0), (2.0, 0.0, 0.0)), drone) & rover


def test_what_is_left_of_a_way() -> None:
    """What lies behind is given up; where a way crosses itself, the later leg is not taken for the present one."""
    way = ((0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (10.0, 5.0, 0.0), (5.0, 5.0, 0.0), (5.0, -5.0, 0.0))
    leg, left = geometry.rest(way, (5.0, 0.0), 0, 1.0)
    assert (leg, left[0], left[1:]) == (0, (4.0, 0.0, 0.0), way[1:])
    leg, left = geometry.rest(way, (10.0, 3.0), leg, 1.0)
    assert (leg, left[0], left[1:]) == (1, (10.0, 2.0, 0.0), way[2:])
    assert geometry.still_to_go(way, (9.9, 3.0)) == way[2:]
    assert geometry.ahead(way, 12.0) == ((0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (10.0, 2.0, 0.0))
