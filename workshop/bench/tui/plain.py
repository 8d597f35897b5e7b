"""The alternative that is measured beside: one DataTable of the tasks, all of whose cells are set at each tick.

It hears the same and is drawn as often; it is what Textual's own examples of live tables do.
"""

from rich.text import Text
from textual.app import ComposeResult
from textual.widgets import DataTable

from appliance.model import TaskRecord
from appliance.tui import status_styles
from appliance.tui.app import SCREENS, SwiftbotApp
from appliance.tui.base_screen import FleetScreen
from appliance.tui.safe import safe
from appliance.tui.store import Store

TITLES = ("task", "state", "first step", "instruction")


def _cells(record: TaskRecord) -> tuple[Text, ...]:
    sign = status_styles.task(record.state)
    first = record.subtasks[0] if record.subtasks else None
    step = f"{first.progress:.0%} {safe(first.note, 40)}" if first is not None else ""
    return Text(safe(record.id, 63), "bold"), Text(sign.text, sign.style), Text(step), Text(safe(record.instruction))


class PlainScreen(FleetScreen):
    """All tasks in a DataTable."""

    scope = "fleet"
    shows = ("tasks",)

    def __init__(self) -> None:
        super().__init__()
        self.table: DataTable[Text] = DataTable(id="plain", cursor_type="row")

    def body(self) -> ComposeResult:
        """Make the table."""
        yield self.table

    def draw_body(self, store: Store) -> None:
        """Set every cell of every task; widths follow the contents, as they do unless one says otherwise."""
        table = self.table
        if not table.columns:
            for title in TITLES:
                table.add_column(title, key=title)
        for name in store.newest:
            cells = _cells(store.tasks[name])
            if name in table.rows:
                for title, cell in zip(TITLES, cells, strict=True):
                    table.update_cell(name, title, cell, update_width=True)
            else:
                table.add_row(*cells, key=name)


class PlainApp(SwiftbotApp):
    """The terminal UI with that table on its first screen."""

    MODES = SCREENS | {"fleet": PlainScreen}  # pyright: ignore[reportAssignmentType] - as in the class above

    @property
    def cursor(self) -> int:
        """Row under the cursor."""
        return self.front.table.cursor_row if isinstance(self.front, PlainScreen) else -1
