"""notify: send a message; where none is given, what the subtasks before have found."""

from typing import Any

from _lib import params, summaries
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return to, text and what became of the notice."""
    to = params.text(ctx, "to")
    text = params.text(ctx, "text", default="") or summaries.overview(ctx.inputs)
    ctx.progress(0.3, f"telling {to}")
    answer = ctx.notify(to, text)
    ctx.progress(1.0, f"{to} is told")
    return {**answer, "to": to, "text": text}
