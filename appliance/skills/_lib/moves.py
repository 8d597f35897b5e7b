"""Moves a robot: asks where it is, plans, sends the way, waits for arrival. Shared by all skills that go somewhere.

The calls are the same each time (state, then goto), because a call's number is part of the command's identity: a
repeated attempt must meet its own earlier goto, nothing else. A robot that flies takes off by itself when it is sent
somewhere from the ground.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from . import params, paths
from .context import Context
from .places import Spot

AIRBORNE_M = 0.5
"""Below this a robot that flies is on the ground, and a place is one on the ground, metres."""
SLOWEST_MPS = 0.3
"""What the time allowed for a way is reckoned with: a slow robot is not a lost one."""
MAX_WAYPOINTS = 100
"""What a robot takes in one command."""


class State(NamedTuple):
    """Where the robot is, metres, and whether it flies."""

    x: float
    y: float
    z: float
    flies: bool


def state(ctx: Context) -> State:
    """Ask the robot where it is; ctx.Fail when it does not know."""
    return read_state(ctx, str(ctx.robot), ctx.command("state", timeout_s=10))


def read_state(ctx: Context, robot: str, info: Mapping[str, Any]) -> State:
    """Return where a robot is by its answer to `state`; ctx.Fail when it does not know."""
    pose = params.table(info.get("pose"))
    if not isinstance(info.get("pose"), dict):
        raise ctx.Fail(
            f"{robot} does not know where it is", "wait for its position fix, then try again", retryable=True
        )
    return State(
        float(pose.get("x", 0.0)),
        float(pose.get("y", 0.0)),
        float(pose.get("z", 0.0)),
        bool(info.get("flies", False)),
    )


def speed(ctx: Context, *, default: float | None = None) -> float:
    """Return the speed to go at, m/s: what was asked, never more than the site allows."""
    limit = float(ctx.site.get("speed_limit_mps", 8.0))
    asked = params.number(ctx, "speed_mps", default=limit if default is None else default, low=0.01, high=1000.0)
    if asked > limit:
        ctx.log(f"{asked:g} m/s is more than the site allows, going at {limit:g} m/s", asked=asked, limit=limit)
    return min(asked, limit)


def plan_way(ctx: Context, start: paths.Point, goal: Spot, *, flies: bool = False) -> list[paths.Point]:
    """Return the waypoints to a spot around obstacles and forbidden areas, on the ground along one-way aisles.

    ctx.Fail when there is no way.

    A robot that flies goes round obstacles too where it can (the map gives them no height), over them where the
    start or the goal leaves no other way, and never over a forbidden area.
    """
    try:
        return _way(ctx, start, goal, flies=flies)
    except paths.NoPath as error:
        raise ctx.CallError("precondition", f"cannot reach {goal.name}: {error.message}", error.remedy) from error


def reachable(ctx: Context, before: State, goal: Spot) -> bool:
    """Whether the map has a way from where the robot is to a spot."""
    try:
        return bool(_way(ctx, (before.x, before.y), goal, flies=before.flies))
    except paths.NoPath:
        return False


def _way(ctx: Context, start: paths.Point, goal: Spot, *, flies: bool) -> list[paths.Point]:
    forbidden = paths.rectangles(ctx.site.get("forbidden") or ())
    obstacles = paths.rectangles(ctx.site.get("obstacles") or ())
    aisles = [] if flies else paths.one_ways(ctx.site.get("aisles") or ())
    try:
        return paths.plan(start, (goal.x, goal.y), [*obstacles, *forbidden], aisles=aisles)
    except paths.NoPath:
        if not flies:
            raise
        return paths.plan(start, (goal.x, goal.y), forbidden)


def go(
    ctx: Context, goals: Sequence[Spot], *, speed_mps: float, done: float = 0.0, share: float = 1.0
) -> dict[str, Any]:
    """Send the robot through spots, one after the other, and wait until it is at the last.

    Args:
        ctx: the run.
        goals: where to, at least one.
        speed_mps: at what speed.
        done: progress before.
        share: progress that this way is worth.

    Returns:
        `pose` at the end, `path_m`, `waypoints`.
    """
    before = state(ctx)
    altitude = altitude_for(ctx, str(ctx.robot), before, goals)
    here: paths.Point = (before.x, before.y)
    way: list[paths.Point] = []
    waypoints: list[dict[str, float]] = []
    for goal in goals:
        leg = plan_way(ctx, here if not way else way[-1], goal, flies=before.flies)
        if before.flies and goal.z > AIRBORNE_M:
            altitude = goal.z
        for x, y in leg:
            height = {} if altitude is None else {"z": round(altitude, 2)}
            waypoints.append({"x": round(x, 3), "y": round(y, 3)} | height)
        way += leg
    if len(waypoints) > MAX_WAYPOINTS:
        raise ctx.CallError(
            "payload", f"the way has {len(waypoints)} turns, {MAX_WAYPOINTS} are possible", "go in several steps"
        )
    metres = paths.length([here, *way])
    name = goals[-1].name
    ctx.progress(done + 0.1 * share, f"going to {name}: {metres:.1f} m, {len(waypoints)} waypoints")
    answer = ctx.command(
        "goto", timeout_s=60 + metres / min(speed_mps, SLOWEST_MPS), waypoints=waypoints, speed_mps=speed_mps
    )
    ctx.progress(done + share, f"at {name}")
    end = params.table(answer.get("pose")) or dict(waypoints[-1])
    return {"pose": end, "path_m": round(metres, 2), "waypoints": waypoints}


def altitude_for(ctx: Context, robot: str, before: State, goals: Sequence[Spot]) -> float | None:
    """Return the height to fly at, None where the robot is to choose: it drives, or takes off first."""
    limit = float(ctx.site.get("altitude_limit_m", 60.0))
    for goal in goals:
        if goal.z > limit:
            raise ctx.CallError(
                "payload", f"{goal.name} is {goal.z:g} m up, the site allows {limit:g} m", "choose a lower place"
            )
        if goal.z > AIRBORNE_M and not before.flies:
            raise ctx.CallError(
                "precondition",
                f"{goal.name} is {goal.z:g} m up and {robot} does not fly",
                "send a robot that flies",
            )
    return min(before.z, limit) if before.flies and before.z > AIRBORNE_M else None
