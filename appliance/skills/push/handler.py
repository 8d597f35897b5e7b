"""push: push or pull a thing within reach to a place, or a step ahead."""

from typing import Any

from _lib import orders
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return what the robot says and what was meant."""
    return orders.carry_out(
        ctx, "push", ("object",), optional=("to",), doing="pushing {object}", done="{object} is pushed"
    )
