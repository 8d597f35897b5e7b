"""A log as segments, MCAP files one after another: channels, rotation, gaps, attachments, and a disk that is full.

`OpenLog` is one segment while it is written; `LogWriter` starts and ends segments. Both are synchronous and without
threads or network, with clock, free space and file passed in, so that every way a disk can fail is tried in a test.
The writer never raises for the disk's sake: it pauses, says why in `problem`, counts what it could not write, and goes
on by itself when there is space again, with a `Gap` in the log and the incidents that happened meanwhile.

`About` is what goes into each segment beside the messages: the configuration without its secrets, and the versions.
"""

import errno
import platform
import sys
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, cast

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import RecordError
from appliance.model import Site, keyspace
from appliance.model.keys import Keys
from appliance.model.recorder_api import Deletion, Gap, Incident
from appliance.plane.backlog import UNKNOWN, kind_of
from appliance.record.channels import Shared, shared_for
from appliance.record.mcap_writer import LogFile, McapFile, free_bytes
from appliance.record.models import LoggedMessage
from appliance.record.redact import LEAST_SECRET, Redactor, known_secrets, without_secrets
from appliance.record.retention import finished, going_text, make_room
from appliance.record.schemas import ChannelKind, Derive, Foxglove, KeySchemas
from appliance.record.settings import RecordConfig

JSON = "application/json"
LAST_NS = 2**63 - 1
MOST_ATTACHMENTS = 1_000
"""Attachments of a file: each is in its index, which readers hold in memory."""


class File(Protocol):
    """What is needed of a file; `LogFile`, or a failing one in tests."""

    path: Path

    def write(self, data: bytes, /) -> int: ...  # noqa: D102 - see LogFile
    def tell(self) -> int: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102
    def sync(self) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102
    def abandon(self) -> bool: ...  # noqa: D102


class Attached(Struct, frozen=True):
    """A file that goes into a log: what messages are understood by."""

    name: str
    media_type: str
    data: bytes


class _Channel(Struct, frozen=True):
    number: int
    derive: Derive | None = None


class OpenLog:
    """A file being written. OSError from every method that writes; it is then to be abandoned.

    Args:
        file: new and empty.
        config: chunk size and compression.
        schemas: what the fleet's keys carry.
        foxglove: what is derived from them.
        since: when it was opened, by the writer's clock.
    """

    def __init__(
        self, file: File, config: RecordConfig, schemas: KeySchemas, foxglove: Foxglove, *, since: float
    ) -> None:
        self.file = file
        self.since = since
        self.unflushed = 0
        """Messages that are not in a whole chunk yet: what a failing write loses."""
        self.gaps: list[Gap] = []
        """Gaps among them."""
        self.marks: list[Incident] = []
        """Incidents among them."""
        self._config = config
        self._schemas = schemas
        self._foxglove = foxglove
        self._mcap = McapFile(file, chunk_bytes=config.chunk_bytes, compression=config.compression)
        self._channels: dict[tuple[str, str], _Channel] = {}
        self._schema_numbers: dict[str, int] = {}
        self._attached = 0
        self._loose = False
        """Whether there is something that is not in a whole chunk yet."""
        self._unsynced = True

    @property
    def channels(self) -> int:
        """Channels announced so far."""
        return len(self._channels)

    def start(self, library: str, metadata: dict[str, dict[str, str]], attached: tuple[Attached, ...]) -> None:
        """Write the beginning: it is whole then."""
        self._mcap.start(profile="", library=library)
        for name, values in metadata.items():
            self._mcap.add_metadata(name, values)
        at_ns = int(metadata.get("swiftbot", {}).get("start_ns", "0"))
        for each in attached:
            self._attach(each, at_ns)
        self._mcap.flush()

    def add(self, message: LoggedMessage, *, now_ns: int) -> None:
        """Write a message, and what is derived from it."""
        self.unflushed += 1  # until it is in a whole chunk; counted as lost when a write fails before that
        at_ns = message.at_ns if 0 < message.at_ns <= LAST_NS else now_ns
        if message.deleted:
            deletion = msgspec.json.encode(Deletion(key=message.key, at_ns=at_ns))
            self.put(self._keys(keyspace.RECORDER_DELETED, self._config.name), at_ns, deletion)
            return
        shared = shared_for(message.key, message.payload) if message.encoding == JSON else None
        topic = message.key if shared is None else shared.topic
        channel = self._channels.get((topic, message.encoding))
        if channel is None:
            channel = self._register(topic, message.encoding, key=message.key, shared=shared)
        self._loose = True
        if self._mcap.add_message(channel.number, at_ns, message.payload):
            self._settle()
        if channel.derive is not None:
            for made in channel.derive(message):
                self.put(made.topic, at_ns, made.payload, kind=made.kind)

    def add_gap(self, gap: Gap, *, now_ns: int) -> None:
        """Write down what is missing."""
        self.gaps.append(gap)  # comes back into the books when the file fails before it is whole
        at_ns = gap.until_ns if 0 < gap.until_ns <= LAST_NS else now_ns
        self.put(self._keys(keyspace.RECORDER_GAP, self._config.name), at_ns, msgspec.json.encode(gap))

    def add_incident(self, incident: Incident, *, now_ns: int) -> None:
        """Write down what happened."""
        self.marks.append(incident)  # waits for room again when the file fails before it is whole
        at_ns = incident.at_ns if 0 < incident.at_ns <= LAST_NS else now_ns
        self.put(self._keys(keyspace.RECORDER_INCIDENT, self._config.name), at_ns, msgspec.json.encode(incident))

    def put(self, topic: str, at_ns: int, payload: bytes, *, kind: ChannelKind | None = None) -> None:
        """Write a message of the recorder's own; with a `kind`: one that was derived from another."""
        channel = self._channels.get((topic, JSON)) or self._register(topic, JSON, kind=kind)
        self._loose = True
        if self._mcap.add_message(channel.number, at_ns, payload):
            self._settle()

    def flush(self, attached: tuple[Attached, ...] = (), *, now_ns: int = 0, sync: bool = False) -> bool:
        """Make whole what there is, with attachments behind it; whether anything new is on the disk now."""
        if self._loose or attached:
            self._mcap.flush()
            self._settle()
            for each in attached:
                self._attach(each, now_ns)
            self._mcap.flush()
        if not self._unsynced:
            return False
        if sync:
            self.file.sync()
        self._unsynced = False
        return True

    def finish(self, attached: tuple[Attached, ...] = (), *, now_ns: int = 0, sync: bool = False) -> None:
        """Write the rest and the summary, and close the file."""
        self.flush(attached, now_ns=now_ns)
        self._mcap.finish()
        if sync:
            self.file.sync()
        self.file.close()

    def _attach(self, attached: Attached, at_ns: int) -> None:
        if self._attached < MOST_ATTACHMENTS:
            self._attached += 1
            self._unsynced = True
            self._mcap.add_attachment(attached.name, attached.media_type, attached.data, at_ns=at_ns)

    def _settle(self) -> None:
        """A chunk has just been written, so all before it is whole: a later failure is cut back to here."""
        self.file.flush()
        self.unflushed = 0
        self.gaps.clear()
        self.marks.clear()
        self._loose = False
        self._unsynced = True

    @property
    def _keys(self) -> Keys:
        return self._schemas.keys

    def _register(
        self, topic: str, encoding: str, *, key: str = "", shared: Shared | None = None, kind: ChannelKind | None = None
    ) -> _Channel:
        """Announce a channel, of a key or shared by many, or (with a `kind`) of what is derived."""
        derived, key = kind is not None, key or topic
        kind = kind or self._schemas.kind_of(key, encoding)
        schema = 0
        if kind.schema:
            schema = self._schema_numbers.get(kind.schema, 0)
            if not schema:
                schema = self._mcap.register_schema(kind.schema, "jsonschema", kind.schema_text)
                self._schema_numbers[kind.schema] = schema
        # The metadata lets the reader give back Zenoh's encoding and leave out what the recorder made itself.
        metadata = {"encoding": encoding, **dict(kind.metadata)} | ({"derived": "true"} if derived else {})
        metadata |= {} if shared is None else shared.metadata
        number = self._mcap.register_channel(topic, kind.encoding, schema, metadata)
        channel = _Channel(number, None if derived else self._foxglove.deriving(key))
        self._channels[topic, encoding] = channel
        return channel


log = structlog.get_logger(__name__)

VERSION = "0.1.0"
"""Version of the recorder written into each file's metadata."""
METADATA = "swiftbot"
"""Name of that metadata record."""
FOXGLOVE = "foxglove"
"""Name of the metadata record by which Foxglove knows whose recording it is (docs.foxglove.dev, "Manage data")."""
NOT_HEARD = "not heard"
"""Reason of a gap that is not the recorder's doing."""
PLANE = "plane"
"""Source of what sessions have put and the recorder was not linked for (`record.backfill`)."""
MOST_KINDS = 50
"""Kinds of keys that misses are counted by; further ones are counted together."""
OTHERS = "(others)"
VEHICLE = "mavlink"
"""Source of what vehicles have sent and no gateway received, by the numbers of their frames."""
MOST_PLANS = 200
"""Attachments that wait for the next flush."""
MOST_MARKS = 1_000
"""Incidents that wait for room on the disk: some 300 KB. The first ones are kept, which are nearest to the cause."""
_FIRST_RETRY_S = 1.0
_LAST_RETRY_S = 30.0
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def file_prefix(fleet: str, name: str) -> str:
    """Return what the file names of a fleet's recorder begin with; no two recorders have the same.

    A dash within the fleet's name is doubled: recorder `c` of fleet `a-b` and recorder `b-c` of fleet `a` may share a
    folder, and the budget of one must not take the files of the other.
    """
    return f"{fleet.replace('-', '--')}-{name}-"


def _added(kinds: dict[str, int], more: Mapping[str, int]) -> dict[str, int]:
    """Add counts by kind of key to others, which are of `MOST_KINDS` kinds and `OTHERS` at most; returns them."""
    for kind, count in more.items():
        where = kind if kind in kinds or len(kinds) < MOST_KINDS else OTHERS
        kinds[where] = kinds.get(where, 0) + count
    return kinds


class LogWriter:
    """Writes one recorder's sequence of files.

    Args:
        config: Sizes and times.
        fleet: Whose messages; goes into names and metadata.
        site: Where the fleet is on the globe, for locations.
        attached: What each file begins with: configuration, versions.
        clock: Monotonic seconds.
        wall: Unix nanoseconds.
        free: Free bytes of a folder's file system.
        open_file: Opens a new file; OSError when it cannot.
    """

    def __init__(
        self,
        config: RecordConfig,
        *,
        fleet: str,
        site: Site | None = None,
        attached: tuple[Attached, ...] = (),
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], int] = time.time_ns,
        free: Callable[[Path], int] = free_bytes,
        open_file: Callable[[Path], File] = LogFile,
    ) -> None:
        config.check()
        self.config = config
        self.fleet = fleet
        self.problem = ""
        self.messages = 0
        self.files: list[Path] = []
        self.dropped: dict[str, int] = {}
        self.not_heard: dict[str, int] = {}
        self.missed: dict[str, int] = {}
        """Messages of the fleet that are not in the log, whatever for, by kind of key."""
        self.missed_at_ns = 0
        """Time of the last of them; 0: none is missing."""
        self.removed = 0
        """Old files removed to stay within `total_bytes` and `days`."""
        self.going = ""
        """Which files go next if nobody keeps them, in words."""
        self._prefix = file_prefix(fleet, config.name)
        keys = Keys(fleet)
        self._schemas = KeySchemas(keys)
        self._foxglove = Foxglove(keys, config.name, site=site)
        self._attached = attached
        self._clock, self._wall, self._free, self._open_file = clock, wall, free, open_file
        self._current: OpenLog | None = None
        self._gaps: dict[tuple[str, str], Gap] = {}
        self._marks: list[Incident] = []
        self._waiting: list[Attached] = []
        self._retry_at = float("-inf")
        self._retry_s = _FIRST_RETRY_S
        self._reason = "disk full"
        self._flushed_at = clock()
        self._sequence = 0

    @property
    def recording(self) -> bool:
        """Whether a file is open and taking messages."""
        return self._current is not None

    @property
    def file(self) -> str:
        """Name of the file being written; empty while paused."""
        return self._current.file.path.name if self._current else ""

    @property
    def file_bytes(self) -> int:
        """Its size so far."""
        return self._current.file.tell() if self._current else 0

    @property
    def waiting_marks(self) -> int:
        """Incidents that are in no file yet, for want of room."""
        return len(self._marks)

    def prepare(self) -> None:
        """Make the folder and see that files can be made there; RecordError with the remedy otherwise."""
        folder = self.config.folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe = folder / f".{self.config.name}.probe"
            probe.touch()
            probe.unlink()
        except OSError as error:
            if error.errno in _FULL:
                return  # a full disk is waited for, not refused
            raise RecordError(
                f"cannot write logs in {folder}: {error.strerror}",
                remedy="set record.directory to a folder this user may write in",
            ) from error

    def write(self, message: LoggedMessage) -> bool:
        """Log one message; False when it was dropped (and counted)."""
        if len(message.payload) > self.config.message_bytes:
            self.drop("too large", message.key, len(message.payload), message.at_ns)
            return False
        current = self._current or self._ready()
        if current is None:
            self.drop(self._reason, message.key, len(message.payload), message.at_ns)
            return False
        self.messages += 1
        try:
            current.add(message, now_ns=self._wall())
        except OSError as error:
            self._fail(error)
            return False
        return True

    def drop(
        self, reason: str, key: str, size: int, at_ns: int, *, count: int = 1, keys: Mapping[str, int] | None = None
    ) -> None:
        """Count messages that will not be in the log; a gap message tells of them as soon as one can be written.

        `keys`: the same by kind of key; without, all are of the kind of `key`.
        """
        self.dropped[reason] = self.dropped.get(reason, 0) + count
        kinds = self._count_missed(count, key, at_ns, keys)
        gap = Gap(reason=reason, dropped=count, payload_bytes=size, since_ns=at_ns, until_ns=at_ns, last_key=key)
        self._note(replace(gap, keys=kinds))

    def miss(self, source: str, count: int, key: str, at_ns: int, *, keys: Mapping[str, int] | None = None) -> None:
        """Count messages that never came here; told in the log as those that were dropped are.

        Frames of a vehicle (source `mavlink`) were lost on its link, before the fleet had them: the gap is logged, and
        nothing of the fleet's is missing.
        """
        self.not_heard[source] = self.not_heard.get(source, 0) + count
        kinds = dict(keys or {kind_of(key): count})
        if source != VEHICLE:
            kinds = self._count_missed(count, key, at_ns, keys)
        gap = Gap(reason=NOT_HEARD, dropped=count, since_ns=at_ns, until_ns=at_ns, last_key=key, source=source)
        self._note(replace(gap, keys=kinds))

    def mark(self, incident: Incident) -> None:
        """Write an incident down as soon as there is room for it, and have what leads up to it on the disk soon."""
        self._keep(incident)
        current = self._current or self._ready()
        if current is None:
            return
        try:
            self._write_marks(current)
        except OSError as error:
            self._fail(error)

    def attach(self, attached: Attached) -> None:
        """Add a file to the log with the next flush."""
        if len(self._waiting) < MOST_PLANS and len(attached.data) <= self.config.message_bytes:
            self._waiting.append(attached)

    def tick(self) -> None:
        """Flush, rotate and look after free space, each when it is due; to be called a few times a second."""
        now = self._clock()
        # With `incidents` a file is begun by the first message only: gaps wait, one for each reason and source.
        current = self._ready() if self.config.mode == "all" or self.problem else self._current
        if current is None:
            return
        try:
            self._write_gaps(current)
            self._write_marks(current)
            if now - self._flushed_at >= self.config.flush_s:
                self._flushed_at = now
                if current.flush(self._take_attached(), now_ns=self._wall(), sync=self.config.fsync):
                    self._retry_s = _FIRST_RETRY_S
                if self._free(self.config.folder) < self.config.free_bytes:
                    self._pause_for_space()
                    return
        except OSError as error:
            self._fail(error)
            return
        if (
            current.file.tell() >= self.config.rotate_bytes
            or now - current.since >= self.config.rotate_s
            or current.channels >= self.config.max_channels
        ):
            self._finish()

    def close(self) -> None:
        """Finish the file, with its summary, as far as the disk allows; the next message begins another."""
        current = self._current
        if current is None and (self._gaps or self._marks):
            self._retry_at = float("-inf")
            current = self._ready()
        if current is not None:
            try:
                self._write_gaps(current)
                self._write_marks(current)
            except OSError as error:
                self._fail(error)
                return
            self._finish()

    def _count_missed(self, count: int, key: str, at_ns: int, keys: Mapping[str, int] | None) -> dict[str, int]:
        kinds = dict(keys or {kind_of(key) if key else UNKNOWN: count})
        _added(self.missed, kinds)
        self.missed_at_ns = max(self.missed_at_ns, at_ns)
        return kinds

    # --- inside ------------------------------------------------------------------------------------------

    def _note(self, gap: Gap) -> None:
        """Add a gap to those that wait to be written; one per reason and source."""
        old = self._gaps.get((gap.reason, gap.source))
        if old is not None:
            gap = replace(
                gap,
                dropped=old.dropped + gap.dropped,
                payload_bytes=old.payload_bytes + gap.payload_bytes,
                since_ns=min(old.since_ns, gap.since_ns),
                until_ns=max(old.until_ns, gap.until_ns),
                last_key=gap.last_key or old.last_key,
                keys=_added(dict(old.keys), gap.keys),
            )
        self._gaps[gap.reason, gap.source] = gap

    def _keep(self, incident: Incident) -> None:
        """Have an incident wait to be written; beyond the bound it is counted with the messages that were dropped."""
        if len(self._marks) < MOST_MARKS:
            self._marks.append(incident)
        else:
            self.drop(self._reason, self._schemas.keys(keyspace.RECORDER_INCIDENT, self.config.name), 0, incident.at_ns)

    def _ready(self) -> OpenLog | None:
        """Return the file to write in, opening one when it is time; None while there is no space."""
        if self._current is not None:
            return self._current
        now = self._clock()
        if now < self._retry_at:
            return None
        try:
            floor = self.config.free_bytes
            if self.problem:
                floor += floor // 8  # so that it does not stop and go at the edge
            free = self._free(self.config.folder)
            if free < floor:
                self._wait(
                    f"only {free} bytes free in {self.config.folder}, {floor} wanted: nothing is recorded", full=True
                )
                return None
            self._current = self._start(now)
        except OSError as error:
            self._retry_s = min(_LAST_RETRY_S, self._retry_s * 2)
            self._wait(
                f"cannot open a log file in {self.config.folder}: {error.strerror}: nothing is recorded",
                full=error.errno in _FULL,
            )
            return None
        if self.problem:
            log.info("recording again", file=self.file, after=self.problem)
        self.problem = ""
        return self._current

    def _start(self, now: float) -> OpenLog:
        started_ns = self._wall()
        folder, budget = self.config.folder, self.config.budget
        self.removed += make_room(folder, self._prefix, budget, now_ns=started_ns)
        files, warn_s = finished(folder, self._prefix), self.config.warn_hours * 3600
        self.going = going_text(files, budget, now_ns=started_ns, warn_s=warn_s)
        stamp = datetime.fromtimestamp(started_ns / 1e9, tz=UTC)
        while True:
            self._sequence += 1
            name = f"{self._prefix}{stamp:%Y%m%dT%H%M%SZ}-{self._sequence:04d}.mcap"
            try:
                file = self._open_file(self.config.folder / name)
                break
            except FileExistsError:
                continue  # another start within this second
        current = OpenLog(file, self.config, self._schemas, self._foxglove, since=now)
        about = {
            "fleet": self.fleet,
            "version": VERSION,
            "recorder": self.config.name,
            "start": stamp.isoformat(),
            "start_ns": str(started_ns),
            "sequence": str(self._sequence),
        }
        device = {"deviceName": self.config.device_name or f"{self.fleet}-{self.config.name}"}
        if self.config.device_id:
            device["deviceId"] = self.config.device_id
        try:
            current.start(f"swiftbot {VERSION}", {METADATA: about, FOXGLOVE: device}, self._attached)
        except OSError:
            file.abandon()
            raise
        self.files.append(file.path)
        return current

    def _write_gaps(self, current: OpenLog) -> None:
        """Write down what is missing. A gap leaves the books once it is handed to the file."""
        for which in list(self._gaps):
            current.add_gap(self._gaps.pop(which), now_ns=self._wall())

    def _write_marks(self, current: OpenLog) -> None:
        """Write down the incidents that wait; those that a failing file takes with it come back (`_fail`)."""
        while self._marks:
            current.add_incident(self._marks.pop(0), now_ns=self._wall())

    def _take_attached(self) -> tuple[Attached, ...]:
        out, self._waiting = tuple(self._waiting), []
        return out

    def _finish(self) -> None:
        current, self._current = self._current, None
        if current is None:
            return
        try:
            current.finish(self._take_attached(), now_ns=self._wall(), sync=self.config.fsync)
        except OSError as error:
            self._current = current
            self._fail(error)

    def _pause_for_space(self) -> None:
        self._finish()
        self._wait(
            f"less than {self.config.free_bytes} bytes free in {self.config.folder}: "
            "recording stops until there is space",
            full=True,
        )

    def _fail(self, error: OSError) -> None:
        """Give up the file at its last whole chunk; what was not in one is counted as a gap."""
        full = error.errno in _FULL
        current, self._current = self._current, None
        if current is not None:
            for gap in current.gaps:
                self._note(gap)
            waiting, self._marks = [*current.marks, *self._marks], []
            for mark in waiting:
                self._keep(mark)
            if current.unflushed:
                self.drop("disk full" if full else "write error", "", 0, self._wall(), count=current.unflushed)
                self.messages -= current.unflushed
            if not current.file.abandon():
                self.files.remove(current.file.path)
        what = "the disk is full" if full else (error.strerror or str(error))
        self._retry_s = min(_LAST_RETRY_S, self._retry_s * 2)  # back to the first after a flush that worked
        self._wait(f"writing in {self.config.folder} failed: {what}: recording stops until it works again", full=full)

    def _wait(self, problem: str, *, full: bool) -> None:
        if problem != self.problem:
            log.warning("recorder paused", problem=problem)
        self.problem = problem
        self._reason = "disk full" if full else "write error"
        self._retry_at = self._clock() + self._retry_s


PACKAGES = ("eclipse-zenoh", "mcap", "msgspec", "onnxruntime-genai", "podman", "pymavlink", "textual", "zstandard")
MOST_SECRET_FILE_BYTES = 4096


class About(Struct, frozen=True, kw_only=True):
    """What a recorder needs beside its settings: what logs are understood by, and what must not be in them."""

    site: Site | None = None
    """Where the fleet is on the globe."""
    attached: tuple[Attached, ...] = ()
    """Goes into each file: the configuration, without its secrets, and the versions."""
    secrets: tuple[str, ...] = ()
    """Values that are taken out of every message (`redact.known_secrets`)."""


def about(configuration: Mapping[str, Any], environment: Mapping[str, str], *, site: Site | None = None) -> About:
    """Return what a recorder puts into its files, and what it keeps out of them.

    Args:
        configuration: the gateway's, as plain data; empty when there is none.
        environment: of this process: what its variables hold whose names say so is kept out of every message.
        site: where the fleet is.
    """
    secrets = known_secrets(environment, configuration) + _of_files(configuration)
    attached = [Attached("versions.json", "application/json", msgspec.json.format(msgspec.json.encode(versions())))]
    if configuration:
        plain = Redactor(secrets).json(msgspec.json.encode(without_secrets(configuration)))
        attached.append(Attached("configuration.json", "application/json", msgspec.json.format(plain)))
    return About(site=site, attached=tuple(attached), secrets=secrets)


def versions() -> dict[str, str]:
    """Return the versions of what runs here."""
    found = {"swiftbot": VERSION, "python": sys.version.split()[0], "system": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _secret_files(configuration: Mapping[str, Any]) -> list[Path]:
    """Return the files that hold secrets: the key of the upstream model, those that sign MAVLink links."""
    llm = cast("dict[str, Any]", configuration.get("llm") or {})
    robots = cast("dict[str, Any]", configuration.get("robots") or {})
    links = cast("list[dict[str, Any]]", robots.get("mavlink") or [])
    named = [llm.get("upstream_key_file"), *(each.get("signing") for each in links)]
    return [
        Path(each).expanduser()
        for each in named
        if isinstance(each, str) and each and not each.startswith("credential:")
    ]


def _of_files(configuration: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what is in the files that hold secrets, as far as this process may read them."""
    found: list[str] = []
    for path in _secret_files(configuration):
        try:
            with path.open(encoding="utf-8") as file:
                text = file.read(MOST_SECRET_FILE_BYTES).strip()
        except (OSError, UnicodeDecodeError):
            continue  # the gateway says what is wrong with it; what cannot be read here cannot be leaked from here
        found += [each for each in (text, text.removeprefix("hex:")) if len(each) >= LEAST_SECRET]
    return tuple(dict.fromkeys(found))
