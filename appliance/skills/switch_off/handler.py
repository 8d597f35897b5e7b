"""switch_off: switch a device off that is within reach."""

from typing import Any

from _lib import params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return the object, its state and what the robot says."""
    thing = params.text(ctx, "object")
    ctx.progress(0.1, f"switching off {thing}")
    answer = ctx.command("switch_off", timeout_s=90, object=thing)
    ctx.progress(1.0, f"{thing} is off")
    return {**answer, "object": thing}
