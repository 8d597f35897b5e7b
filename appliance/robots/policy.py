"""The safety policy, applied last: what of a command a site allows, whatever plan, operator or handler asked for it.

The site's file is the policy: its fence (which no robot leaves), forbidden areas (which none enters), obstacles (which
bind robots on the ground), altitude and speed limits. A command that breaks it is refused with the reason before
anything moves. Pure.
"""

import math
from collections.abc import Sequence

from appliance.model import Box, Pose, Site
from appliance.model.geo import MAX_EXTENT_M, blocked_leg, core, crosses, inside, rings
from appliance.robots.verbs import (
    MAX_WAYPOINTS,
    GotoArgs,
    MissionArgs,
    OrbitArgs,
    RobotFailure,
    VelocityArgs,
    Waypoint,
    in_range,
)

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
"""A robot that is moved by hand holds after so long unless it is told again: a person who is gone is noticed."""
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
