"""track: keep a coloured thing located: a picture a second, and where in it the thing is."""

import time
from typing import Any

from _lib import colours, params, pictures
from _lib.context import Context

EVERY_S = 1.0
USUAL_S = 10.0
MAX_S = 600.0


def run(ctx: Context) -> dict[str, Any]:
    """Return detections (the last seen), the track (time and box of each view) and how often it was lost."""
    target = params.text(ctx, "target")
    lasting = params.number(ctx, "duration_s", default=USUAL_S, low=EVERY_S, high=MAX_S)
    every = params.number(ctx, "window_ms", default=EVERY_S * 1000, low=200.0, high=60000.0) / 1000
    if not colours.wanted(target, ctx.site).sure:
        raise ctx.CallError(
            "payload", f"{target!r} cannot be recognised: only coloured things can", "name a colour, such as 'red box'"
        )
    begun = time.monotonic()
    track: list[dict[str, Any]] = []
    last: list[dict[str, Any]] = []
    views = max(1, round(lasting / every))
    for view in range(views):
        time.sleep(max(0.0, begun + view * every - time.monotonic()))
        data, _ = pictures.take(ctx, target)
        rows = colours.detections(colours.decode(ctx, data, f"view {view + 1}"), target, ctx.site)
        last = rows[:1] or last
        track.append({"at_s": round(time.monotonic() - begun, 2), "box": rows[0]["box"] if rows else None})
        ctx.progress((view + 1) / views, f"{target} {'seen' if rows else 'lost'}")
    lost = sum(each["box"] is None for each in track)
    if lost == len(track):
        raise ctx.Fail(f"{target} was never seen in {len(track)} views", "point the robot at it first")
    return {"target": target, "detections": last, "count": len(last), "track": track, "lost": lost}
