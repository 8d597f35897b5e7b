"""hold: stay where it is, for a time where one is given."""

from typing import Any

from _lib import params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return held_s and what the robot says."""
    seconds = params.number(ctx, "duration_s", default=0.0, low=0.0, high=86400.0)
    ctx.progress(0.1, f"holding for {seconds:g} s" if seconds else "holding")
    arguments = {"duration_s": seconds} if seconds else {}
    answer = ctx.command("hold", timeout_s=60 + seconds, **arguments)
    ctx.progress(1.0, "held")
    return {**answer, "held_s": seconds}
