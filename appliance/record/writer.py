"""Messages into MCAP files: channels, flushing, rotation, and what happens when the disk is full.

Synchronous and without threads or network, with clock, free space and file passed in, so that every way a disk
can fail is tried in a test. It never raises for the disk's sake: it pauses, says why in `problem`, counts what
it could not write, and goes on by itself when there is space again, with a `Gap` in the log.
"""

import errno
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Protocol, cast

import msgspec
import structlog
from mcap.writer import CompressionType, Writer
from msgspec import Struct

from appliance.errors import RecordError
from appliance.plane.keys import Keys
from appliance.record.budget import make_room
from appliance.record.facts import Deletion, Gap, LoggedMessage
from appliance.record.logfile import LogFile, free_bytes
from appliance.record.schemas import ChannelKind, KeySchemas
from appliance.record.settings import RecordConfig

log = structlog.get_logger(__name__)

VERSION = "0.1.0"
"""Version of the recorder written into each file's metadata."""
METADATA = "swiftbot"
"""Name of that metadata record."""
COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
_MAX_NS = 2**63 - 1
_FIRST_RETRY_S = 1.0
_LAST_RETRY_S = 30.0
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class File(Protocol):
    """What the writer needs of a file; `LogFile`, or a failing one in tests."""

    path: Path

    def write(self, data: bytes) -> int: ...  # noqa: D102 - see LogFile
    def tell(self) -> int: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102
    def sync(self) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102
    def abandon(self) -> bool: ...  # noqa: D102


class _Open(Struct, kw_only=True):
    """A file being written. Channel ids by (topic, Zenoh encoding)."""

    file: File
    mcap: Writer
    since: float
    channels: dict[tuple[str, str], int]
    schemas: dict[str, int]
    whole: int = 0
    """Size at the last whole chunk."""
    unflushed: int = 0
    """Messages that are not in a whole chunk yet: what a failing write loses."""
    gaps: list[Gap]
    """Gaps among them."""
    synced: bool = True


class LogWriter:
    """Writes one recorder's sequence of files.

    Args:
        config: Sizes and times.
        fleet: Whose messages; goes into names and metadata.
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
        self.removed = 0
        """Old files removed to stay within `total_bytes`."""
        self._prefix = f"{fleet}-{config.name}-"
        self._keys = Keys(fleet)
        self._schemas = KeySchemas(self._keys)
        self._clock, self._wall, self._free, self._open_file = clock, wall, free, open_file
        self._current: _Open | None = None
        self._gaps: dict[str, Gap] = {}
        self._retry_at = float("-inf")
        self._retry_s = _FIRST_RETRY_S
        self._reason = "disk full"
        self._flushed_at = clock()
        self._sequence = 0
        self._news_topic = self._keys.recorder_log(config.name)

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
        current = self._ready()
        if current is None:
            self.drop(self._reason, message.key, len(message.payload), message.at_ns)
            return False
        self.messages += 1
        current.unflushed += 1  # until it is in a whole chunk; counted as lost when a write fails before that
        try:
            self._add(current, message)
        except OSError as error:
            self._fail(error)
            return False
        return True

    def drop(self, reason: str, key: str, size: int, at_ns: int, *, count: int = 1) -> None:
        """Count messages that will not be in the log; a gap message tells of them as soon as one can be written."""
        self.dropped[reason] = self.dropped.get(reason, 0) + count
        self._note(Gap(reason=reason, dropped=count, payload_bytes=size, since_ns=at_ns, until_ns=at_ns, last_key=key))

    def tick(self) -> None:
        """Flush, rotate and look after free space, each when it is due; to be called a few times a second."""
        now = self._clock()
        current = self._ready()
        if current is None:
            return
        try:
            self._write_gaps(current)
            if now - self._flushed_at >= self.config.flush_s:
                self._flush(current)
                if self._free(self.config.folder) < self.config.free_bytes:
                    self._pause_for_space()
                    return
        except OSError as error:
            self._fail(error)
            return
        if (
            current.file.tell() >= self.config.rotate_bytes
            or now - current.since >= self.config.rotate_s
            or len(current.channels) >= self.config.max_channels
        ):
            self._finish()

    def close(self) -> None:
        """Finish the file, with its summary, as far as the disk allows."""
        current = self._current
        if current is None and self._gaps:
            self._retry_at = float("-inf")
            current = self._ready()
        if current is not None:
            try:
                self._write_gaps(current)
            except OSError as error:
                self._fail(error)
                return
            self._finish()

    # --- inside ------------------------------------------------------------------------------------------

    def _note(self, gap: Gap) -> None:
        """Add a gap to those that wait to be written; one per reason."""
        old = self._gaps.get(gap.reason)
        self._gaps[gap.reason] = (
            gap
            if old is None
            else Gap(
                reason=gap.reason,
                dropped=old.dropped + gap.dropped,
                payload_bytes=old.payload_bytes + gap.payload_bytes,
                since_ns=min(old.since_ns, gap.since_ns),
                until_ns=max(old.until_ns, gap.until_ns),
                last_key=gap.last_key or old.last_key,
            )
        )

    def _ready(self) -> _Open | None:
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

    def _start(self, now: float) -> _Open:
        if self.config.total_bytes:
            # Room for the file that begins now, too.
            room = self.config.total_bytes - self.config.rotate_bytes
            self.removed += make_room(self.config.folder, self._prefix, budget_bytes=room)
        started_ns = self._wall()
        stamp = datetime.fromtimestamp(started_ns / 1e9, tz=UTC)
        while True:
            self._sequence += 1
            name = f"{self._prefix}{stamp:%Y%m%dT%H%M%SZ}-{self._sequence:04d}.mcap"
            try:
                file = self._open_file(self.config.folder / name)
                break
            except FileExistsError:
                continue  # another start within this second
        try:
            mcap = Writer(
                cast("IO[Any]", file),
                chunk_size=self.config.chunk_bytes,
                compression=COMPRESSIONS[self.config.compression],
            )
            mcap.start(profile="", library=f"swiftbot {VERSION}")
            mcap.add_metadata(
                METADATA,
                {
                    "fleet": self.fleet,
                    "version": VERSION,
                    "recorder": self.config.name,
                    "start": stamp.isoformat(),
                    "start_ns": str(started_ns),
                    "sequence": str(self._sequence),
                },
            )
            mcap.flush()
        except OSError:
            file.abandon()
            raise
        self.files.append(file.path)
        return _Open(file=file, mcap=mcap, since=now, channels={}, schemas={}, gaps=[], whole=file.tell())

    def _add(self, current: _Open, message: LoggedMessage) -> None:
        at_ns = message.at_ns if 0 < message.at_ns <= _MAX_NS else self._wall()
        if message.deleted:
            deletion = msgspec.json.encode(Deletion(key=message.key, at_ns=at_ns))
            topic = self._keys.recorder_deleted(self.config.name)
            self._put(current, topic, "application/json", at_ns, deletion)
            return
        self._put(current, message.key, message.encoding, at_ns, message.payload)
        if self._schemas.is_news(message.key):
            news = self._schemas.as_foxglove_log(message)
            if news is not None:
                self._put(current, self._news_topic, "application/json", at_ns, news)

    def _put(self, current: _Open, topic: str, encoding: str, at_ns: int, payload: bytes) -> None:
        channel = current.channels.get((topic, encoding))
        if channel is None:
            channel = self._register(current, topic, encoding)
        current.mcap.add_message(channel, log_time=at_ns, data=payload, publish_time=at_ns)
        self._settle(current, unflushed=0)

    def _settle(self, current: _Open, *, unflushed: int) -> None:
        """If the writer has just written a chunk, all before it is whole: a later failure is cut back to here."""
        if current.file.tell() == current.whole:
            return
        current.file.flush()
        current.whole = current.file.tell()
        current.unflushed = unflushed
        current.gaps.clear()
        current.synced = False

    def _register(self, current: _Open, topic: str, encoding: str) -> int:
        kind: ChannelKind = self._schemas.kind_of(topic, encoding)
        schema = 0
        if kind.schema:
            schema = current.schemas.get(kind.schema, 0)
            if not schema:
                schema = current.mcap.register_schema(kind.schema, "jsonschema", kind.schema_text)
                current.schemas[kind.schema] = schema
        # The metadata lets the reader give back Zenoh's encoding and leave out what the recorder made itself.
        metadata = {"encoding": encoding} | ({"derived": "true"} if topic == self._news_topic else {})
        channel = current.mcap.register_channel(topic, kind.encoding, schema, metadata)
        current.channels[topic, encoding] = channel
        self._settle(current, unflushed=min(1, current.unflushed))  # the message itself is yet to be added
        return channel

    def _write_gaps(self, current: _Open) -> None:
        """Write down what was dropped. A reason leaves the books once its gap is handed to the file."""
        for reason in list(self._gaps):
            gap = self._gaps.pop(reason)
            current.gaps.append(gap)  # comes back into the books when the file fails before it is whole
            at_ns = gap.until_ns if 0 < gap.until_ns <= _MAX_NS else self._wall()
            topic = self._keys.recorder_gap(self.config.name)
            self._put(current, topic, "application/json", at_ns, msgspec.json.encode(gap))

    def _flush(self, current: _Open) -> None:
        self._flushed_at = self._clock()
        if current.unflushed or current.gaps:
            current.mcap.flush()
            self._settle(current, unflushed=0)
        if not current.synced:
            if self.config.fsync:
                current.file.sync()
            current.synced = True
            self._retry_s = _FIRST_RETRY_S

    def _finish(self) -> None:
        current, self._current = self._current, None
        if current is None:
            return
        try:
            current.mcap.flush()
            self._settle(current, unflushed=0)
            current.mcap.finish()
            if self.config.fsync:
                current.file.sync()
            current.file.close()
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
