"""After a cancel or a stop: where each robot stands, what it still holds, and what can be done about it. Pure.

`left` says it of one robot as it was heard last, `origin_of` finds where a robot picked up what it holds, `put_down`
and `bring_back` are the plans that get rid of it.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Literal

from msgspec import Struct

from appliance.model import Plan, Pose, RobotInfo, Site, Subtask, SubtaskRecord, SubtaskState, TaskRecord

NEAR_M = 10.0
"""A place further off than this is no help to find a robot."""
HERE = "here"
"""Where the skill `place` puts a thing down when it names no place."""

Do = Literal["put_down_here", "bring_it_back", "resume_robots", "retry", "resume"]
"""Operations that are offered, by the names of their functions."""


class Offer(Struct, frozen=True):
    """Something that can be done: an operation, and the robot or task that it is about."""

    do: Do
    on: str


class Left(Struct, frozen=True, kw_only=True):
    """A robot as it was heard last."""

    robot: str
    online: bool
    pose: Pose | None
    near: str
    """The nearest place of the site and how far it is; empty: none is near, or where the robot is is not known."""
    holding: str
    stopped: bool
    offers: tuple[Offer, ...] = ()

    @property
    def text(self) -> str:
        """In words, without the offers."""
        at = f"at {self.pose.x:.1f} {self.pose.y:.1f} {self.pose.z:.1f} m" if self.pose is not None else "somewhere"
        parts = [
            f"{self.robot} {'stands' if self.online else 'is offline, last heard'} {at}",
            f"({self.near})" if self.near else "",
            f"and holds the {self.holding}" if self.holding else "and holds nothing",
        ]
        return " ".join(filter(None, parts))


def robots_of(record: TaskRecord) -> tuple[str, ...]:
    """Return the robots that have begun something for a task, in the order of its plan."""
    return tuple(dict.fromkeys(robot for each in record.subtasks if each.attempts for robot in each.robots))


def unfinished(record: TaskRecord) -> bool:
    """Whether a task ended, or stands, before all of it was done."""
    return record.state in ("cancelled", "cancelling", "failed") or bool(record.paused)


def left(
    robot: RobotInfo, *, record: TaskRecord | None = None, site: Site | None = None, stopped: bool = False
) -> Left:
    """Return how a robot stands, and what can be done.

    Args:
        robot: as it was heard last.
        record: the task that it worked for.
        site: for the nearest place.
        stopped: whether a soft stop holds it.
    """
    offers: list[Offer] = []
    if stopped:
        offers.append(Offer("resume_robots", robot.id))
    elif robot.holding and "place" in robot.verbs:
        offers += [Offer("put_down_here", robot.id), Offer("bring_it_back", robot.id)]
    if record is not None and not stopped and not record.remembered:
        if record.state in ("cancelled", "failed"):
            offers.append(Offer("retry", record.id))
        elif record.paused:
            offers.append(Offer("resume", record.id))
    return Left(
        robot=robot.id,
        online=robot.online,
        pose=robot.pose,
        near=_near(robot.pose, site),
        holding=robot.holding,
        stopped=stopped,
        offers=tuple(offers),
    )


def lefts(
    robots: Mapping[str, RobotInfo],
    names: Iterable[str],
    *,
    record: TaskRecord | None = None,
    site: Site | None = None,
    stopped: bool = False,
) -> tuple[Left, ...]:
    """Return how several robots stand; those that are not known are left out."""
    return tuple(
        left(robots[name], record=record, site=site, stopped=stopped) for name in dict.fromkeys(names) if name in robots
    )


def _near(pose: Pose | None, site: Site | None) -> str:
    if pose is None or site is None or not site.places:
        return ""
    distance, name = min((math.hypot(each.x - pose.x, each.y - pose.y), name) for name, each in site.places.items())
    return f"{distance:.1f} m from {name}" if distance <= NEAR_M else ""


def origin_of(records: Iterable[TaskRecord], robot: str, thing: str) -> str:
    """Return where a robot picked up what it holds: a place, or `x, y` in metres; empty when no task tells.

    Args:
        records: tasks, the newest first.
        robot: its name.
        thing: what it holds.
    """
    for record in records:
        picks = [
            each
            for each in record.subtasks
            if each.subtask.skill == "pick"
            and robot in (each.bound_robot, each.subtask.robot)
            and each.state is SubtaskState.SUCCEEDED
            and _same(str(each.subtask.params.get("object", "")), thing)
        ]
        if picks:
            return _gone_to(record, picks[-1], robot) or _position(picks[-1])
    return ""


def _same(one: str, other: str) -> bool:
    """Whether two names may be of one thing: all words of one are in the other."""
    first, second = ({*name.lower().replace("_", " ").split()} - {"the", "a", "an"} for name in (one, other))
    return bool(first and second) and (first <= second or second <= first)


def _gone_to(record: TaskRecord, pick: SubtaskRecord, robot: str) -> str:
    """Return the place that the robot went to last before a subtask, by the plan; empty when it went nowhere."""
    by_id = {each.subtask.id: each for each in record.subtasks}
    before, asked = list(pick.subtask.after), set[str]()
    while before:
        name = before.pop(0)
        each = by_id.get(name)
        if each is None or name in asked:
            continue
        asked.add(name)
        if each.subtask.skill == "goto" and robot in (each.bound_robot, each.subtask.robot):
            return str(each.subtask.params.get("place", ""))
        before += each.subtask.after
    return ""


def _position(pick: SubtaskRecord) -> str:
    """Return where the robot told that it was when it had picked the thing up, as `x, y`."""
    pose = (pick.result or {}).get("pose")
    match pose:
        case {"x": int() | float() as x, "y": int() | float() as y}:
            return f"{x:.2f}, {y:.2f}" if math.isfinite(x) and math.isfinite(y) else ""
        case _:
            return ""


def put_down(robot: RobotInfo) -> Plan:
    """Return the plan that has a robot put down what it holds where it stands."""
    step = Subtask(id="s1", skill="place", robot=robot.id, params={"object": robot.holding, "at": HERE})
    return Plan(domain="manipulation", subtasks=(step,))


def bring_back(robot: RobotInfo, origin: str, site: Site | None) -> Plan:
    """Return the plan that has a robot go to a place, or `x, y`, and put down there what it holds."""
    at = origin if site is not None and site.find(origin) is not None else HERE
    return Plan(
        domain="manipulation",
        subtasks=(
            Subtask(id="s1", skill="goto", robot=robot.id, params={"place": origin}),
            Subtask(id="s2", skill="place", robot=robot.id, params={"object": robot.holding, "at": at}, after=("s1",)),
        ),
    )
