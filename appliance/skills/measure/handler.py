"""measure: a quantity such as distance, temperature, gas or sound level, by the robot's own sensor."""

import math
from typing import Any

from _lib import params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return number, unit, quantity, target and what the robot says."""
    quantity = params.text(ctx, "quantity")
    target = params.text(ctx, "target", default="")
    ctx.progress(0.1, f"measuring {quantity}")
    answer = ctx.command("measure", timeout_s=60, quantity=quantity, target=target)
    value = answer.get("number")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ctx.Fail(
            f"{ctx.robot} answered {value!r} for {quantity}, no number", "look at its sensor", retryable=True
        )
    unit = str(answer.get("unit", ""))
    ctx.progress(1.0, f"{quantity}: {value:g} {unit}".strip())
    return {**answer, "number": float(value), "unit": unit, "quantity": quantity, "target": target}
