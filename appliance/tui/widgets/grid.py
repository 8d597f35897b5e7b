"""A table that draws only the lines that are seen: rows by key, fixed columns, a cursor.

It exists beside Textual's DataTable because that one keeps every cell, measures and repaints all of them at a change of
one (32 to 76 ms for 500 rows of 8). Here a row is whatever thing it stands for; its cells are made when it is seen, and
again when the thing is another. What a flush costs is a matter of the window's height, not of the fleet's size.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

from msgspec import Struct
from rich.cells import cell_len, set_cell_size
from rich.segment import Segment
from rich.style import Style
from textual import events
from textual.geometry import Region, Size
from textual.message import Message
from textual.scroll_view import ScrollView
from textual.strip import Strip

from appliance.tui.formatting import Cell
from appliance.tui.part_keys import GRID, part_bindings
from appliance.tui.safe import clip

Draw = Callable[[Any], Sequence[Cell]]

_GUTTER = 2
"""Cells on the left for the cursor's sign, so that the cursor is shown by more than colour."""
_MUCH = 8
"""Cells left over, of which one is spared."""
_KEPT = 400
"""Lines kept as they were drawn."""


class Column(Struct, frozen=True, kw_only=True):
    """A column: `width` cells, more if it may `grow`; left out first where the window is narrow if `drop` is high."""

    title: str
    width: int
    grow: bool = False
    right: bool = False
    drop: int = 0
    """0: never left out."""


class Grid(ScrollView, can_focus=True, inherit_bindings=False):
    """A table of rows by key.

    Args:
        columns: fixed for good; several may grow and share what is left.
        draw: makes the cells of a row from its thing; texts must be clean (`safe`).
        id: of the widget.
        empty: what is shown while there is no row.
    """

    COMPONENT_CLASSES: ClassVar[set[str]] = {"grid--head", "grid--cursor"}
    BINDINGS = part_bindings(GRID)

    class About(Message):
        """Something about a row."""

        def __init__(self, grid: "Grid", key: str) -> None:
            super().__init__()
            self.grid = grid
            self.key = key

        @property
        def control(self) -> "Grid":
            """The grid it is about."""
            return self.grid

    class Moved(About):
        """The cursor is on another row."""

    class Picked(About):
        """A row was picked, by Enter or a second click."""

    def __init__(self, columns: Sequence[Column], draw: Draw, *, id: str, empty: str = "nothing") -> None:  # noqa: A002
        super().__init__(id=id)
        self._columns = tuple(columns)
        self._draw = draw
        self._empty = empty
        self._keys: list[str] = []
        self._rows: Mapping[str, Any] = {}
        self._cursor = 0
        self._kept: dict[str, tuple[Any, tuple[int, ...], Strip]] = {}
        self._widths: tuple[int, ...] = ()
        self.drawn = 0
        """Lines drawn since the start: tests see by it that what is unchanged costs nothing."""

    # --- rows ----------------------------------------------------------------------------------------------------

    @property
    def keys(self) -> Sequence[str]:
        """Keys of the rows, in order."""
        return self._keys

    @property
    def selected(self) -> str | None:
        """Key of the row under the cursor."""
        return self._keys[self._cursor] if self._cursor < len(self._keys) else None

    @property
    def thing(self) -> Any:
        """What the row under the cursor stands for; None when there is none."""
        return self._rows.get(self.selected or "")

    def show(self, rows: Mapping[str, Any], *, empty: str | None = None) -> None:
        """Show rows in this order; the cursor stays on its row as long as that is there.

        Args:
            rows: what the rows stand for, by key.
            empty: what is shown when there are none.
        """
        if empty is not None and empty != self._empty:
            self._empty = empty
            self.refresh()
        keys, before = list(rows), self._keys
        old = self._rows
        # A view of a mapping that goes on changing would hide what has changed since.
        self._rows = dict(rows)
        if keys != before:
            selected = self.selected
            self._keys = keys
            if selected is not None and selected in rows:
                self._cursor = keys.index(selected)
            else:
                self._cursor = max(0, min(self._cursor, len(keys) - 1))
            if len(keys) != len(before):
                self.virtual_size = Size(self.size.width, len(keys) + 1)
            self._follow()
            self.refresh()
            if self.selected != selected:
                self._tell()
            return
        top = round(self.scroll_offset.y)
        shown = range(top, min(len(keys), top + self.size.height))
        self._refresh_rows(index for index in shown if old.get(keys[index]) is not self._rows[keys[index]])

    def select(self, key: str) -> bool:
        """Put the cursor on a row; whether it is there."""
        if key not in self._rows:
            return False
        self._move(self._keys.index(key))
        return True

    def redraw(self) -> None:
        """Draw all again, as when something else that cells depend on has changed."""
        self._kept.clear()
        self.refresh()

    # --- cursor --------------------------------------------------------------------------------------------------

    def action_cursor(self, step: int) -> None:
        """Move by rows."""
        self._move(self._cursor + step)

    def action_page(self, step: int) -> None:
        """Move by windows."""
        self._move(self._cursor + step * max(1, self.size.height - 2))

    def action_edge(self, end: int) -> None:
        """Move to the first or the last row."""
        self._move(len(self._keys) - 1 if end else 0)

    def action_pick(self) -> None:
        """Pick the row under the cursor."""
        if self.selected is not None:
            self.post_message(self.Picked(self, self.selected))

    def _move(self, index: int) -> None:
        index = max(0, min(index, len(self._keys) - 1))
        if index == self._cursor or not self._keys:
            return
        before, self._cursor = self._cursor, index
        self._refresh_rows((before, index))
        self._follow()
        self._tell()

    def _tell(self) -> None:
        if self.selected is not None:
            self.post_message(self.Moved(self, self.selected))

    def _follow(self) -> None:
        """Scroll so that the cursor is seen."""
        height = max(1, self.size.height - 1)
        top = round(self.scroll_offset.y)
        if self._cursor < top:
            self.scroll_to(y=self._cursor, animate=False, immediate=True)
        elif self._cursor >= top + height:
            self.scroll_to(y=self._cursor - height + 1, animate=False, immediate=True)

    async def _on_click(self, event: events.Click) -> None:
        index = round(self.scroll_offset.y) + event.y - 1
        if event.y > 0 and index < len(self._keys):
            again = index == self._cursor and event.chain > 1
            self._move(index)
            if again:
                self.action_pick()

    # --- drawing -------------------------------------------------------------------------------------------------

    def _refresh_rows(self, indices: Iterable[int]) -> None:
        """Have rows painted that are seen, all at once: each call of its own empties the widget's caches."""
        width, height = self.size
        above = 1 - round(self.scroll_offset.y)
        regions = [Region(0, index + above, width, 1) for index in indices if 0 < index + above < height]
        if regions:
            self.refresh(*regions)

    def on_resize(self) -> None:
        """Fit the columns to the window."""
        self._widths = widths(self._columns, self.size.width - _GUTTER)
        self.virtual_size = Size(self.size.width, len(self._keys) + 1)
        self._follow()

    def notify_style_update(self) -> None:
        """Colours have changed: forget what was drawn."""
        self._kept.clear()
        super().notify_style_update()

    def render_line(self, y: int) -> Strip:
        """Draw one line of the window."""
        width, style = self.size.width, self.rich_style
        if not self._widths:
            self._widths = widths(self._columns, width - _GUTTER)
        if y == 0:
            head = self.get_component_rich_style("grid--head")
            titles = [(column.title, "") for column in self._columns]
            return (
                Strip([Segment(" " * _GUTTER), *self._segments(titles)])
                .apply_style(style + head)
                .adjust_cell_length(width, style)
            )
        index = round(self.scroll_offset.y) + y - 1
        if index >= len(self._keys):
            if y == 1 and not self._keys:
                empty = clip(self._empty, width - _GUTTER)
                return (
                    Strip([Segment(" " * _GUTTER + empty, Style(dim=True))])
                    .apply_style(style)
                    .adjust_cell_length(width, style)
                )
            return Strip.blank(width, style)
        key = self._keys[index]
        strip = self._row(key)
        if index == self._cursor:
            cursor = self.get_component_rich_style("grid--cursor")
            return Strip([Segment("› "), *strip]).adjust_cell_length(width).apply_style(style + cursor)
        return Strip([Segment("  "), *strip]).adjust_cell_length(width).apply_style(style)

    def _row(self, key: str) -> Strip:
        thing = self._rows[key]
        kept = self._kept.get(key)
        if kept is not None and kept[0] is thing and kept[1] == self._widths:
            return kept[2]
        self.drawn += 1
        strip = Strip(self._segments(self._draw(thing)))
        if len(self._kept) > _KEPT:
            self._kept.clear()
        self._kept[key] = (thing, self._widths, strip)
        return strip

    def _segments(self, cells: Sequence[Cell]) -> list[Segment]:
        found: list[Segment] = []
        for column, width, cell in zip(self._columns, self._widths, cells, strict=False):
            if not width:
                continue
            text, style = (cell, "") if isinstance(cell, str) else cell
            found.append(Segment(fit(text, width, right=column.right), Style.parse(style) if style else None))
            found.append(Segment(" "))
        return found[:-1]


def fit(text: str, width: int, *, right: bool = False) -> str:
    """Return a text in exactly `width` terminal cells: cut with an ellipsis, or filled with blanks."""
    if text.isascii():
        if len(text) > width:
            return f"{text[: width - 1]}…"
        return text.rjust(width) if right else text.ljust(width)
    text = clip(text, width)
    return " " * (width - cell_len(text)) + text if right else set_cell_size(text, width)


def widths(columns: Sequence[Column], room: int) -> tuple[int, ...]:
    """Return how wide each column is, 0 for one that is left out: first those with the highest `drop`, then the last.

    What is left over goes to those that may grow, evenly; of much one cell stays free, so that none touches the edge.
    """
    shown = [True] * len(columns)

    def needed() -> int:
        return sum(column.width + 1 for column, here in zip(columns, shown, strict=True) if here) - 1

    for index in sorted(range(len(columns)), key=lambda each: (-columns[each].drop, -each)):
        if needed() <= room:
            break
        shown[index] = index == 0
    found = [column.width if here else 0 for column, here in zip(columns, shown, strict=True)]
    growing = [index for index, column in enumerate(columns) if shown[index] and column.grow]
    left = room - needed()
    if left < 0:
        found[0] = max(1, room)
    left -= left > _MUCH
    for number, index in enumerate(growing):
        if left > 0:
            found[index] += left // len(growing) + (number < left % len(growing))
    return tuple(found)
