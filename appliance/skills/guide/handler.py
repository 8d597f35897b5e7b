"""guide: ask a person to follow, lead the way to a place, and say that it is reached."""

from typing import Any

from _lib import moves, params
from _lib.context import Context
from _lib.places import resolve

WALKING_MPS = 1.0
"""A person who is led is not to run."""


def run(ctx: Context) -> dict[str, Any]:
    """Return person, place, pose, path_m and waypoints."""
    person = params.text(ctx, "person")
    spot = resolve(ctx, params.text(ctx, "place"))
    ctx.command("say", timeout_s=120, text=f"{person}, please follow me to {spot.name}")
    way = moves.go(ctx, [spot], speed_mps=min(WALKING_MPS, moves.speed(ctx)), done=0.1, share=0.8)
    ctx.command("say", timeout_s=120, text=f"{person}, this is {spot.name}")
    ctx.progress(1.0, f"at {spot.name}")
    return {"person": person, "place": spot.name, **way}
