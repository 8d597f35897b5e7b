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
from msgspec.structs import replace

from appliance.model import Place, Plan, Site, Subtask, Tier, oversize
from appliance.model.geo import MAX_EXTENT_M, inside, off_height, off_site, to_site
from appliance.robots.mavlink.dialect import constant, label

MAX_PICTURES = 10
MAX_LAPS = 20
MAX_HOLD_S = 3600.0
MAX_PATH = 480
"""Characters of one path's text, within what a plan's parameter may have; a longer way is several subtasks."""
DATUM_M = 1.0
"""A point so little under the ground is on it: heights of the map and of satellites differ by as much."""

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
_X, _Y, _Z = (constant(f"MAV_MISSION_INVALID_{name}") for name in ("PARAM5_X", "PARAM6_Y", "PARAM7"))
"""Of latitude, longitude and altitude: MAVLink's x is the latitude, which is the site's y."""
_UNSET = 2**31 - 1
"""A latitude or longitude that is not given, in MISSION_ITEM_INT."""


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
        self.site = site
        self.subtasks: list[Subtask] = []
        self.here = ""
        """The place flown to last."""
        self.speed: float | None = None
        self._way: list[str] = []

    def add(self, skill: str, **params: object) -> None:
        """Add a subtask."""
        self._go()
        self._append(skill, params)

    def hold(self, seconds: float) -> None:
        """Add a stay; 0: until the next subtask begins."""
        self.add("hold", **({"duration_s": seconds} if seconds > 0 else {}))

    def pass_by(self, place: str) -> None:
        """Add a waypoint; several in a row are one way."""
        if self.speed is not None:
            self._go()
        self._way.append(place)
        self.here = place

    def _go(self) -> None:
        way, self._way = self._way, []
        while way:
            count = _fitting(way)
            leg, way = way[:count], way[count:]
            if len(leg) > 1:
                self._append("follow_path", {"path": "; ".join(leg)})
            else:
                speed = {} if self.speed is None else {"speed_mps": self.speed}
                self._append("goto", {"place": leg[0], **speed})

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
        z = self.height(number, item)
        x, y, _ = to_site(self.site, item.x / 1e7, item.y / 1e7, 0.0)
        # What latitude and longitude cannot be first: 91 degrees north is no point of any map.
        if abs(item.x) > 90 * 10**7 or max(abs(x), abs(y)) > MAX_EXTENT_M:
            which = _X if abs(item.x) > 90 * 10**7 or abs(y) > MAX_EXTENT_M else _Y
            raise UnfitItem(which, f"{what}: more than {MAX_EXTENT_M / 1e3:g} km from the site")
        spot = Place(x=round(x, 1), y=round(y, 1), z=z)  # satellites are no better
        if (off := off_site(self.site, spot)) is not None:
            which = {"x": _Y, "y": _X, "z": _Z}[off.axis]
            raise UnfitItem(which, f"{what}: ({spot.x:g}, {spot.y:g}) {off.why}")
        for box in self.site.forbidden:
            if inside(box, spot.x, spot.y):
                raise UnfitItem(DENIED, f"{what}: it lies in {box.name}, which is forbidden")
        for box in self.site.obstacles:
            if inside(box, spot.x, spot.y):
                raise UnfitItem(DENIED, f"{what}: it lies inside {box.name}, an obstacle")
        return f"({spot.x:.1f}, {spot.y:.1f}, {spot.z:.1f})"

    def check_circle(self, number: int, item: Item, radius_m: float) -> None:
        """Raise UnfitItem for a circle around an item's position that leaves the site."""
        x, y, _ = to_site(self.site, item.x / 1e7, item.y / 1e7, 0.0)
        for east, north in ((radius_m, 0.0), (0.0, radius_m), (-radius_m, 0.0), (0.0, -radius_m)):
            # To decimetres, as the plan says its middle.
            edge = Place(x=round(x, 1) + east, y=round(y, 1) + north)
            if (off := off_site(self.site, edge)) is not None:
                raise UnfitItem(_FIRST_PARAM + 2, f"item {number}: a circle of {radius_m:g} m {off.why}")

    def height(self, number: int, item: Item, low: float = 0.0) -> float:
        """Return an item's height over the site's ground, metres, at least `low`; UnfitItem when there is none."""
        if item.frame not in _GLOBAL | _RELATIVE:
            name = label("MAV_FRAME", item.frame).removeprefix("MAV_FRAME_")
            raise UnfitItem(UNSUPPORTED_FRAME, f"item {number}: frame {name} is not supported, use GLOBAL_RELATIVE_ALT")
        if item.z is None:
            raise UnfitItem(_Z, f"item {number}: no altitude")
        z = round(item.z if item.frame in _RELATIVE else item.z - self.site.altitude_m, 1)
        if -DATUM_M <= z < 0:
            z = 0.0
        if why := off_height(self.site, z):
            raise UnfitItem(_Z, f"item {number}: it {why}")
        if z < low:
            raise UnfitItem(_Z, f"item {number}: {z:g} m is too low, use at least {low:g} m")
        return z


def _fitting(way: Sequence[str]) -> int:
    """Return how many places of a way fit one subtask's text, at least one."""
    size = count = 0
    for place in way:
        size += len(place) + 2
        if count and size > MAX_PATH:
            break
        count += 1
    return count


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
        maker.add("takeoff", altitude_m=maker.height(number, item, low=0.5))
    elif item.command == _LAND:
        if (item.x or item.y) and _UNSET not in (item.x, item.y):
            # NaN is the ground, wherever that is.
            ground = item if item.z is not None else replace(item, frame=min(_RELATIVE), z=0.0)
            maker.pass_by(maker.place(number, ground))
        maker.add("land")
    elif item.command == _RETURN:
        maker.add("return_home")
    elif item.command in (_DELAY, _WAIT):
        maker.hold(_number(number, item, 1, low=0.0, high=MAX_HOLD_S))
    elif item.command == _SPEED:
        maker.speed = _number(number, item, 2, low=0.1, high=maker.site.speed_limit_mps)
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
        radius = max(0.5, abs(_number(number, item, 3, low=-100.0, high=100.0, usual=2.0)) or 2.0)
        maker.check_circle(number, item, radius)
        maker.here = place
        maker.add("orbit", target=place, laps=laps, radius_m=radius)
        return
    maker.pass_by(place)
    hold_s = 0.0
    if item.command != _LOITER:
        hold_s = _number(number, item, 1, low=0.0, high=MAX_HOLD_S, usual=0.0)
    if item.command != _WAYPOINT or hold_s > 0:
        maker.hold(hold_s)


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
