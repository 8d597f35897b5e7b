"""A map of positions in a terminal: braille dots for what stands and where robots came from, a sign for each robot.

`Canvas` is cells to draw on: braille dots, and signs above them, read as lines of styled pieces. A cell is about twice
as high as wide and has 2 by 4 dots, so dots are square and both axes have one scale. Robots that fall together are
drawn as their number, and named where there is room. Pure.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

from msgspec import Struct
from rich.cells import cell_len

from appliance.model import Site
from appliance.tui.safe import safe

_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of a braille cell by row and column (Unicode block 2800)."""
_BRAILLE = [chr(0x2800 + bits) for bits in range(256)]


class Line(Struct, frozen=True):
    """A line of the map: pieces of text, each with its style, that together have its width."""

    pieces: tuple[tuple[str, str], ...]

    @property
    def plain(self) -> str:
        """Its characters."""
        return "".join(text for text, _ in self.pieces)


class Canvas:
    """Cells with dots, and signs above them, row by row."""

    def __init__(self, columns: int, rows: int) -> None:
        self.columns, self.rows = columns, rows
        self._dots = [bytearray(columns) for _ in range(rows)]
        self._styles: list[list[str]] = [[""] * columns for _ in range(rows)]
        self._taken = [bytearray(columns) for _ in range(rows)]
        """Cells that have a sign."""
        self._signs: list[dict[int, tuple[str, str]]] = [{} for _ in range(rows)]
        """By column: character and style; a wide character has an empty one after it."""

    def dot(self, column: int, up: int, style: str) -> None:
        """Set a dot, counted from the lower left."""
        down = self.rows * 4 - 1 - up
        if 0 <= column < self.columns * 2 and 0 <= down < self.rows * 4:
            self._dots[down >> 2][column >> 1] |= _DOTS[down & 3][column & 1]
            self._styles[down >> 2][column >> 1] = style

    def cell(self, column: int, up: int) -> tuple[int, int] | None:
        """Return the cell of a dot; None outside."""
        row, cell = self.rows - 1 - up // 4, column // 2
        return (row, cell) if 0 <= row < self.rows and 0 <= cell < self.columns else None

    def free(self, row: int, column: int, cells: int) -> bool:
        """Whether so many cells are on the map and have no sign."""
        if not (0 <= row < self.rows and 0 <= column <= self.columns - cells):
            return False
        return self._taken[row].find(1, column, column + cells) < 0

    def write(self, row: int, column: int, text: str, style: str) -> None:
        """Write text from a cell on; what has no room any more is left out."""
        signs, taken = self._signs[row], self._taken[row]
        for each in text:
            width = 1 if each.isascii() else cell_len(each)
            if not width or column + width > self.columns:
                continue
            signs[column] = (each, style)
            taken[column] = 1
            for more in range(column + 1, column + width):
                signs[more] = ("", style)
                taken[more] = 1
            column += width

    def mark(self, row: int, column: int, sign: str, style: str) -> None:
        """Write a sign that others may be written over."""
        self._signs[row][column] = (sign, style)

    def lines(self) -> list[Line]:
        """Return the rows."""
        return [self._line(row) for row in range(self.rows)]

    def _line(self, row: int) -> Line:
        dots, styles, signs = self._dots[row], self._styles[row], self._signs[row]
        pieces: list[tuple[str, str]] = []
        now: list[str] = []
        style_now = ""
        for column in range(self.columns):
            if column in signs:
                character, style = signs[column]
            elif dots[column]:
                character, style = _BRAILLE[dots[column]], styles[column]
            else:
                character, style = " ", ""
            if style != style_now:
                if now:
                    pieces.append(("".join(now), style_now))
                    now = []
                style_now = style
            now.append(character)
        pieces.append(("".join(now), style_now))
        return Line(tuple(pieces))


LEAST_M = 4.0
"""Metres that the shorter side shows at least: a robot alone is not blown up."""
MOST_BOXES = 400
MOST_M = 1e7
"""A position further off than this is a fault of its sender, and would shrink the others to a dot."""
MOST_NAMES = 100
"""Robots, or cells with several, that are named where there is room."""
ARROWS_EVERY = 4
"""Cells from one arrow of an aisle to the next."""
TOO_WIDE = 2.0
"""So much wider than needed a view may be before it is fitted again."""
_ARROWS = "↑↗→↘↓↙←↖"
_LABEL = 14


class Spot(Struct, frozen=True, kw_only=True):
    """Something with a name at a place: a robot, or a place of the site."""

    name: str
    x: float
    y: float
    online: bool = True
    heading_deg: float | None = None
    trail: tuple[tuple[float, float], ...] = ()


class Area(Struct, frozen=True, kw_only=True):
    """An axis-aligned rectangle on the ground, metres."""

    x: tuple[float, float]
    y: tuple[float, float]
    forbidden: bool = False
    one_way: str = ""
    """Of an aisle: `north`, `east`, `south` or `west`."""


def areas_of(site: Site) -> list[Area]:
    """Return a site's obstacles, forbidden areas and one-way aisles."""
    return [
        *(Area(x=each.x, y=each.y) for each in site.obstacles),
        *(Area(x=each.x, y=each.y, forbidden=True) for each in site.forbidden),
        *(Area(x=each.x, y=each.y, one_way=each.one_way) for each in site.aisles),
    ]


class View(Struct, frozen=True, kw_only=True):
    """What part of the ground is shown in so many cells: the lower left corner and metres a dot."""

    left: float
    bottom: float
    metres: float
    columns: int
    rows: int

    def dot(self, x: float, y: float) -> tuple[int, int]:
        """Return the column and the row from below of a position's dot."""
        return math.floor((x - self.left) / self.metres), math.floor((y - self.bottom) / self.metres)

    def shows(self, x: float, y: float) -> bool:
        """Whether a position falls within it."""
        column, up = self.dot(x, y)
        return 0 <= column < self.columns * 2 and 0 <= up < self.rows * 4


def _real(x: float, y: float) -> bool:
    # What is no number is in no range.
    return -MOST_M < x < MOST_M and -MOST_M < y < MOST_M


def view_of(points: Sequence[tuple[float, float]], columns: int, rows: int, before: View | None = None) -> View:
    """Return the view that shows all points within so many cells, with a margin.

    The view before stays as long as it shows all of them and is not far too wide: a map whose scale changes with every
    step of the outermost robot cannot be read, and would have to be drawn as a whole each time.
    """
    columns, rows = max(1, columns), max(1, rows)
    points = [each for each in points if _real(*each)] or [(0.0, 0.0)]
    low_x, high_x = min(x for x, _ in points), max(x for x, _ in points)
    low_y, high_y = min(y for _, y in points), max(y for _, y in points)
    dots_x, dots_y = max(2, columns * 2), max(4, rows * 4)
    # A cell of margin at each side, so that a sign at the edge is whole.
    room_x, room_y = max(1, dots_x - 4), max(1, dots_y - 8)
    metres = max((high_x - low_x) / room_x, (high_y - low_y) / room_y, LEAST_M / max(1, min(room_x, room_y)))
    if (
        before is not None
        and (before.columns, before.rows) == (columns, rows)
        and before.metres <= TOO_WIDE * metres
        and before.shows(low_x, low_y)
        and before.shows(high_x, high_y)
    ):
        return before
    return View(
        left=(low_x + high_x) / 2 - metres * dots_x / 2,
        bottom=(low_y + high_y) / 2 - metres * dots_y / 2,
        metres=metres,
        columns=columns,
        rows=rows,
    )


def view_for(
    robots: Iterable[Spot],
    columns: int,
    rows: int,
    *,
    places: Mapping[str, tuple[float, float]] | None = None,
    areas: Sequence[Area] = (),
    before: View | None = None,
) -> View:
    """Return the view that shows robots, places and areas on a map of `rows` lines, the scale among them."""
    points = [(each.x, each.y) for each in robots]
    points += (places or {}).values()
    points += [(x, y) for box in areas[:MOST_BOXES] if _real(*box.x) and _real(*box.y) for x in box.x for y in box.y]
    return view_of(points, columns, max(2, rows) - 1, before)


def scale_of(metres: float, cells: int) -> tuple[float, int]:
    """Return a round length (1, 2 or 5 times a power of ten metres) and its cells, at most a third of `cells`."""
    most = max(2.0, cells / 3) * 2 * metres
    power = 10.0 ** math.floor(math.log10(most))
    length = max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= most * (1 + 1e-9))
    return length, max(1, round(length / metres / 2))


def draw(
    robots: Iterable[Spot],
    columns: int,
    rows: int,
    *,
    places: Mapping[str, tuple[float, float]] | None = None,
    areas: Sequence[Area] = (),
    selected: str = "",
    view: View | None = None,
) -> list[Line]:
    """Return the map as `rows` lines of `columns` cells; the last line is its scale.

    Args:
        robots: those with a position; one that is no number or beyond all bounds is left out.
        columns: cells of a line.
        rows: lines, the scale among them.
        places: named places of the site.
        areas: obstacles, forbidden areas and one-way aisles.
        selected: the robot that is marked.
        view: what is shown, for a map of this size; without it all there is.
    """
    columns, rows = max(1, columns), max(2, rows)
    shown = [each for each in robots if _real(each.x, each.y)]
    known = {name: at for name, at in (places or {}).items() if _real(*at)}
    boxes = [each for each in areas[:MOST_BOXES] if _real(*each.x) and _real(*each.y)]
    if view is None or (view.columns, view.rows) != (columns, rows - 1):
        view = view_for(shown, columns, rows, places=known, areas=boxes)
    canvas = Canvas(columns, rows - 1)
    for box in boxes:
        if box.one_way:
            _arrows(canvas, view, box)
        else:
            _outline(canvas, view, box)
    for each in shown:
        for x, y in each.trail:
            if _real(x, y):
                canvas.dot(*view.dot(x, y), "dim")
    _robots(canvas, view, shown, selected)
    _places(canvas, view, known)
    return [*canvas.lines(), _scale(view, columns, len(shown))]


def _outline(canvas: Canvas, view: View, box: Area) -> None:
    style = "red" if box.forbidden else "dim"
    (left, bottom), (right, top) = view.dot(min(box.x), min(box.y)), view.dot(max(box.x), max(box.y))
    # Forbidden areas are dotted, so that they differ from obstacles without colour.
    step = 2 if box.forbidden else 1
    for column in range(left, right + 1, step):
        canvas.dot(column, bottom, style)
        canvas.dot(column, top, style)
    for row in range(bottom, top + 1, step):
        canvas.dot(left, row, style)
        canvas.dot(right, row, style)


def _arrows(canvas: Canvas, view: View, aisle: Area) -> None:
    """Draw an aisle as arrows along its middle; what is written later goes over them."""
    (x0, x1), (y0, y1) = aisle.x, aisle.y
    across = aisle.one_way in ("east", "west")
    sign = {"north": "↑", "east": "→", "south": "↓", "west": "←"}[aisle.one_way]
    apart = ARROWS_EVERY * view.metres * (2 if across else 4)
    count = max(1, round((x1 - x0 if across else y1 - y0) / apart))
    for number in range(min(count, canvas.columns + canvas.rows)):
        share = (number + 0.5) / count
        x, y = (x0 + share * (x1 - x0), (y0 + y1) / 2) if across else ((x0 + x1) / 2, y0 + share * (y1 - y0))
        cell = canvas.cell(*view.dot(x, y))
        if cell is not None:
            canvas.mark(*cell, sign, "dim")


def _robots(canvas: Canvas, view: View, robots: Sequence[Spot], selected: str) -> None:
    clusters: dict[tuple[int, int], list[Spot]] = defaultdict(list)
    for each in robots:
        cell = canvas.cell(*view.dot(each.x, each.y))
        if cell is not None:
            clusters[cell].append(each)
    for (row, column), members in clusters.items():
        marked = any(each.name == selected for each in members)
        style = _style(members, marked=marked)
        if len(members) == 1:
            canvas.write(row, column, _sign(members[0]), style)
        else:
            number = str(len(members)) if len(members) < 100 else "99+"
            at = min(column, canvas.columns - len(number))
            if canvas.free(row, at, len(number)):
                canvas.write(row, at, number, style)
            else:
                canvas.write(row, column, "+", style)
    # Names after all signs: a name must not cover a robot. The selected one has the first choice of room.
    order = sorted(clusters)
    order.sort(key=lambda cell: selected not in _names(clusters[cell]))
    for row, column in order[:MOST_NAMES]:
        _label(canvas, row, column, clusters[row, column], selected)


def _names(members: Sequence[Spot]) -> list[str]:
    return [each.name for each in members]


def _style(members: Sequence[Spot], *, marked: bool) -> str:
    online = any(each.online for each in members)
    style = "bold green" if online else "red"
    return f"{style} reverse" if marked else style


def _sign(robot: Spot) -> str:
    if not robot.online:
        return "✘"
    if robot.heading_deg is None or not math.isfinite(robot.heading_deg):
        return "●"
    return _ARROWS[round(robot.heading_deg / 45) % 8]


def _label(canvas: Canvas, row: int, column: int, members: Sequence[Spot], selected: str) -> None:
    names = _names(members)
    first = selected if selected in names else names[0]
    more = f" +{len(names) - 1}" if len(names) > 1 else ""
    label = f"{safe(first, _LABEL)}{more}"
    width = cell_len(label)
    own = len(str(len(members))) if len(members) > 1 else 1
    for at_row, at in ((row, column + own), (row, column - width), (row + 1, column), (row - 1, column)):
        if canvas.free(at_row, at, width):
            canvas.write(at_row, at, label, "bold" if selected in names else "")
            return


def _places(canvas: Canvas, view: View, places: Mapping[str, tuple[float, float]]) -> None:
    for name, at in sorted(places.items()):
        cell = canvas.cell(*view.dot(*at))
        if cell is None:
            continue
        row, column = cell
        if canvas.free(row, column, 1):
            canvas.write(row, column, "+", "cyan")
        label = safe(name, _LABEL)
        if canvas.free(row, column + 1, cell_len(label) + 1):
            canvas.write(row, column + 1, label, "cyan")


def _scale(view: View, columns: int, robots: int) -> Line:
    length, cells = scale_of(view.metres, columns)
    told = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
    line = f"├{'─' * max(0, cells - 2)}┤ {told}  N↑"
    if not robots:
        line += "  no robot tells its position"
    return Line(((line[:columns].ljust(columns), "dim"),))
