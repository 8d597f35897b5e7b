"""Messages that never came: speakers number what they say, and a hole in the numbers is missing from the log.

A recorder can only write down what it hears. What was lost on the way to it, or never sent, shows in the numbers of
those kinds of messages that have one: log lines of a gateway, events of a run, transitions of a task, frames of a
MAVLink component (one byte, so a loss of 256 in a row does not show). Pure state: no clock, no I/O.
"""

from collections import OrderedDict

import msgspec
from msgspec import Struct

from appliance.plane.keys import Keys
from appliance.record.expressions import compile_expression

MOST_SOURCES = 20_000
"""Speakers whose numbers are remembered; the one that was silent for longest is forgotten first."""
_V1, _V2 = 0xFE, 0xFD
_WINDOW = 256
_RESTARTED = 3
"""So many frames in a row that follow each other, and not the last one, are of a component that began again."""
_UNHEARD = (-1, -1, 0)


class _Numbered(Struct):
    """A message's own numbers: what it tells about may have such fields as well."""

    number: int = -1
    sequence: int = -1
    attempt: int = 0
    coordinator: str = ""


class Hole(Struct, frozen=True):
    """So many messages are missing before the one that was just heard."""

    source: str
    missing: int
    key: str


class Sequences:
    """Notices holes in the numbers of one fleet's speakers."""

    def __init__(self, keys: Keys) -> None:
        self._last: OrderedDict[tuple[str, str], tuple[int, int, int]] = OrderedDict()
        """The last number of each, the last one that came behind it, and how many of those came in a row."""
        self._kinds = (
            (compile_expression(keys.transition()), "transition"),
            (compile_expression(keys.run()), "run"),
            (compile_expression(keys.log()), "log"),
            # Not of what is sent: each other end is told a part of it.
            (compile_expression(keys.mavlink(direction="rx")), "mavlink"),
            (compile_expression(keys.link_frames(direction="rx")), "mavlink"),
        )
        self.missing: dict[str, int] = {}
        """Messages not heard so far, by kind."""

    def kind_of(self, key: str) -> str:
        """Return which numbers messages of a key have; "" for none. To be asked once a key."""
        return next((kind for pattern, kind in self._kinds if pattern.fullmatch(key)), "")

    def heard(self, kind: str, key: str, payload: bytes) -> Hole | None:
        """Note a message; returns the hole before it, if there is one."""
        if kind == "mavlink":
            return self._frame(key, payload)
        try:
            told = msgspec.json.decode(payload, type=_Numbered)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return None
        number, source = (told.sequence, told.coordinator[:80]) if kind == "transition" else (told.number, "")
        if kind == "run":
            source = str(told.attempt)
        if number < 0:
            return None
        last = self._note((key, source), number)
        # A new coordinator goes on from a record, a new process counts anew: neither is a hole.
        if last is None or number <= last + 1:
            return None
        return self._hole(kind, number - last - 1, key)

    def _frame(self, key: str, payload: bytes) -> Hole | None:
        if len(payload) >= 10 and payload[0] == _V2:
            number, speaker = payload[4], f"{payload[5]}/{payload[6]}"
        elif len(payload) >= 6 and payload[0] == _V1:
            number, speaker = payload[2], f"{payload[3]}/{payload[4]}"
        else:
            return None
        source = (key, speaker)
        last, late, run = self._last.get(source, _UNHEARD)
        ahead = (number - last) % _WINDOW
        if last < 0 or 0 < ahead <= _WINDOW // 2:
            self._note(source, number)
            return self._hole("mavlink", ahead - 1, key) if last >= 0 and ahead > 1 else None
        # Behind: one that was overtaken, or is told again; or its speaker has begun again, as some in a row show.
        run = run + 1 if number == (late + 1) % _WINDOW else 1
        if run < _RESTARTED:
            self._note(source, last, late=number, run=run)
        else:
            self._note(source, number)
        return None

    def _note(self, source: tuple[str, str], number: int, *, late: int = -1, run: int = 0) -> int | None:
        """Remember what was heard last of a source; returns what was before."""
        last, _, _ = self._last.pop(source, _UNHEARD)
        self._last[source] = (number, late, run)
        if len(self._last) > MOST_SOURCES:
            self._last.popitem(last=False)
        return None if last < 0 else last

    def _hole(self, kind: str, missing: int, key: str) -> Hole:
        self.missing[kind] = self.missing.get(kind, 0) + missing
        return Hole(kind, missing, key)
