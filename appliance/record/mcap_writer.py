"""MCAP files, written with little work a message, onto a file that a failed write leaves whole.

The records are those of the specification (mcap.dev/spec): header, schemas and channels at their first use, chunks
with a message index each, attachments, metadata, and at the end a summary that repeats schemas and channels. The
`mcap` package writes the same files; it makes an object and a dozen small writes of each message, which at 50,000
messages a second is more than one core has. Only what is written rarely goes through its record classes here.

Every write goes to the kernel at once. `McapFile` keeps its place only as long as each write succeeds, so when one
fails (disk full, file size limit, I/O error) `LogFile` cuts the log back to the end of the last whole flush and ends it
with a bare footer: a legal file, and what was in it stays.
"""

import contextlib
import os
import struct
import zlib
from pathlib import Path
from typing import Protocol, cast

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

_ENDING = (
    struct.pack("<BQI", 0x0F, 4, 0)  # DataEnd, no checksum
    + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)  # Footer without summary
    + bytes((137, 77, 67, 65, 80, 48, 13, 10))
)
"""The shortest legal end of an MCAP file: no summary, so readers stream it."""


class LogFile:
    """A new file opened for a log (FileExistsError when it is there). Raises OSError from every method that writes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        self._position = 0
        self._whole = 0

    def write(self, data: bytes) -> int:
        """Write all of `data`."""
        rest = memoryview(data)
        while rest:
            written = os.write(self._handle, rest)
            rest = rest[written:]
            self._position += written
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._position

    def flush(self) -> None:
        """Take what is written so far for whole: the mcap writer calls this with no record in the middle."""
        self._whole = self._position

    def sync(self) -> None:
        """Have the kernel put it on the disk."""
        os.fdatasync(self._handle)

    def close(self) -> None:
        """Close after a good end."""
        os.close(self._handle)

    def abandon(self) -> bool:
        """Cut back to the last whole flush, end the file there as well as the disk allows, close it.

        Returns:
            Whether anything is left; False when the file was removed because nothing of it was whole.
        """
        with contextlib.suppress(OSError):
            os.ftruncate(self._handle, self._whole)
            os.lseek(self._handle, self._whole, os.SEEK_SET)
            if self._whole and os.write(self._handle, _ENDING) < len(_ENDING):
                os.ftruncate(self._handle, self._whole)
        with contextlib.suppress(OSError):
            os.close(self._handle)
        if not self._whole:
            with contextlib.suppress(OSError):
                self.path.unlink()
        return bool(self._whole)


def free_bytes(folder: Path) -> int:
    """Return what an unprivileged process may still write on the file system of `folder`, bytes."""
    stat = os.statvfs(folder)
    return stat.f_bavail * stat.f_frsize


MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))
_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time."""
_FIELDS = 22
"""Bytes of a message's fields before its data."""
_INDEX = struct.Struct("<BQHI")


class Output(Protocol):
    """What a file is written to: each `write` takes all it is given."""

    def write(self, data: bytes, /) -> int: ...  # noqa: D102
    def tell(self) -> int: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102


class McapFile:
    """Writes one file. Nothing but its own counters is kept of what is written: the summary names chunks, not messages.

    Args:
        output: where to; its position must be 0.
        chunk_bytes: a chunk is ended when it has grown beyond this.
        compression: `zstd`, `lz4` or `none`.

    Raises OSError of `output` from every method but the constructor; the file is then to be given up.
    """

    def __init__(self, output: Output, *, chunk_bytes: int, compression: str) -> None:
        self._output = output
        self._chunk_bytes = chunk_bytes
        self._compression = "" if compression == "none" else compression
        self._zstd = zstandard.ZstdCompressor(level=3)
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: dict[int, int] = {}
        self._chunk_indexes: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._start_ns = self._end_ns = 0
        self._messages = 0
        self._chunk = bytearray()
        self._index: dict[int, list[int]] = {}
        """Channel -> time and place in the chunk of each of its messages, one after the other."""

    def start(self, *, profile: str, library: str) -> None:
        """Write the beginning."""
        self._output.write(MAGIC + _built(Header(profile, library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Announce a schema; returns its number."""
        number = len(self._schemas) + 1
        schema = Schema(id=number, data=data, encoding=encoding, name=name)
        self._schemas[number] = schema
        self._chunk += _built(schema)
        return number

    def register_channel(self, topic: str, message_encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Announce a channel; returns its number."""
        number = len(self._channels) + 1
        channel = Channel(
            id=number, topic=topic, message_encoding=message_encoding, schema_id=schema, metadata=metadata
        )
        self._channels[number] = channel
        self._chunk += _built(channel)
        return number

    def add_message(self, channel: int, at_ns: int, data: bytes, sequence: int = 0) -> bool:
        """Add a message; whether the chunk with it has been written, and all before it."""
        chunk, index = self._chunk, self._index.get(channel)
        if index is None:
            index = self._index[channel] = []
        index.append(at_ns)
        index.append(len(chunk))
        chunk += _MESSAGE.pack(0x05, _FIELDS + len(data), channel, sequence, at_ns, at_ns)
        chunk += data
        if len(chunk) > self._chunk_bytes:
            self._end_chunk()
            return True
        return False

    def add_attachment(self, name: str, media_type: str, data: bytes, *, at_ns: int) -> None:
        """Write an attachment, after the chunk in progress."""
        self._end_chunk()
        offset = self._output.tell()
        record = _built(Attachment(create_time=at_ns, log_time=at_ns, name=name, media_type=media_type, data=data))
        self._output.write(record)
        self._attachments.append(
            AttachmentIndex(
                offset=offset,
                length=len(record),
                log_time=at_ns,
                create_time=at_ns,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write a metadata record, after the chunk in progress."""
        self._end_chunk()
        offset = self._output.tell()
        record = _built(Metadata(name=name, metadata=metadata))
        self._output.write(record)
        self._metadata.append(MetadataIndex(offset=offset, length=len(record), name=name))

    def flush(self) -> None:
        """End the chunk in progress, if there is a message in it."""
        self._end_chunk()
        self._output.flush()

    def finish(self) -> None:
        """Write what is left, the summary and the end."""
        self._end_chunk()
        self._output.write(_built(DataEnd(0)))
        begin = self._output.tell()
        groups: tuple[tuple[int, list[McapRecord]], ...] = (
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, list(self._attachments)),
            (Opcode.METADATA_INDEX, list(self._metadata)),
        )
        summary = bytearray()
        offsets: list[SummaryOffset] = []
        for opcode, records in groups:
            if not records:
                continue
            at = len(summary)
            for record in records:
                summary += _built(record)
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=begin + at, group_length=len(summary) - at))
        offsets_at = begin + len(summary)
        for offset in offsets:
            summary += _built(offset)
        checksum = zlib.crc32(summary)
        checksum = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, begin, offsets_at), checksum)
        footer = Footer(summary_start=begin, summary_offset_start=offsets_at, summary_crc=checksum)
        self._output.write(bytes(summary) + _built(footer) + MAGIC)
        self._output.flush()

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunk_indexes),
            message_count=self._messages,
            message_start_time=self._start_ns,
            message_end_time=self._end_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _end_chunk(self) -> None:
        if not self._index:
            return  # schemas and channels wait for the first message
        start_ns = min(min(each[::2]) for each in self._index.values())
        end_ns = max(max(each[::2]) for each in self._index.values())
        chunk, size = self._packed(start_ns, end_ns)
        at = self._output.tell()
        offsets: dict[int, int] = {}
        records = bytearray(chunk)
        for channel, entries in self._index.items():
            offsets[channel] = at + len(records)
            records += _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(entries), channel, 8 * len(entries))
            records += struct.pack(f"<{len(entries)}Q", *entries)
        # In one write: on a full disk either all of it is there or the file is cut back to before it.
        self._output.write(bytes(records))
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_length=len(chunk),
                chunk_start_offset=at,
                compression=self._compression,
                compressed_size=size,
                message_end_time=end_ns,
                message_index_length=len(records) - len(chunk),
                message_index_offsets=offsets,
                message_start_time=start_ns,
                uncompressed_size=len(self._chunk),
            )
        )
        for channel, entries in self._index.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(entries) // 2
            self._messages += len(entries) // 2
        self._start_ns = start_ns if len(self._chunk_indexes) == 1 else min(self._start_ns, start_ns)
        self._end_ns = max(self._end_ns, end_ns)
        self._chunk = bytearray()
        self._index = {}

    def _packed(self, start_ns: int, end_ns: int) -> tuple[bytes, int]:
        """Return the chunk record and the size of what is packed in it."""
        plain = bytes(self._chunk)
        if self._compression == "zstd":
            packed: bytes = self._zstd.compress(plain)
        elif self._compression == "lz4":
            packed = bytes(cast("bytes", lz4.frame.compress(plain)))  # pyright: ignore[reportUnknownMemberType]
        else:
            packed = plain
        record = Chunk(
            compression=self._compression,
            data=packed,
            message_end_time=end_ns,
            message_start_time=start_ns,
            uncompressed_crc=zlib.crc32(plain),
            uncompressed_size=len(plain),
        )
        return _built(record), len(packed)


def _built(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
