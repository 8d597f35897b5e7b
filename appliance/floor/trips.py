"""Where a robot's commands take it. Pure."""

import math
from collections.abc import Sequence
from typing import Any

from appliance.floor.decide import Trip
from appliance.model import Pose, RobotCommand, RobotInfo, Site
from appliance.model.floor import Point
from appliance.robots.verbs import (
    FollowArgs,
    GotoArgs,
    MissionArgs,
    NamedToArgs,
    OrbitArgs,
    RobotFailure,
    TakeoffArgs,
    args_of,
    parse_args,
)

AIRBORNE_M = 0.5
ROAM_MPS = 1.5
"""How fast a robot follows on a shared floor, at most."""
ROAM_S = 3.0
"""What a robot without a goal can reach in so long is reserved: until it is renewed, it stops, and it stands."""
STEP_M = 1.0
"""How far a thing is pushed when no place is named."""
_CORNERS = 12
"""Of the polygon that stands for a circle; it lies outside."""


def trip_of(command: RobotCommand, info: RobotInfo, site: Site, *, task: str, takeoff_m: float) -> Trip | None:
    """Return where a command takes a robot; None for one that moves no base, and for arguments that cannot be read.

    Args:
        command: as it is to be sent.
        info: the robot; it knows where it is.
        site: for how high it may come home.
        task: whose command it is.
        takeoff_m: how high a robot takes off where nothing says it.
    """
    kind, pose = args_of(command.verb), info.pose
    if kind is None or pose is None:
        return None
    try:
        args = parse_args(command.verb, command.args, kind)
    except RobotFailure:
        return None  # the robot's side says what is wrong
    at: Point = (pose.x, pose.y, max(0.0, pose.z) if info.flies else 0.0)
    height = at[2] if at[2] > AIRBORNE_M else takeoff_m if info.flies else 0.0
    points: list[Point]
    fixed = True
    match command.verb, args:
        case "goto", GotoArgs():
            fixed = False
            points = _heights([(each.x, each.y, each.z) for each in args.waypoints], height, flies=info.flies)
            if info.flies and at[2] <= AIRBORNE_M:
                points.insert(0, (at[0], at[1], points[0][2]))
        case "mission", MissionArgs():
            points = _mission(args, info, site, height)
        case "orbit", OrbitArgs():
            centre = _heights([(args.x, args.y, args.z)], height, flies=info.flies)[0]
            points = _circle((args.x, args.y), abs(args.radius_m), centre[2], at)
        case "return_home", _ if info.home is not None:
            fixed = info.flies
            points = _home(at, info, site) if info.flies else [(info.home.x, info.home.y, 0.0)]
        case "takeoff", TakeoffArgs():
            points = [(at[0], at[1], args.altitude_m if args.altitude_m is not None else takeoff_m)]
        case "land", _:
            points = [(at[0], at[1], 0.0)]
        case "push", NamedToArgs():
            to = site.find(args.to) if args.to else None
            if args.to and to is None:
                return None
            points = [(to.x, to.y, at[2])] if to is not None else _circle(at[:2], STEP_M, at[2], at)
        case "follow", FollowArgs():
            reach = ROAM_S * follow_mps(args.speed_mps, info)
            target = args.target.strip().lower().replace(" ", "_")
            return Trip(
                robot=info.id, task=task, command=command.id, points=(at,), flies=info.flies, fixed=True,
                reach_m=reach, beside=target,
            )  # fmt: skip
        case _:
            return None
    if not points or not all(math.isfinite(value) for point in points for value in point):
        return None
    return Trip(robot=info.id, task=task, command=command.id, points=tuple(points), flies=info.flies, fixed=fixed)


def follow_mps(asked: float | None, info: RobotInfo) -> float:
    """Return how fast a robot follows, m/s."""
    limit = info.limits.speed_mps if info.limits is not None else None
    return min(each for each in (asked, limit, ROAM_MPS) if each)


def goto_args(command: RobotCommand, trip: Trip, way: Sequence[Point]) -> dict[str, Any]:
    """Return the arguments of a goto along a way that was reserved, whose first point is where the robot is."""
    if command.verb == "goto" and tuple(way[1:]) == trip.points:
        return command.args
    points = [{"x": x, "y": y} | ({"z": round(z, 2)} if trip.flies else {}) for x, y, z in way[1:]]
    speed = command.args.get("speed_mps")
    return {"waypoints": points} | ({"speed_mps": speed} if speed is not None else {})


def _heights(points: Sequence[tuple[float, float, float | None]], height: float, *, flies: bool) -> list[Point]:
    """Fill in the heights that are not said: a robot keeps the one that it has."""
    found: list[Point] = []
    for x, y, z in points:
        if flies and z is not None and z > AIRBORNE_M:
            height = z
        found.append((x, y, height if flies else 0.0))
    return found


def _mission(args: MissionArgs, info: RobotInfo, site: Site, height: float) -> list[Point]:
    points = _heights([(each.x, each.y, each.z) for each in args.steps], height, flies=info.flies)
    if args.end == "return" and info.home is not None:
        points += _home(points[-1], info, site)
    elif args.end == "land" and points:
        points.append((*points[-1][:2], 0.0))
    return points


def _home(start: Point, info: RobotInfo, site: Site) -> list[Point]:
    """Return the way home of a robot that flies: it may climb as high as the site allows, and lands."""
    home = info.home or Pose()
    top = max(start[2], site.altitude_limit_m if info.kind == "mavlink" else start[2])
    return [(start[0], start[1], top), (home.x, home.y, top), (home.x, home.y, 0.0)]


def _circle(centre: tuple[float, float], radius_m: float, height: float, at: Point) -> list[Point]:
    radius = radius_m / math.cos(math.pi / _CORNERS)
    begin = math.atan2(at[1] - centre[1], at[0] - centre[0])
    corners = [begin + math.tau * corner / _CORNERS for corner in range(_CORNERS + 1)]
    return [(centre[0] + radius * math.cos(each), centre[1] + radius * math.sin(each), height) for each in corners]
