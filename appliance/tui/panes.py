"""The four panes of the terminal UI. Each draws a snapshot, and only what has changed since the last one."""

from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import BindingType
from textual.containers import Vertical, VerticalScroll
from textual.widgets import DataTable, RichLog, Static

from appliance.tui import drawing
from appliance.tui.board import Snapshot
from appliance.tui.drawing import Row, Rows


class DiffTable(DataTable[Text]):
    """A table that is shown rows by key and touches only the cells that differ."""

    BINDINGS: ClassVar[list[BindingType]] = []

    def __init__(self, columns: tuple[str, ...], *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id, cursor_type="row", zebra_stripes=False)
        self._titles = columns
        self._shown: Rows = {}
        self.cells_written = 0
        """Cells written since the start: tests see by it that unchanged rows cost nothing."""
        for title in columns:
            self.add_column(title, key=title)

    def show(self, rows: Rows) -> None:
        """Make the table show `rows`, in that order; the cursor stays on its row as long as that is there."""
        if rows.keys() == self._shown.keys() and list(rows) == list(self._shown):
            for key, row in rows.items():
                if row != self._shown[key]:
                    self._write(key, row)
        else:
            self._arrange(rows)
        self._shown = dict(rows)

    @property
    def selected(self) -> str | None:
        """Key of the row under the cursor."""
        keys = list(self._shown)
        return keys[self.cursor_row] if 0 <= self.cursor_row < len(keys) else None

    def select(self, key: str) -> None:
        """Put the cursor on a row, if it is there."""
        if key in self._shown:
            self.move_cursor(row=list(self._shown).index(key))

    def _write(self, key: str, row: Row) -> None:
        for title, cell, old in zip(self._titles, row, self._shown[key], strict=True):
            if cell != old:
                self.cells_written += 1
                self.update_cell(key, title, cell, update_width=True)

    def _arrange(self, rows: Rows) -> None:
        """Rows came, went or changed places: write the table anew (rare), or append when that is all."""
        old = list(self._shown)
        new = list(rows)
        if new[: len(old)] == old:
            for key in old:
                self._write(key, rows[key])
            fresh, selected = new[len(old) :], None
        else:
            selected = self.selected
            self.clear()
            fresh = new
        for key in fresh:
            self.cells_written += len(self._titles)
            self.add_row(*rows[key], key=key)
        if selected in rows:
            self.move_cursor(row=new.index(selected))


class Pane(Vertical):
    """A pane: draws snapshots, filtered."""

    shown_filter = ""

    def draw(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        raise NotImplementedError

    def filtered(self, rows: Rows) -> Rows:
        """Return the rows that contain the filter's text."""
        return {key: row for key, row in rows.items() if drawing.contains((*row, Text(key)), self.shown_filter)}


class FleetPane(Pane):
    """Gateways, robots, and what is wrong with gateways in whole sentences."""

    def compose(self) -> ComposeResult:
        """Make the pane's parts."""
        yield DiffTable(drawing.GATEWAYS, id="gateways")
        yield Static(id="notes")
        yield DiffTable(drawing.ROBOTS, id="robots")

    def draw(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        self.query_one("#gateways", DiffTable).show(self.filtered(drawing.gateway_rows(snapshot)))
        self.query_one("#robots", DiffTable).show(self.filtered(drawing.robot_rows(snapshot)))
        parts = (drawing.gateway_notes(snapshot.gateways), drawing.recorder_notes(snapshot.recorders))
        notes = Text("\n").join(part for part in parts if part)
        shown = self.query_one("#notes", Static)
        shown.display = bool(notes)
        shown.update(notes)


class TasksPane(Pane):
    """Tasks, and the selected one with its plan as a graph."""

    def __init__(self, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self._snapshot: Snapshot | None = None
        self._drawn: Text | None = None
        self._wanted = ""

    def compose(self) -> ComposeResult:
        """Make the pane's parts."""
        yield DiffTable(drawing.TASKS, id="tasks")
        with VerticalScroll(id="detail-box"):
            yield Static(id="detail")

    def draw(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        self._snapshot = snapshot
        table = self.query_one("#tasks", DiffTable)
        table.show(self.filtered(drawing.task_rows(snapshot)))
        if self._wanted and snapshot.task(self._wanted) is not None:
            table.select(self._wanted)
            self._wanted = ""
        self._draw_detail()

    @property
    def selected(self) -> str | None:
        """Id of the selected task."""
        return self.query_one("#tasks", DiffTable).selected

    def select(self, task_id: str) -> None:
        """Select a task as soon as it is shown."""
        self._wanted = task_id

    def on_data_table_row_highlighted(self) -> None:
        """Another task was selected."""
        self._draw_detail()

    def _draw_detail(self) -> None:
        selected = self.selected
        record = self._snapshot.task(selected) if self._snapshot is not None and selected is not None else None
        if record is None:
            text = Text("no tasks yet: s submits one" if not self.shown_filter else "no task matches the filter", "dim")
        else:
            text = drawing.task_text(record)
        if text != self._drawn:
            self._drawn = text
            self.query_one("#detail", Static).update(text)


class PoolPane(Pane):
    """Containers of all gateways."""

    def compose(self) -> ComposeResult:
        """Make the pane's parts."""
        yield DiffTable(drawing.CONTAINERS, id="containers")

    def draw(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        self.query_one("#containers", DiffTable).show(self.filtered(drawing.container_rows(snapshot)))


class LogPane(Pane):
    """Notices, run events and log lines as they come."""

    def __init__(self, *, id: str, most: int) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self._most = most
        self._last = 0
        self._filter = ""

    def compose(self) -> ComposeResult:
        """Make the pane's parts."""
        yield RichLog(id="lines", max_lines=self._most, wrap=True, min_width=20)

    def draw(self, snapshot: Snapshot) -> None:
        """Add the lines that are new; all of them when the filter has changed."""
        lines = self.query_one("#lines", RichLog)
        if self._filter != self.shown_filter:
            self._filter = self.shown_filter
            self._last = 0
            lines.clear()
        for entry in snapshot.entries:
            if entry.serial > self._last:
                line = drawing.entry_line(entry)
                if drawing.contains((line,), self._filter):
                    lines.write(line)
        if snapshot.entries:
            self._last = snapshot.entries[-1].serial
