"""One line of text out of any message of the plane: facts by their fields, everything else as it came, bounded.

A line is made when it is drawn, not when it is heard: at thousands of messages a second nearly all are never seen.
"""

from datetime import datetime
from typing import Any

import msgspec
from msgspec import Struct
from rich.text import Text

from appliance.tui.safe import safe

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
    chunks = key.split("/")
    if chunks[0] == "swiftbot" and len(chunks) > 2:
        chunks = chunks[2:]
    return safe("/".join(chunks), 80), chunks[-1]


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
