"""Moves several robots of a joint skill together: where each is, who takes which spot, and one command for all.

The calls are the same each time (state of all, then goto of all): see `moves`.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

from . import moves, params, paths
from .context import Context
from .places import Spot

APART_M = 1.5
"""Between the middles of neighbours where robots stand together."""
_RINGS = 12
"""How many rings of spots are looked at around a place."""
_ALL_WAYS = 6
"""Robots up to which every way to share the spots is looked at."""


def states(ctx: Context) -> dict[str, moves.State]:
    """Ask all robots where they are; ctx.Fail when one does not know, or there is one alone."""
    if len(ctx.robots) < 2:
        raise ctx.CallError("precondition", "a joint skill needs several robots", "list all that take part")
    answers = ctx.command_all("state", {robot: {} for robot in ctx.robots}, timeout_s=30)
    return {robot: moves.read_state(ctx, robot, answer) for robot, answer in answers.items()}


def around(ctx: Context, middle: Spot, count: int) -> list[Spot]:
    """Return so many spots near a place, the nearest first, apart from each other and where a robot can stand."""
    closed = [*paths.rectangles(ctx.site.get("obstacles") or ()), *paths.rectangles(ctx.site.get("forbidden") or ())]
    fence = params.table(ctx.site.get("fence"))
    found: list[Spot] = []
    for ring in range(_RINGS):
        radius = ring * APART_M
        spots = max(1, math.floor(2 * math.pi * ring)) if ring else 1
        for number in range(spots):
            angle = 2 * math.pi * number / spots
            x, y = middle.x + radius * math.cos(angle), middle.y + radius * math.sin(angle)
            if standable(x, y, closed, fence) and all(math.dist((x, y), (o.x, o.y)) >= 0.95 * APART_M for o in found):
                found.append(Spot(middle.name, x, y, middle.z))
            if len(found) == count:
                return found
    raise ctx.CallError(
        "precondition", f"there is no room for {count} robots at {middle.name}", "choose a place with more room"
    )


def standable(x: float, y: float, closed: Sequence[paths.Rectangle], fence: Mapping[str, Any]) -> bool:
    """Whether a robot can stand at a point: inside the fence, and half its size away from what is closed."""
    if fence and not (fence["x"][0] < x < fence["x"][1] and fence["y"][0] < y < fence["y"][1]):
        return False
    return not any(box.grown(APART_M / 2).holds((x, y)) for box in closed)


def shared(robots: Mapping[str, moves.State], spots: Sequence[Spot]) -> dict[str, Spot]:
    """Return who takes which spot: the shortest ways in all of a few robots, else the nearest pairs first."""

    def way(robot: str, spot: Spot) -> float:
        return math.dist(robots[robot][:2], (spot.x, spot.y))

    names = [*robots]
    if len(names) <= _ALL_WAYS:
        orders = itertools.permutations(spots, len(names))
        best = min(orders, key=lambda order: sum(map(way, names, order)))
        return dict(zip(names, best, strict=True))
    pairs = sorted(((way(robot, spot), robot, spot) for robot in names for spot in spots), key=lambda pair: pair[:2])
    found: dict[str, Spot] = {}
    for _, robot, spot in pairs:
        if robot not in found and spot not in found.values():
            found[robot] = spot
    return found


def go(
    ctx: Context, before: Mapping[str, moves.State], goals: Mapping[str, Spot], *, speed_mps: float, what: str
) -> dict[str, dict[str, Any]]:
    """Send all robots to their spots at the same time, so fast that they arrive together, and wait for all.

    Returns:
        By robot: `pose` at the end and `path_m`.
    """
    ways = {
        robot: moves.plan_way(ctx, before[robot][:2], goal, flies=before[robot].flies) for robot, goal in goals.items()
    }
    lengths = {robot: paths.length([before[robot][:2], *way]) for robot, way in ways.items()}
    longest = max(lengths.values())
    args: dict[str, dict[str, Any]] = {}
    for robot, way in ways.items():
        altitude = moves.altitude_for(ctx, robot, before[robot], [goals[robot]])
        height = {} if altitude is None else {"z": round(altitude, 2)}
        share = lengths[robot] / longest if longest > 0 else 1.0
        args[robot] = {
            "waypoints": [{"x": round(x, 3), "y": round(y, 3)} | height for x, y in way],
            "speed_mps": max(min(speed_mps, moves.SLOWEST_MPS), speed_mps * share),
        }
    ctx.progress(0.1, f"{', '.join(goals)} {what}: {longest:.1f} m at most")
    answers = ctx.command_all("goto", args, timeout_s=60 + longest / min(speed_mps, moves.SLOWEST_MPS))
    ctx.progress(1.0, f"{', '.join(goals)} have arrived")
    return {
        robot: {"pose": params.table(answer.get("pose")), "path_m": round(lengths[robot], 2)}
        for robot, answer in answers.items()
    }
