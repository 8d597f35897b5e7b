"""Looks for coloured things in pictures: those of the inputs, or one taken now. Shared by detect, count and find."""

from typing import Any

from . import colours, moves, params, pictures
from .context import Context
from .places import resolve


def images(ctx: Context, target: str) -> list[tuple[pictures.Reference, bytes]]:
    """Return the pictures to look at: those of the inputs, else one taken now; ctx.Fail when neither is possible.

    A parameter `area` sends the robot there first when there is no picture to look at.
    """
    given = list(pictures.references(ctx.inputs, "image/"))[-pictures.MAX_PICTURES :]
    if given:
        return [(each, ctx.get_artifact(each)) for each in given]
    if ctx.robot is None:
        raise ctx.Fail(
            f"there is no picture to look for {target} in", "photograph it first, or name a robot with a camera"
        )
    if "area" in ctx.params:
        moves.go(ctx, [resolve(ctx, params.text(ctx, "area"))], speed_mps=moves.speed(ctx), share=0.4)
    data, _ = pictures.take(ctx, target)
    return [(pictures.keep(ctx, target, data), data)]


def detect(ctx: Context, target: str, found: list[tuple[pictures.Reference, bytes]]) -> dict[str, Any]:
    """Return the result of a look at pictures: detections, their number, and a marked picture of each."""
    rows: list[dict[str, Any]] = []
    marked: list[pictures.Reference] = []
    for number, (reference, data) in enumerate(found, start=1):
        name = str(reference.get("name", f"picture {number}"))
        picture = colours.decode(ctx, data, name)
        here = colours.detections(picture, target, ctx.site)
        rows += [{**row, "image": reference.get("artifact", "")} for row in here]
        marked.append(
            ctx.put_artifact(
                f"{params.slug(target)}-marked-{number}.png", colours.annotated(picture, here), "image/png"
            )
        )
        ctx.progress(0.4 + 0.5 * number / len(found), f"{name}: {len(here)} found")
    result: dict[str, Any] = {"target": target, "detections": rows, "count": len(rows), "annotated": marked}
    result["images"] = [reference for reference, _ in found]
    if not colours.wanted(target, ctx.site).sure:
        result["note"] = f"nothing in {target!r} can be recognised by colour: every coloured thing is listed"
    return result


def most_in_one(rows: list[dict[str, Any]]) -> int:
    """Return the number of things seen: pictures of one place show the same ones, so the fullest picture counts."""
    per: dict[str, int] = {}
    for row in rows:
        key = str(row.get("image", ""))
        per[key] = per.get(key, 0) + 1
    return max(per.values(), default=0)
