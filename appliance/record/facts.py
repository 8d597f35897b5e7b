"""What a log tells: one message, a gap in it, a deletion, and the account of a file or a recorder.

They exist apart from writer and reader because both sides, the CLI and the terminal UI speak in them.
"""

from msgspec import Struct, field


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
    """Old files removed to stay within the disk budget."""
    started_ns: int = 0
    at_ns: int = 0


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
