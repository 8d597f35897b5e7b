"""Which robots go to which charger, and which one makes room there. Pure.

The robot with the least charge goes first, to the nearest charger that is free; the others wait where they stand. When
none is free, a robot that has charged enough and stands there without a task leaves.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from msgspec import Struct

from appliance.model import Place, RobotInfo
from appliance.tasks.settings import BatteryConfig


class Seen(Struct, frozen=True, kw_only=True):
    """A robot as the fleet sees it."""

    info: RobotInfo
    idle: bool = True
    """It stands, no task has it, and tasks may command it."""
    at: str = ""
    """The charger that it stands at."""
    bound_for: str = ""
    """The charger that it goes to, or has reserved."""


class Trip(Struct, frozen=True, kw_only=True):
    """Where a robot is sent, and why in words."""

    robot: str
    place: str
    why: str
    charges: bool = True
    """Whether it goes to a charger; it makes room there otherwise."""


def decide(
    robots: Sequence[Seen],
    *,
    chargers: Mapping[str, tuple[Place, int]],
    others: Mapping[str, Place],
    battery: BatteryConfig,
) -> list[Trip]:
    """Return the trips that are to be made now.

    Args:
        robots: all that are known.
        chargers: those that are open, with how many robots each takes.
        others: places where a robot may stand that makes room.
        battery: the reserve, and the charge from which on a robot may leave.
    """
    taken = Counter(place for each in robots for place in {each.at, each.bound_for} - {""})
    low = [each for each in robots if _is_low(each, battery)]
    trips: list[Trip] = []
    waiting = 0
    for each in sorted(low, key=lambda each: (each.info.battery_percent or 0.0, each.info.id)):
        free = {name: place for name, (place, takes) in chargers.items() if taken[name] < takes}
        if not free:
            waiting += 1
            continue
        nearest = min(free, key=lambda name: (_distance(each.info, free[name]), name))
        taken[nearest] += 1
        why = f"has {each.info.battery_percent:.0f} % of its battery, below {battery.reserve_percent:g} %"
        trips.append(Trip(robot=each.info.id, place=nearest, why=why))
    # One robot is enough for each that waits; those that are on their way out count already.
    waiting -= sum(bool(each.at) and not each.idle and _is_full(each.info, battery) for each in robots)
    full = [each for each in robots if each.at in chargers and each.idle and _is_full(each.info, battery)]
    for each in sorted(full, key=lambda each: (-(each.info.battery_percent or 0.0), each.info.id))[: max(0, waiting)]:
        if others:
            away = min(others, key=lambda name: (_distance(each.info, others[name]), name))
            why = f"has {each.info.battery_percent:.0f} % of its battery, and another waits for {each.at}"
            trips.append(Trip(robot=each.info.id, place=away, why=why, charges=False))
    return trips


def _is_low(robot: Seen, battery: BatteryConfig) -> bool:
    info = robot.info
    return (
        robot.idle
        and not robot.at
        and not robot.bound_for
        and not info.flies
        and "goto" in info.verbs
        and info.pose is not None
        and info.battery_percent is not None
        and info.battery_percent < battery.reserve_percent
    )


def _is_full(info: RobotInfo, battery: BatteryConfig) -> bool:
    return info.battery_percent is not None and info.battery_percent >= battery.charged_percent


def _distance(info: RobotInfo, place: Place) -> float:
    return math.dist((info.pose.x, info.pose.y), (place.x, place.y)) if info.pose is not None else math.inf
