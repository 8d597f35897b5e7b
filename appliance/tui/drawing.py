"""Text out of facts: durations, bars, and the drawing of a plan. Pure, so that tests read what a person reads.

State is told by a sign and a word, never by colour alone; foreign text is made safe.
"""

import math
import time
from collections.abc import Sequence
from datetime import datetime

from rich.cells import cell_len

from appliance.model import Failure
from appliance.tui.safe import safe

Cell = str | tuple[str, str]
"""A text, or a text and its style, as tables take them."""

_BAR_WIDTH = 12
_BARS = "▁▂▃▄▅▆▇█"


def milliseconds(value: float | None, none: str = "") -> str:
    """Return milliseconds for people; `none` when there are none."""
    if value is None:
        return none
    if not value >= 1000:
        return f"{value:.1f} ms" if value < 100 else f"{value:.0f} ms"
    return f"{value / 1000:.1f} s" if value < 600_000 else duration(value / 1000)


def duration(seconds: float) -> str:
    """Return a duration for people in at most five characters: 4 s, 12 m, 3 h, 5 d."""
    seconds = max(0.0, seconds)
    for unit, length, limit in (("s", 1.0, 60.0), ("m", 60.0, 3600.0), ("h", 3600.0, 86_400.0)):
        if seconds < limit:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds / 86_400:.0f} d"


def file_size(size: int) -> str:
    """Return the size of a file for people, in at most nine characters."""
    return f"{size / 2**10:.0f} KiB" if size < 2**20 else f"{size / 2**20:.1f} MiB"


def counted(number: int, thing: str) -> str:
    """Return so many of a thing whose plural takes an s."""
    return f"{number:,} {thing}{'' if number == 1 else 's'}"


def bar(fraction: float, width: int = _BAR_WIDTH) -> str:
    """Return a progress bar of `width` cells and the percentage; `fraction` outside 0 to 1 is cut."""
    share = min(1.0, max(0.0, fraction)) if math.isfinite(fraction) else 0.0
    full = round(share * width)
    return f"{'█' * full}{'░' * (width - full)} {share:.0%}"


def sparkline(values: Sequence[float], width: int) -> str:
    """Return the last values as a line of `width` bars at most; on a logarithmic scale when they span decades."""
    if width <= 0 or not values:
        return ""
    shown = [max(0.0, each) if math.isfinite(each) else 0.0 for each in values[-width:]]
    least, most = min(shown), max(shown)
    if most > 20 * max(least, 1e-9):
        shown = [math.log1p(each) for each in shown]
        least, most = min(shown), max(shown)
    span = (most - least) or 1.0
    return "".join(_BARS[min(len(_BARS) - 1, int((each - least) / span * len(_BARS)))] for each in shown)


def hanging(text: str, margin: str, width: int) -> str:
    """Return a text with a margin before each line that it takes in so many cells; as one line without a width.

    Textual would begin the lines that follow at the left edge, where they look like something of their own.
    """
    if width <= cell_len(margin) + 20:
        return f"{margin}{text}"
    lines, line = list[str](), ""
    for word in text.split(" "):
        if line and cell_len(margin) + cell_len(line) + 1 + cell_len(word) > width:
            lines, line = [*lines, line], word
        else:
            line = f"{line} {word}" if line else word
    return "\n".join(f"{margin}{each}" for each in [*lines, line])


def told(failure: Failure | None) -> str:
    """Return a failure with its remedy in one line."""
    if failure is None:
        return ""
    return safe(f"{failure.message} → {failure.remedy}" if failure.remedy else failure.message)


def age(since_ns: int, now_ns: int = 0) -> str:
    """Return for how long something has been so, in at most five characters; empty when it was not told.

    Args:
        since_ns: Unix nanoseconds; 0: not told.
        now_ns: Unix nanoseconds; 0: now.
    """
    if since_ns <= 0:
        return ""
    seconds = max(0, ((now_ns or time.time_ns()) - since_ns) // 10**9)
    for unit, length in (("d", 86_400), ("h", 3600), ("m", 60)):
        if seconds >= length:
            return f"{min(9999, seconds // length)}{unit}"
    return f"{seconds}s"


def clock(at_ns: int) -> str:
    """Return the time of day for people; dashes for none, or one that no calendar has."""
    try:
        return datetime.fromtimestamp(at_ns / 1e9).astimezone().strftime("%H:%M:%S") if at_ns > 0 else "--:--:--"
    except (OverflowError, OSError, ValueError):
        return "--:--:--"
