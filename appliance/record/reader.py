"""Reading logs back, whatever state they are in: what is in one, and its messages.

A finished file is summed up from its index at once; any other is streamed. Messages come in the order in which they
were recorded, which is what a replay wants.

mcap's own readers give up at the first thing they do not expect, and read a cut-off record as a shorter one. A
log of a killed recorder, or one from a dying disk, is worth more than that: `RecordStream` frames each record against
the end of the file and checks each chunk against its checksum, so a message is either exactly what was written
or it is reported as damage, and what follows is still read.
"""

import contextlib
import dataclasses
import io
import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary

from appliance.errors import NotFoundError, RecordError
from appliance.model.recorder_api import Deletion, Gap, Incident
from appliance.plane.backlog import UNKNOWN, kind_of
from appliance.record.channels import shared_of
from appliance.record.models import ChannelInfo, LoggedMessage, LogInfo, compile_expression
from appliance.record.segments import METADATA, VEHICLE

MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))
CHUNK_LIMIT = 256 * 2**20
"""Largest chunk taken, unpacked: a damaged size must not cost the machine's memory."""
_FRAME = struct.Struct("<BQ")
BROKEN = (McapError, ValueError, struct.error, zstandard.ZstdError, EOFError, RuntimeError, MemoryError, OverflowError)
"""What the decoders raise on bad bytes (lz4 raises RuntimeError, checksums ValueError)."""

Record = Header | Schema | Channel | Message | Metadata | Attachment
_READ = (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.METADATA, Opcode.ATTACHMENT)


class RecordStream:
    """Yields a log's records in file order; afterwards `finished` and `problems` say how it ended.

    Raises:
        NotFoundError: no such file.
        RecordError: not an MCAP file at all.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.finished = False
        """A footer and the closing magic were there."""
        self.problems: list[str] = []
        """Damage, one sentence each. An end that is merely missing is not damage."""
        self.lost_bytes = 0
        """Bytes after the last whole record of an unfinished file."""
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self._messages = 0
        self._claimed = 0
        self._chunks = self._indexed = 0
        self._ends_with_magic = False

    def __iter__(self) -> Iterator[Record]:
        """Read the file; once only."""
        with open_log(self.path) as stream:
            size = os.fstat(stream.fileno()).st_size
            stream.seek(-min(size, len(MAGIC)), os.SEEK_END)
            self._ends_with_magic = size >= 2 * len(MAGIC) and stream.read() == MAGIC
            stream.seek(len(MAGIC))
            yield from self._records(stream, size)

    def _records(self, stream: BinaryIO, size: int) -> Iterator[Record]:
        while True:
            start = stream.tell()
            frame = stream.read(_FRAME.size)
            if len(frame) < _FRAME.size:
                self._cut(start, size)
                return
            opcode, length = _FRAME.unpack(frame)
            if length > size - start - _FRAME.size or opcode == 0:
                self._cut(start, size)
                return
            if opcode == Opcode.FOOTER:
                stream.seek(length, os.SEEK_CUR)
                self.finished = stream.read(len(MAGIC)) == MAGIC
                if not self.finished:
                    self._cut(start, size)
                elif self._messages < self._claimed:
                    # A damaged opcode makes a chunk look like something to skip: only the count tells.
                    self.problems.append(f"{self._claimed - self._messages} of {self._claimed} messages are missing")
                elif self._chunks < self._indexed:
                    self.problems.append(f"{self._indexed - self._chunks} of {self._indexed} chunks are missing")
                return
            if opcode == Opcode.STATISTICS and length >= 8:
                (self._claimed,) = struct.unpack_from("<Q", stream.read(length))
                continue
            self._chunks += opcode == Opcode.CHUNK
            self._indexed += opcode == Opcode.CHUNK_INDEX
            if opcode == Opcode.CHUNK:
                yield from self._chunk(stream.read(length), start)
            elif opcode in _READ and length <= CHUNK_LIMIT:
                record = self._record(opcode, stream.read(length), start)
                if record is not None:
                    yield record
            else:
                stream.seek(length, os.SEEK_CUR)

    def _cut(self, start: int, size: int) -> None:
        """Framing ends before the footer: an unfinished file, or damage if somebody did finish it."""
        self.lost_bytes = size - start
        if self._ends_with_magic:
            self.problems.append(f"damaged at byte {start}: {self.lost_bytes} bytes up to the end cannot be read")

    def _record(self, opcode: int, body: bytes, start: int) -> Record | None:
        stream = ReadDataStream(io.BytesIO(body))
        try:
            if opcode == Opcode.MESSAGE:
                message = Message.read(stream, len(body)) if len(body) > 22 else _empty_message(body)
                return message if self._known(message) else None
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
                return schema
            if opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self.channels[channel.id] = channel
                return channel
            if opcode == Opcode.ATTACHMENT:
                return _attachment(body)
            return Header.read(stream) if opcode == Opcode.HEADER else Metadata.read(stream)
        except BROKEN as error:
            self.problems.append(f"record at byte {start} is damaged ({_why(error)})")
            return None

    def _chunk(self, body: bytes, start: int) -> Iterator[Record]:
        try:
            records = unpacked(body)
        except TooLarge as error:
            self.problems.append(f"chunk at byte {start} {error}, more than is taken")
            return
        except BROKEN as error:
            self.problems.append(f"chunk at byte {start} is damaged ({_why(error)}): its messages are lost")
            return
        for record in records:
            if isinstance(record, Schema):
                self.schemas[record.id] = record
            elif isinstance(record, Channel):
                self.channels[record.id] = record
            elif isinstance(record, Message):
                if not self._known(record):
                    continue
            else:
                continue
            yield record

    def _known(self, message: Message) -> bool:
        if message.channel_id in self.channels:
            self._messages += 1
            return True
        problem = f"messages of channel {message.channel_id} cannot be named: where it was announced is damaged"
        if problem not in self.problems:
            self.problems.append(problem)
        return False


class TooLarge(ValueError):  # noqa: N818 - what it says
    """A chunk that unpacks to more than is taken, or says so."""


def unpacked(body: bytes) -> list[McapRecord]:
    """Return the records of a chunk, checked against its checksum.

    Whatever it says of its size, no more than `CHUNK_LIMIT` is unpacked: one of BROKEN is raised, TooLarge among them.
    """
    chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
    claimed = chunk.uncompressed_size
    if chunk.compression == "zstd":  # which unpacks to what one of the two says, or fails
        claimed = max(claimed, zstandard.frame_content_size(chunk.data))
    if claimed > CHUNK_LIMIT:
        raise TooLarge(f"claims {claimed} bytes")
    if chunk.compression == "lz4":  # which unpacks to whatever is in it
        unpacking: Any = lz4.frame.LZ4FrameDecompressor()
        plain = bytes(unpacking.decompress(chunk.data, max_length=CHUNK_LIMIT + 1))
        if len(plain) > CHUNK_LIMIT:
            raise TooLarge(f"has more than {CHUNK_LIMIT} bytes in it")
        if not unpacking.eof:
            raise ValueError("what is packed in it is not whole")
        chunk = dataclasses.replace(chunk, compression="", data=plain)
    return breakup_chunk(chunk, validate_crc=True)


def chunk_at(stream: BinaryIO, offset: int) -> list[McapRecord]:
    """Return the records of the chunk at a place that an index names; one of BROKEN where there is none."""
    stream.seek(offset)
    opcode, length = _FRAME.unpack(stream.read(_FRAME.size))
    if opcode != Opcode.CHUNK or length > os.fstat(stream.fileno()).st_size - stream.tell():
        raise ValueError("there is no chunk where the index has one")
    return unpacked(stream.read(length))


def _empty_message(body: bytes) -> Message:
    """Read a message without payload: the library takes reading nothing for the end of the file."""
    channel, sequence, log_time, publish_time = struct.unpack("<HIQQ", body)
    return Message(channel_id=channel, log_time=log_time, data=b"", publish_time=publish_time, sequence=sequence)


def _attachment(body: bytes) -> Attachment:
    """Read an attachment, checked against its checksum (0: it has none)."""
    (claimed,) = struct.unpack_from("<I", body, len(body) - 4)
    if claimed and zlib.crc32(memoryview(body)[:-4]) != claimed:
        raise ValueError("an attachment's checksum does not match")
    return Attachment.read(ReadDataStream(io.BytesIO(body)))


def _why(error: BaseException) -> str:
    return str(error) or type(error).__name__


def open_log(path: Path) -> BinaryIO:
    """Open a log and check that it begins as one; NotFoundError or RecordError otherwise."""
    try:
        stream = path.open("rb")
    except FileNotFoundError as error:
        raise NotFoundError(
            f"no log file {path}", remedy="`swiftbot record` writes logs; see record.directory"
        ) from error
    except OSError as error:
        raise RecordError(f"cannot read {path}: {error.strerror}", remedy="name a log file you may read") from error
    try:
        magic = stream.read(len(MAGIC))
    except OSError as error:
        stream.close()
        raise RecordError(f"cannot read {path}: {error.strerror}", remedy="name a log file you may read") from error
    if magic != MAGIC:
        stream.close()
        what = "it is empty" if not magic else "it does not begin as one"
        raise RecordError(f"{path} is not an MCAP file: {what}", remedy="nothing of it can be read")
    return stream


_GAPS = compile_expression("swiftbot/*/recorder/*/gap")
_INCIDENTS = compile_expression("swiftbot/*/recorder/*/incident")
_MALFORMED = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""What a stranger's put on the recorder's own keys raises: it is a message like others then."""
_DELETIONS = compile_expression("swiftbot/*/recorder/*/deleted")


def info(path: Path | str, *, verify: bool = False) -> LogInfo:
    """Sum up a log.

    Args:
        path: The file.
        verify: Read every message even of a finished file, so that damage in its middle is found.

    Raises:
        NotFoundError: no such file.
        RecordError: not an MCAP file.
    """
    path = Path(path)
    return (None if verify else _from_index(path)) or _by_streaming(path)


def read(
    path: Path | str, *, keys: Iterable[str] | str | None = None, problems: list[str] | None = None
) -> Iterator[LoggedMessage]:
    """Yield a log's messages in the order they were recorded; an unfinished file ends where it was cut off.

    What the recorder added for Foxglove is left out; deletions come as messages with `deleted` set.

    Args:
        path: The file.
        keys: Key expressions; only messages of keys that one of them includes. None: all.
        problems: Takes the sentences about damage; without it damage raises after all that could be read.

    Raises:
        NotFoundError: no such file.
        RecordError: not an MCAP file, or (at the end) parts of it are damaged.
    """
    path = Path(path)
    wanted = None if keys is None else [compile_expression(key) for key in ((keys,) if isinstance(keys, str) else keys)]

    def want(key: str) -> bool:
        return wanted is None or any(pattern.fullmatch(key) for pattern in wanted)

    stream = RecordStream(path)
    taken: dict[int, bool] = {}
    count = 0
    for record in stream:
        if isinstance(record, Channel):
            taken[record.id] = record.metadata.get("derived") != "true" and (
                want(record.topic)
                or _DELETIONS.fullmatch(record.topic) is not None
                or shared_of(record.topic, record.metadata) is not None
            )
        elif isinstance(record, Message) and taken[record.channel_id]:
            channel = stream.channels[record.channel_id]
            message = logged(channel, record)
            if message.key != channel.topic and not want(message.key):
                continue
            count += 1
            yield message
    if problems is not None:
        problems.extend(stream.problems)
    elif stream.problems:
        raise RecordError(
            f"{path} is damaged; {count} messages could be read: {'; '.join(stream.problems[:3])}",
            remedy="the messages before this error are as they were written",
        )


def logged(channel: Channel, message: Message) -> LoggedMessage:
    """Return a record as the message it stands for: under its key, a deletion as the deletion of its key."""
    if _DELETIONS.fullmatch(channel.topic):
        try:
            deletion = msgspec.json.decode(message.data, type=Deletion)
        except _MALFORMED:
            pass  # a stranger's put on that key: give it as it is
        else:
            return LoggedMessage(deletion.key, message.log_time, b"", "", deleted=True)
    encoding = channel.metadata.get("encoding", channel.message_encoding)
    shared = shared_of(channel.topic, channel.metadata)
    key = shared.key_of(message.data) if shared is not None else None
    return LoggedMessage(key or channel.topic, message.log_time, message.data, encoding)


class _Account:
    """What the recorder itself wrote down: what is missing, and what happened."""

    def __init__(self) -> None:
        self.dropped = self.not_heard = self.not_received = 0
        self.missed: dict[str, int] = {}
        self.incidents: list[Incident] = []

    def gap(self, data: bytes) -> None:
        try:
            gap = msgspec.json.decode(data, type=Gap)
        except _MALFORMED:
            return
        if gap.source == VEHICLE:
            self.not_received += gap.dropped
            return
        if gap.source:
            self.not_heard += gap.dropped
        else:
            self.dropped += gap.dropped
        for kind, count in (gap.keys or {kind_of(gap.last_key) if gap.last_key else UNKNOWN: gap.dropped}).items():
            self.missed[kind] = self.missed.get(kind, 0) + count

    def incident(self, data: bytes) -> None:
        with contextlib.suppress(*_MALFORMED):
            self.incidents.append(msgspec.json.decode(data, type=Incident))

    def take(self, topic: str, data: bytes) -> None:
        if _GAPS.fullmatch(topic):
            self.gap(data)
        elif _INCIDENTS.fullmatch(topic):
            self.incident(data)


def _by_streaming(path: Path) -> LogInfo:
    stream = RecordStream(path)
    counts: dict[int, int] = {}
    start = end = 0
    account = _Account()
    attachments: list[str] = []
    metadata: dict[str, str] = {}
    told: dict[int, bool] = {}
    for record in stream:
        if isinstance(record, Message):
            number, at = record.channel_id, record.log_time
            start = at if not counts else min(start, at)
            end = max(end, at)
            counts[number] = counts.get(number, 0) + 1
            if told.get(number):
                account.take(stream.channels[number].topic, record.data)
        elif isinstance(record, Channel):
            told[record.id] = _is_told(record.topic)
        elif isinstance(record, Attachment):
            attachments.append(record.name)
        elif isinstance(record, Metadata) and record.name == METADATA:
            metadata = record.metadata
    problems = list(stream.problems)
    if not stream.finished and not problems:
        lost = f", {stream.lost_bytes} bytes at its end were not" if stream.lost_bytes else ""
        problems.append(f"the file was not finished, or is still being written; all whole chunks were read{lost}")
    return LogInfo(
        path=str(path),
        size_bytes=path.stat().st_size,
        messages=sum(counts.values()),
        channels=_channels(stream.channels, stream.schemas, counts),
        start_ns=start,
        end_ns=end,
        recovered=not stream.finished,
        dropped=account.dropped,
        not_heard=account.not_heard,
        not_received=account.not_received,
        missed=account.missed,
        attachments=tuple(attachments),
        incidents=tuple(account.incidents),
        problems=tuple(problems),
        metadata=metadata,
    )


def _from_index(path: Path) -> LogInfo | None:
    """Sum up a finished file from its summary; None when it has none that will do (then it is streamed)."""
    with open_log(path) as stream:
        try:
            reader = make_reader(stream)
            summary = reader.get_summary()
            if summary is None or not _complete(summary):
                return None
            assert summary.statistics is not None  # noqa: S101 - _complete has seen it
            counts = summary.statistics.channel_message_counts
            account = _Account()
            told = {number: channel.topic for number, channel in summary.channels.items() if _is_told(channel.topic)}
            for index in sorted(summary.chunk_indexes, key=lambda each: each.chunk_start_offset):
                if not told or (index.message_index_offsets and told.keys().isdisjoint(index.message_index_offsets)):
                    continue  # it has no gap or incident; where the messages have no index, every chunk may be
                for record in chunk_at(stream, index.chunk_start_offset):
                    if isinstance(record, Message) and record.channel_id in told:
                        account.take(told[record.channel_id], record.data)
            metadata: dict[str, str] = {}
            for found in reader.iter_metadata():
                if found.name == METADATA:
                    metadata = found.metadata
        except (*BROKEN, McapError, KeyError, OSError):
            return None
        return LogInfo(
            path=str(path),
            size_bytes=path.stat().st_size,
            messages=summary.statistics.message_count,
            channels=_channels(summary.channels, summary.schemas, counts),
            start_ns=summary.statistics.message_start_time,
            end_ns=summary.statistics.message_end_time,
            dropped=account.dropped,
            not_heard=account.not_heard,
            not_received=account.not_received,
            missed=account.missed,
            attachments=tuple(each.name for each in summary.attachment_indexes),
            incidents=tuple(account.incidents),
            metadata=metadata,
        )


def _is_told(topic: str) -> bool:
    return bool(_GAPS.fullmatch(topic) or _INCIDENTS.fullmatch(topic))


def _complete(summary: Summary) -> bool:
    """Whether the summary repeats every channel and schema (it may legally not)."""
    if summary.statistics is None:
        return False
    if any(number not in summary.channels for number in summary.statistics.channel_message_counts):
        return False
    return all(channel.schema_id == 0 or channel.schema_id in summary.schemas for channel in summary.channels.values())


def _channels(
    channels: dict[int, Channel], schemas: dict[int, Schema], counts: dict[int, int]
) -> tuple[ChannelInfo, ...]:
    found: list[ChannelInfo] = []
    for channel in channels.values():
        schema = schemas.get(channel.schema_id)
        found.append(
            ChannelInfo(
                key=channel.topic,
                messages=counts.get(channel.id, 0),
                schema=schema.name if schema else "",
                encoding=channel.message_encoding,
            )
        )
    return tuple(sorted(found, key=lambda item: item.key))
