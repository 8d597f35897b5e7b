"""orbit: circle round a place, lap by lap, on a ring that no obstacle cuts."""

import math
from typing import Any

from _lib import moves, params, paths
from _lib.context import Context
from _lib.places import Spot, resolve

POINTS = 16
"""Waypoints a lap: the ring is at most 2 % inside the circle."""


def run(ctx: Context) -> dict[str, Any]:
    """Return target, radius_m, laps, path_m and the last pose."""
    centre = resolve(ctx, params.text(ctx, "target"))
    radius = params.number(ctx, "radius_m", default=2.0, low=0.5, high=100.0)
    laps = params.whole(ctx, "laps", default=1, low=1, high=20)
    speed = moves.speed(ctx)
    before = moves.state(ctx)
    ring = _ring(ctx, before, centre, radius)
    metres = 0.0
    result: dict[str, Any] = {}
    for lap in range(laps):
        share = 1.0 / laps
        result = moves.go(ctx, [*ring, ring[0]], speed_mps=speed, done=lap * share, share=share)
        metres += result["path_m"]
        ctx.partial({"target": centre.name, "laps": lap + 1})
    whole = {"target": centre.name, "radius_m": radius, "laps": laps, "path_m": round(metres, 2)}
    return whole | {"pose": result.get("pose")}


def _ring(ctx: Context, before: moves.State, centre: Spot, radius: float) -> list[Spot]:
    """Points of the circle, beginning nearest to the robot; ctx.Fail when an obstacle cuts it."""
    first = math.atan2(before.y - centre.y, before.x - centre.x)
    ring = [
        Spot(
            f"the ring round {centre.name}",
            centre.x + radius * math.cos(angle),
            centre.y + radius * math.sin(angle),
            centre.z,
        )
        for angle in (first + 2 * math.pi * step / POINTS for step in range(POINTS))
    ]
    boxes = ctx.site.get("forbidden") or ()
    walls = paths.rectangles(boxes if before.flies else [*boxes, *(ctx.site.get("obstacles") or ())])
    for one, other in zip(ring, [*ring[1:], ring[0]], strict=True):
        for wall in walls:
            if wall.cuts((one.x, one.y), (other.x, other.y)):
                raise ctx.CallError(
                    "payload",
                    f"a circle of {radius:g} m round {centre.name} runs through {wall.name!r}",
                    "choose another radius",
                )
    return ring
