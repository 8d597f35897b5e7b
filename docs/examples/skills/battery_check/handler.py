"""battery_check: is there enough in the robot's battery?"""

from typing import Any

from _lib import params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return number (percent) and at_least; fail when it is less."""
    at_least = params.number(ctx, "at_least", default=20.0, low=0.0, high=100.0)
    ctx.progress(0.1, f"asking {ctx.robot}")
    percent = ctx.command("state", timeout_s=10).get("battery_percent")
    if percent is None:
        raise ctx.Fail(f"{ctx.robot} does not report its battery", "ask a robot that does")
    if percent < at_least:
        raise ctx.Fail(f"{ctx.robot} has {percent:g} %, {at_least:g} % are wanted", "charge it first", retryable=False)
    ctx.progress(1.0, f"{percent:g} %")
    return {"number": percent, "target": "percent of battery", "at_least": at_least}
