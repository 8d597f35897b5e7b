"""goto: resolve the place, plan a way round obstacles and forbidden areas, go, wait for arrival."""

from typing import Any

from _lib import moves, params
from _lib.context import Context
from _lib.places import resolve


def run(ctx: Context) -> dict[str, Any]:
    """Return place, pose, path_m and waypoints."""
    spot = resolve(ctx, params.text(ctx, "place"))
    return {"place": spot.name, **moves.go(ctx, [spot], speed_mps=moves.speed(ctx))}
