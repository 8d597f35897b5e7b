"""cut: cut or slice a thing within reach."""

from typing import Any

from _lib import orders
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return what the robot says and what was meant."""
    return orders.carry_out(ctx, "cut", ("object",), doing="cutting {object}", done="{object} is cut")
