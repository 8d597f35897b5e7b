"""pick: grasp and lift an object that is within reach."""

from typing import Any

from _lib import params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return the object and what the robot says."""
    thing = params.text(ctx, "object")
    ctx.progress(0.1, f"picking {thing}")
    answer = ctx.command("pick", timeout_s=90, object=thing)
    ctx.progress(1.0, f"holds {thing}")
    return {**answer, "object": thing}
