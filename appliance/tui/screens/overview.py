"""The first screen: alerts, robots with their map, tasks in work, and gateways with their load over the last reports.

Each part is as high as its rows, or has an equal share of the window where there is no room for all of them. The map
stands beside the parts in a wide window and below them in a narrow one, as far as there is room; in a wide window the
newest lines of the log fill what is left. Enter on a row opens what it stands for.
"""

from collections.abc import Sequence

from msgspec import Struct
from msgspec.structs import replace
from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.containers import Container, Vertical
from textual.screen import Screen
from textual.widgets import Static

from appliance.alerts.rules import ordered
from appliance.model import TaskRecord
from appliance.model.alerts import Alert
from appliance.reasons import time_of_day
from appliance.tui import status_styles
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.formatting import Cell, sparkline
from appliance.tui.robot_view import Ground, KnownRobots, robot_cells, searched
from appliance.tui.safe import safe
from appliance.tui.screens import alerts as alerts_screen
from appliance.tui.screens import robots as robots_screen
from appliance.tui.screens import tasks as tasks_screen
from appliance.tui.screens.fleet import GatewayScreen, gateway_state, gateways_of, hot
from appliance.tui.store import Gateway, Store
from appliance.tui.task_view import task_cells
from appliance.tui.widgets.grid import Column, Grid

_DROPPED_FIRST = {"kind, link": 3, "x y z": 2, "batt": 1}
ROBOTS = tuple(replace(each, drop=_DROPPED_FIRST.get(each.title, 0)) for each in robots_screen.ROBOTS)
"""The map tells positions: their column is left out where there is no room for all."""
GATEWAYS = (
    Column(title="gateway", width=9, grow=True),
    Column(title="state", width=12),
    Column(title="load", width=4, right=True),
    Column(title="last reports", width=20),
    Column(title="runs", width=5, right=True),
    Column(title="tasks", width=5, right=True),
    Column(title="robots", width=12, grow=True, drop=1),
)
_WIDE = 120
"""Columns from which the map stands beside the parts."""
_MAP_LINES = 7
"""A map of fewer lines says nothing."""


class LoadedGateway(Struct, frozen=True):
    """A gateway, and its load over its last reports, 0 to 1, the newest last."""

    gateway: Gateway
    loads: tuple[float, ...]


def gateway_cells(each: LoadedGateway) -> tuple[Cell, ...]:
    """Return the cells of a gateway's row."""
    status = each.gateway.status
    style = "dim" if each.gateway.lost_ns else ""
    return (
        (safe(status.id, 63), f"bold {style}"),
        gateway_state(each.gateway),
        (f"{status.load:.0%}", style or hot(status.load)),
        (sparkline(each.loads, 20, span=(0.0, 1.0)), style or hot(status.load) or "green"),
        (f"{status.running}+{status.queue}" if status.queue else str(status.running), style),
        (str(status.tasks), style),
        (safe(", ".join(status.robots), 80), style),
    )


def heights(wanted: Sequence[int], room: int, *, least: int = 2) -> list[int]:
    """Return how many lines each part gets: what it wants if there is room for all, else what is there, evenly.

    Args:
        wanted: lines that each part has use for.
        room: lines there are.
        least: lines that each part gets even if there are not so many.
    """
    found = [min(each, least) for each in wanted]
    while short := [index for index, each in enumerate(wanted) if found[index] < each][: room - sum(found)]:
        if sum(found) >= room:
            break
        for index in short:
            found[index] += 1
    return found


class OverviewScreen(FleetScreen):
    """What goes on in the fleet, all at once."""

    scope = "overview"
    shows = ("alerts", "robots", "tasks", "gateways", "enquiries", "stops", "closures", "entries")
    BINDINGS = bindings("overview")

    def __init__(self) -> None:
        super().__init__()
        self._known = KnownRobots()
        self._gateways: dict[str, LoadedGateway] = {}
        self._tasks_seen: object = None
        self._active: dict[str, TaskRecord] = {}

    def body(self) -> ComposeResult:
        """Make the parts."""
        with Container(id="parts"):
            with Vertical(id="tables"):
                yield Grid(alerts_screen.ALERTS, alerts_screen.alert_cells, id="alerts", empty="no alerts")
                yield Grid(ROBOTS, robot_cells, id="robots", empty="no robots are known")
                yield Grid(tasks_screen.TASKS, task_cells, id="tasks", empty="no task in work: s submits one")
                yield Grid(GATEWAYS, gateway_cells, id="gateways", empty="no gateway is known yet")
                yield Static(id="lines")
            yield Ground(id="ground")

    def on_mount(self) -> None:
        """Let ages grow while the screen is seen."""
        self.set_interval(1.0, self._grow_older)

    def _grow_older(self) -> None:
        if self.is_current:
            self._grid("alerts").redraw()

    def on_resize(self) -> None:
        """Put the map beside or below the tables."""
        if self.ready:
            self.query_one("#parts").set_class(self.size.width >= _WIDE, "wide")

    def _grid(self, name: str) -> Grid:
        return self.query_one(f"#{name}", Grid)

    def draw_body(self, store: Store) -> None:
        """Show all parts, each as high as there is room for."""
        robots = self.filtered(self._known.of(store), searched)
        alerts = {each.id: each for each in ordered(store.alerts.values())}
        self._grid("alerts").show(self.filtered(alerts, lambda name, each: f"{name} {each.level} {each.what}"))
        self._grid("robots").show(robots)
        self._grid("tasks").show(self.filtered(self._in_work(store), tasks_screen.searched))
        self._grid("gateways").show(self.filtered(self._loaded(store), lambda name, _: name))
        self._arrange(store)
        self.query_one(Ground).show(robots.values(), selected=self._grid("robots").selected or "", view=self.view)

    def _in_work(self, store: Store) -> dict[str, TaskRecord]:
        """Return the tasks that have not ended, newest first; looked for again only when a task has changed."""
        counted = (store, store.revision("tasks"))
        if counted != self._tasks_seen:
            self._tasks_seen = counted
            self._active = {name: store.tasks[name] for name in store.newest if not store.tasks[name].state.final}
        return self._active

    def _loaded(self, store: Store) -> dict[str, LoadedGateway]:
        known = gateways_of(store, self.view.fleet)
        fresh = {name: LoadedGateway(each, tuple(store.loads.get(name, ()))) for name, each in known.items()}
        # What is as it was stays the same thing, so that its line is not drawn again.
        self._gateways = {
            name: before if (before := self._gateways.get(name, each)) == each else each for name, each in fresh.items()
        }
        return self._gateways

    def _arrange(self, store: Store) -> None:
        """Give each table its height, and what is left to the map or the log."""
        wide = self.size.width >= _WIDE
        self.query_one("#parts").set_class(wide, "wide")
        room = self.query_one("#body").size.height or max(0, self.size.height - 3)
        names = ("alerts", "robots", "tasks", "gateways")
        # A head, at least a line, and a blank one below.
        given = heights([max(2, len(self._grid(name).keys) + 1) + 1 for name in names], room)
        for name, lines in zip(names, given, strict=True):
            if self._grid(name).styles.height != lines:
                self._grid(name).styles.height = lines
        left = room - sum(given)
        self.query_one("#tables").styles.height = room if wide else min(room, sum(given))
        self.query_one(Ground).display = wide or left >= _MAP_LINES
        said = list(store.entries)[-(left - 1) :] if wide and left > 2 else []
        lines = [
            Text.assemble(
                (f"{time_of_day(each.at_ns)} ", "dim"), (f"{each.source} ", "cyan"),
                (each.text, status_styles.level(each.level).style),
            )
            for each in said
        ]  # fmt: skip
        text = Text("\n").join(lines)
        text.no_wrap, text.overflow = True, "ellipsis"
        self.say("#lines", text)

    @on(Grid.Moved, "#robots")
    def _mark(self, event: Grid.Moved) -> None:
        self.query_one(Ground).mark(event.key)

    @on(Grid.Picked)
    def drill(self, event: Grid.Picked) -> None:
        """Open what the row stands for."""
        event.stop()
        if event.grid.id == "alerts":
            self.host.show_alert(event.key)
            return
        made: dict[str | None, type[Screen[None]]] = {
            "robots": robots_screen.RobotScreen,
            "tasks": tasks_screen.TaskScreen,
            "gateways": GatewayScreen,
        }
        self.application.push_screen(made[event.grid.id](event.key))

    def chosen(self) -> dict[str, str]:
        """Return what the selected row of the table that has the focus stands for."""
        grid = self.focused
        if not isinstance(grid, Grid) or grid.selected is None:
            return {}
        match grid.id:
            case "alerts":
                alert: Alert = grid.thing
                return alerts_screen.chosen_of(alert)
            case "robots":
                return robots_screen.chosen_of(grid.thing)
            case "tasks":
                return tasks_screen.chosen_of(grid.thing)
            case _:
                return {"gateway": grid.selected}
