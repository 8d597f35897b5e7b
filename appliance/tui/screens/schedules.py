"""The screen of schedules, places and robots out of use, and standing rules. `S` opens it over any other."""

import time

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.errors import SwiftbotError
from appliance.model.closures import Closure
from appliance.model.schedules import ScheduleShown
from appliance.reasons import time_of_day
from appliance.schedules import due
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.command_line import PLACES, SCHEDULES, asked_schedules
from appliance.tui.formatting import Cell, duration
from appliance.tui.safe import safe
from appliance.tui.store import Store
from appliance.tui.widgets.grid import Column, Grid

COLUMNS = (
    Column(title="schedule", width=14, grow=True),
    Column(title="when", width=14),
    Column(title="next", width=9),
    Column(title="state", width=9),
    Column(title="runs", width=4, right=True),
    Column(title="missed", width=6, right=True),
    Column(title="instruction", width=14, grow=True),
)
CLOSURES = (
    Column(title="out of use", width=10),
    Column(title="name", width=14, grow=True),
    Column(title="until", width=9),
    Column(title="by", width=10),
    Column(title="reason", width=28, grow=True),
)
_ASK_S = 3.0


def schedule_cells(shown: ScheduleShown) -> tuple[Cell, ...]:
    """Return the cells of a schedule's row."""
    schedule = shown.schedule
    if schedule.paused is not None:
        state = ("‖ paused", "yellow")
    else:
        state = ("✔ active", "green") if shown.next_ns else ("· over", "dim")
    missed = (f"▲{schedule.missed}", "yellow") if schedule.missed else "0"
    return (
        (safe(schedule.id, 60), "bold"),
        safe(due.times_text(schedule.spec), 80),
        moment(shown.next_ns[0] if shown.next_ns else 0),
        state,
        str(schedule.fired),
        missed,
        safe(schedule.spec.instruction, 200),
    )


def moment(at_ns: int) -> str:
    """Return a moment to come in few characters: the time of day within a day, else in how long it is."""
    left_s = at_ns / 1e9 - time.time()
    if not at_ns:
        return "–"
    return time_of_day(at_ns)[:5] if left_s < 86_400 else f"in {duration(left_s)}"


def closure_cells(closure: Closure) -> tuple[Cell, ...]:
    """Return the cells of a row of what is out of use."""
    word = {"place": "◌ closed", "robot": "◌ maint."}.get(closure.kind, "◌ rule")
    name = closure.name if closure.rule is None else closure.rule.text
    return (
        (word, "yellow"),
        (safe(name, 200), "bold"),
        moment(closure.until_ns),
        safe(closure.by.by, 60),
        safe(closure.by.why, 200),
    )


class SchedulesScreen(FleetScreen):
    """Schedules above, what is out of use and standing rules below."""

    scope = "schedules"
    shows = ("asked", "closures")
    BINDINGS = bindings("schedules")

    def title_of(self) -> str:
        """Return what it is: it has no number."""
        return "schedules"

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Grid(COLUMNS, schedule_cells, id="schedules", empty="no schedules: n adds one")
        yield Static(id="about")
        yield Grid(
            CLOSURES, closure_cells, id="closures", empty="nothing is out of use, and there are no standing rules"
        )

    def on_mount(self) -> None:
        """Ask for the schedules while the screen is seen: they are put nowhere."""
        self.set_interval(_ASK_S, self._ask)
        self._ask()

    def _ask(self) -> None:
        if self.is_current and self.view.steerable and self.store.connection.connected:
            self.run_worker(self._fetch(), group="schedules", exclusive=True)

    async def _fetch(self) -> None:
        try:
            self.store.asked.put(SCHEDULES, await self.view.orders.schedules())
            if PLACES not in self.store.asked:  # for Tab after `:close-place`
                self.store.asked.put(PLACES, await self.view.orders.site())
        except SwiftbotError:
            return  # the banner tells what is wrong with the connection; what was heard last stays

    def draw_body(self, store: Store) -> None:
        """Show both tables."""
        rows = {each.schedule.id: each for each in asked_schedules(store).schedules}
        empty = "no schedules: n adds one" if self.view.steerable else "a recorded log has no schedules"
        shown = self.filtered(rows, lambda name, each: f"{name} {each.schedule.spec.instruction}")
        self.query_one("#schedules", Grid).show(shown, empty="no schedule matches the filter" if rows else empty)
        now_ns = time.time_ns()
        kept_out = sorted(
            (each for each in store.closures.values() if each.holds(now_ns)), key=lambda each: (each.kind, each.name)
        )
        self.query_one("#closures", Grid).show({each.id: each for each in kept_out})
        self._draw_about()

    @on(Grid.Moved, "#schedules")
    def _draw_about(self) -> None:
        if not self.ready:
            return
        shown: ScheduleShown | None = self.query_one("#schedules", Grid).thing
        self.say("#about", Text() if shown is None else about(shown))

    def chosen(self) -> dict[str, str]:
        """Return the selected schedule with its last task, or place, robot or rule, by which table has the focus."""
        grid = self.focused
        if not isinstance(grid, Grid) or grid.thing is None:
            return {}
        if grid.id == "closures":
            closure: Closure = grid.thing
            return {closure.kind: closure.name}
        schedule = grid.thing.schedule
        return {"schedule": schedule.id} | ({"task": schedule.task} if schedule.task else {})


def about(shown: ScheduleShown) -> Text:
    """Return a schedule in full: the instruction, who added it, its last task, what was missed."""
    schedule = shown.schedule
    why = f": {safe(schedule.added.why, 200)}" if schedule.added.why else ""
    out = Text.assemble(
        (safe(schedule.id, 60), "bold"), f" {safe(schedule.spec.instruction, 600)}\n",
        (f"added by {safe(schedule.added.by, 80)}{why}, submitted by {safe(shown.owner, 63) or 'no gateway'}", "dim"),
    )  # fmt: skip
    if schedule.task:
        at = due.when(schedule.fired_ns, schedule.spec.zone)
        out.append(f"\nlast task {safe(schedule.task, 64)}, due {safe(at, 60)}")
    if schedule.missed:
        out.append(f"\n▲ {schedule.missed} missed: {safe(schedule.missed_why, 300)}", "yellow")
    return out
