"""place: put a held object down at something within reach."""

from typing import Any

from _lib import params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return the object, where it is now, and what the robot says."""
    thing, at = params.text(ctx, "object"), params.text(ctx, "at")
    ctx.progress(0.1, f"putting {thing} at {at}")
    answer = ctx.command("place", timeout_s=90, object=thing, at=at)
    ctx.progress(1.0, f"{thing} is at {at}")
    return {**answer, "object": thing, "at": at}
