"""wait_for: wait for a time, or until a person confirms that something has happened."""

import re
import time
from typing import Any

from _lib import params
from _lib.context import Context

LONGEST_S = 290.0
_TIME = re.compile(r"(\d+(?:\.\d+)?)\s*(s|sec|second|m|min|minute)s?")
_TICK_S = 0.5


def run(ctx: Context) -> dict[str, Any]:
    """Return what was waited for, that it was confirmed or how long it was waited, and where the robot stood."""
    event = params.text(ctx, "event")
    limit_s = params.number(ctx, "timeout_s", default=240.0, low=1.0, high=LONGEST_S)
    if (said := _TIME.fullmatch(event.strip().lower())) is not None:
        seconds = float(said[1]) * (60.0 if said[2].startswith("m") else 1.0)
        if seconds > LONGEST_S:
            raise ctx.CallError("payload", f"{event} is longer than {LONGEST_S:g} s", remedy="split the wait")
        return {"event": event, "waited_s": _wait(ctx, seconds), "pose": ctx.command("state").get("pose")}
    ctx.progress(0.1, f"waits for: {event}")
    answer = ctx.ask(f"{ctx.robot or 'A task'} waits for: {event}. Has it happened?", ("yes", "no"), timeout_s=limit_s)
    if answer != "yes":
        raise ctx.Fail(f"it has not happened: {event}", remedy="a person said no")
    ctx.progress(1.0, "confirmed")
    return {"event": event, "confirmed": True, "pose": ctx.command("state").get("pose")}


def _wait(ctx: Context, seconds: float) -> float:
    began = time.monotonic()
    while (waited := time.monotonic() - began) < seconds:
        ctx.progress(waited / seconds, f"{seconds - waited:.0f} s left")
        time.sleep(min(_TICK_S, seconds - waited))
    return seconds
