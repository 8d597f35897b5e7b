"""Ways and the cells that a robot sweeps on them. Pure.

The floor is cut into cells of `CELL_M` by `CELL_M` and bands of height of `BAND_M`; what a robot touches on its way is
a set of them. Two robots whose sets have no cell in common are further apart than the sum of their radii, or one above
the other.
"""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

from msgspec import Struct

from appliance.model.floor import Point

CELL_M = 0.5
BAND_M = 2.0
PIECE_M = 1.0
"""Of a way that is freed at a time."""
Flat = tuple[float, float]


class Size(Struct, frozen=True, kw_only=True):
    """A robot's body, metres, and what its position may be off."""

    radius_m: float
    height_m: float
    margin_m: float

    @property
    def kept_m(self) -> float:
        """Radius of what is reserved for it."""
        return self.radius_m + self.margin_m


def cells(way: Sequence[Point], size: Size) -> frozenset[str]:
    """Return the names of the cells that a robot touches on a way; of a single point: where it stands."""
    found: set[str] = set()
    legs = list(pairwise(way)) or [(way[0], way[0])]
    for start, end in legs:
        flat = _flat_cells(start[:2], end[:2], size.kept_m)
        low, high = bands(min(start[2], end[2]), max(start[2], end[2]), size)
        found.update(f"{band},{column},{row}" for band in range(low, high + 1) for column, row in flat)
    return frozenset(found)


def covered(way: Sequence[Point], size: Size) -> Iterable[tuple[float, float, float, float]]:
    """Yield rectangles (x0, x1, y0, y1), metres, that the cells of a way make up, a row of a leg each."""
    for start, end in list(pairwise(way)) or [(way[0], way[0])]:
        rows: dict[int, list[int]] = {}
        for column, row in _flat_cells(start[:2], end[:2], size.kept_m):
            rows.setdefault(row, []).append(column)
        for row, columns in rows.items():
            yield min(columns) * CELL_M, (max(columns) + 1) * CELL_M, row * CELL_M, (row + 1) * CELL_M


def sweep(way: Sequence[Point], size: Size) -> tuple[tuple[float, frozenset[str]], ...]:
    """Return the cells of a way piece by piece, each with the metres along the way at which it ends."""
    pieces: list[tuple[float, frozenset[str]]] = []
    behind = 0.0
    for start, end in pairwise(way):
        span = math.dist(start, end)
        count = max(1, math.ceil(span / PIECE_M))
        points = [_between(start, end, number / count) for number in range(count + 1)]
        for number, piece in enumerate(pairwise(points), start=1):
            pieces.append((behind + span * number / count, cells(piece, size)))
        behind += span
    return tuple(pieces) or ((0.0, cells(way, size)),)


def _between(start: Point, end: Point, share: float) -> Point:
    x, y, z = (one + share * (other - one) for one, other in zip(start, end, strict=True))
    return x, y, z


def bands(low_m: float, high_m: float, size: Size) -> tuple[int, int]:
    """Return the lowest and highest band that a body between two heights touches; one on the ground has the lowest."""
    bottom = low_m - size.margin_m if low_m > CELL_M else 0.0
    top = high_m + size.height_m + (size.margin_m if high_m > CELL_M else 0.0)
    return max(0, math.floor(bottom / BAND_M)), max(0, math.floor(top / BAND_M))


def _flat_cells(start: Flat, end: Flat, radius: float) -> Iterable[tuple[int, int]]:
    """Return columns and rows of the cells that come nearer to a line than `radius`."""
    low, high = sorted((start, end), key=lambda point: point[1])
    for row in range(math.floor((low[1] - radius) / CELL_M), math.floor((high[1] + radius) / CELL_M) + 1):
        # The stretch of the line that is near enough to this row.
        y0, y1 = row * CELL_M - radius, (row + 1) * CELL_M + radius
        rise = high[1] - low[1]
        first, last = (0.0, 1.0) if rise < 1e-9 else (max(0.0, (y0 - low[1]) / rise), min(1.0, (y1 - low[1]) / rise))
        xs = [low[0] + share * (high[0] - low[0]) for share in (first, last)]
        for column in range(math.floor((min(xs) - radius) / CELL_M), math.floor((max(xs) + radius) / CELL_M) + 1):
            x, y = column * CELL_M, row * CELL_M
            off = from_line((x + CELL_M / 2, y + CELL_M / 2), start, end) - radius
            # A cell holds the circle of half its width, and lies in that of half its diagonal.
            if off <= CELL_M / 2 or (off <= CELL_M * 0.7072 and _from_square(start, end, x, y) <= radius):
                yield column, row


def _from_square(start: Flat, end: Flat, x: float, y: float) -> float:
    """Distance of a line from the cell whose lower left corner is at (x, y)."""
    far_x, far_y = x + CELL_M, y + CELL_M
    corners = ((x, y), (far_x, y), (x, far_y), (far_x, far_y))
    nearest = min(from_line(corner, start, end) for corner in corners)
    ends = (math.hypot(max(x - px, px - far_x, 0.0), max(y - py, py - far_y, 0.0)) for px, py in (start, end))
    nearest = min(nearest, *ends)
    if nearest == 0.0 or start == end:
        return nearest
    # A line that passes through has corners on both sides.
    sides = [(end[0] - start[0]) * (cy - start[1]) - (end[1] - start[1]) * (cx - start[0]) for cx, cy in corners]
    through = min(sides) < 0.0 < max(sides) and all(
        min(start[axis], end[axis]) <= (far_x, far_y)[axis] and max(start[axis], end[axis]) >= (x, y)[axis]
        for axis in (0, 1)
    )
    return 0.0 if through else nearest


def from_line(point: Flat, start: Flat, end: Flat) -> float:
    """Distance of a point from the line between two points."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length2 = dx * dx + dy * dy
    share = 0.0 if length2 <= 0.0 else ((point[0] - start[0]) * dx + (point[1] - start[1]) * dy) / length2
    share = max(0.0, min(1.0, share))
    return math.hypot(point[0] - start[0] - share * dx, point[1] - start[1] - share * dy)


def from_way(point: Flat, way: Sequence[Point]) -> float:
    """Distance of a point from a way, on the ground."""
    if len(way) == 1:
        return math.dist(point, way[0][:2])
    return min(from_line(point, start[:2], end[:2]) for start, end in pairwise(way))


def ways_meet(one: Sequence[Point], other: Sequence[Point], apart: float) -> bool:
    """Whether two ways come nearer to each other than that, on the ground."""
    for start, end in pairwise(one):
        for first, last in pairwise(other):
            if _cross(start[:2], end[:2], first[:2], last[:2]):
                return True
            gaps = (
                from_line(start[:2], first[:2], last[:2]),
                from_line(end[:2], first[:2], last[:2]),
                from_line(first[:2], start[:2], end[:2]),
                from_line(last[:2], start[:2], end[:2]),
            )
            if min(gaps) < apart:
                return True
    return False


def _cross(start: Flat, end: Flat, first: Flat, last: Flat) -> bool:
    def side(one: Flat, other: Flat, point: Flat) -> float:
        return (other[0] - one[0]) * (point[1] - one[1]) - (other[1] - one[1]) * (point[0] - one[0])

    apart = side(start, end, first) * side(start, end, last) < 0.0
    return apart and side(first, last, start) * side(first, last, end) < 0.0


def length(way: Sequence[Point]) -> float:
    """Metres along a way."""
    return sum(math.dist(start, end) for start, end in pairwise(way))


def rest(way: Sequence[Point], at: Flat, leg: int, behind_m: float) -> tuple[int, tuple[Point, ...]]:
    """Return the leg that a robot is on, and what is left of its way from `behind_m` behind it.

    Args:
        way: the whole way.
        at: where it is.
        leg: the leg that it was on before; it does not go back.
        behind_m: what is kept behind it.
    """
    if len(way) < 2:
        return leg, tuple(way)

    def off(number: int) -> float:
        return from_line(at, way[number][:2], way[number + 1][:2])

    # Only on to the next leg: where a way crosses itself, a later one may be as near.
    number = leg
    while number + 2 < len(way) and off(number + 1) < off(number) - 1e-6:
        number += 1
    start, end = way[number], way[number + 1]
    span = math.dist(start[:2], end[:2])
    if span < 1e-9:
        return number, tuple(way[number:])
    along = ((at[0] - start[0]) * (end[0] - start[0]) + (at[1] - start[1]) * (end[1] - start[1])) / span
    if along <= behind_m:
        return number, tuple(way[max(0, number - 1) :])
    share = min(1.0, (along - behind_m) / span)
    return number, (_between(start, end, share), *way[number + 1 :])


def still_to_go(way: Sequence[Point], at: Flat) -> tuple[Point, ...]:
    """Return the points of a way that lie before a robot of which nothing is known but where it is."""
    legs = range(len(way) - 1)
    nearest = min(legs, key=lambda number: (from_line(at, way[number][:2], way[number + 1][:2]), number), default=0)
    return tuple(way[nearest + 1 :])


def ahead(way: Sequence[Point], metres: float) -> tuple[Point, ...]:
    """Return the first stretch of a way."""
    taken, left = [way[0]], metres
    for start, end in pairwise(way):
        span = math.dist(start, end)
        if span >= left:
            share = left / span if span > 0.0 else 0.0
            return (*taken, _between(start, end, share))
        taken.append(end)
        left -= span
    return tuple(taken)
