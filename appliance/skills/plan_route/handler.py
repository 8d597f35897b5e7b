"""plan_route: compute a way without moving, from where an earlier subtask ended or from home."""

from typing import Any

from _lib import moves, params, paths
from _lib.context import Context
from _lib.places import Spot, resolve


def run(ctx: Context) -> dict[str, Any]:
    """Return place, start, path (points of x and y) and path_m."""
    goal = resolve(ctx, params.text(ctx, "place"))
    start = _start(ctx)
    way = moves.plan_way(ctx, (start.x, start.y), goal)
    metres = paths.length([(start.x, start.y), *way])
    ctx.progress(1.0, f"{metres:.1f} m from {start.name}")
    points = [{"x": round(x, 3), "y": round(y, 3)} for x, y in [(start.x, start.y), *way]]
    return {"target": goal.name, "start": start.name, "path": points, "route_m": round(metres, 2)}


def _start(ctx: Context) -> Spot:
    for result in ctx.inputs.values():
        pose = params.table(result.get("pose"))
        if isinstance(result.get("pose"), dict):  # an empty one is the origin: zeros are left out on the wire
            return Spot("where the robot is", float(pose.get("x", 0.0)), float(pose.get("y", 0.0)))
    return resolve(ctx, "home")
