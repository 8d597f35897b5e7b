"""rendezvous: share spots at a place among the robots, go there together, and be done when all have arrived."""

from typing import Any

from _lib import joint, moves, params
from _lib.context import Context
from _lib.places import resolve


def run(ctx: Context) -> dict[str, Any]:
    """Return place, robots: by name pose and path_m."""
    place = resolve(ctx, params.text(ctx, "place"))
    before = joint.states(ctx)
    goals = joint.shared(before, joint.around(ctx, place, len(before)))
    robots = joint.go(ctx, before, goals, speed_mps=moves.speed(ctx), what=f"meet at {place.name}")
    return {"place": place.name, "robots": robots}
