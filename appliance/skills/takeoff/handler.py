"""takeoff: climb to an altitude within the site's limit."""

from typing import Any

from _lib import params
from _lib.context import Context

USUAL_M = 5.0
"""Altitude when none is asked for, metres above home."""


def run(ctx: Context) -> dict[str, Any]:
    """Return altitude_m and what the robot says."""
    limit = float(ctx.site.get("altitude_limit_m", 60.0))
    altitude = params.number(ctx, "altitude_m", default=min(USUAL_M, limit), low=0.5, high=10000.0)
    if altitude > limit:
        raise ctx.CallError(
            "payload", f"{altitude:g} m is above the site's limit of {limit:g} m", f"ask for at most {limit:g} m"
        )
    ctx.progress(0.1, f"climbing to {altitude:g} m")
    answer = ctx.command("takeoff", timeout_s=90, altitude_m=altitude)
    ctx.progress(1.0, f"at {altitude:g} m")
    return {**answer, "altitude_m": altitude}
