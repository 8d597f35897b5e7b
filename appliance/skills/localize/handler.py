"""localize: where the robot is, as it estimates it itself, over a short window of time.

The spread of its estimates says how steady they are. A `method` in the plan has no effect, and the result says so: the
robot chooses its estimator.
"""

import math
import statistics
import time
from typing import Any

from _lib import params
from _lib.context import Context

EVERY_S = 0.2
MOST = 50
"""Estimates that are asked for at most."""


def run(ctx: Context) -> dict[str, Any]:
    """Return pose (median; metres, degrees), spread_m (largest distance from it), estimates and method."""
    window_s = params.number(ctx, "window_ms", default=1000.0, low=0.0, high=60_000.0) / 1e3
    asked = params.text(ctx, "method", default="")
    count = max(1, min(MOST, round(window_s / EVERY_S)))
    found: list[dict[str, float]] = []
    for number in range(count):
        if number:
            time.sleep(window_s / count)
        pose: object = ctx.command("state", timeout_s=10).get("pose")
        found.append({name: float(value) for name, value in params.table(pose).items() if _is_number(value)})
        ctx.progress((number + 1) / count, f"{len(found)} estimates")
    found = [each for each in found if {"x", "y"} <= each.keys()]
    if not found:
        raise ctx.Fail(f"{ctx.robot} does not know where it is", "wait for its position fix, then try again")
    where = {name: round(statistics.median(each.get(name, 0.0) for each in found), 3) for name in ("x", "y", "z")}
    if any("heading_deg" in each for each in found):
        where["heading_deg"] = round(_heading([each["heading_deg"] for each in found if "heading_deg" in each]), 1)
    spread = max(math.hypot(each["x"] - where["x"], each["y"] - where["y"]) for each in found)
    result = {"pose": where, "spread_m": round(spread, 3), "estimates": len(found), "method": "the robot's own"}
    return result | ({"note": f"the robot chooses how, not {asked!r}"} if asked else {})


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _heading(degrees: list[float]) -> float:
    """Return the mean direction, 0 to 360."""
    east = sum(math.sin(math.radians(each)) for each in degrees)
    north = sum(math.cos(math.radians(each)) for each in degrees)
    return math.degrees(math.atan2(east, north)) % 360.0
