"""find: look round for a coloured thing until it is seen, from where the robot is and from points about it."""

from typing import Any

from _lib import colours, looking, moves, params, paths, pictures
from _lib.context import Context
from _lib.places import Spot, resolve

STEP_M = 1.5
"""How far it goes for another view: turning alone is no command that every robot has, going somewhere is."""
CALLS_A_VIEW = 3
"""state, goto, capture."""
VIEWS = ((0.0, 1.0, "north"), (1.0, 0.0, "east"), (0.0, -1.0, "south"), (-1.0, 0.0, "west"))


def run(ctx: Context) -> dict[str, Any]:
    """Return found, detections, the picture it was seen in, and the points that it looked from."""
    target = params.text(ctx, "target")
    if not colours.wanted(target, ctx.site).sure:
        raise ctx.CallError(
            "payload", f"{target!r} cannot be recognised: only coloured things can", "name a colour, such as 'red box'"
        )
    speed = moves.speed(ctx)
    saved = ctx.resume or {}
    looked = params.rows(saved.get("looked_from"))
    if saved:
        start, begin = (float(saved["x"]), float(saved["y"])), int(saved["next"])
    else:
        if "area" in ctx.params:
            moves.go(ctx, [resolve(ctx, params.text(ctx, "area"))], speed_mps=speed, share=0.2)
        here = moves.state(ctx)
        start, begin = (here.x, here.y), 0
    x, y = start
    spots = [
        Spot("here", x, y),
        *(Spot(f"a view from the {side}", x + STEP_M * dx, y + STEP_M * dy) for dx, dy, side in VIEWS),
    ]
    for number, spot in enumerate(spots[begin:], start=begin):
        if number:
            if _closed(ctx, spot):
                # The calls of a view that is left out are made up for, so that later ones keep their numbers.
                for _ in range(CALLS_A_VIEW):
                    moves.state(ctx)
                continue
            moves.go(ctx, [spot], speed_mps=speed, done=0.2 + 0.15 * number, share=0.05)
        data, about = pictures.take(ctx, target)
        looked = [*looked, {"x": round(spot.x, 2), "y": round(spot.y, 2)}]
        views = len(looked)
        picture = colours.decode(ctx, data, f"view {views}")
        rows = colours.detections(picture, target, ctx.site)
        ctx.progress(0.3 + 0.15 * number, f"view {views}: {len(rows)} seen")
        so_far: dict[str, Any] = {"found": bool(rows), "target": target, "views": views, "looked_from": looked}
        if rows:
            image = pictures.keep(ctx, target, data, views)
            marked = ctx.put_artifact(
                f"{params.slug(target)}-marked.png", colours.annotated(picture, rows), "image/png"
            )
            rows = [{**row, "image": image["artifact"]} for row in rows]
            seen = {"detections": rows, "count": looking.most_in_one(rows), "image": image, "annotated": [marked]}
            return {**so_far, **seen, "camera": about}
        # Nothing here: an attempt on another gateway goes on with the next view.
        ctx.checkpoint({"x": x, "y": y, "next": number + 1, "looked_from": looked})
        ctx.partial(so_far)
    raise ctx.Fail(f"{target} was not seen from {len(looked)} points", "look in another area: name it as `area`")


def _closed(ctx: Context, spot: Spot) -> bool:
    """Whether a point cannot be stood at."""
    boxes = (*(ctx.site.get("obstacles") or ()), *(ctx.site.get("forbidden") or ()))
    return any(wall.grown(paths.CLEARANCE_M).holds((spot.x, spot.y)) for wall in paths.rectangles(boxes))
