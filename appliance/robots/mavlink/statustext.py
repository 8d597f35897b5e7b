"""STATUSTEXT, both ways: what people at ground stations read, and what a vehicle says in words.

A text of more than 50 characters goes and comes in parts with a common `id` (MAVLink guide, STATUSTEXT); parts can be
lost, so what has arrived is passed on after a while with a mark where something is missing. What a vehicle said may
explain why it refused (`Texts`: pure, the clock passed in).
"""

import secrets
from collections import OrderedDict, deque

from msgspec import Struct

from appliance.robots.mavlink.dialect import Message, make

INFO, NOTICE, WARNING, ERROR = 6, 5, 4, 3
"""MAV_SEVERITY."""
PART = 50
"""Characters of one STATUSTEXT."""
MOST = 4 * PART
"""Characters of a text that is sent: longer ones are cut, and end with `...`."""


def statustext(text: str, severity: int) -> list[Message]:
    """Return a text as at most five parts; ASCII, since displays on radios know no other."""
    data = text.encode("ascii", "replace")
    if len(data) > MOST:
        data = data[: MOST - 4].rstrip() + b"..."  # the last part is then not full
    return parts(data, severity)


def parts(data: bytes, severity: int) -> list[Message]:
    """Return a text as it is in parts with a common id, none where one is enough.

    A part that is not full ends a text, so one whose last part is full has an empty one behind it (MAVLink,
    STATUSTEXT).
    """
    if len(data) <= PART:
        return [make("STATUSTEXT", severity=severity, text=data, id=0, chunk_seq=0)]
    number = 1 + secrets.randbelow(65_535)
    return [
        make("STATUSTEXT", severity=severity, text=data[at : at + PART], id=number, chunk_seq=at // PART)
        for at in range(0, len(data) + 1, PART)
    ]


MAX_PARTS = 8
MAX_OPEN = 8
KEPT = 32
REFUSAL_SEVERITY = 4
"""MAV_SEVERITY_WARNING: what is less urgent explains no refusal, unless it says so itself."""
_PATIENCE_S = 1.0
_EXPLAINS = ("prearm:", "arm:", "arming:")


class Said(Struct, frozen=True):
    """A whole text: when it was heard (monotonic seconds), MAV_SEVERITY, words."""

    at: float
    severity: int
    text: str

    @property
    def explains(self) -> bool:
        """Whether it may tell why something was refused."""
        return self.severity <= REFUSAL_SEVERITY or self.text.lower().startswith(_EXPLAINS)


class Texts:
    """Texts of one vehicle, the last ones kept."""

    def __init__(self) -> None:
        self._open: OrderedDict[int, tuple[float, int, dict[int, str]]] = OrderedDict()
        self._said: deque[Said] = deque(maxlen=KEPT)

    def take(self, severity: int, text: str | bytes, number: int, part: int, now: float) -> Said | None:
        """Take in a STATUSTEXT; return the text that it completes, if it does."""
        raw = text if isinstance(text, bytes) else text.encode("utf-8", "replace")
        words = raw.split(b"\0")[0].decode("utf-8", "replace")
        if number == 0:
            return self._keep(Said(now, severity, words.strip()))
        if not 0 <= part < MAX_PARTS:
            return None
        began, _, parts = self._open.setdefault(number, (now, severity, {}))
        parts[part] = words
        while len(self._open) > MAX_OPEN:
            self._close(next(iter(self._open)))
        # A part that is not full is the last one.
        last = next((index for index, each in sorted(parts.items()) if len(each.encode()) < PART), None)
        if (last is not None and len(parts) == last + 1) or len(parts) == MAX_PARTS:
            return self._close(number)
        del began
        return None

    def tick(self, now: float) -> list[Said]:
        """Give up waiting for parts that do not come; return the texts as far as they came.

        Some senders end a text with a full part: nothing but the time tells that it was the last one.
        """
        late = [number for number, (began, _, _) in self._open.items() if now - began > _PATIENCE_S]
        return [self._close(number) for number in late]

    def since(self, at: float, now: float) -> tuple[str, ...]:
        """Return the words since a time that may explain a refusal, each once, oldest first."""
        self.tick(now + _PATIENCE_S)
        return tuple(dict.fromkeys(each.text for each in self._said if each.at >= at and each.explains and each.text))

    def _close(self, number: int) -> Said:
        began, severity, parts = self._open.pop(number)
        words = "".join(parts.get(index, "…") for index in range(max(parts) + 1))
        return self._keep(Said(began, severity, words.strip()))

    def _keep(self, said: Said) -> Said:
        self._said.append(said)
        return said
