"""Where a robot's commands take it. Pure."""

import math
from collections.abc import Sequence
from typing import Any

from appliance.floor.decide import Trip
from appliance.model import Pose, RobotCommand, RobotInfo, Site
from appliance.model.floor import Point
from appliance.robots.verbs import (
    GotoArgs,
    MissionArgs,
    OrbitArgs,
    RobotFailure,
    TakeoffArgs,
    args_of,
    parse_args,
)

AIRBORNE_M = 0.5
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
            points = _heights([(each.x, each.y, each.z) for each in args.steps], height, flies=info.flies)
            if args.end == "return" and info.home is not None:
                points += _home(points[-1], info, site)
            elif args.end == "land" and points:
                points.append((*points[-1][:2], 0.0))
        case "orbit", OrbitArgs():
            points = _circle(args, _heights([(args.x, args.y, args.z)], height, flies=info.flies)[0], at)
        case "return_home", _ if info.home is not None:
            fixed = info.flies
            points = _home(at, info, site) if info.flies else [(info.home.x, info.home.y, 0.0)]
        case "takeoff", TakeoffArgs():
            points = [(at[0], at[1], args.altitude_m if args.altitude_m is not None else takeoff_m)]
        case "land", _:
            points = [(at[0], at[1], 0.0)]
        case _:
            return None
    if not points or not all(math.isfinite(value) for point in points for value in point):
        return None
    return Trip(robot=info.id, task=task, command=command.id, points=tuple(points), flies=info.flies, fixed=fixed)


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


def _home(start: Point, info: RobotInfo, site: Site) -> list[Point]:
    """Return the way home of a robot that flies: it may climb as high as the site allows, and lands."""
    home = info.home or Pose()
    top = max(start[2], site.altitude_limit_m if info.kind == "mavlink" else start[2])
    return [(start[0], start[1], top), (home.x, home.y, top), (home.x, home.y, 0.0)]


def _circle(args: OrbitArgs, centre: Point, at: Point) -> list[Point]:
    radius = abs(args.radius_m) / math.cos(math.pi / _CORNERS)
    begin = math.atan2(at[1] - args.y, at[0] - args.x)
    corners = range(_CORNERS + 1)
    return [
        (
            args.x + radius * math.cos(begin + math.tau * corner / _CORNERS),
            args.y + radius * math.sin(begin + math.tau * corner / _CORNERS),
            centre[2],
        )
        for corner in corners
    ]
