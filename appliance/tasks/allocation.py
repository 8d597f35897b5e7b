"""What a task would cost each robot that can do it: way, time, work that waits, battery. Pure.

Ways and times are those of `estimate`. The charge that a robot needs is reckoned from both: a full battery lasts
so many metres, and so many seconds, and the shares of both add up. Of work that waits the time is in it, the way is
not. A robot that does not tell its charge is not judged by it; of one that does not say where it is, only the time is
known.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import msgspec
from msgspec import Struct

from appliance.estimate import estimate
from appliance.floor.decide import PLACE_M
from appliance.model import Plan, RobotInfo, Site, Subtask
from appliance.tasks.settings import BatteryConfig

MOST_TOLD = 4
"""Robots of which a choice says what the task would have cost them."""
USUAL_STATION = "charger"
"""Where a robot docks when the plan names no station."""
UNKNOWN_S = 3.0
"""Expected of a run of which nothing is known."""
Expected = Callable[[str, str], float | None]
"""Skill, robot -> seconds that a run of it is expected to take; None when nothing is known."""


class Cost(Struct, frozen=True, kw_only=True):
    """What subtasks would cost one robot."""

    robot: str
    queue_s: float = 0.0
    """Work of other tasks that it has first."""
    takes_s: float = 0.0
    way_m: float = 0.0
    ends_percent: float | None = None
    """Charge at the end; None: not known."""
    short: str = ""
    """Why it must not be taken: it would end below its reserve. In words; empty when it would not."""
    charging: str = ""
    """Why it is not chosen: it stands at a charger, and has not charged enough. In words; empty when that is not so."""
    holding: str = ""
    """What it carries now."""
    unsuited: bool = False
    """It carries something and what it has to do begins with empty hands, or the other way round."""

    @property
    def ends_s(self) -> float:
        """When it would be done, seconds from now."""
        return self.queue_s + self.takes_s

    def __str__(self) -> str:
        """Return it in words."""
        if self.short:
            return self.short
        told = [f"{self.robot} {self.ends_s:.0f} s"]
        if self.way_m:
            told.append(f"way {self.way_m:.0f} m")
        if self.queue_s:
            told.append(f"has {self.queue_s:.0f} s to do first")
        if self.ends_percent is not None:
            told.append(f"ends with {self.ends_percent:.0f} %")
        if self.holding:
            told.append(f"holds {self.holding}")
        return ", ".join(told)


def cost(
    robot: RobotInfo,
    subtasks: Sequence[Subtask],
    *,
    queue_s: float = 0.0,
    site: Site,
    expected: Expected,
    battery: BatteryConfig,
) -> Cost:
    """Return what subtasks would cost a robot.

    Args:
        robot: as it was heard last.
        subtasks: what it would do, whichever robot they name.
        queue_s: how long other tasks still have it.
        site: the map.
        expected: how long runs take.
        battery: the reserve, and how far and how long a full battery lasts.
    """
    mine = tuple(msgspec.structs.replace(each, robot=robot.id) for each in subtasks)
    measured = {
        (skill, robot.id): seconds
        for skill in {each.skill for each in mine}
        if (seconds := expected(skill, robot.id)) is not None
    }
    found = estimate(Plan(domain="", subtasks=mine), site=site, robots={robot.id: robot}, measured=measured)
    takes_s = sum(seconds_of(each.takes_s) for each in found.steps)
    way_m = sum(each.length_m for each in found.steps)
    ends = None
    if robot.battery_percent is not None:
        ends = robot.battery_percent - used_percent(robot, way_m, queue_s + takes_s, battery)
    charges = any(goes_to_charger(each, site) for each in mine)
    short = ""
    if ends is not None and battery.reserve_percent and ends < battery.reserve_percent and not charges:
        left = max(0.0, math.floor(10 * ends) / 10)
        reserve = f"{battery.reserve_percent:g} %"
        short = f"{robot.id} would end with {left:g} % of its battery, below the reserve of {reserve}"
    at = "" if charges else _charges_at(robot, site, battery)
    charging = f"{robot.id} charges at {at}, until it has {battery.charged_percent:g} %" if at else ""
    return Cost(
        robot=robot.id, queue_s=queue_s, takes_s=takes_s, way_m=way_m, ends_percent=ends, short=short,
        charging=charging, holding=robot.holding, unsuited=bool(robot.holding) != _puts(mine),
    )  # fmt: skip


def used_percent(robot: RobotInfo, way_m: float, seconds: float, battery: BatteryConfig) -> float:
    """Return the charge that a way and a time use up, % of a full battery.

    Args:
        robot: its own range counts before the configured one; one that flies lasts shorter.
        way_m: metres.
        seconds: the whole time, standing and moving.
        battery: how far and how long a full battery lasts.
    """
    told = robot.limits.range_m if robot.limits is not None else None
    lasts_s = battery.flies_s if robot.flies else battery.lasts_s
    return 100.0 * (way_m / (told or battery.range_m) + seconds / lasts_s)


def best_first(costs: Sequence[Cost], *, last: Callable[[str], tuple[bool, bool]]) -> list[Cost]:
    """Order the robots that may be taken, best first: fit hands, the earliest end, the most charge left, the name.

    Args:
        costs: of the robots that can do it.
        last: what counts before all of that; smaller comes first.
    """
    free = [each for each in costs if not each.short and not each.charging]
    return sorted(
        free,
        key=lambda each: (
            last(each.robot), each.unsuited, round(each.ends_s), -(each.ends_percent or 0.0), each.robot
        ),
    )  # fmt: skip


def choose(
    costs: Sequence[Cost], behind: Mapping[str, tuple[bool, bool]], hindered: Mapping[str, str]
) -> tuple[list[str], str]:
    """Return the robots that may be taken, best first, and why; or none and the reason for the wait.

    Args:
        costs: of the robots that can do it.
        behind: whether a robot has something else to do in the task, and whether it keeps failing at this one.
        hindered: robots that tasks may not command just now, with the reason.
    """
    order = best_first(costs, last=lambda robot: behind[robot])
    short = sorted(each.short or each.charging for each in costs if each.short or each.charging)
    if not order:
        return [], f"waits for a robot: {'; '.join(short)}"
    told = [f"took {order[0]}"]
    told += [f"not {each}{', keeps failing at it' if behind[each.robot][1] else ''}" for each in order[1:MOST_TOLD]]
    told += [*short, *(f"{name} is {reason}" for name, reason in sorted(hindered.items()))]
    return [each.robot for each in order], "; ".join(told)


def _charges_at(robot: RobotInfo, site: Site, battery: BatteryConfig) -> str:
    """Return the charger at which a robot has to stay; "" when it need not."""
    pose, percent = robot.pose, robot.battery_percent
    if not battery.auto_charge or pose is None or percent is None or percent >= battery.charged_percent:
        return ""
    near = (name for name, place in site.chargers.items() if math.dist((place.x, place.y), (pose.x, pose.y)) <= PLACE_M)
    return next(near, "")


def seconds_of(known: float | None) -> float:
    """Return how long a run takes of which so much is known."""
    return UNKNOWN_S if known is None else known


def _puts(subtasks: Sequence[Subtask]) -> bool:
    """Whether subtasks put down or hand over what they have not picked up themselves."""
    skills = {each.skill for each in subtasks}
    return bool(skills & {"place", "give"}) and "pick" not in skills


def goes_to_charger(subtask: Subtask, site: Site) -> bool:
    """Whether a subtask takes its robot to a charger."""
    docks = subtask.skill == "dock"
    named = subtask.params.get("station", USUAL_STATION) if docks else subtask.params.get("place", "")
    return site.find(str(named)) in site.chargers.values()
