"""Plans a way around rectangles: A* on a grid, then straight lines wherever the view is free.

Why a grid: its cost is bounded by the number of cells, whatever the number of obstacles; about 10,000 cells
plan a 100 x 100 m site in tens of milliseconds without anything installed. A cell is closed when it so much as
touches a grown obstacle, so every grid step is free; the shortcuts are checked against the rectangles
themselves, so what comes out never cuts a corner that the grid was too coarse to show. One-way aisles bar steps
against them in all cells that they touch, and shortcuts likewise. Pure.
"""

import heapq
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

Point = tuple[float, float]

CLEARANCE_M = 0.6
"""Kept from obstacles where the start and the goal themselves keep it: half a robot and a bit."""
CELLS = 10_000
"""Grid cells of the first try; a second and a third try have 4 and 9 times as many."""
MIN_CELL_M = 0.2
_BORDER_M = 3.0
_ANCHOR_CELLS = 3
_EDGE = 1e-9
_ROUNDED_M = 2e-3
"""Against a one-way aisle by rounding of waypoints, metres."""
NUDGE_M = 0.5
"""Who is so near to its goal goes straight, also against a one-way aisle: it stopped a bit beyond it."""
_EAST, _WEST, _NORTH, _SOUTH = 1, 2, 4, 8
_WAYS = {
    "east": (1.0, 0.0, _WEST),
    "west": (-1.0, 0.0, _EAST),
    "north": (0.0, 1.0, _SOUTH),
    "south": (0.0, -1.0, _NORTH),
}
"""By the direction of an aisle: the unit vector, and the steps that it bars."""


class NoPath(Exception):  # noqa: N818 - says what it is
    """There is no way; `remedy` says what may help."""

    def __init__(self, message: str, remedy: str) -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy


class Rectangle(NamedTuple):
    """An area that is closed: its inside, not its edge."""

    name: str
    x0: float
    x1: float
    y0: float
    y1: float

    def holds(self, point: Point) -> bool:
        """Whether a point is strictly inside."""
        return self.x0 < point[0] < self.x1 and self.y0 < point[1] < self.y1

    def gap(self, point: Point) -> float:
        """Distance of a point outside, metres, the larger of both axes'."""
        return max(self.x0 - point[0], point[0] - self.x1, self.y0 - point[1], point[1] - self.y1, 0.0)

    def grown(self, margin: float) -> "Rectangle":
        """Return it larger by `margin` on every side."""
        return Rectangle(self.name, self.x0 - margin, self.x1 + margin, self.y0 - margin, self.y1 + margin)

    def cuts(self, start: Point, end: Point) -> bool:
        """Whether the straight line between two points passes through the inside (Liang-Barsky clipping)."""
        low, high = 0.0, 1.0
        for begin, stop, edge, other_edge in (
            (start[0], end[0], self.x0, self.x1),
            (start[1], end[1], self.y0, self.y1),
        ):
            near, far = edge + _EDGE, other_edge - _EDGE
            length = stop - begin
            if abs(length) < 1e-12:
                if not near < begin < far:
                    return False
                continue
            one, other = (near - begin) / length, (far - begin) / length
            low, high = max(low, min(one, other)), min(high, max(one, other))
            if low >= high:
                return False
        return True


def rectangles(boxes: Sequence[Mapping[str, Any]]) -> list[Rectangle]:
    """Return the site's obstacles or forbidden areas (dicts of name, x, y) as rectangles."""
    return [
        Rectangle(
            str(box.get("name", "obstacle")),
            float(box["x"][0]),
            float(box["x"][1]),
            float(box["y"][0]),
            float(box["y"][1]),
        )
        for box in boxes
    ]


class OneWay(NamedTuple):
    """An aisle that is gone along in one direction only; across it is free."""

    area: Rectangle
    direction: str
    """`north`, `east`, `south` or `west`."""

    def against(self, start: Point, end: Point) -> bool:
        """Whether the straight line between two points runs against it."""
        x, y, _ = _WAYS[self.direction]
        along = (end[0] - start[0]) * x + (end[1] - start[1]) * y
        return along < -_ROUNDED_M and self.area.cuts(start, end)


def one_ways(aisles: Sequence[Mapping[str, Any]]) -> list[OneWay]:
    """Return the site's aisles (dicts of name, x, y, one_way)."""
    areas = rectangles(aisles)
    return [OneWay(area, str(each["one_way"])) for area, each in zip(areas, aisles, strict=True)]


def straight(start: Point, end: Point, walls: Sequence[Rectangle], aisles: Sequence[OneWay] = ()) -> bool:
    """Whether a robot may go straight: through no wall, and against no aisle unless it is as good as there."""
    return free(start, end, walls) and (math.dist(start, end) <= NUDGE_M or _obeys(start, end, aisles))


def _obeys(start: Point, end: Point, aisles: Sequence[OneWay]) -> bool:
    return not any(each.against(start, end) for each in aisles)


def plan(
    start: Point,
    goal: Point,
    closed: Sequence[Rectangle],
    *,
    aisles: Sequence[OneWay] = (),
    clearance: float = CLEARANCE_M,
    tries: int = 3,
) -> list[Point]:
    """Return the waypoints from `start` (left out) to `goal` (the last), metres.

    No leg passes through the inside of a rectangle of `closed`, or runs against an aisle. Where start or goal are
    nearer to a rectangle than `clearance`, that one's clearance shrinks to what they have. `tries`: grids that are
    searched, each finer.

    Raises:
        NoPath: start or goal is inside a closed area, or everything between them is closed, or runs against aisles.
    """
    for what, point in (("the robot", start), ("the goal", goal)):
        if not (math.isfinite(point[0]) and math.isfinite(point[1])):
            raise NoPath(f"{what} is at {point}, which is no position", "check the robot's position source")
        for box in closed:
            if box.holds(point):
                remedy = "drive it out by hand" if point is start else "choose another place, or correct the site's map"
                raise NoPath(f"{what} is inside {box.name!r}, where no robot may go", remedy)
    walls = [box.grown(min(clearance, 0.9 * box.gap(start), 0.9 * box.gap(goal))) for box in closed]
    if straight(start, goal, walls, aisles):
        return [goal]
    for finer in range(1, tries + 1):
        cells = _search(start, goal, walls, aisles, CELLS * finer * finer)
        if cells is not None:
            return _straighten([start, *cells, goal], walls, aisles)[1:]
    if aisles:
        way = [start, *plan(start, goal, closed, clearance=clearance, tries=tries)]
        wrong = [each for each in aisles if any(each.against(one, other) for one, other in pairwise(way))]
        raise NoPath(
            f"no way from ({start[0]:.1f}, {start[1]:.1f}) to ({goal[0]:.1f}, {goal[1]:.1f}) but against "
            + ", ".join(f"{each.area.name!r}, one-way to the {each.direction}" for each in wrong),
            "leave another way round in the site's file, turn the aisle round or take its one_way out",
        )
    raise NoPath(
        f"no way from ({start[0]:.1f}, {start[1]:.1f}) to ({goal[0]:.1f}, {goal[1]:.1f})",
        "everything between is closed by obstacles and forbidden areas: correct the site's map or choose another place",
    )


def free(start: Point, end: Point, walls: Sequence[Rectangle]) -> bool:
    """Whether the straight line crosses no wall."""
    return not any(wall.cuts(start, end) for wall in walls)


def length(points: Sequence[Point]) -> float:
    """Return the length of a line through points, metres."""
    return sum(math.dist(one, other) for one, other in pairwise(points))


class _Grid:
    """Open and closed cells, row by row, with a closed border so that no step leaves the grid."""

    def __init__(
        self, start: Point, goal: Point, walls: Sequence[Rectangle], aisles: Sequence[OneWay], cells: int
    ) -> None:
        boxes = [*walls, *(each.area for each in aisles)]
        xs = [start[0], goal[0], *(box.x0 for box in boxes), *(box.x1 for box in boxes)]
        ys = [start[1], goal[1], *(box.y0 for box in boxes), *(box.y1 for box in boxes)]
        width, height = max(xs) - min(xs) + 2 * _BORDER_M, max(ys) - min(ys) + 2 * _BORDER_M
        self.cell = max(MIN_CELL_M, math.sqrt(width * height / cells))
        self.x0, self.y0 = min(xs) - _BORDER_M - self.cell, min(ys) - _BORDER_M - self.cell
        self.columns = math.ceil(width / self.cell) + 2
        self.rows = math.ceil(height / self.cell) + 2
        self.closed = bytearray(self.columns * self.rows)
        for row in range(self.rows):
            edge = row in (0, self.rows - 1)
            first = row * self.columns
            if edge:
                self.closed[first : first + self.columns] = b"\1" * self.columns
            self.closed[first] = self.closed[first + self.columns - 1] = 1
        for wall in walls:
            for first, last in self._rows_of(wall):
                self.closed[first:last] = b"\1" * (last - first)
        self.barred = bytearray(len(self.closed))
        """Steps that one-way aisles bar, from the cell and to it."""
        for each in aisles:
            steps = _WAYS[each.direction][2]
            for first, last in self._rows_of(each.area):
                for cell in range(first, last):
                    self.barred[cell] |= steps

    def _rows_of(self, box: Rectangle) -> Iterable[tuple[int, int]]:
        """Yield the cells that a box touches, row by row: the first, and the one after the last."""
        if box.x1 - box.x0 <= 2 * _EDGE or box.y1 - box.y0 <= 2 * _EDGE:
            return
        left, right = self._span(box.x0 - self.x0, box.x1 - self.x0, self.columns)
        low, high = self._span(box.y0 - self.y0, box.y1 - self.y0, self.rows)
        for row in range(low, high):
            yield row * self.columns + left, row * self.columns + right

    def _span(self, low: float, high: float, count: int) -> tuple[int, int]:
        return max(0, math.floor(low / self.cell)), min(count, math.ceil(high / self.cell))

    def centre(self, cell: int) -> Point:
        row, column = divmod(cell, self.columns)
        return self.x0 + (column + 0.5) * self.cell, self.y0 + (row + 0.5) * self.cell

    def anchors(
        self, point: Point, walls: Sequence[Rectangle], aisles: Sequence[OneWay], *, leaving: bool
    ) -> dict[int, float]:
        """Open cells near a point that it sees, and that can be gone to from it or from which it can, with distance."""
        column, row = int((point[0] - self.x0) / self.cell), int((point[1] - self.y0) / self.cell)
        found: dict[int, float] = {}
        for near_row in range(max(0, row - _ANCHOR_CELLS), min(self.rows, row + _ANCHOR_CELLS + 1)):
            for near_column in range(max(0, column - _ANCHOR_CELLS), min(self.columns, column + _ANCHOR_CELLS + 1)):
                cell = near_row * self.columns + near_column
                leg = (point, self.centre(cell)) if leaving else (self.centre(cell), point)
                if not self.closed[cell] and free(*leg, walls) and _obeys(*leg, aisles):
                    found[cell] = math.dist(point, self.centre(cell))
        return found


def _search(
    start: Point, goal: Point, walls: Sequence[Rectangle], aisles: Sequence[OneWay], cells: int
) -> list[Point] | None:
    """A* over cell centres with eight neighbours; a diagonal step needs both its sides open."""
    grid = _Grid(start, goal, walls, aisles, cells)
    closed, barred, columns, cell_m = grid.closed, grid.barred, grid.columns, grid.cell
    ends = grid.anchors(goal, walls, aisles, leaving=False)
    begins = grid.anchors(start, walls, aisles, leaving=True)
    if not ends or not begins:
        return None
    sides = ((1, _EAST), (-1, _WEST), (columns, _NORTH), (-columns, _SOUTH))
    diagonal = (
        (columns + 1, columns, 1, _NORTH | _EAST),
        (columns - 1, columns, -1, _NORTH | _WEST),
        (1 - columns, -columns, 1, _SOUTH | _EAST),
        (-columns - 1, -columns, -1, _SOUTH | _WEST),
    )
    goal_column, goal_row = (goal[0] - grid.x0) / cell_m - 0.5, (goal[1] - grid.y0) / cell_m - 0.5
    best = dict(begins)
    came: dict[int, int] = {}
    settled = bytearray(len(closed))

    def rest(cell: int) -> float:
        row, column = divmod(cell, columns)
        return math.hypot(column - goal_column, row - goal_row) * cell_m

    heap = [(distance + rest(cell), cell) for cell, distance in begins.items()]
    heapq.heapify(heap)
    shortest, last = math.inf, -1
    while heap:
        estimate, cell = heapq.heappop(heap)
        if estimate >= shortest:
            break
        if settled[cell]:
            continue
        settled[cell] = 1
        so_far = best[cell]
        if cell in ends and so_far + ends[cell] < shortest:
            shortest, last = so_far + ends[cell], cell
        here = barred[cell]
        steps = [
            (cell + step, so_far + cell_m)
            for step, side in sides
            if not (closed[cell + step] or (here | barred[cell + step]) & side)
        ]
        for step, one, other, side in diagonal:
            shut = closed[cell + step] or closed[cell + one] or closed[cell + other]
            if not (shut or (here | barred[cell + step]) & side):
                steps.append((cell + step, so_far + cell_m * math.sqrt(2)))
        for near, cost in steps:
            if not settled[near] and cost < best.get(near, math.inf):
                best[near] = cost
                came[near] = cell
                heapq.heappush(heap, (cost + rest(near), near))
    if last < 0:
        return None
    way = [last]
    while way[-1] in came:
        way.append(came[way[-1]])
    return [grid.centre(cell) for cell in reversed(way)]


def _straighten(points: list[Point], walls: Sequence[Rectangle], aisles: Sequence[OneWay]) -> list[Point]:
    """Leave out every point that the line from an earlier to a later one makes needless."""
    way = [points[0]]
    here = 0
    while here < len(points) - 1:
        reach = here + 1
        for far in range(len(points) - 1, here + 1, -1):
            if free(points[here], points[far], walls) and _obeys(points[here], points[far], aisles):
                reach = far
                break
        way.append(points[reach])
        here = reach
    return way
