"""land: come down where it is and wait until it stands."""

from typing import Any

from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return what the robot says, with `landed` set."""
    ctx.progress(0.1, "landing")
    answer = ctx.command("land", timeout_s=150)
    ctx.progress(1.0, "landed")
    return {**answer, "landed": True}
