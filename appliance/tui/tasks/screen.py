"""The screen of tasks: all of them, and the selected one with its plan as a graph and why it waits."""

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.model import SubtaskState, TaskRecord
from appliance.tui.frame import FleetScreen
from appliance.tui.grid import Column, Grid
from appliance.tui.keys import bindings
from appliance.tui.store import Store
from appliance.tui.tasks.facts import reason, task_cells, task_text
from appliance.tui.tasks.graph import TaskScreen
from appliance.tui.widgets import Pane

TASKS = (
    Column(title="task", width=12),
    Column(title="state", width=12),
    Column(title="done", width=5, right=True),
    Column(title="%", width=4, right=True),
    Column(title="at", width=8, drop=2),
    Column(title="by", width=8, drop=3),
    Column(title="instruction", width=20, grow=True),
    Column(title="waits for", width=24, grow=True, drop=4),
)
"""What a task waits for stands below the table too, of the selected one: narrow windows have no room for it twice."""
_EMPTY = "no tasks yet: s submits one"


def searched(name: str, record: TaskRecord) -> str:
    """Return what a filter looks at: also robots, skills and why it waits."""
    parts = [name, str(record.state), record.instruction, record.submitter, record.coordinator, reason(record)]
    parts += [
        f"{each.subtask.skill} {each.bound_robot or each.subtask.robot or ''} {each.gateway}"
        for each in record.subtasks
    ]
    return " ".join(parts)


class TasksScreen(FleetScreen):
    """Tasks, newest first, over the plan of the selected one. Enter opens it."""

    scope = "tasks"
    shows = ("tasks",)
    BINDINGS = bindings("tasks")
    DEFAULT_CSS = """
    TasksScreen #tasks { height: 2fr; }
    TasksScreen #detail-box { height: 3fr; border-top: solid $foreground 30%; scrollbar-size: 1 1; padding: 0 1; }
    TasksScreen #detail-box:focus { border-top: solid $accent; }
    """

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Grid(TASKS, task_cells, id="tasks", empty=_EMPTY)
        with Pane(id="detail-box"):
            yield Static(id="detail")

    def draw_body(self, store: Store) -> None:
        """Show the tasks, newest first."""
        rows = {name: store.tasks[name] for name in store.newest}
        shown = self.filtered(rows, searched)
        grid = self.query_one("#tasks", Grid)
        grid.show(shown, empty="no task matches the filter" if rows else _EMPTY)
        if (wanted := self.host.wanted_task) and grid.select(wanted):
            self.host.wanted_task = ""
        self._draw_detail()

    def on_resize(self) -> None:
        """Lay the plan out for the window."""
        if self.ready:
            self._draw_detail()

    @on(Grid.Moved)
    def _draw_detail(self) -> None:
        record: TaskRecord | None = self.query_one("#tasks", Grid).thing
        self.say("#detail", Text() if record is None else task_text(record, self.query_one("#detail-box").size.width))

    @on(Grid.Picked)
    def _open(self, event: Grid.Picked) -> None:
        event.stop()
        self.application.push_screen(TaskScreen(event.key))

    def chosen(self) -> dict[str, str]:
        """Return the selected task, and a subtask of it when only one runs."""
        record: TaskRecord | None = self.query_one("#tasks", Grid).thing
        if record is None:
            return {}
        running = [each.subtask.id for each in record.subtasks if each.state is SubtaskState.RUNNING]
        found = {"task": record.id}
        if len(running) == 1:
            found["subtask"] = f"{record.id}/{running[0]}"
        return found
