"""The screen of robots: what they are, how they are, what they do; and where, on a map. Enter shows one whole."""

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.containers import Container, Vertical
from textual.widgets import Static

from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.robot_view import Ground, KnownRobots, Robot, about, robot_cells, searched, selected_text
from appliance.tui.safe import safe
from appliance.tui.store import Store
from appliance.tui.widgets import Pane
from appliance.tui.widgets.grid import Column, Grid

ROBOTS = (
    Column(title="robot", width=8, grow=True),
    Column(title="kind, link", width=12),
    Column(title="mode", width=12),
    Column(title="batt", width=4, right=True),
    Column(title="x y z", width=13, right=True),
    Column(title="mission", width=11, grow=True),
    Column(title="state", width=11, grow=True),
)
"""All columns fit at 80 columns, beside a scroll bar."""
_WIDE = 150
"""Columns from which the map stands beside the table."""


class RobotsScreen(FleetScreen):
    """All robots, and the map."""

    scope = "robots"
    shows = ("robots", "tasks", "gateways", "enquiries", "stops", "closures")
    BINDINGS = bindings("robots")

    def __init__(self) -> None:
        super().__init__()
        self._known = KnownRobots()

    def body(self) -> ComposeResult:
        """Make the parts."""
        with Container(id="parts"):
            with Vertical(id="list"):
                yield Grid(ROBOTS, robot_cells, id="robots", empty="no robots are known")
                yield Static(id="selected")
            yield Ground(id="ground")

    def on_resize(self) -> None:
        """Put the map beside or below the table."""
        if self.ready:
            self.query_one("#parts").set_class(self.size.width >= _WIDE, "wide")

    def draw_body(self, store: Store) -> None:
        """Show the robots by name, and where they are."""
        rows = self._known.of(store)
        shown = self.filtered(rows, searched)
        grid = self.query_one("#robots", Grid)
        grid.show(shown, empty="no robot matches the filter" if rows else "no robots are known")
        self.query_one(Ground).show(shown.values(), selected=grid.selected or "", view=self.view)
        self._tell()

    @on(Grid.Moved)
    def _mark(self, event: Grid.Moved) -> None:
        self.query_one(Ground).mark(event.key)
        self._tell()

    def _tell(self) -> None:
        robot: Robot | None = self.query_one("#robots", Grid).thing
        self.say("#selected", selected_text(robot) if robot is not None else Text())

    @on(Grid.Picked)
    def _open(self, event: Grid.Picked) -> None:
        event.stop()
        self.application.push_screen(RobotScreen(event.key))

    def chosen(self) -> dict[str, str]:
        """Return the selected robot, and what it asks."""
        robot: Robot | None = self.query_one("#robots", Grid).thing
        return chosen_of(robot)


def chosen_of(robot: Robot | None) -> dict[str, str]:
    """Return what a robot stands for: itself, its question, its task."""
    if robot is None:
        return {}
    found = {"robot": robot.info.id}
    if robot.questions:
        found["enquiry"] = robot.questions[0].id
    if robot.mission:
        found["task"] = robot.mission.partition("/")[0]
        found["subtask"] = robot.mission.partition(" ")[0]
    return found


class RobotScreen(FleetScreen):
    """One robot whole."""

    scope = "robot"
    tab = "robots"
    shows = ("robots", "tasks", "gateways", "enquiries", "stops", "closures")
    BINDINGS = bindings("robot")

    def __init__(self, robot: str) -> None:
        super().__init__()
        self.robot_id = robot
        self._known = KnownRobots()
        self._robot: Robot | None = None

    def title_of(self) -> str:
        """Return the robot."""
        return self.robot_id

    def body(self) -> ComposeResult:
        """Make the parts."""
        with Pane(id="about-box"):
            yield Static(id="about")
        yield Ground(id="ground")

    def draw_body(self, store: Store) -> None:
        """Show it as it is now, among the others on the map."""
        robots = self._known.of(store)
        self._robot = robots.get(self.robot_id)
        gone = Text(f"robot {safe(self.robot_id, 63)} is not known (any more)")
        self.say("#about", about(self._robot, self.size.width - 2) if self._robot is not None else gone)
        self.query_one(Ground).show(robots.values(), selected=self.robot_id, view=self.view)

    def chosen(self) -> dict[str, str]:
        """Return the robot, and what it asks."""
        return chosen_of(self._robot) or {"robot": self.robot_id}
