"""return_home: go back to the launch position and wait until it is there."""

from typing import Any

from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return what the robot says, with `home` set."""
    ctx.progress(0.1, "returning home")
    answer = ctx.command("return_home", timeout_s=500)
    ctx.progress(1.0, "home")
    return {**answer, "home": True}
