"""give: hand a held object to a person within reach."""

from typing import Any

from _lib import params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return the object, who has it now, and what the robot says."""
    thing = params.text(ctx, "object")
    to = params.text(ctx, "to")
    ctx.progress(0.1, f"giving {thing} to {to}")
    answer = ctx.command("give", timeout_s=90, object=thing, to=to)
    ctx.progress(1.0, f"{to} has {thing}")
    return {**answer, "object": thing, "given_to": answer.get("to", to)}
