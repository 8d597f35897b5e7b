"""The last lines of what is heard, and the widget that shows them: only those in the window are drawn.

The filter comes before the tail is cut, so a rare line stays on screen however many others come after it: what is shown
are the last so many matching lines, and not the matching ones among the last so many. While nothing is filtered both
are the same. The view stays where it is while others come. It exists beside Textual's RichLog because that draws every
line that comes, seen or not, and cuts, then filters.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar, cast

from rich.cells import cell_len
from rich.console import Console
from rich.segment import Segment
from rich.text import Text
from textual.app import App
from textual.geometry import Size
from textual.scroll_view import ScrollView
from textual.strip import Strip

from appliance.tui.command_line import Filter
from appliance.tui.part_keys import LINES, part_bindings

T = TypeVar("T")


class Tail(Generic[T]):
    """The tail of one stream.

    Args:
        most: lines kept, and as many that match while there is a filter.
        plain: makes the text that a filter sees of a line.
    """

    def __init__(self, most: int, plain: Callable[[T], str]) -> None:
        self.most = most
        self.count = 0
        """Lines put so far."""
        self.revision = 0
        """Rises when other lines are to be shown."""
        self._plain = plain
        self._all: deque[T] = deque(maxlen=most)
        self._matching: deque[T] | None = None
        self._filter = Filter()

    @property
    def filter(self) -> Filter:
        """The filter in force."""
        return self._filter

    def set_filter(self, wanted: Filter) -> None:
        """Show only lines that match, those that are kept at once."""
        if wanted == self._filter:
            return
        self._filter = wanted
        self._matching = None
        if wanted:
            self._matching = deque((each for each in self._all if self._fits(each)), maxlen=self.most)
        self.revision += 1

    def put(self, line: T) -> None:
        """Take a line."""
        self.count += 1
        self._all.append(line)
        if self._matching is None:
            self.revision += 1
        elif self._fits(line):
            self._matching.append(line)
            self.revision += 1

    def clear(self) -> None:
        """Forget all lines; what is put from now on is shown."""
        self._all.clear()
        if self._matching is not None:
            self._matching.clear()
        self.revision += 1

    @property
    def lines(self) -> Sequence[T]:
        """What is shown, oldest first."""
        return self._all if self._matching is None else self._matching

    def _fits(self, line: T) -> bool:
        return self._filter.matches(self._plain(line))


WIDEST = 600
"""Cells that a line may be scrolled sideways."""
SIDEWAYS = 20
"""Cells that it is by one key."""


class LineView(ScrollView, Generic[T], can_focus=True, inherit_bindings=False):
    """A window on lines.

    Args:
        text: draws a line; it must be one line and clean (`safe`).
        number: counts the lines, rising, so that the window stays with its line.
        id: of the widget.
        empty: what is shown while there are none.
    """

    BINDINGS = part_bindings(LINES)
    # No bar below: it would take a line of few, and what is cut is marked where it is.

    def __init__(
        self,
        text: Callable[[T], Text],
        number: Callable[[T], int],
        *,
        id: str,  # noqa: A002 - Textual's name
        empty: str = "nothing was heard yet",
    ) -> None:
        super().__init__(id=id)
        self.following = True
        """Whether the window stays at the newest line."""
        self.drawn = 0
        """Lines drawn since the start: tests see by it that what is not seen costs nothing."""
        self._text = text
        self._number = number
        self._empty = empty
        self._lines: Sequence[T] = ()

    def show(self, lines: Sequence[T], *, empty: str | None = None) -> None:
        """Show lines, oldest first."""
        if empty is not None:
            self._empty = empty
        top = round(self.scroll_offset.y)
        anchor = self._number(self._lines[top]) if not self.following and top < len(self._lines) else None
        self._lines = list(lines)
        self.virtual_size = Size(WIDEST, len(self._lines))
        if self.following:
            self.scroll_end(animate=False, immediate=True, x_axis=False)
        elif anchor is not None:
            self.scroll_to(y=self._index_of(anchor), animate=False, immediate=True)
        self.refresh()

    def on_resize(self) -> None:
        """Stay at the newest line: before the first layout there was no height to scroll by."""
        if self.following:
            self.scroll_end(animate=False, immediate=True, x_axis=False)

    def _index_of(self, number: int) -> int:
        """Return where the line of that number is, or the first after it."""
        low, high = 0, len(self._lines)
        while low < high:
            middle = (low + high) // 2
            if self._number(self._lines[middle]) < number:
                low = middle + 1
            else:
                high = middle
        return low

    # --- keys ----------------------------------------------------------------------------------------------------

    def follow(self, *, on: bool) -> None:
        """Go to the newest line and stay there, or stay here."""
        self.following = on
        if on:
            self.scroll_end(animate=False, immediate=True, x_axis=False)

    def action_move(self, step: int) -> None:
        """Scroll by a line."""
        self._go(round(self.scroll_offset.y) + step)

    def action_page(self, step: int) -> None:
        """Scroll by a window."""
        self._go(round(self.scroll_offset.y) + step * max(1, self.size.height - 1))

    def action_sideways(self, step: int) -> None:
        """Scroll to the side."""
        self.scroll_to(x=max(0, round(self.scroll_offset.x) + step * SIDEWAYS), animate=False, immediate=True)

    def action_first(self) -> None:
        """Go to the oldest line."""
        self._go(0)

    def action_last(self) -> None:
        """Go to the newest line and stay there."""
        self.follow(on=True)

    def _go(self, top: int) -> None:
        last = max(0, len(self._lines) - self.size.height)
        # At the end it follows again, as pagers do.
        self.following = top >= last
        self.scroll_to(y=max(0, min(top, last)), animate=False, immediate=True)

    def on_mouse_scroll_up(self) -> None:
        """A wheel that goes back ends following; Textual's own handler scrolls."""
        self.following = False

    def on_mouse_scroll_down(self) -> None:
        """At the end it follows again."""
        self.following = round(self.scroll_offset.y) + 1 >= max(0, len(self._lines) - self.size.height)

    def _renderer(self) -> Console:
        """Return what Rich renders on."""
        return cast("App[object]", self.app).console  # pyright: ignore[reportUnknownMemberType]

    # --- drawing -------------------------------------------------------------------------------------------------

    def render_line(self, y: int) -> Strip:
        """Draw a line of the window."""
        width, style = self.size.width, self.rich_style
        index = round(self.scroll_offset.y) + y
        if index >= len(self._lines):
            if not self._lines and not y:
                return Strip(Text(self._empty, "dim").render(self._renderer())).adjust_cell_length(width, style)
            return Strip.blank(width, style)
        self.drawn += 1
        line = self._text(self._lines[index])
        left, long = round(self.scroll_offset.x), cell_len(line.plain)
        strip = Strip([each for each in line.render(self._renderer()) if each.text], long)
        before, after = int(left > 0 and long > 0), int(long > left + width)
        shown = strip.crop(left + before, left + width - after)
        if before or after:
            mark = Strip([Segment("…")], 1)
            shown = Strip.join([*[mark] * before, shown.adjust_cell_length(width - before - after), *[mark] * after])
        return shown.adjust_cell_length(width, style).apply_style(style)
