"""patrol: round the edge of a mapped area, or along a route of places, for some laps or some time.

Each lap is one command and is saved: an attempt on another gateway goes on with the next one.
"""

import time
from typing import Any

from _lib import moves, params, places
from _lib.context import Context
from _lib.places import Spot

MARGIN_M = 1.0
"""Distance kept from the area that is walked round."""
MAX_LAPS = 50


def run(ctx: Context) -> dict[str, Any]:
    """Return area, laps, path_m and the last pose."""
    name = params.text(ctx, "area")
    laps = params.whole(ctx, "laps", default=1, low=1, high=MAX_LAPS)
    lasting = params.number(ctx, "duration_s", default=0.0, low=0.0, high=3600.0)
    spots = _round(ctx, name)
    speed = moves.speed(ctx)
    saved = ctx.resume or {}
    lap, metres, pose = int(saved.get("lap", 0)), float(saved.get("path_m", 0.0)), saved.get("pose")
    begun = time.monotonic() - float(saved.get("seconds", 0.0))
    share = 1.0 / laps
    while lap == 0 or (lap < MAX_LAPS and time.monotonic() - begun < lasting if lasting else lap < laps):
        done = min(1.0, lap * share) * 0.9
        result = moves.go(ctx, [*spots, spots[0]], speed_mps=speed, done=done, share=share * 0.9)
        metres, pose = metres + result["path_m"], result.get("pose")
        lap += 1
        ctx.checkpoint({"lap": lap, "path_m": metres, "pose": pose, "seconds": time.monotonic() - begun})
        ctx.partial({"area": name, "laps": lap, "path_m": round(metres, 2)})
    return {"area": name, "laps": lap, "path_m": round(metres, 2), "pose": pose}


def _round(ctx: Context, name: str) -> list[Spot]:
    box = places.area(ctx, name)
    if box is not None:
        x0, x1, y0, y1 = box[0] - MARGIN_M, box[1] + MARGIN_M, box[2] - MARGIN_M, box[3] + MARGIN_M
        corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        return [Spot(f"corner {number} of {name}", x, y) for number, (x, y) in enumerate(corners, start=1)]
    spots = places.route(ctx, name)
    if len(spots) < 2:
        areas = [
            str(each.get("name")) for each in (*(ctx.site.get("obstacles") or ()), *(ctx.site.get("forbidden") or ()))
        ]
        raise ctx.CallError(
            "payload",
            f"{name!r} is one point on the map, with no edge to walk",
            f"name two places or more, or one of: {', '.join(areas) or 'no area is mapped'}",
        )
    return spots
