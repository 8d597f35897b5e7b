"""clean: wash, wipe, sweep or vacuum a thing or an area within reach."""

from typing import Any

from _lib import orders
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return what the robot says and what was meant."""
    return orders.carry_out(ctx, "clean", ("object",), doing="cleaning {object}", done="{object} is clean")
