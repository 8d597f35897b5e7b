"""pour: pour the contents of what is held into a container within reach."""

from typing import Any

from _lib import orders
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return what the robot says and what was meant."""
    return orders.carry_out(
        ctx, "pour", ("object", "into"), doing="pouring {object} into {into}", done="{object} is in {into}"
    )
