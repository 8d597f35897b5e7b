"""count: how many things of a kind the detections handed on show, or a picture shows."""

from typing import Any

from _lib import colours, looking, params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return number, target and what was counted from."""
    target = params.text(ctx, "target")
    want = colours.wanted(target, ctx.site)
    if not want.sure:
        raise ctx.CallError(
            "payload",
            f"{target!r} cannot be told from other things: only colours can",
            "name a colour, such as 'red boxes'",
        )
    rows = {
        identity: _fitting(result, want.colours) for identity, result in ctx.inputs.items() if "detections" in result
    }
    if rows:
        # Each subtask looked somewhere else; what several pictures of one show is the same.
        number = sum(looking.most_in_one(each) for each in rows.values())
        ctx.progress(1.0, f"{number} {target}")
        return {"number": number, "target": target, "counted_in": sorted(rows)}
    seen = looking.detect(ctx, target, looking.images(ctx, target))
    number = looking.most_in_one(seen["detections"])
    ctx.progress(1.0, f"{number} {target}")
    return {"number": number, **seen}


def _fitting(result: dict[str, Any], wanted: tuple[str, ...]) -> list[dict[str, Any]]:
    return [row for row in params.rows(result.get("detections")) if row.get("colour") in wanted]
