"""The map of positions as a widget: fits its window, remembers where robots came from, asks for the site once."""

from collections.abc import Iterable

from rich.segment import Segment
from rich.style import Style
from textual import work
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from appliance.errors import SwiftbotError
from appliance.model import Site
from appliance.tui.data import View
from appliance.tui.robots.canvas import Line
from appliance.tui.robots.facts import Robot, areas, places, spots
from appliance.tui.robots.map import View as MapView
from appliance.tui.robots.map import draw, view_for
from appliance.tui.robots.trails import Trails


class Ground(Widget):
    """The map; only lines that have changed are painted."""

    def __init__(self, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self.trails = Trails()
        self._site: Site | None = None
        self._robots: tuple[Robot, ...] = ()
        self._selected = ""
        self._of: View | None = None
        self._asked = False
        self._view: MapView | None = None
        self._lines: list[Line] = []
        self.drawn = 0
        """Lines that have changed since the start: tests see by it that what stands still costs nothing."""

    def show(self, robots: Iterable[Robot], *, selected: str, view: View) -> None:
        """Show robots where they are."""
        if view is not self._of:
            # Another fleet, or a recorded log: nobody of it came from there.
            self._of, self.trails = view, Trails()
        self._robots, self._selected = tuple(robots), selected
        self.trails.note(each.info for each in self._robots)
        if not self._asked and view.steerable:
            self._asked = True
            self._ask(view)
        self._draw()

    def mark(self, selected: str) -> None:
        """Mark another robot, all else being as it was."""
        if selected != self._selected:
            self._selected = selected
            self._draw()

    @work(exclusive=True, group="site")
    async def _ask(self, view: View) -> None:
        try:
            self._site = await view.orders.site()
        except SwiftbotError:
            self._asked = False  # asked again with the next drawing: the map is of use without it
            return
        self._draw()

    def on_resize(self) -> None:
        """Fit the window."""
        self._draw()

    def _draw(self) -> None:
        columns, rows = self.size.width, self.size.height
        if columns < 4 or rows < 3:
            return
        shown = spots(self._robots, self.trails, selected=self._selected)
        known, boxes = places(self._site), areas(self._site)
        self._view = view_for(shown, columns, rows, places=known, areas=boxes, before=self._view)
        lines = draw(shown, columns, rows, places=known, areas=boxes, selected=self._selected, view=self._view)
        before, self._lines = self._lines, lines
        if len(lines) != len(before):
            self.refresh()
            return
        changed = [row for row, (old, new) in enumerate(zip(before, lines, strict=True)) if old != new]
        self.drawn += len(changed)
        if changed:
            self.refresh(*(Region(0, row, columns, 1) for row in changed))

    def render_line(self, y: int) -> Strip:
        """Draw one line of the window."""
        width, style = self.size.width, self.rich_style
        if y >= len(self._lines):
            return Strip.blank(width, style)
        line = Strip([Segment(text, Style.parse(how) if how else None) for text, how in self._lines[y].pieces])
        return line.adjust_cell_length(width, style).apply_style(style)
