"""ask: put a question to people and wait for the answer."""

from typing import Any

from _lib import params
from _lib.context import Context

WAIT_S = 270.0
"""Less than the skill's own time, so that the answer is "nobody" and not a run that was cut off."""


def run(ctx: Context) -> dict[str, Any]:
    """Return the question, the answer as text, and where the robot stood."""
    question = params.text(ctx, "question")
    to = params.text(ctx, "to", default="operator")
    ctx.progress(0.1, f"asks {to}: {question}")
    answer = ctx.ask(question, to=to, timeout_s=WAIT_S)
    ctx.progress(1.0, answer)
    return {"question": question, "text": answer, "pose": ctx.command("state").get("pose")}
