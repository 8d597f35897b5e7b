"""follow_path: go through places and coordinates in the order given, round obstacles between them."""

from typing import Any

from _lib import moves, params
from _lib.context import Context
from _lib.places import route


def run(ctx: Context) -> dict[str, Any]:
    """Return the places passed, the last as `place`, with pose, path_m and waypoints."""
    text = params.text(ctx, "path")
    spots = route(ctx, text)
    if not spots:
        raise ctx.CallError(
            "not-found", f"there is no place in {text!r}", "name places in order, such as 'goal 1, aisle, dock 3'"
        )
    done = moves.go(ctx, spots, speed_mps=moves.speed(ctx))
    return {"path": [spot.name for spot in spots], "place": spots[-1].name, **done}
