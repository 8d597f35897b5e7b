"""Messages that never came: speakers number what they say, and a hole in the numbers is missing from the log.

A recorder can only write down what it hears. What was lost on the way to it, or never sent, shows in the numbers of
those kinds of messages that have one: log lines of a gateway, events of a run, transitions of a task, frames of a
MAVLink component (one byte, so a loss of 256 in a row does not show). Pure state: no clock, no I/O.
"""

import re
from collections import OrderedDict

from msgspec import Struct

from appliance.plane.keys import Keys
from appliance.record.expressions import compile_expression

MOST_SOURCES = 20_000
"""Speakers whose numbers are remembered; the one that was silent for longest is forgotten first."""
_NUMBER = re.compile(rb'"number"\s*:\s*(\d{1,18})')
_SEQUENCE = re.compile(rb'"sequence"\s*:\s*(\d{1,18})')
_ATTEMPT = re.compile(rb'"attempt"\s*:\s*(\d{1,9})')
_COORDINATOR = re.compile(rb'"coordinator"\s*:\s*"([^"]{0,80})"')
_V1, _V2 = 0xFE, 0xFD
_WINDOW = 256


class Hole(Struct, frozen=True):
    """So many messages are missing before the one that was just heard."""

    source: str
    missing: int
    key: str


class Sequences:
    """Notices holes in the numbers of one fleet's speakers."""

    def __init__(self, keys: Keys) -> None:
        self._last: OrderedDict[tuple[str, str], int] = OrderedDict()
        self._kinds = (
            (compile_expression(keys.transition()), "transition"),
            (compile_expression(keys.run()), "run"),
            (compile_expression(keys.log()), "log"),
            (compile_expression(keys.mavlink()), "mavlink"),
            (compile_expression(keys.link_frames()), "mavlink"),
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
        found = (_SEQUENCE if kind == "transition" else _NUMBER).search(payload)
        if found is None:
            return None
        source = ""
        if kind == "run" and (attempt := _ATTEMPT.search(payload)):
            source = attempt.group(1).decode()
        elif kind == "transition" and (coordinator := _COORDINATOR.search(payload)):
            source = coordinator.group(1).decode("utf-8", "replace")
        number = int(found.group(1))
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
        last = self._note((key, speaker), number)
        missing = 0 if last is None else (number - last - 1) % _WINDOW
        # More than half of the circle is one that was overtaken, not 200 that were lost.
        return self._hole("mavlink", missing, key) if 0 < missing < _WINDOW // 2 else None

    def _note(self, source: tuple[str, str], number: int) -> int | None:
        last = self._last.pop(source, None)
        self._last[source] = number
        if len(self._last) > MOST_SOURCES:
            self._last.popitem(last=False)
        return last

    def _hole(self, kind: str, missing: int, key: str) -> Hole:
        self.missing[kind] = self.missing.get(kind, 0) + missing
        return Hole(kind, missing, key)
