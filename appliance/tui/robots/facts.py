"""Robots as rows, sentences and spots of the map. Pure."""

from collections.abc import Iterable, Sequence

from msgspec import Struct
from rich.text import Text

from appliance.model import (
    Enquiry,
    Lease,
    Pose,
    RobotInfo,
    Site,
    SubtaskState,
    TaskRecord,
)
from appliance.tui.drawing import Cell, hanging
from appliance.tui.robots.map import Area, Spot
from appliance.tui.robots.trails import TRAIL, Trails, shown_of
from appliance.tui.safe import safe
from appliance.tui.store import Gateway

_BUSY = (SubtaskState.DISPATCHED, SubtaskState.RUNNING)


class Robot(Struct, frozen=True, kw_only=True):
    """A robot with all that is known around it."""

    info: RobotInfo
    mission: str = ""
    """`task/subtask skill` of what it does, empty for nothing."""
    stopped: str = ""
    """Why it is given no commands, in words."""
    lease: Lease | None = None
    """Who has taken it over."""
    questions: tuple[Enquiry, ...] = ()
    """What it, or a skill about it, asks people."""


def missions(record: TaskRecord) -> dict[str, str]:
    """Return what robots do just now for a task, by robot: `task/subtask skill` and how far it is."""
    if record.state.final:
        return {}
    found: dict[str, str] = {}
    for each in record.subtasks:
        robot = each.bound_robot or each.subtask.robot
        if robot and each.state in _BUSY:
            share = f" {min(1.0, max(0.0, each.progress)):.0%}" if each.progress else ""
            found[robot] = f"{record.id}/{each.subtask.id} {each.subtask.skill}{share}"
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
    return info.gateway or "itself"


def state_cell(robot: Robot) -> tuple[str, str]:
    """Return a robot's state with sign and style, the most urgent first."""
    info = robot.info
    if not info.online:
        return f"✘ offline {safe(info.note, 80)}".rstrip(), "red"
    if robot.stopped:
        return f"■ {safe(robot.stopped, 80)}", "bold red"
    if robot.questions:
        return f"? asks: {safe(robot.questions[0].question, 80)}", "bold yellow"
    if info.failsafe:
        return f"✘ failsafe: {safe(info.failsafe, 80)}", "bold red"
    if robot.lease is not None:
        return f"⇅ {safe(robot.lease.text, 80)}", "magenta"
    if info.seized:
        return f"▲ taken: {safe(info.seized, 80)}", "yellow"
    if info.warnings or info.estimator:
        return f"▲ {safe(', '.join((*info.warnings, *info.estimator)), 80)}", "yellow"
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
    """Return a site's obstacles and forbidden areas."""
    if site is None:
        return []
    return [Area(x=each.x, y=each.y) for each in site.obstacles] + [
        Area(x=each.x, y=each.y, forbidden=True) for each in site.forbidden
    ]


def places(site: Site | None) -> dict[str, tuple[float, float]]:
    """Return a site's places."""
    return {name: (each.x, each.y) for name, each in site.places.items()} if site is not None else {}
