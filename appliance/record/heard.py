"""What a gateway hears of the fleet's recorders, for its own status and for whoever asks what is wrong. Pure."""

from collections.abc import Iterable, Mapping

from appliance.model import RecorderNote
from appliance.record.facts import RecorderStatus

MOST_RECORDERS = 8
SILENT_S = 5.0
"""A recorder tells of itself every second; without word for so long something is wrong with it."""
FORGET_S = 3600.0
"""One that was not heard for so long is not expected any more."""
SILENT = "silent"
_KINDS = 10
"""Kinds of keys that a note names; the rest are counted together."""


class Recorders:
    """The recorders as heard; times are monotonic seconds."""

    def __init__(self) -> None:
        self._heard: dict[str, tuple[RecorderStatus, float]] = {}

    def hear(self, status: RecorderStatus, now: float) -> bool:
        """Take a recorder's account of itself; whether anything of its note is new. One that stops is forgotten."""
        before = self.notes(now)
        if status.state == "stopped":
            self._heard.pop(status.id, None)
        elif status.id in self._heard or len(self._heard) < MOST_RECORDERS:
            self._heard[status.id] = (status, now)
        return self.notes(now) != before

    def notes(self, now: float) -> tuple[RecorderNote, ...]:
        """Return what is to be known of each, by name."""
        gone = [name for name, (_, at) in self._heard.items() if now - at > FORGET_S]
        for name in gone:
            del self._heard[name]
        return tuple(note_of(status, silent=now - at > SILENT_S) for _, (status, at) in sorted(self._heard.items()))


def note_of(status: RecorderStatus, *, silent: bool = False) -> RecorderNote:
    """Return the part of a recorder's status that others are told of."""
    most = sorted(status.missed.items(), key=lambda each: (-each[1], each[0]))
    keys = dict(most[:_KINDS])
    if rest := sum(count for _, count in most[_KINDS:]):
        keys["(others)"] = rest
    return RecorderNote(
        id=status.id,
        state=SILENT if silent else status.state,
        problem=status.problem[:300],
        missed=sum(status.missed.values()),
        keys=keys,
        missed_at_ns=status.missed_at_ns,
    )


def kinds_text(keys: Mapping[str, int], *, most: int = 3) -> str:
    """Return kinds of keys with their counts, the largest first: `gw/*/log 12, robot/*/mavlink/* 3`."""
    ranked = sorted(keys.items(), key=lambda each: (-each[1], each[0]))
    named = [f"{kind[:60]} {count:,}" for kind, count in ranked[:most]]
    more = len(ranked) - most
    return ", ".join(named) + (f" and {more} more" if more > 0 else "")


def problem_of(note: RecorderNote) -> str:
    """Return what is wrong with a recorder, in one line; empty when nothing is."""
    parts: list[str] = []
    if note.state == SILENT:
        parts.append(f"not heard for more than {SILENT_S:g} s")
    elif note.problem:
        parts.append(note.problem)
    if note.missed:
        parts.append(f"missed {note.missed:,} messages of keys {kinds_text(note.keys)}")
    return "; ".join(parts)


def together(notes: Iterable[RecorderNote]) -> tuple[RecorderNote, ...]:
    """Return one note for each recorder of what several gateways tell: a gateway that is cut off knows less.

    The one with the most misses; silent only where all call it so.
    """
    found: dict[str, RecorderNote] = {}
    for note in notes:
        old = found.get(note.id)
        if old is None or (note.state != SILENT, note.missed) > (old.state != SILENT, old.missed):
            found[note.id] = note
    return tuple(found[name] for name in sorted(found))
