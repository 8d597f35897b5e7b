"""MCAP files record by record, from the front, whatever state they are in.

mcap's own readers give up at the first thing they do not expect, and read a cut-off record as a shorter one. A
log of a killed recorder, or one from a dying disk, is worth more than that: each record is framed here against
the end of the file and each chunk checked against its checksum, so a message is either exactly what was written
or it is reported as damage, and what follows is still read.
"""

import dataclasses
import io
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk

from appliance.errors import NotFoundError, RecordError

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
