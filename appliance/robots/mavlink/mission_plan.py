"""A MAVLink mission as a plan of the appliance's skills: each item by what it means, none by a model. Pure.

    NAV_WAYPOINT                         goto, or follow_path for several in a row; param1 > 0: and hold so long
    NAV_TAKEOFF, NAV_LAND, NAV_RETURN…   takeoff, land (goto first, where a place is given), return_home
    NAV_LOITER_UNLIM, NAV_LOITER_TIME    goto and hold
    NAV_LOITER_TURNS                     orbit: param1 laps, param3 radius
    NAV_DELAY, CONDITION_DELAY           hold
    DO_CHANGE_SPEED                      speed of the movements after it
    IMAGE_START_CAPTURE                  photograph: param3 pictures, of the place flown to last

Subtasks follow one another in the order of the items. What an item asks and no skill does is refused with the number of
MAVLink's MAV_MISSION_RESULT and a sentence, before anything is flown. Source: MAVLink guide, "Mission Protocol",
"MAV_CMD".
"""

import math
from collections.abc import Sequence

from msgspec import Struct

from appliance.model import Plan, Site, Subtask, Tier, oversize
from appliance.model.geo import MAX_EXTENT_M, inside, to_site
from appliance.robots.mavlink.dialect import constant, label

MAX_PICTURES = 10
MAX_LAPS = 20
MAX_HOLD_S = 3600.0

_WAYPOINT, _TAKEOFF, _LAND, _RETURN = (
    constant(f"MAV_CMD_NAV_{name}") for name in ("WAYPOINT", "TAKEOFF", "LAND", "RETURN_TO_LAUNCH")
)
_LOITER, _LOITER_TURNS, _LOITER_TIME, _DELAY = (
    constant(f"MAV_CMD_NAV_{name}") for name in ("LOITER_UNLIM", "LOITER_TURNS", "LOITER_TIME", "DELAY")
)
_WAIT, _SPEED, _PICTURE = (
    constant(f"MAV_CMD_{name}") for name in ("CONDITION_DELAY", "DO_CHANGE_SPEED", "IMAGE_START_CAPTURE")
)
_SOMEWHERE = frozenset((_WAYPOINT, _LOITER, _LOITER_TURNS, _LOITER_TIME))
_GLOBAL = frozenset(constant(f"MAV_FRAME_{name}") for name in ("GLOBAL", "GLOBAL_INT"))
_RELATIVE = frozenset(constant(f"MAV_FRAME_{name}") for name in ("GLOBAL_RELATIVE_ALT", "GLOBAL_RELATIVE_ALT_INT"))

UNSUPPORTED_FRAME = constant("MAV_MISSION_UNSUPPORTED_FRAME")
UNSUPPORTED = constant("MAV_MISSION_UNSUPPORTED")
INVALID = constant("MAV_MISSION_INVALID")
DENIED = constant("MAV_MISSION_DENIED")
NO_SPACE = constant("MAV_MISSION_NO_SPACE")
_FIRST_PARAM = constant("MAV_MISSION_INVALID_PARAM1")
"""Of param1; those of the other parameters follow."""


class Item(Struct, frozen=True, kw_only=True):
    """One mission item as it came. `params` are param1 to param4, None for NaN; x and y are degrees times 1e7."""

    command: int
    frame: int
    params: tuple[float | None, float | None, float | None, float | None] = (None, None, None, None)
    x: int = 0
    y: int = 0
    z: float | None = None
    current: int = 0
    autocontinue: int = 1


class UnfitItem(Exception):  # noqa: N818 - what it says
    """A mission cannot be done: `result` is a MAV_MISSION_RESULT."""

    def __init__(self, result: int, message: str) -> None:
        super().__init__(message)
        self.result = result


class _Maker:
    """Collects subtasks, each after the one before."""

    def __init__(self, robot: str, site: Site) -> None:
        self._robot = robot
        self._site = site
        self.subtasks: list[Subtask] = []
        self.here = ""
        """The place flown to last."""
        self.speed: float | None = None
        self._way: list[str] = []

    def add(self, skill: str, **params: object) -> None:
        """Add a subtask."""
        self._go()
        self._append(skill, params)

    def pass_by(self, place: str) -> None:
        """Add a waypoint; several in a row are one way."""
        if self.speed is not None:
            self._go()
        self._way.append(place)
        self.here = place

    def _go(self) -> None:
        way, self._way = self._way, []
        if len(way) > 1:
            self._append("follow_path", {"path": "; ".join(way)})
        elif way:
            speed = {} if self.speed is None else {"speed_mps": self.speed}
            self._append("goto", {"place": way[0], **speed})

    def _append(self, skill: str, params: dict[str, object]) -> None:
        after = (self.subtasks[-1].id,) if self.subtasks else ()
        name = f"m{len(self.subtasks) + 1}"
        self.subtasks.append(Subtask(id=name, skill=skill, robot=self._robot, params=params, after=after))

    def done(self) -> tuple[Subtask, ...]:
        """Return all."""
        self._go()
        return tuple(self.subtasks)

    def place(self, number: int, item: Item) -> str:
        """Return an item's position as places are written; UnfitItem when it is none a robot may be sent to."""
        what = f"item {number}"
        if item.frame not in _GLOBAL | _RELATIVE:
            name = label("MAV_FRAME", item.frame).removeprefix("MAV_FRAME_")
            raise UnfitItem(UNSUPPORTED_FRAME, f"{what}: frame {name} is not supported, use GLOBAL_RELATIVE_ALT")
        if item.z is None:
            raise UnfitItem(_FIRST_PARAM + 6, f"{what}: no altitude")
        x, y, z = to_site(self._site, item.x / 1e7, item.y / 1e7, item.z)
        if item.frame in _RELATIVE:
            z = item.z
        if abs(item.x) > 90 * 10**7 or max(abs(x), abs(y)) > MAX_EXTENT_M:
            raise UnfitItem(_FIRST_PARAM + 4, f"{what}: more than {MAX_EXTENT_M / 1e3:g} km from the site")
        if z > self._site.altitude_limit_m:
            raise UnfitItem(
                _FIRST_PARAM + 6, f"{what}: {z:g} m is above the site's limit of {self._site.altitude_limit_m:g} m"
            )
        for box in self._site.forbidden:
            if inside(box, x, y):
                raise UnfitItem(DENIED, f"{what}: it lies in {box.name}, which is forbidden")
        return f"({x:.1f}, {y:.1f}, {max(0.0, z):.1f})"  # satellites are no better


def plan_of(items: Sequence[Item], *, robot: str, site: Site, first: int = 0, last: int | None = None) -> Plan:
    """Return the plan that a mission means.

    Args:
        items: in order.
        robot: the vehicle that is to do it.
        site: where it is.
        first: the item to begin with, from 0.
        last: the last one to do; None: to the end.

    Raises:
        UnfitItem: it cannot be done, and why; the first item that cannot be is named.
    """
    if not items:
        raise UnfitItem(INVALID, "the mission is empty")
    last = len(items) - 1 if last is None else last
    if not 0 <= first <= last < len(items):
        raise UnfitItem(INVALID, f"items {first} to {last} of {len(items)} are none")
    maker = _Maker(robot, site)
    for number in range(first, last + 1):
        _take(maker, number, items[number])
    subtasks = maker.done()
    if not subtasks:
        raise UnfitItem(INVALID, "the mission asks for nothing")
    if problem := oversize(len(subtasks)):
        raise UnfitItem(NO_SPACE, f"{problem}: split the mission")
    return Plan(domain="navigation", subtasks=subtasks, tier=Tier.RULES, confidence=1.0)


def _take(maker: _Maker, number: int, item: Item) -> None:
    """Add what one item asks for."""
    if item.command in _SOMEWHERE:
        _go(maker, number, item)
    elif item.command == _TAKEOFF:
        altitude = _number(number, item, 7, low=0.5, high=1000.0)
        maker.add("takeoff", altitude_m=round(altitude, 2))
    elif item.command == _LAND:
        if item.x or item.y:
            maker.pass_by(maker.place(number, item))
        maker.add("land")
    elif item.command == _RETURN:
        maker.add("return_home")
    elif item.command in (_DELAY, _WAIT):
        maker.add("hold", duration_s=_number(number, item, 1, low=0.0, high=MAX_HOLD_S))
    elif item.command == _SPEED:
        maker.speed = _number(number, item, 2, low=0.1, high=100.0)
    elif item.command == _PICTURE:
        if not maker.here:
            raise UnfitItem(UNSUPPORTED, f"item {number}: a picture needs a waypoint before it")
        count = _number(number, item, 3, low=0.0, high=MAX_PICTURES, usual=1.0)
        maker.add("photograph", target=maker.here, count=max(1, round(count)))
    else:
        name = label("MAV_CMD", item.command).removeprefix("MAV_CMD_")
        raise UnfitItem(UNSUPPORTED, f"item {number}: {name} is not supported")


def _go(maker: _Maker, number: int, item: Item) -> None:
    place = maker.place(number, item)
    if item.command == _LOITER_TURNS:
        laps = max(1, round(_number(number, item, 1, low=0.0, high=MAX_LAPS, usual=1.0)))
        radius = abs(_number(number, item, 3, low=-100.0, high=100.0, usual=2.0)) or 2.0
        maker.here = place
        maker.add("orbit", target=place, laps=laps, radius_m=max(0.5, radius))
        return
    maker.pass_by(place)
    hold_s = 0.0
    if item.command != _LOITER:
        hold_s = _number(number, item, 1, low=0.0, high=MAX_HOLD_S, usual=0.0)
    if item.command != _WAYPOINT or hold_s > 0:
        maker.add("hold", **({"duration_s": hold_s} if hold_s > 0 else {}))


def _number(number: int, item: Item, place: int, *, low: float, high: float, usual: float | None = None) -> float:
    """Return a parameter (7 is the altitude) within bounds; NaN is what is usual, if anything is."""
    value = item.z if place == 7 else item.params[place - 1]
    if value is None:
        value = usual
    if value is None or not math.isfinite(value) or not low <= value <= high:
        raise UnfitItem(
            _FIRST_PARAM + place - 1,
            f"item {number}: param{place} is {'missing' if value is None else f'{value:g}'}, use {low:g} to {high:g}",
        )
    return value
