"""follow: keep behind a moving person, robot or vehicle for some time; the robot sees where its target is."""

from typing import Any

from _lib import moves, params
from _lib.context import Context

USUAL_S = 30.0
BEHIND_M = 2.0
"""Distance kept, metres."""


def run(ctx: Context) -> dict[str, Any]:
    """Return target, duration_s and what the robot says, such as how far it went."""
    target = params.text(ctx, "target")
    lasting = params.number(ctx, "duration_s", default=USUAL_S, low=1.0, high=3600.0)
    ctx.progress(0.1, f"following {target} for {lasting:g} s")
    answer = ctx.command(
        "follow",
        timeout_s=lasting + 60.0,
        target=target,
        duration_s=lasting,
        distance_m=BEHIND_M,
        speed_mps=moves.speed(ctx),
    )
    ctx.progress(1.0, f"followed {target}")
    return {**answer, "target": target, "duration_s": lasting}
