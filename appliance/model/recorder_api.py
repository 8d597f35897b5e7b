"""What recorders and replays put, and what they write into logs beside what they hear."""

from msgspec import Struct, field


class Gap(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Messages that are not in the log, and why: what was dropped is itself written down."""

    reason: str
    """`queue full`, `disk full`, `too large` or `write error`: dropped here. `not heard`: numbers that a speaker left
    out, or that were lost on the way here (see `source`)."""
    dropped: int
    payload_bytes: int = 0
    since_ns: int = 0
    until_ns: int = 0
    last_key: str = ""
    """Key of the last message dropped, as a hint."""
    source: str = ""
    """Of what was not heard: whose numbers have a hole. `plane`: of a session of the fleet; `mavlink`: frames of a
    vehicle that no gateway received, lost on its link or while its gateway was down; `log`, `run` and `transition`: of
    senders whose sessions give no numbers."""
    keys: dict[str, int] = {}
    """The same count by kind of key, such as `gw/*/log`."""


class Deletion(Struct, frozen=True, kw_only=True):
    """A key that was deleted: a delete carries no payload, so it cannot stand on its key's own channel."""

    key: str
    at_ns: int


class Trigger(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Somebody, or something, says that what has just happened is worth keeping."""

    reason: str
    by: str = ""


class Incident(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What made the recorder keep what it has, in the log at the place where it happened."""

    reason: str
    """`task failed`, `failsafe`, `stop` or `asked`."""
    detail: str = ""
    key: str = ""
    """Of the message that told it."""
    at_ns: int = 0
    before_s: float = 0.0
    """How far back the log goes from here, where it had waited in the ring."""


class RecorderStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A recorder's account of itself, put every second."""

    id: str
    fleet: str
    state: str = "starting"
    """`recording`, `waiting` (for an incident), `paused` (see `problem`), `failed` or `stopped`."""
    problem: str = ""
    file: str = ""
    """File name within the recorder's directory."""
    files: int = 0
    messages: int = 0
    file_bytes: int = 0
    queued: int = 0
    dropped: dict[str, int] = field(default_factory=dict[str, int])
    """Messages not recorded, by reason."""
    not_heard: dict[str, int] = field(default_factory=dict[str, int])
    """Messages that never came here, by whose numbers they are missing from."""
    fetched: int = 0
    """Messages that did not reach it when they were put, and were fetched from their senders afterwards."""
    missed: dict[str, int] = field(default_factory=dict[str, int])
    """Messages of the fleet that are not in its log, dropped or not heard, by kind of key, such as `gw/*/log`."""
    missed_at_ns: int = 0
    """Time of the last of them; 0: none is missing."""
    redacted: int = 0
    """Messages from which a secret was taken."""
    incidents: int = 0
    last_incident: str = ""
    unwritten_incidents: int = 0
    """Of them, those that wait in memory until there is room on the disk."""
    held: int = 0
    """Messages that wait in the ring for an incident."""
    removed: int = 0
    """Old files removed to stay within the budget of disk and days."""
    going: str = ""
    """Which logs are removed soon if nobody keeps them, in words; empty when none are."""
    started_ns: int = 0
    at_ns: int = 0


class Clock(Struct, frozen=True, kw_only=True):
    """The time in a log that is being replayed, put a few times a second."""

    at_ns: int
    rate: float
    """Seconds of the log a second; 0: as fast as possible."""
    paused: bool = False
    ended: bool = False
