"""The terminal UI itself: header, banner, four panes, filter and dialogs over one view of the fleet.

Textual's part of it, nothing else: it works at 80 columns by 24 lines over SSH, draws a few times a second and
only what changed, and never stops because the network does.
"""

import contextlib
import re
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import structlog
from rich.text import Text
from textual import on
from textual.app import App, ComposeResult, SystemCommand
from textual.css.query import NoMatches
from textual.screen import Screen
from textual.widgets import ContentSwitcher, Footer, Input, Static

from appliance.errors import SwiftbotError
from appliance.model import TaskRecord
from appliance.plane.settings import PlaneConfig
from appliance.tui.actions import ACTIONS, bindings
from appliance.tui.board import Snapshot
from appliance.tui.data import FleetView, View
from appliance.tui.dialogs import ConfirmDialog, HelpDialog, SubmitDialog
from appliance.tui.panes import FleetPane, LogPane, Pane, PoolPane, TasksPane
from appliance.tui.settings import TuiConfig

log = structlog.get_logger(__name__)

PANES = {"fleet": "Fleet", "tasks": "Tasks", "pool": "Pool", "log": "Log"}
"""Panes in the order of their keys."""
_FOCUS = {"fleet": "#gateways", "tasks": "#tasks", "pool": "#containers", "log": "#lines"}
_FONT = re.compile(r"@font-face \{[^}]*\}\s*")


class SwiftbotApp(App[None]):
    """The terminal UI on a view of a fleet.

    Args:
        view: What is shown; closed with the app.
        config: How often it is drawn.
    """

    TITLE = "SwiftBot"
    BINDINGS = bindings()  # pyright: ignore[reportAssignmentType] - Textual wants a list of its own union
    COMMAND_PALETTE_BINDING: ClassVar[str] = "ctrl+p"
    CSS = """
    #header { height: 1; background: $primary-darken-2; color: $text; }
    #banner { height: auto; max-height: 3; background: $error-darken-1; color: $text; padding: 0 1; display: none; }
    ContentSwitcher { height: 1fr; }
    Pane { height: 1fr; }
    DataTable { height: 1fr; scrollbar-size: 1 1; }
    #gateways { height: auto; max-height: 50%; }
    #notes { height: auto; max-height: 6; padding: 0 1; }
    #robots { height: 1fr; border-top: solid $primary-darken-2; }
    #tasks { height: 2fr; }
    #detail-box { height: 3fr; border-top: solid $primary-darken-2; scrollbar-size: 1 1; }
    #detail-box:focus { border-top: solid $accent; }
    RichLog { scrollbar-size: 1 1; }
    #filter { height: 1; border: none; padding: 0 1; display: none; }
    ModalScreen { align: center middle; }
    .dialog { width: 90%; max-width: 100; height: 80%; border: round $accent; background: $surface; padding: 0 1; }
    .small { height: auto; width: 60; }
    .title { text-style: bold; }
    #plan-box { height: 1fr; scrollbar-size: 1 1; }
    #signs { margin-top: 1; }
    #hint { color: $text-muted; }
    """

    def __init__(self, view: View, config: TuiConfig | None = None) -> None:
        super().__init__()
        self._view = view
        self._config = config or TuiConfig()
        self._config.check()
        self._drawn_revision: object = None
        self.pane_name = "fleet"
        """Which pane is shown: fleet, tasks, pool or log."""

    def compose(self) -> ComposeResult:
        """Make the screen."""
        yield Static(id="header")
        yield Static(id="banner")
        with ContentSwitcher(initial="pane-fleet"):
            yield FleetPane(id="pane-fleet")
            yield TasksPane(id="pane-tasks")
            yield PoolPane(id="pane-pool")
            yield LogPane(id="pane-log", most=self._config.entries)
        yield Input(placeholder="filter rows: Enter keeps, Esc shows all", id="filter", compact=True)
        yield Footer(compact=True, show_command_palette=False)

    async def on_mount(self) -> None:
        """Begin to listen and to draw."""
        self.sub_title = self._view.fleet
        await self._view.start()
        self.set_interval(1 / self._config.refresh_hz, self._redraw)
        self.action_show("fleet")

    async def on_unmount(self) -> None:
        """End listening."""
        await self._view.close()

    # --- drawing -----------------------------------------------------------------------------------------

    @property
    def pane(self) -> Pane:
        """The pane that is shown."""
        return self.query_one(f"#pane-{self.pane_name}", Pane)

    def _redraw(self) -> None:
        # While the app ends, the timer may still fire when parts of the screen are gone.
        with contextlib.suppress(NoMatches):
            self.draw()

    def draw(self, *, force: bool = False) -> None:
        """Draw what is new; nothing when nothing is."""
        revision = (self._view.revision, self.pane_name, self.pane.shown_filter)
        if revision == self._drawn_revision and not force:
            return
        self._drawn_revision = revision
        snapshot = self._view.snapshot()
        self._draw_header(snapshot)
        self.pane.draw(snapshot)

    def _draw_header(self, snapshot: Snapshot) -> None:
        running = sum(not record.state.final for record in snapshot.tasks)
        text = Text.assemble(
            (" SwiftBot ", "bold"),
            f"{snapshot.fleet} · {len(snapshot.gateways)} gw · {len(snapshot.robots)} robots · {running} active ",
        )
        for number, (name, title) in enumerate(PANES.items(), start=1):
            text.append(f" {number} {title} ", "reverse" if name == self.pane_name else "")
        self.query_one("#header", Static).update(text)
        banner = self.query_one("#banner", Static)
        connection = snapshot.connection
        banner.display = not connection.connected
        if not connection.connected:
            banner.update(Text.assemble((f"✘ {connection.problem}", "bold"), f" → {connection.remedy}"))

    # --- actions -----------------------------------------------------------------------------------------

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Cancel is offered where a task is selected."""
        if action == "cancel_task":
            return self.pane_name == "tasks"
        return super().check_action(action, parameters)

    def action_show(self, name: str) -> None:
        """Show a pane."""
        self.pane_name = name
        self.query_one(ContentSwitcher).current = f"pane-{name}"
        self.query_one(_FOCUS[name]).focus()
        field = self.query_one("#filter", Input)
        field.value = self.pane.shown_filter
        field.display = bool(field.value)
        self.refresh_bindings()
        self.draw()

    def action_submit(self) -> None:
        """Ask for an instruction, show its plan, run it when confirmed."""

        def submitted(record: TaskRecord | None) -> None:
            if record is not None:
                self.query_one("#pane-tasks", TasksPane).select(record.id)
                self.action_show("tasks")
                self.notify(f"accepted as {record.id}", markup=False)

        # The id is made here, so that submitting again after a lost answer is the same task.
        self.push_screen(SubmitDialog(self._view, task_id=f"t-{uuid.uuid4().hex[:10]}"), submitted)

    def action_cancel_task(self) -> None:
        """Cancel the selected task, after asking."""
        selected = self.query_one("#pane-tasks", TasksPane).selected
        record = self._view.snapshot().task(selected) if selected is not None else None
        if record is None:
            self.notify("no task is selected", severity="warning")
            return
        if record.state.final:
            self.notify(f"task {record.id} has ended: {record.state}", severity="warning", markup=False)
            return

        def answered(yes: bool | None) -> None:
            if yes:
                self.run_worker(self._cancel(record.id), group="cancel")

        self.push_screen(ConfirmDialog(f"Cancel task {record.id}?\n{record.instruction[:200]}"), answered)

    async def _cancel(self, task_id: str) -> None:
        try:
            record = await self._view.cancel(task_id)
        except SwiftbotError as error:
            self.tell(error)
        else:
            self.notify(f"task {task_id}: {record.state}", markup=False)

    def action_filter(self) -> None:
        """Open the filter of the shown pane."""
        field = self.query_one("#filter", Input)
        field.display = True
        field.focus()

    def action_clear_filter(self) -> None:
        """Show all rows again."""
        field = self.query_one("#filter", Input)
        field.value = ""
        field.display = False
        self._filter("")
        self.query_one(_FOCUS[self.pane_name]).focus()

    def action_switch_focus(self) -> None:
        """Go to the next part of the pane."""
        self.screen.focus_next()

    def action_help(self) -> None:
        """Show keys and signs."""
        self.push_screen(HelpDialog())

    def get_system_commands(self, screen: Screen[Any]) -> Iterable[SystemCommand]:
        """Offer the same actions in the command palette."""
        _ = screen
        for action in ACTIONS:

            async def call(name: str = action.call) -> None:
                await self.run_action(name)

            yield SystemCommand(action.title, f"{action.help} ({action.shown})", call)
        yield SystemCommand("Theme", "Change the colours", self.action_change_theme)

    @on(Input.Changed, "#filter")
    def filter_changed(self, event: Input.Changed) -> None:
        """Filter while it is typed."""
        self._filter(event.value)

    @on(Input.Submitted, "#filter")
    def filter_kept(self) -> None:
        """Keep the filter, go back to the rows."""
        self.query_one("#filter", Input).display = bool(self.pane.shown_filter)
        self.query_one(_FOCUS[self.pane_name]).focus()

    def _filter(self, text: str) -> None:
        self.pane.shown_filter = text
        self.draw()

    def tell(self, error: SwiftbotError) -> None:
        """Show an error with its remedy."""
        text = f"{error.message}\n→ {error.remedy}" if error.remedy else error.message
        self.notify(text, title="Error", severity="error", timeout=10, markup=False)

    def export_svg(self, path: Path) -> None:
        """Write a picture of the screen as it is now, without references to fonts on other machines."""
        path.write_text(_FONT.sub("", self.export_screenshot(title=f"SwiftBot · {self._view.fleet}")))


async def export_picture(
    view: View, path: Path, *, keys: tuple[str, ...] = ("2",), size: tuple[int, int] = (100, 30)
) -> None:
    """Run the terminal UI without a terminal on `view`, press `keys`, write its picture to `path` as SVG.

    Args:
        view: What is shown.
        path: SVG file to write.
        keys: Keys pressed first, in Textual's names.
        size: Columns and lines.
    """
    app = SwiftbotApp(view)
    async with app.run_test(size=size) as pilot:
        await pilot.pause()
        await pilot.press(*keys)
        await pilot.pause(0.5)
        app.draw(force=True)
        await pilot.pause()
        app.export_svg(path)


async def run_tui(plane_config: PlaneConfig, fleet: str, config: TuiConfig | None = None) -> None:
    """Run the terminal UI on a fleet until the person leaves (`swiftbot tui`).

    Log lines of this process go to its log screen meanwhile: on the terminal they would spoil the picture.

    Raises:
        ConfigError: a setting cannot work.
    """
    config = config or TuiConfig()
    config.check()
    view = FleetView(plane_config, fleet, config)
    before = structlog.get_config()
    structlog.configure(
        processors=[structlog.processors.add_log_level, view.take_own_log], cache_logger_on_first_use=False
    )
    try:
        await SwiftbotApp(view, config).run_async()
    finally:
        structlog.configure(**before)
