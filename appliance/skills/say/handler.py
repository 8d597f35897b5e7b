"""say: speak, or show words, to people near by."""

from typing import Any

from _lib import params
from _lib.context import Context

MAX_CHARACTERS = 300
"""What a vehicle without a speaker can show as a text."""


def run(ctx: Context) -> dict[str, Any]:
    """Return what was said and what the robot says about it."""
    text = params.text(ctx, "text")
    to = params.text(ctx, "to", default="")
    words = f"{to}: {text}" if to else text
    if len(words) > MAX_CHARACTERS:
        raise ctx.CallError("payload", f"{len(words)} characters to say", f"say at most {MAX_CHARACTERS} at once")
    ctx.progress(0.1, f"saying {words[:60]}")
    answer = ctx.command("say", timeout_s=120, text=words)
    ctx.progress(1.0, "said")
    return {**answer, "said": words}
