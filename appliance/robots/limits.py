"""What may be asked of a robot: limits of configuration, robot and site.

They are checked before an order is sent, and those of the site once more where a gateway carries it out. The site's
file is the safety policy: its fence (which no robot leaves), forbidden areas (which none enters), obstacles (which bind
robots on the ground), altitude and speed limits. A command that breaks it is refused with the reason before anything
moves, whatever plan, operator or handler asked for it.

A MAVLink vehicle is held to its site last, in the gateway that commands it (`check_way` and the others). A robot that
speaks Zenoh commands itself, and nobody knows whether it looks at anything: so the gateway that sends it an order on
behalf of a task or of an operator holds the order to the site, and to what the robot said of itself when it registered.
Limits that the configuration gives to robots (`[safety] limits`) hold for both kinds. What is above a bound is refused
with the reason; speeds and take-off heights that nobody asked for, a skill's usual ones, are lowered to it. `Orders`
puts the roster in; the rest is pure.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any

import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import SwiftbotError, from_code
from appliance.model import Box, Pose, RobotCommand, RobotInfo, Site
from appliance.model.site import GRAZE_M, MAX_EXTENT_M, blocked_leg, core, crosses, inside, rings
from appliance.robots.verbs import (
    MAX_WAYPOINTS,
    GotoArgs,
    MissionArgs,
    OrbitArgs,
    RobotFailure,
    TakeoffArgs,
    VelocityArgs,
    Waypoint,
    args_of,
    in_range,
    parse_args,
)

# --- limits of the site: pure ----------------------------------------------------------------------------------------

_SOFT_M = 1.0
"""How far a robot on its way may be in a forbidden area: what GPS errs and braking takes."""
_CLOSE_S = 0.55
"""Two positions told within so long are joined by a straight line: those of 2 Hz with what their times vary, or of 5 Hz
with one lost."""


def check_way(site: Site, start: Pose, goto: GotoArgs, *, flies: bool) -> tuple[Waypoint, ...]:
    """Return the waypoints of an allowed way; RobotFailure with the reason otherwise."""
    check_points(site, start, goto.waypoints, flies=flies)
    check_speed(site, goto.speed_mps)
    return goto.waypoints


def check_mission(site: Site, start: Pose | None, mission: MissionArgs, *, flies: bool) -> tuple[Waypoint, ...]:
    """Return the waypoints of an allowed mission; RobotFailure with the reason otherwise.

    `start` None: it is not known yet at which waypoint it is begun, so the legs are left to `check_points`.
    """
    points = tuple(Waypoint(step.x, step.y, step.z) for step in mission.steps)
    for number, step in enumerate(mission.steps, start=1):
        if not (math.isfinite(step.hold_s) and 0.0 <= step.hold_s <= 3600.0):
            raise RobotFailure("payload", f"mission: step {number} stays {step.hold_s:g} s, 0 to 3600 are possible")
    check_points(site, start, points, flies=flies, verb="mission")
    check_speed(site, mission.speed_mps, verb="mission")
    return points


def check_orbit(site: Site, start: Pose | None, orbit: OrbitArgs, *, flies: bool) -> None:
    """Raise RobotFailure unless the circle, and the way to it, are allowed.

    `start` None: it is not known where the robot goes from, so the circle alone is looked at.
    """
    radius = abs(orbit.radius_m)
    if not (math.isfinite(radius) and 1.0 <= radius <= 500.0):
        raise RobotFailure("payload", f"orbit: a radius of {orbit.radius_m:g} m, 1 to 500 are possible")
    if not (math.isfinite(orbit.laps) and 0.0 < orbit.laps <= 100.0):
        raise RobotFailure("payload", f"orbit: {orbit.laps:g} laps, up to 100 are possible")
    # Fence and altitude hold for the whole circle if they hold for the four points that are farthest out.
    ends = [(radius, 0.0), (0.0, radius), (-radius, 0.0), (0.0, -radius)]
    farthest = [Waypoint(orbit.x + x, orbit.y + y, orbit.z) for x, y in ends]
    check_points(site, None, farthest, flies=flies, verb="orbit")
    for box in _closed(site, flies=flies):
        if rings(box, (orbit.x, orbit.y), radius):
            raise RobotFailure("refused", f"the circle goes through {box.name}", remedy="choose another radius")
    if start is not None:
        angle = math.atan2(start.y - orbit.y, start.x - orbit.x)
        first = Waypoint(orbit.x + radius * math.cos(angle), orbit.y + radius * math.sin(angle), orbit.z)
        check_points(site, start, (first,), flies=flies, verb="orbit")
    check_speed(site, orbit.speed_mps, verb="orbit")


def _closed(site: Site, *, flies: bool) -> tuple[Box, ...]:
    return site.forbidden if flies else (*site.forbidden, *site.obstacles)


def check_points(
    site: Site, start: Pose | None, points: Sequence[Waypoint], *, flies: bool, verb: str = "goto", behind: int = 0
) -> None:
    """Raise RobotFailure unless every point, and every leg to them, is allowed.

    Args:
        site: whose fence, areas and limits hold.
        start: where the robot is, and the first leg begins; None: the points alone are looked at.
        points: the way.
        flies: whether it goes over obstacles.
        verb: what it does, for messages.
        behind: how many waypoints came before these, for messages.
    """
    if not 1 <= len(points) <= MAX_WAYPOINTS:
        raise RobotFailure("payload", f"{verb}: {len(points)} waypoints, 1 to {MAX_WAYPOINTS} are possible")
    for number, point in enumerate(points, start=behind + 1):
        for value in (point.x, point.y, point.z or 0.0):
            if not math.isfinite(value) or abs(value) > MAX_EXTENT_M:
                raise RobotFailure(
                    "payload", f"{verb}: waypoint {number} is not within {MAX_EXTENT_M:g} m of the origin"
                )
        if (point.z or 0.0) > site.altitude_limit_m:
            raise RobotFailure(
                "refused",
                f"waypoint {number} is {point.z:g} m up, the site allows {site.altitude_limit_m:g} m",
                remedy="choose a lower altitude",
            )
        # The fence has no holes, so what leads from one point inside to another stays inside.
        if site.fence is not None and not inside(site.fence, point.x, point.y, 1e-6):
            raise RobotFailure(
                "refused",
                f"waypoint {number} at ({point.x:g}, {point.y:g}) is outside {site.fence.name}",
                remedy="choose a point inside the fence",
            )
    if start is None:
        return
    closed = _closed(site, flies=flies)
    blocked = blocked_leg(closed, (start.x, start.y), [(point.x, point.y) for point in points])
    if blocked is not None:
        index, box = blocked
        raise RobotFailure(
            "refused",
            f"the leg to waypoint {behind + index + 1} goes through {box.name}",
            remedy="plan a way round it",
        )


def check_speed(site: Site, speed_mps: float | None, *, verb: str = "goto") -> None:
    """Raise RobotFailure unless the speed is None, or above 0 and within the site's limit."""
    if speed_mps is None:
        return
    if not math.isfinite(speed_mps) or speed_mps <= 0.0:
        raise RobotFailure("payload", f"{verb}: a speed of {speed_mps:g} m/s gets nowhere")
    if speed_mps > site.speed_limit_mps:
        raise RobotFailure(
            "refused",
            f"{speed_mps:g} m/s is above the site's limit of {site.speed_limit_mps:g} m/s",
            remedy="choose a lower speed",
        )


LONGEST_MOVE_S = 1.0
"""A robot that is moved by hand holds after so long without a new order: a person who is gone is noticed."""
FASTEST_TURN_DPS = 120.0


def check_velocity(site: Site, start: Pose, move: VelocityArgs, *, flies: bool) -> tuple[float, float, float]:
    """Return east, north and up in m/s of an allowed move by hand; RobotFailure with the reason otherwise."""
    in_range("velocity", "for_s", move.for_s, 0.05, LONGEST_MOVE_S)
    in_range("velocity", "turn_dps", move.turn_dps, -FASTEST_TURN_DPS, FASTEST_TURN_DPS)
    parts = (move.forward_mps, move.left_mps, move.up_mps)
    if not all(math.isfinite(part) for part in parts):
        raise RobotFailure("payload", "velocity: a speed is no number")
    speed = math.hypot(*parts)
    if speed > 0.0:
        check_speed(site, speed, verb="velocity")
    if move.up_mps and not flies:
        raise RobotFailure("payload", "velocity: it does not fly, and goes neither up nor down")
    angle = math.radians(start.heading_deg)
    east = move.forward_mps * math.sin(angle) - move.left_mps * math.cos(angle)
    north = move.forward_mps * math.cos(angle) + move.left_mps * math.sin(angle)
    if speed > 0.0:
        end = Waypoint(start.x + east * move.for_s, start.y + north * move.for_s, start.z + move.up_mps * move.for_s)
        check_points(site, start, (end,), flies=flies, verb="velocity")
    return east, north, move.up_mps


def breach(
    site: Site, pose: Pose, *, flies: bool, before: Pose | None = None, apart_s: float = 0.0, margin_m: float = 3.0
) -> str:
    """Return in words how a robot that moves has left what the site allows, empty when it has not.

    Args:
        site: whose fence, areas and limits hold.
        pose: where it is.
        flies: whether it has an altitude.
        before: where it said that it was last: between two reports it may pass right through a narrow area.
        apart_s: the time between the two; what it flew in a longer one is not known, and the position alone counts.
        margin_m: what GPS and braking need: a robot that grazes the edge is not stopped for it.
    """
    if site.fence is not None and not inside(site.fence, pose.x, pose.y, margin_m):
        return f"it is outside {site.fence.name}, at ({pose.x:.0f}, {pose.y:.0f})"
    if flies and pose.z > site.altitude_limit_m + margin_m:
        return f"it is {pose.z:.0f} m up, the site allows {site.altitude_limit_m:g} m"
    rim = min(margin_m, _SOFT_M)
    for box in site.forbidden:
        if inside(core(box, rim), pose.x, pose.y):
            return f"it is in {box.name}"
        if before is not None and apart_s <= _CLOSE_S and _went_through(box, before, pose, rim):
            return f"it went through {box.name}"
    return ""


def _went_through(box: Box, before: Pose, pose: Pose, rim_m: float) -> bool:
    """Tell whether the line between two positions goes deeper into an area than that of a way round its corner.

    Where a way along two edges has the corner half-way, a line of length L comes L / (2 * sqrt 2) from both edges, and
    less deep with the corner elsewhere. A narrow area keeps its middle whatever the rim (`core`).
    """
    length = math.hypot(pose.x - before.x, pose.y - before.y)
    return crosses(box, (before.x, before.y), (pose.x, pose.y), rim_m + length / (2.0 * math.sqrt(2.0)))


log = structlog.get_logger(__name__)

# --- limits of an order ----------------------------------------------------------------------------------------------

CHOSEN = frozenset({"speed_mps", "altitude_m"})
"""Values that a skill chooses where its plan says none."""
STALE_M = 0.5
"""A robot's place in the roster is some tenths of a second old: an area that it stands in or at by that place loses so
much of its rim for the leg that begins there, which the robot itself, knowing better, looks at again."""
_GROUND_M = 0.5
_CORE_M = 4 * GRAZE_M
"""What is left of the narrowest wall when it loses its rim: enough to be in the way."""


class Bounds(Struct, frozen=True, kw_only=True):
    """The most that somebody allows; None where they say nothing."""

    whose: str
    """In words, for messages: `the limits that rover_1 registered`."""
    speed_mps: float | None = None
    altitude_m: float | None = None
    range_m: float | None = None
    """Longest way of one order."""


class Usual(Struct, frozen=True, kw_only=True):
    """What a robot does by itself where an order does not say: how fast it goes, how high from the ground."""

    speed_mps: float = math.inf
    takeoff_m: float = math.inf


LIMITED = (GotoArgs, MissionArgs, OrbitArgs, TakeoffArgs, VelocityArgs)
"""Arguments that say where to, how high or how fast: `held` looks at them."""


class _Bound(Struct, frozen=True):
    value: float
    whose: str


def registered(info: RobotInfo) -> Bounds:
    """Return what a robot said of itself."""
    limits, whose = info.limits, f"the limits that {info.id} registered"
    if limits is None:
        return Bounds(whose=whose)
    altitude = limits.altitude_m if info.flies else None
    return Bounds(whose=whose, speed_mps=limits.speed_mps, altitude_m=altitude, range_m=limits.range_m)


def held(
    command: RobotCommand,
    info: RobotInfo | None,
    bounds: Sequence[Bounds],
    site: Site | None,
    *,
    chosen: Collection[str] = (),
    usual: "Usual | None" = None,
    begun: bool = False,
) -> RobotCommand:
    """Return an order as it may be sent.

    Args:
        command: the order.
        info: its robot as the roster has it; None: it is not there, and only bounds can be looked at.
        bounds: whose limits hold.
        site: the site, for robots that nobody else holds to it; None: it is not looked at.
        chosen: arguments that nobody asked for: they are lowered to a bound instead of refused.
        usual: what the robot does where an order does not say; None: it is not known.
        begun: the robot may be carrying it out already. It is somewhere on the way then: the leg and the range from
            where it is now are not those of the order, and refusing it would leave the robot going unwatched.

    Raises:
        RobotFailure: `refused` with whose limit it breaks, `payload` when its arguments cannot be read.
    """
    kind = args_of(command.verb)
    if kind is None or not issubclass(kind, LIMITED):
        return command
    args = parse_args(command.verb, command.args, kind)
    usual = usual or Usual()
    speed, altitude = _strictest(bounds, "speed_mps"), _strictest(bounds, "altitude_m")
    match args:
        case VelocityArgs():
            pace = math.hypot(args.forward_mps, args.left_mps, args.up_mps)
            _within(pace, speed, "m/s")
            if site is not None and pace > 0.0:
                check_speed(site, pace, verb="velocity")
            return command
        case TakeoffArgs():
            height = _climb(args.altitude_m, altitude, usual.takeoff_m, lower="altitude_m" in chosen)
            if site is not None:
                _within(height, _Bound(site.altitude_limit_m, "the site's limit"), "m up")
            return command if height == args.altitude_m else _with(command, altitude_m=height)
        case GotoArgs() | MissionArgs() | OrbitArgs():
            way = _way(args)
            for point in way:
                _within(point.z, altitude, "m up")
            _check_range(None if begun else info, way, _strictest(bounds, "range_m"))
            changed = _from_the_ground(command, info, altitude, usual.takeoff_m)
            changed = _slowed(changed, args.speed_mps, speed, usual.speed_mps, lower="speed_mps" in chosen)
            if site is not None:
                _check_site(site, info, replace(args, speed_mps=changed.args.get("speed_mps")), begun=begun)
            return changed


def _strictest(bounds: Sequence[Bounds], key: str) -> _Bound | None:
    found = [_Bound(value, each.whose) for each in bounds if (value := getattr(each, key)) is not None]
    return min(found, key=lambda each: each.value, default=None)


def _within(value: float | None, bound: _Bound | None, unit: str) -> None:
    """Raise RobotFailure for what is above a bound; what is no number is not below it."""
    if value is None or bound is None or value <= bound.value:
        return
    raise RobotFailure(
        "refused",
        f"{value:g} {unit} is above {bound.value:g} {unit}, by {bound.whose}",
        remedy=f"ask for at most {bound.value:g} {unit}",
    )


def _slowed(
    command: RobotCommand, speed: float | None, bound: _Bound | None, usual_mps: float, *, lower: bool
) -> RobotCommand:
    """Return an order at a speed within the bound; robots choose their own where none is said."""
    if bound is None or (speed is None and usual_mps <= bound.value):
        return command
    if speed is not None and not lower:
        _within(speed, bound, "m/s")
    return command if speed is not None and speed <= bound.value else _with(command, speed_mps=bound.value)


def _climb(height: float | None, bound: _Bound | None, usual_m: float, *, lower: bool) -> float | None:
    if bound is None:
        return height
    if height is None:
        return bound.value if bound.value < usual_m else None
    if not lower:
        _within(height, bound, "m up")
    return min(height, bound.value)


def _from_the_ground(
    command: RobotCommand, info: RobotInfo | None, bound: _Bound | None, usual_m: float
) -> RobotCommand:
    """Give the points of a way that begins on the ground a height, where its robot would else go higher than it may."""
    if bound is None or bound.value >= usual_m or info is None or not info.flies:
        return command
    name = "waypoints" if command.verb == "goto" else "steps"
    points: list[dict[str, Any]] = [command.args] if command.verb == "orbit" else command.args[name]
    z = None if all(map(_high, points)) else _begun_at(info, bound)
    if z is None:
        return command
    given = [point if _high(point) else {**point, "z": z} for point in points]
    return _with(command, z=z) if command.verb == "orbit" else _with(command, **{name: given})


def _begun_at(info: RobotInfo, bound: _Bound) -> float | None:
    """Return the height of the site at which a way without heights is begun, None where its robot flies and keeps its.

    Bounds count from the ground that a robot takes off from, its home; heights of the site from the site's origin,
    which may be up or down the hill.
    """
    here = None if info.pose is None else info.pose.z
    ground = info.home.z if info.home is not None else None if info.armed else here
    if ground is None:
        # Armed, and nobody knows above what: a robot that flies keeps its height, one that does not is held to it.
        return bound.value if here is None or here <= _GROUND_M else min(bound.value, here)
    if info.armed and here is not None and here - ground > _GROUND_M:
        return None
    z = ground + bound.value
    if z <= _GROUND_M:
        # So low a height means "as it is" in an order, and it would climb as high as it usually does.
        raise RobotFailure(
            "refused",
            f"{info.id} stands {-ground:.0f} m below the site's origin, where an order cannot hold it to "
            f"{bound.value:g} m up, by {bound.whose}",
            remedy="let it take off first: `takeoff` counts from the ground",
        )
    return z


def _high(point: Mapping[str, Any]) -> bool:
    """Whether a point has a height of its own: on the ground it means the one that is flown at."""
    return (point.get("z") or 0.0) > _GROUND_M


def _with(command: RobotCommand, **args: object) -> RobotCommand:
    return replace(command, args=command.args | args)


def _way(args: GotoArgs | MissionArgs | OrbitArgs) -> tuple[Waypoint, ...]:
    match args:
        case GotoArgs():
            return args.waypoints
        case MissionArgs():
            return tuple(Waypoint(step.x, step.y, step.z) for step in args.steps)
        case OrbitArgs():
            return (Waypoint(args.x, args.y, args.z),)


def _check_range(info: RobotInfo | None, way: Sequence[Waypoint], bound: _Bound | None) -> None:
    if bound is None:
        return
    places = [(point.x, point.y) for point in way]
    if info is not None and info.pose is not None:
        places.insert(0, (info.pose.x, info.pose.y))
    metres = sum(math.dist(one, other) for one, other in pairwise(places))
    if not metres <= bound.value:  # what is no number too
        raise RobotFailure(
            "refused",
            f"a way of {metres:.0f} m is longer than {bound.value:g} m, by {bound.whose}",
            remedy="go in several steps, with a charge between them",
        )


def _check_site(site: Site, info: RobotInfo | None, args: GotoArgs | MissionArgs | OrbitArgs, *, begun: bool) -> None:
    """Raise RobotFailure for a way that the site does not allow, as far as the roster tells where it begins."""
    flies = info is not None and info.flies
    here = None if info is None else info.pose
    match args:
        case OrbitArgs():
            # The circle alone: its middle may be in an area, and the way to it is the robot's.
            check_orbit(site, None, args, flies=flies)
            return
        case MissionArgs():
            check_mission(site, None, args, flies=flies)
        case GotoArgs():
            check_points(site, None, args.waypoints, flies=flies)
            check_speed(site, args.speed_mps)
    way = _way(args)
    first = way[0]
    closed = site.forbidden if flies else (*site.forbidden, *site.obstacles)
    for box in closed:
        # Whatever stands in one must be able to leave it, by a point in it too.
        out = here is not None and inside(box, here.x, here.y, STALE_M)
        if not out and inside(core(box, GRAZE_M), first.x, first.y):
            raise RobotFailure("refused", f"waypoint 1 is in {box.name}", remedy="choose a point outside of it")
    if len(way) > 1:
        check_points(site, Pose(x=first.x, y=first.y), way[1:], flies=flies, verb=_verb(args), behind=1)
    if here is None or begun:
        return
    # Where it is far from a wall, the age of its place makes none of the wall go away.
    boxes = [_smaller(box) if inside(box, here.x, here.y, STALE_M) else box for box in closed]
    blocked = blocked_leg(boxes, (here.x, here.y), [(first.x, first.y)])
    if blocked is not None:
        raise RobotFailure(
            "refused", f"the leg to waypoint 1 goes through {blocked[1].name}", remedy="plan a way round it"
        )


def _verb(args: Struct) -> str:
    return "goto" if isinstance(args, GotoArgs) else "mission"


def _smaller(box: Box) -> Box:
    """Return a box without its rim; a narrow one keeps its middle, or a robot that stands at a wall would see none."""

    def middle(low: float, high: float) -> tuple[float, float]:
        rim = max(0.0, min(STALE_M, (high - low - _CORE_M) / 2))
        return low + rim, high - rim

    return Box(name=box.name, x=middle(*box.x), y=middle(*box.y))


class Orders:
    """Holds the orders of one gateway's tasks and operators.

    Args:
        site: the site.
        roster: the robots as they are known now.
        configured: what the configuration gives a robot.
        vehicles: what vehicles that a gateway commands do by themselves, by whether they fly.
    """

    def __init__(
        self,
        site: Site,
        *,
        roster: Callable[[], Mapping[str, RobotInfo]],
        configured: Callable[[str], Bounds],
        vehicles: Callable[[bool], Usual],
    ) -> None:
        self._site = site
        self._roster = roster
        self._configured = configured
        self._vehicles = vehicles

    def held(
        self, robot: str, command: RobotCommand, chosen: Collection[str] = (), begun: bool = False
    ) -> RobotCommand:
        """Return an order as it may be sent; RefusedError with the reason, PayloadError for what cannot be read.

        Arguments as of `held`.
        """
        info = self._roster().get(robot)
        bounds = [self._configured(robot)]
        alone = info is not None and info.kind == "zenoh"
        if info is not None and alone:
            bounds.append(registered(info))
        try:
            usual = None if info is None or alone else self._vehicles(info.flies)
            site = self._site if alone else None
            sent = held(command, info, bounds, site, chosen=chosen, usual=usual, begun=begun)
        except RobotFailure as error:
            failure = error.failure
            log.warning("order not sent", robot=robot, verb=command.verb, id=command.id, reason=failure.message)
            raise _told(robot, error) from error
        if sent is not command:
            lowered = {key: sent.args[key] for key in CHOSEN if sent.args.get(key) != command.args.get(key)}
            log.info("order is held to its limits", robot=robot, verb=command.verb, id=command.id, **lowered)
        return sent


def _told(robot: str, error: RobotFailure) -> SwiftbotError:
    failure = error.failure
    return from_code(failure.code, f"not sent to {robot}: {failure.message}", failure.remedy)
