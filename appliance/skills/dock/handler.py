"""dock: drive to a charging or loading station and stand there."""

from typing import Any

from _lib import moves, params
from _lib.context import Context
from _lib.places import resolve

USUAL = "charger"
"""Where a robot docks when no station is named."""


def run(ctx: Context) -> dict[str, Any]:
    """Return place, pose, path_m, waypoints and the battery there."""
    spot = resolve(ctx, params.text(ctx, "station", default=USUAL))
    if moves.state(ctx).flies:
        raise ctx.CallError(
            "precondition", f"{ctx.robot} flies, and docks are for those that drive", "send it there, then have it land"
        )
    way = moves.go(ctx, [spot], speed_mps=moves.speed(ctx), share=0.9)
    battery = ctx.command("state", timeout_s=10).get("battery_percent")
    ctx.progress(1.0, f"docked at {spot.name}")
    return {"place": spot.name, **way, "battery_percent": battery}
