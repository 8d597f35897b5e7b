"""One order to the robot, carried out by it: shared by skills whose whole work is the robot's own."""

from collections.abc import Sequence
from typing import Any

from . import params
from .context import Context

LONGEST_S = 240.0
"""How long the robot may take, seconds: less than these skills' runs."""


def carry_out(
    ctx: Context, verb: str, needed: Sequence[str], *, optional: Sequence[str] = (), doing: str, done: str
) -> dict[str, Any]:
    """Give the robot one order with texts from the plan, and wait until it is done.

    Args:
        ctx: the run.
        verb: what the robot is told.
        needed: parameters that the order must have, texts.
        optional: those it gets where the plan has them.
        doing: what is said before, with the parameters in braces.
        done: what is said after.

    Returns:
        What the robot answers, and the parameters.
    """
    order = {name: params.text(ctx, name) for name in needed}
    order |= {name: params.text(ctx, name) for name in optional if ctx.params.get(name) is not None}
    ctx.progress(0.1, doing.format(**order))
    answer = ctx.command(verb, timeout_s=LONGEST_S, **order)
    ctx.progress(1.0, done.format(**order))
    return {**answer, **order}
