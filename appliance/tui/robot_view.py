"""Robots as rows, sentences and spots of the map, and the map of positions as a widget.

`KnownRobots` keeps all robots with what is known around them, updated only where something has changed since the last
look: with hundreds of robots and a thousand tasks, looking through all of them for each drawing would cost more than
the drawing itself. `Trails` keeps their last positions, bounded. `Ground` fits the map to its window and asks for the
site once.
"""

import time
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from itertools import islice

from msgspec import Struct
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual import work
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from appliance.errors import SwiftbotError
from appliance.model import Enquiry, Lease, Pose, RobotInfo, Site, SubtaskState, TaskRecord
from appliance.model import gateways as facts
from appliance.tui.formatting import Cell, hanging
from appliance.tui.safe import safe
from appliance.tui.store import Gateway, Store
from appliance.tui.subscriptions import View
from appliance.tui.widgets.map import Area, Line, Spot, areas_of, draw, view_for
from appliance.tui.widgets.map import View as MapView

TRAIL = 60
"""Positions remembered of each robot."""
MOST_TRAILS = 1000
MOST_SHOWN = 2000
"""Positions of all trails that are shown together."""


def shown_of(robots: int) -> int:
    """Return how many positions each of so many robots leaves on the map: with hundreds, long trails are one blur."""
    return max(1, MOST_SHOWN // max(1, robots))


class Trails:
    """Where robots were."""

    def __init__(self) -> None:
        self._trails: dict[str, deque[tuple[float, float]]] = {}

    def note(self, robots: Iterable[RobotInfo]) -> None:
        """Take positions; one like the last is not kept twice."""
        for each in robots:
            pose = each.pose
            if pose is None:
                continue
            trail = self._trails.get(each.id)
            if trail is None:
                if len(self._trails) >= MOST_TRAILS:
                    continue
                trail = self._trails[each.id] = deque(maxlen=TRAIL)
            at = (pose.x, pose.y)
            if not trail or trail[-1] != at:
                trail.append(at)

    def last(self, robot: str, most: int) -> tuple[tuple[float, float], ...]:
        """Return the last positions of a robot, oldest first."""
        trail = self._trails.get(robot)
        if trail is None:
            return ()
        return tuple(trail) if len(trail) <= most else tuple(islice(trail, len(trail) - most, None))


_BUSY = (SubtaskState.DISPATCHED, SubtaskState.RUNNING)


class Robot(Struct, frozen=True, kw_only=True):
    """A robot with all that is known around it."""

    info: RobotInfo
    mission: str = ""
    """`task/subtask skill` of what it does, empty for nothing."""
    stopped: str = ""
    """Why it is given no commands, in words."""
    maintenance: str = ""
    """Who has taken it out of use, why and until when, in words."""
    lease: Lease | None = None
    """Who has taken it over."""
    questions: tuple[Enquiry, ...] = ()
    """What it, or a skill about it, asks people."""
    queue: tuple[str, ...] = ()
    """The tasks that have something for it, in order, with what each waits for."""


def queues_of(gateways: Iterable[Gateway]) -> dict[str, tuple[str, ...]]:
    """Return the tasks that have something for robots, in order, by robot."""
    found: dict[str, tuple[str, ...]] = {}
    for each in facts.queues(gateway.status for gateway in gateways if not gateway.lost_ns):
        waits = " (waits)" if each.state == "ready" else " (later)" if each.state == "later" else ""
        found[each.robot] = (*found.get(each.robot, ()), f"{each.task}{waits}")
    return found


def missions(record: TaskRecord) -> dict[str, str]:
    """Return what robots do just now for a task, by robot: `task/subtask skill`, how far, and what it waits for."""
    if record.state.final:
        return {}
    found: dict[str, str] = {}
    for each in record.subtasks:
        if each.state in _BUSY:
            share = f" {min(1.0, max(0.0, each.progress)):.0%}" if each.progress else ""
            waits = f" {each.note}" if each.note.startswith("waits for ") else ""
            found |= dict.fromkeys(each.robots, f"{record.id}/{each.subtask.id} {each.subtask.skill}{share}{waits}")
    return found


def leases_of(gateways: Iterable[Gateway]) -> dict[str, Lease]:
    """Return who has taken robots over, by robot."""
    found: dict[str, Lease] = {}
    for gateway in gateways:
        for each in () if gateway.lost_ns else gateway.status.leases:
            if not each.ended and (each.robot not in found or found[each.robot].at_ns < each.at_ns):
                found[each.robot] = each
    return found


def questions_of(enquiries: Iterable[Enquiry]) -> dict[str, tuple[Enquiry, ...]]:
    """Return the questions that wait for an answer, by robot."""
    found: dict[str, list[Enquiry]] = {}
    for each in enquiries:
        if each.open:
            found.setdefault(each.robot, []).append(each)
    return {robot: tuple(asked) for robot, asked in found.items()}


def link(info: RobotInfo) -> str:
    """Return how it is linked: by its own session, or by a gateway's link."""
    return info.gateway or "direct"


def state_cell(robot: Robot) -> tuple[str, str]:
    """Return a robot's state with sign and style, the most urgent first."""
    info = robot.info
    if not info.online and not robot.maintenance:
        return f"✘ offline {safe(info.note, 80)}".rstrip(), "red"
    if robot.stopped:
        return f"■ {safe(robot.stopped, 80)}", "bold red"
    if robot.questions:
        return f"? asks: {safe(robot.questions[0].question, 80)}", "bold yellow"
    if info.failsafe:
        return f"✘ failsafe: {safe(info.failsafe, 80)}", "bold red"
    if robot.lease is not None:
        return f"⇅ {safe(robot.lease.text, 80)}", "magenta"
    if robot.maintenance:
        return f"◌ {safe(robot.maintenance, 80)}", "yellow"
    if told := (f"taken: {info.seized}" if info.seized else ", ".join((*info.warnings, *info.estimator))):
        return f"▲ {safe(told, 80)}", "yellow"
    words = " ".join(part for part in (f"holds {info.holding}" if info.holding else "", info.note) if part)
    return f"✔ {safe(words, 80) or 'online'}", "green"


def battery_cell(info: RobotInfo) -> tuple[str, str]:
    """Return the charge, with a sign where it is low."""
    if info.battery_percent is None:
        return "–", "dim"
    low = info.battery_percent < 20
    return f"{'▲' if low else ''}{info.battery_percent:.0f}%", "yellow" if low else ""


def place(pose: Pose | None) -> str:
    """Return a position in metres."""
    return "–" if pose is None else f"{pose.x:.1f} {pose.y:.1f} {pose.z:.1f}"


def robot_cells(robot: Robot) -> tuple[Cell, ...]:
    """Return a robot's row: name, kind with link, mode, battery, position, mission, state."""
    info = robot.info
    return (
        (safe(info.id, 63), "bold"),
        f"{safe(info.kind, 20)} {safe(link(info), 63)}",
        safe(f"{info.mode}{' armed' if info.armed else ''}".strip() or "–", 40),
        battery_cell(info),
        place(info.pose),
        safe(robot.mission or "–", 80),
        state_cell(robot),
    )


def searched(name: str, robot: Robot) -> str:
    """Return what a filter looks at."""
    info = robot.info
    return f"{name} {info.kind} {link(info)} {info.mode} {info.note} {robot.mission} {state_cell(robot)[0]}"


def troubles(robot: Robot) -> list[str]:
    """Return what keeps a robot from working, in sentences with what helps."""
    info, found = robot.info, list[str]()
    if not info.online:
        whom = f"{safe(info.gateway, 63)}'s link to it" if info.gateway else "its own session"
        found.append(f"nothing is heard of it → see that it is on, and {whom} (`swiftbot robots links list`)")
    if robot.maintenance:
        name = safe(info.id, 63)
        found.append(f"{safe(robot.maintenance, 200)} → `swiftbot robots maintain {name} --end` when it may work again")
    if robot.stopped:
        found.append("nothing moves it until it is let go → z or `:resume-robots`, when the way is clear")
    if info.failsafe:
        found.append(f"failsafe: {safe(info.failsafe, 200)} → commands are taken again when the vehicle ends it")
    if info.seized:
        found.append(f"not commanded: {safe(info.seized, 200)} → it is again when its pilot gives it back")
    if info.warnings:
        found.append(safe(", ".join(info.warnings), 200))
    if info.estimator:
        found.append(f"its position estimator does not know {safe(', '.join(info.estimator), 200)}")
    return found


def selected_text(robot: Robot) -> Text:
    """Return of the robot under the cursor what its row has no room for: its whole state and its mission."""
    state, style = state_cell(robot)
    mission = f" · {safe(robot.mission, 120)}" if robot.mission else " · no mission"
    if robot.questions and state.startswith("?"):
        mission = f" → A answers{mission}"
    return Text.assemble((safe(robot.info.id, 63), "bold"), " ", (state, style), mission)


def about(robot: Robot, width: int = 0) -> Text:
    """Return all that is known of a robot, in lines of labelled facts; what is longer than a line goes on below itself.

    Args:
        robot: which one.
        width: cells of a line; 0: however many it takes.
    """
    info = robot.info
    state, style = state_cell(robot)
    pose = info.pose
    heading = f", heading {pose.heading_deg:.0f}°" if pose is not None else ""
    charge, charge_style = battery_cell(info)
    facts: list[tuple[str, str, str]] = [
        ("state", state, style),
        ("kind", f"{safe(info.kind, 20)}{', flies' if info.flies else ''}", ""),
        ("link", f"by {safe(link(info), 63)}", ""),
        ("mode", f"{safe(info.mode or 'not told', 40)}{', armed' if info.armed else ''}", ""),
        ("battery", charge, charge_style),
        ("position", f"{place(pose)} m east, north, up{heading}" if pose is not None else "not told", ""),
        ("mission", safe(robot.mission or "none", 120), ""),
        ("queue", safe(", ".join(robot.queue) or "empty", 300), ""),
        ("holds", f"{safe(info.holding or 'nothing', 120)}{_ways_to_free(robot)}", ""),
        ("has", safe(", ".join(info.uses) or "not told", 200), ""),
        ("answers", safe(", ".join(info.verbs) or "not told", 300), ""),
    ]
    out = Text()
    for number, (name, value, how) in enumerate(facts):
        out.append(f"{name:<9}", "bold").append(f"{hanging(value, ' ' * 9, width)[9:]}\n", how)
        for each in () if number else troubles(robot):
            out.append(f"▲ {each}\n", "yellow")
    if info.mission_items:
        out.append(f"· item {info.mission_item} of {info.mission_items} of the mission on board\n", "dim")
    if info.note and info.online and not info.seized:
        out.append(f"… {safe(info.note, 300)}\n", "yellow")
    for each in robot.questions:
        choices = f" ({safe(' / '.join(each.choices), 120)})" if each.choices else ""
        out.append(f"? {safe(each.question, 300)}{choices}\n", "bold yellow")
        out.append(f"  `:answer {safe(each.id, 80)} TEXT` or the key of Answer; the first answer counts\n", "dim")
    return out


def _ways_to_free(robot: Robot) -> str:
    """Return how an idle robot gets rid of what it holds; empty where it cannot, or works."""
    if not robot.info.holding or robot.mission or "place" not in robot.info.verbs:
        return ""
    return " → `:put-down` puts it down here, `:bring-back` where it was picked up"


# --- the map -----------------------------------------------------------------------------------------------------


def spots(robots: Sequence[Robot], trails: Trails, *, selected: str = "") -> list[Spot]:
    """Return the robots that tell a position, with where they came from: the selected one whole, others in part."""
    most = shown_of(len(robots))
    found: list[Spot] = []
    for each in robots:
        name, pose = each.info.id, each.info.pose
        if pose is not None:
            found.append(
                Spot(
                    name=name,
                    x=pose.x,
                    y=pose.y,
                    online=each.info.online,
                    heading_deg=pose.heading_deg,
                    trail=trails.last(name, TRAIL if name == selected else most),
                )
            )
    return found


def areas(site: Site | None) -> list[Area]:
    """Return a site's obstacles, forbidden areas and one-way aisles."""
    return areas_of(site) if site is not None else []


def places(site: Site | None, closed: Collection[str] = ()) -> dict[str, tuple[float, float]]:
    """Return a site's places, by what a map calls them."""
    known = site.places.items() if site is not None else ()
    return {f"{name} closed" if name in closed else name: (each.x, each.y) for name, each in known}


class KnownRobots:
    """The robots of a store, followed by its changes."""

    def __init__(self) -> None:
        self._store: Store | None = None
        self._forget()

    def _forget(self) -> None:
        self._rows: dict[str, Robot] = {}
        self._seen_robots = self._seen_tasks = 0
        self._seen: tuple[int, ...] = (-1, -1, -1, -1)
        """Revisions of gateways, enquiries, stops and closures."""
        self._arrangement = -1
        self._of_task: dict[str, dict[str, str]] = {}
        """Task -> robot -> what it does for it."""
        self._doing: dict[str, dict[str, str]] = {}
        """Robot -> task -> what it does for it; the task that began last stands last."""
        self._leases: dict[str, Lease] = {}
        self._queues: dict[str, tuple[str, ...]] = {}
        self._questions: dict[str, tuple[Enquiry, ...]] = {}

    def of(self, store: Store) -> dict[str, Robot]:
        """Return the robots by name as they are now; one that is as it was is the same thing as before."""
        if store is not self._store:
            self._store = store
            self._forget()
        changes = store.robots.since(self._seen_robots)
        self._seen_robots = changes.revision
        stale = set(store.robots) if changes.whole else set(changes.changed)
        stale |= self._follow_tasks(store) | self._follow_around(store)
        rows, kept_out = self._rows, store.out_of_use("robot", time.time_ns())
        for name in stale:
            info = store.robots.get(name)
            if info is None:
                continue
            stop = store.stops.of(name)
            doing = self._doing.get(name)
            fresh = Robot(
                info=info,
                mission=next(reversed(doing.values())) if doing else "",
                stopped=stop.text if stop is not None else "",
                maintenance=kept_out.get(name, ""),
                lease=self._leases.get(name),
                questions=self._questions.get(name, ()),
                queue=self._queues.get(name, ()),
            )
            if rows.get(name) != fresh:
                rows[name] = fresh
        if self._arrangement != store.robots.arrangement:
            self._arrangement = store.robots.arrangement
            self._rows = {name: rows[name] for name in sorted(store.robots)}
        return self._rows

    def _follow_tasks(self, store: Store) -> set[str]:
        """Take over what tasks have robots do; robots that do something else by it."""
        changes = store.tasks.since(self._seen_tasks)
        self._seen_tasks = changes.revision
        gone = set(self._of_task).difference(store.tasks) if changes.whole else changes.gone
        oldest_first = changes.changed if changes.whole else reversed(changes.changed)
        stale: set[str] = set()
        for task in (*oldest_first, *gone):
            record = store.tasks.get(task)
            before, now = self._of_task.get(task, {}), missions(record) if record is not None else {}
            if now == before:
                continue
            for robot in before.keys() - now.keys():
                self._doing[robot].pop(task, None)
                if not self._doing[robot]:
                    del self._doing[robot]
            for robot, text in now.items():
                self._doing.setdefault(robot, {})[task] = text
            stale |= before.keys() | now.keys()
            if now:
                self._of_task[task] = now
            else:
                self._of_task.pop(task, None)
        return stale

    def _follow_around(self, store: Store) -> set[str]:
        """Take over leases, questions, stops and closures; robots that are concerned."""
        gateways, enquiries, *others = self._seen
        self._seen = store.revisions(("gateways", "enquiries", "stops", "closures"))
        stale: set[str] = set()
        if self._seen[0] != gateways:
            leases = leases_of(store.gateways.values())
            stale |= {robot for robot in leases.keys() | self._leases if leases.get(robot) != self._leases.get(robot)}
            self._leases = leases
            queues = queues_of(store.gateways.values())
            stale |= {robot for robot in queues.keys() | self._queues if queues.get(robot) != self._queues.get(robot)}
            self._queues = queues
        if self._seen[1] != enquiries:
            asked = questions_of(store.enquiries.values())
            stale |= {
                robot for robot in asked.keys() | self._questions if asked.get(robot) != self._questions.get(robot)
            }
            self._questions = asked
        if self._seen[2:] != tuple(others):
            stale.update(store.robots)
        return stale


class Ground(Widget):
    """The map; only lines that have changed are painted."""

    def __init__(self, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self.trails = Trails()
        self._site: Site | None = None
        self._closed_places: frozenset[str] = frozenset()
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
        self._closed_places = frozenset(view.store.out_of_use("place", time.time_ns()))
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
        known, boxes = places(self._site, self._closed_places), areas(self._site)
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
