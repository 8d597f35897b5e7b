"""Text out of facts: durations, sizes, bars, times, and one line of any message of the plane. Pure.

State is shown by a sign and a word (`status_styles`), never by colour alone; foreign text is made safe.

A line is made of a message when it is drawn, not when it is heard: at thousands of messages a second nearly all are
never seen. Facts are shown by their fields, everything else as it came, bounded.
"""

import math
import time
from collections.abc import Sequence
from datetime import datetime
from typing import Any

import msgspec
from msgspec import Struct
from rich.cells import cell_len
from rich.text import Text

from appliance.model import Failure
from appliance.model.keys import fleet_and_rest
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


def sparkline(values: Sequence[float], width: int, *, span: tuple[float, float] | None = None) -> str:
    """Return the last values as a line of `width` bars at most.

    Args:
        values: not negative.
        width: cells.
        span: the values of the lowest and the highest bar; None: the least and the greatest value, on a logarithmic
            scale when they span decades.
    """
    if width <= 0 or not values:
        return ""
    shown = [max(0.0, each) if math.isfinite(each) else 0.0 for each in values[-width:]]
    least, most = span or (min(shown), max(shown))
    if span is not None:
        shown = [min(most, max(least, each)) for each in shown]
    elif most > 20 * max(least, 1e-9):
        shown = [math.log1p(each) for each in shown]
        least, most = min(shown), max(shown)
    reach = (most - least) or 1.0
    return "".join(_BARS[min(len(_BARS) - 1, int((each - least) / reach * len(_BARS)))] for each in shown)


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


KEPT = 4096
"""Bytes kept of one message: more than a line can show."""
_LONGEST = 400
_LEVELS = {"debug": "dim", "warning": "yellow", "error": "red", "exception": "red", "critical": "bold red"}
_UNKNOWN = "-" * 12
_SIGNS = {"warning": "▲", "error": "✘", "exception": "✘", "critical": "✘", "notice": "✉"}


class Heard(Struct, frozen=True, kw_only=True):
    """One message as it came. `size` is that of the whole payload; `number` counts what was heard, from 1."""

    number: int
    key: str
    at_ns: int
    payload: bytes
    size: int
    deleted: bool = False


def heard(number: int, key: str, at_ns: int, payload: bytes, *, deleted: bool = False) -> Heard:
    """Keep a message, of a long one its beginning."""
    kept = payload if len(payload) <= KEPT else payload[:KEPT]
    return Heard(number=number, key=key[:512], at_ns=at_ns, payload=kept, size=len(payload), deleted=deleted)


def plain(message: Heard) -> str:
    """Return a message as filters see it."""
    return said(message).plain


class Said(Struct, frozen=True, kw_only=True):
    """A message in words."""

    clock: str
    level: str
    source: str
    text: str

    @property
    def plain(self) -> str:
        """The line as filters see it."""
        return f"{self.clock} {self.level} {self.source} {self.text}"


def said(message: Heard) -> Said:
    """Return a message in words; whatever its payload is, it makes one line."""
    source, kind = _source(message.key)
    level, text = "", ""
    if message.deleted:
        text = "deleted"
    elif message.size > len(message.payload):
        text = f"{_raw(message.payload)} ({message.size:,} bytes)"
    else:
        level, text = _told(kind, message.payload)
    return Said(clock=clock(message.at_ns), level=level, source=source, text=safe(text, _LONGEST))


def clock(at_ns: int) -> str:
    """Return the time of day of Unix nanoseconds on this machine's clock; dashes for none."""
    if not 0 < at_ns < 2**62:
        return _UNKNOWN
    return datetime.fromtimestamp(at_ns // 1_000_000 / 1e3).astimezone().strftime("%H:%M:%S.%f")[:12]


def _source(key: str) -> tuple[str, str]:
    """Return a key without the fleet's part, and its last word: what it is about."""
    _, rest = fleet_and_rest(key)
    return safe(rest, 80), rest.rpartition("/")[2]


def _told(kind: str, payload: bytes) -> tuple[str, str]:
    """Return the level, if it has one, and the text of a payload."""
    try:
        value: Any = msgspec.json.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return "", _raw(payload)
    if not isinstance(value, dict):
        return "", safe(value, _LONGEST)
    fields: dict[str, Any] = value  # pyright: ignore[reportUnknownVariableType] - a JSON object
    if kind == "log" and "event" in fields:
        return safe(fields.get("level", ""), 10).lower(), _log(fields)
    if "text" in fields and "to" in fields:
        return "notice", f"to {fields['to']}: {fields['text']}"
    return "", _pairs(fields)


def _log(fields: dict[str, Any]) -> str:
    more = fields.get("fields")
    told = f"  {_pairs(more)}" if isinstance(more, dict) and more else ""  # pyright: ignore[reportUnknownArgumentType]
    return f"{safe(fields['event'], _LONGEST)}{told}"


def _pairs(fields: dict[str, Any]) -> str:
    out: list[str] = []
    length = 0
    for name, value in fields.items():
        if length > _LONGEST:
            break
        shown = value if isinstance(value, str) else msgspec.json.encode(value)[:_LONGEST].decode(errors="replace")
        out.append(f"{safe(name, 60)}={safe(shown, 120)}")
        length += len(out[-1])
    return " ".join(out)


def _raw(payload: bytes) -> str:
    if not payload:
        return "(empty)"
    try:
        return safe(payload[:_LONGEST].decode(), _LONGEST)
    except UnicodeDecodeError:
        return f"0x{payload[:48].hex()}{'…' if len(payload) > 48 else ''}"


def line_text(told: Said) -> Text:
    """Return the line as it is drawn: time, sign of the level, key, words."""
    style = _LEVELS.get(told.level, "green" if told.level == "notice" else "")
    return Text.assemble(
        (told.clock, "dim"),
        " ",
        (_SIGNS.get(told.level, " "), style),
        " ",
        (told.source, "cyan"),
        " ",
        (told.text, style),
        no_wrap=True,
        end="",
    )
