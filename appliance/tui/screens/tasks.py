"""The screens of tasks: all of them, and one task whole.

Of the selected task the list shows its plan as a graph and why it waits. One task whole is its plan as a graph, and of
the selected subtask the reasons, the result and what its run says.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import Mapping

from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.after_stop import Left, left, robots_of, unfinished
from appliance.errors import SwiftbotError
from appliance.model import SubtaskState, TaskRecord
from appliance.model.task_api import Line, TasksAsk, TaskWhy
from appliance.operations import left_lines
from appliance.tasks.views import why
from appliance.tui import status_styles, task_view
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.formatting import clock, told
from appliance.tui.safe import safe
from appliance.tui.store import Store
from appliance.tui.task_view import Node, brief, nodes, reason, state_cell, subtask_cells, task_cells, task_text, waits
from appliance.tui.widgets import Pane
from appliance.tui.widgets.grid import Column, Grid

SUBTASKS = (
    Column(title="subtask", width=9, grow=True),
    Column(title="skill", width=12),
    Column(title="robot", width=9),
    Column(title="state", width=15),
    Column(title="at", width=6, drop=1),
    Column(title="phase", width=11, drop=2),
    Column(title="startup", width=8, right=True, drop=3),
    Column(title="took", width=8, right=True, drop=4),
    Column(title="try", width=3, right=True, drop=5),
)
ASK_S = 2.0
"""How often the coordinator is asked why something waits, while it is looked at."""
LINES = 500
"""Lines of runs kept."""
PAGE = 100
"""Older tasks that are loaded at once."""
SHOWN = 100
"""Lines of the selected subtask that are shown, the newest."""


def line_text(line: Line) -> Text:
    """Return a line of a task's stream."""
    sign = status_styles.level(line.level)
    progress = f"{line.fields.get('progress', 0.0):.0%} " if "progress" in line.fields else ""
    fields = "" if progress else brief(line.fields)
    return Text.assemble(
        (f"{clock(line.at_ns)} ", "dim"),
        (f"{safe(line.gateway, 12)} {line.kind} ", "cyan"),
        (f"{progress}{safe(line.text, 300)} {fields}".rstrip(), sign.style),
        "\n",
    )


class TaskScreen(FleetScreen):
    """A task with the graph of its plan."""

    scope = "task"
    tab = "tasks"
    shows = ("tasks", "robots", "stops")
    BINDINGS = bindings("task")

    def __init__(self, task: str) -> None:
        super().__init__()
        self.task_id = task
        self._why: TaskWhy | None = None
        self._problem = ""
        self._lines: deque[Line] = deque(maxlen=LINES)
        self._graph: dict[str, Node] = {}

    def title_of(self) -> str:
        """Return the task."""
        return self.task_id

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="about")
        yield Grid(SUBTASKS, subtask_cells, id="subtasks", empty="no plan yet")
        with Pane(id="detail-box"):
            yield Static(id="detail")

    def on_mount(self) -> None:
        """Begin to ask and to listen."""
        self._ask()
        self.set_interval(ASK_S, self._ask_again)
        self._listen()

    # --- asking and listening --------------------------------------------------------------------------------------

    def _ask_again(self) -> None:
        if self.is_current:
            self._ask()

    @work(exclusive=True, group="why")
    async def _ask(self) -> None:
        """Ask why its subtasks wait."""
        record = self.store.tasks.get(self.task_id)
        if not self.view.steerable:
            # A recorded log has no coordinator that could be asked: the record's own reasons are all there is.
            self._why = why(record) if record is not None else None
        else:
            try:
                self._why = await self.view.orders.why(self.task_id)
                self._problem = ""
            except SwiftbotError as error:
                self._problem = f"{error.message} {error.remedy}".rstrip()
                self._why = why(record) if record is not None else self._why
        self._draw_detail()

    @work(group="lines")
    async def _listen(self) -> None:
        """Follow what its runs say, from all gateways."""
        while self.view.steerable:
            try:
                async with contextlib.aclosing(self.view.orders.stream(self.task_id)) as lines:
                    self._lines.clear()
                    async for line in lines:
                        self._lines.append(line)
            except SwiftbotError:
                await asyncio.sleep(ASK_S)
            else:
                return

    # --- drawing ---------------------------------------------------------------------------------------------------

    def draw_body(self, store: Store) -> None:
        """Show the task as it is now."""
        record = store.tasks.get(self.task_id)
        if record is None:
            self.say("#about", Text(f"task {safe(self.task_id, 80)} is not known (any more)", "yellow"))
            self.query_one("#subtasks", Grid).show({})
            return
        self.say("#about", self._about(record))
        rows = nodes(record)
        grid = self.query_one("#subtasks", Grid)
        # A node that is as it was stays the same thing, so that its line is not drawn again.
        rows = {name: known if (known := self._graph.get(name, node)) == node else node for name, node in rows.items()}
        self._graph = rows
        proposal = waits(record)
        empty = "its plan waits for approval: Enter looks at it" if proposal is not None else "being planned …"
        grid.show(self.filtered(rows, lambda name, node: f"{name} {node.record}"), empty=empty)
        self._draw_detail()

    def _about(self, record: TaskRecord) -> Text:
        out = Text.assemble(state_cell(record), f" · {safe(record.instruction, 400)}")
        where = f"coordinated by {safe(record.coordinator, 63)}" if record.coordinator else "no coordinator"
        group = f", served by {safe(', '.join(record.group.members), 100)}" if record.group is not None else ""
        out.append(f"\n{where}{group}", "dim")
        if text := reason(record):
            out.append(f"\n… {text}", "yellow")
        if record.failure is not None:
            out.append(f"\n✘ {told(record.failure)}", "red")
        if unfinished(record):
            for line in left_lines(self._robots_left(record), tui=True):
                out.append(f"\n▸ {safe(line, 400)}", "cyan")
        return out

    def _robots_left(self, record: TaskRecord) -> tuple[Left, ...]:
        """Return how the robots of a task that did not end well stand now."""
        stops = self.store.stops
        return tuple(
            left(robot, record=record, stopped=stops.of(name) is not None)
            for name in robots_of(record)
            if (robot := self.store.robots.get(name)) is not None
        )

    @on(Grid.Moved)
    def _draw_detail(self) -> None:
        if not self.ready:
            return
        node: Node | None = self.query_one("#subtasks", Grid).thing
        text = Text()
        if node is not None:
            name = node.record.subtask.id
            text = task_view.subtask_text(node.record, task_view.of_subtask(self._why, name), problem=self._problem)
            lines = [line for line in self._lines if line.subtask == name]
            if lines:
                text.append("log\n", "bold")
                for line in lines[-SHOWN:]:
                    text.append_text(line_text(line))
        self.say("#detail", text)

    @on(Grid.Picked)
    def _into(self, event: Grid.Picked) -> None:
        event.stop()
        self.query_one("#detail-box").focus()

    def chosen(self) -> dict[str, str]:
        """Return the task, and the selected subtask."""
        selected = self.query_one("#subtasks", Grid).selected
        found = {"task": self.task_id}
        if selected is not None:
            found["subtask"] = f"{self.task_id}/{selected}"
        return found


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


def chosen_of(record: TaskRecord) -> dict[str, str]:
    """Return a task, and a subtask of it when only one runs."""
    running = [each.subtask.id for each in record.subtasks if each.state is SubtaskState.RUNNING]
    found = {"task": record.id}
    if len(running) == 1:
        found["subtask"] = f"{record.id}/{running[0]}"
    return found


class TasksScreen(FleetScreen):
    """Tasks, newest first, over the plan of the selected one. Enter opens it."""

    scope = "tasks"
    shows = ("tasks",)
    BINDINGS = bindings("tasks")

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

    def do_older(self, _given: Mapping[str, str]) -> None:
        """Load the next page of older tasks."""
        if not self.view.steerable:
            self.notify("a recorded log has the tasks of its time only", severity="warning")
        else:
            self._load_older()

    @work(exclusive=True, group="older")
    async def _load_older(self) -> None:
        store = self.store
        if len(store.tasks) + PAGE > store.tasks.most:
            self.notify(
                f"{len(store.tasks):,} tasks are loaded, as many as are kept\n→ `swiftbot task list --before TASK`",
                severity="warning", markup=False,
            )  # fmt: skip
            return
        oldest = store.tasks.get(store.newest[-1]) if store.newest else None
        try:
            page = await self.view.orders.tasks(PAGE, wanted=TasksAsk(remembered=True), after=oldest)
        except SwiftbotError as error:
            self.host.tell(error)
            return
        store.take_tasks(page.tasks)
        lacks = f"; {', '.join(page.unreachable)} did not answer" if page.unreachable else ""
        said = f"{len(page.tasks)} older tasks loaded" if page.tasks else "there are no older tasks"
        self.notify(f"{said}{'; there are more' if page.more else ''}{safe(lacks)}", markup=False)

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
        return {} if record is None else chosen_of(record)
