"""What a log tells: a message, a gap, a deletion, an incident, and the status of files and recorders.

Writer, reader, CLI and terminal UI share these structs, and the matching of keys against Zenoh's key expressions, which
is done here without a Zenoh session, since logs are read where no network is: `*` is one chunk, `**` any number of
chunks (none too), `$*` any text within a chunk. `Recorders` sums up what the fleet's recorders last said, for a
gateway's own status and for diagnosis. No I/O.
"""

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache

from msgspec import Struct

from appliance.errors import ConfigError
from appliance.model import RecorderNote
from appliance.model.recorder_api import Incident, RecorderStatus


class LoggedMessage(Struct, frozen=True):
    """One put (or delete, when `deleted`) on a key. `at_ns` is Zenoh's timestamp, or the arrival's without one.

    `encoding` is Zenoh's (`application/json`, ...). `source` and `number` are the Zenoh session that put it and its
    number there (`plane.backlog`), where the sender gives it one; they are not kept in a log.
    """

    key: str
    at_ns: int
    payload: bytes
    encoding: str = ""
    deleted: bool = False
    source: str = ""
    number: int = 0


class ChannelInfo(Struct, frozen=True, kw_only=True):
    """One channel of a log: `key` is the MCAP topic; `schema` is empty for a schemaless one."""

    key: str
    messages: int
    schema: str = ""
    encoding: str = ""


class LogInfo(Struct, frozen=True, kw_only=True):
    """What is in a log file."""

    path: str
    size_bytes: int
    messages: int
    channels: tuple[ChannelInfo, ...]
    start_ns: int = 0
    end_ns: int = 0
    recovered: bool = False
    """The file was not finished (recorder killed, power cut, disk full): all whole chunks of it were read."""
    dropped: int = 0
    """Messages that the recorder could not write, by its own account in the log's gaps."""
    not_heard: int = 0
    """Messages of the fleet that never reached the recorder, by the numbers that senders give to theirs."""
    not_received: int = 0
    """Frames that vehicles sent and no gateway received, by the numbers of their frames."""
    missed: dict[str, int] = {}
    """`dropped` and `not_heard` together, by kind of key."""
    attachments: tuple[str, ...] = ()
    """Names of what is attached: the configuration, the versions, plans."""
    incidents: tuple[Incident, ...] = ()
    problems: tuple[str, ...] = ()
    metadata: dict[str, str] = {}
    """Fleet, version, recorder and start, as the recorder wrote them."""

    @property
    def duration_s(self) -> float:
        """First to last message, seconds."""
        return max(0, self.end_ns - self.start_ns) / 1e9


@lru_cache(maxsize=1024)
def compile_expression(expression: str) -> re.Pattern[str]:
    """Return the pattern whose `fullmatch` accepts the keys that `expression` includes."""
    # Each chunk takes the slash after it or the end, so that `**` can stand for no chunk without a slash left over.
    out = ""
    for chunk in expression.split("/"):
        if chunk == "**":
            out += "(?:[^/]+(?:/|$))*"
        else:
            body = "[^/]+" if chunk == "*" else "[^/]*".join(re.escape(part) for part in chunk.split("$*"))
            out += f"{body}(?:/|$)"
    return re.compile(out)


def check_expression(expression: str) -> str:
    """Return a key expression that a person has written; ConfigError for one that would never match what is meant.

    Stars beside other text are those of a shell, not of Zenoh. Slashes are let through as they come: topics of other
    writers begin with one.
    """
    wrong = not expression or any(
        ("*" in chunk.replace("$*", "") and chunk not in ("*", "**")) or "$" in chunk.replace("$*", "") or "?" in chunk
        for chunk in expression.split("/")
    )
    if wrong:
        raise ConfigError(
            f"{expression[:80]!r} is no key expression",
            remedy="`*` is one chunk between slashes, `**` any number, `$*` any text within one: **/gw-$*/log",
        )
    return expression


def matches(expression: str, key: str) -> bool:
    """Whether `expression` includes `key`."""
    return compile_expression(expression).fullmatch(key) is not None


MOST_RECORDERS = 8
SILENT_S = 5.0
"""A recorder tells of itself every second; without word for so long something is wrong with it."""
GONE_S = 1.25
"""The same for one whose token is gone: its process ended, or the link to it was cut. A token alone says too little: it
can get lost when a link is made again, and the recorder is still heard."""
BACK_S = 0.3
"""A token that is back so soon was never gone."""
FORGET_S = 3600.0
"""One that was not heard for so long is not expected any more."""
SILENT = "silent"
_KINDS = 10
"""Kinds of keys that a note names; the rest are counted together."""


class Recorders:
    """The recorders as heard; times are monotonic seconds."""

    def __init__(self) -> None:
        self._heard: dict[str, tuple[RecorderStatus, float]] = {}
        self._gone: dict[str, float] = {}
        """Since when the token of each is gone, of those that were not heard since."""

    def there(self, name: str) -> None:
        """Take that a recorder's token is there."""
        self._gone.pop(name, None)

    def went(self, name: str, now: float) -> float:
        """Take that a recorder's token is gone; returns in how many seconds its note is to be looked at again."""
        if name not in self._heard:
            return 0.0  # it stopped in good order, or never said anything
        self._gone[name] = now
        return max(0.0, self._silent_at(name) - now)

    def _silent_at(self, name: str) -> float:
        """Return from when on a recorder counts as silent, if nothing more is heard of it."""
        heard_at = self._heard[name][1]
        gone_at = self._gone.get(name)
        return heard_at + SILENT_S if gone_at is None else max(heard_at + GONE_S, gone_at + BACK_S)

    def hear(self, status: RecorderStatus, now: float) -> bool:
        """Take a recorder's account of itself; whether anything of its note is new. One that stops is forgotten."""
        before = self.notes(now)
        self._gone.pop(status.id, None)
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
            self._gone.pop(name, None)
        return tuple(
            note_of(status, silent=now > self._silent_at(name)) for name, (status, _) in sorted(self._heard.items())
        )


def note_of(status: RecorderStatus, *, silent: bool = False) -> RecorderNote:
    """Return the part of a recorder's status that goes into its gateway's."""
    most = sorted(status.missed.items(), key=lambda each: (-each[1], each[0]))
    keys = dict(most[:_KINDS])
    if rest := sum(count for _, count in most[_KINDS:]):
        keys["(others)"] = rest
    return RecorderNote(
        id=status.id,
        state=SILENT if silent else status.state,
        problem=status.problem[:300],
        going=status.going[:300],
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
        parts.append("not heard any more")
    if note.problem:
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
