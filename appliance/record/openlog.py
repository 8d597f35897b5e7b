"""One log file while it is written: its channels, what of it is whole, and what a failing disk would take from it."""

from pathlib import Path
from typing import Protocol

import msgspec
from msgspec import Struct

from appliance.plane.keys import Keys
from appliance.record.facts import Deletion, Gap, Incident, LoggedMessage
from appliance.record.foxglove import ChannelKind, Derive, Foxglove
from appliance.record.mcapfile import McapFile
from appliance.record.schemas import KeySchemas
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
            self.put(self._keys.recorder_deleted(self._config.name), at_ns, deletion)
            return
        channel = self._channels.get((message.key, message.encoding))
        if channel is None:
            channel = self._register(message.key, message.encoding)
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
        self.put(self._keys.recorder_gap(self._config.name), at_ns, msgspec.json.encode(gap))

    def add_incident(self, incident: Incident, *, now_ns: int) -> None:
        """Write down what happened."""
        self.marks.append(incident)  # waits for room again when the file fails before it is whole
        at_ns = incident.at_ns if 0 < incident.at_ns <= LAST_NS else now_ns
        self.put(self._keys.recorder_incident(self._config.name), at_ns, msgspec.json.encode(incident))

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

    def _register(self, topic: str, encoding: str, *, kind: ChannelKind | None = None) -> _Channel:
        derived = kind is not None
        kind = kind or self._schemas.kind_of(topic, encoding)
        schema = 0
        if kind.schema:
            schema = self._schema_numbers.get(kind.schema, 0)
            if not schema:
                schema = self._mcap.register_schema(kind.schema, "jsonschema", kind.schema_text)
                self._schema_numbers[kind.schema] = schema
        # The metadata lets the reader give back Zenoh's encoding and leave out what the recorder made itself.
        metadata = {"encoding": encoding, **dict(kind.metadata)} | ({"derived": "true"} if derived else {})
        number = self._mcap.register_channel(topic, kind.encoding, schema, metadata)
        channel = _Channel(number, None if derived else self._foxglove.deriving(topic))
        self._channels[topic, encoding] = channel
        return channel
