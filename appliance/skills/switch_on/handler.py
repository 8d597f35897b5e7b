"""switch_on: switch a device on that is within reach."""

from typing import Any

from _lib import params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return the object, its state and what the robot says."""
    thing = params.text(ctx, "object")
    ctx.progress(0.1, f"switching on {thing}")
    answer = ctx.command("switch_on", timeout_s=90, object=thing)
    ctx.progress(1.0, f"{thing} is on")
    return {**answer, "object": thing}
