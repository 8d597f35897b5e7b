"""Making logs, or lines of text, of logs: recovering an unfinished one, merging several, cutting out a part, printing.

Each new log is the same copy, message by message and byte for byte, with a selection by key and time. What is made is a
proper finished file whatever state the sources are in; it appears under its name only when it is complete. `cat` prints
the same selection for people and for pipes.
"""

import contextlib
import heapq
import os
import re
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import Writer
from msgspec import Struct

from appliance.errors import ConfigError, RecordError
from appliance.record.models import LoggedMessage, LogInfo, compile_expression
from appliance.record.reader import RecordStream, info, logged, open_log, read
from appliance.record.segments import VERSION

CHUNK_BYTES = 64 * 1024
"""As the recorder writes them: a later cut loses little."""
PROGRESS_EVERY = 20_000
EDITED = "swiftbot.edit"
"""Name of the metadata record that says what a file was made of."""
_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?s?")

Progress = Callable[[int], None]
"""Told how many messages were copied so far."""


class Select(Struct, frozen=True, kw_only=True):
    """Which messages. Times are Unix nanoseconds, the end excluded; keys are key expressions."""

    keys: tuple[str, ...] = ()
    """Only those that one of them includes; none: all."""
    without: tuple[str, ...] = ()
    """But not those."""
    since_ns: int | None = None
    until_ns: int | None = None

    def matcher(self) -> Callable[[str], bool]:
        """Return the test of a key."""
        wanted = [compile_expression(each) for each in self.keys]
        unwanted = [compile_expression(each) for each in self.without]

        def match(key: str) -> bool:
            if any(pattern.fullmatch(key) for pattern in unwanted):
                return False
            return not wanted or any(pattern.fullmatch(key) for pattern in wanted)

        return match

    def within(self, at_ns: int) -> bool:
        """Whether a time is in the window."""
        return (self.since_ns is None or at_ns >= self.since_ns) and (self.until_ns is None or at_ns < self.until_ns)


def instant(text: str, *, start_ns: int, end_ns: int) -> int:
    """Return the Unix nanoseconds that a person means by `text`.

    Args:
        text: `12.5` or `12.5s`: seconds after the log's start; `-3`: seconds before its end; or an ISO 8601 time
            (UTC unless it says otherwise).
        start_ns: the log's first message.
        end_ns: its last one.

    Raises:
        ConfigError: it is none of these.
    """
    if _NUMBER.fullmatch(text):
        seconds = float(text.rstrip("s"))
        return (end_ns if text.startswith("-") else start_ns) + round(seconds * 1e9)
    try:
        at = datetime.fromisoformat(text)
    except ValueError:
        raise ConfigError(
            f"{text[:60]!r} is no time",
            remedy="write seconds from the log's start (12.5), before its end (-3), or 2026-11-21T10:00:00",
        ) from None
    if at.tzinfo is None:
        at = at.replace(tzinfo=UTC)
    delta = at - datetime(1970, 1, 1, tzinfo=UTC)
    return (delta.days * 86_400 + delta.seconds) * 10**9 + delta.microseconds * 1_000


def span(paths: Sequence[Path]) -> tuple[int, int]:
    """Return the first and last time of some logs, Unix nanoseconds; errors as `reader.info`."""
    told = [each for each in map(info, paths) if each.messages]
    return min((each.start_ns for each in told), default=0), max((each.end_ns for each in told), default=0)


def recover(path: Path | str, out: Path | str, *, progress: Progress = lambda _: None) -> LogInfo:
    """Write all that can be read of `path` as a proper, finished file `out`; return what is in that.

    Raises:
        NotFoundError: no such file.
        RecordError: not an MCAP file, or `out` exists or cannot be written.
    """
    return copy([Path(path)], Path(out), progress=progress)


def copy(
    paths: Sequence[Path], out: Path, select: Select | None = None, *, progress: Progress = lambda _: None
) -> LogInfo:
    """Write the selected messages of some logs, by time, as one finished file; return what is in it.

    Messages of one log stay in the order they were recorded in. A deletion counts under the key it deletes.

    Raises:
        NotFoundError: no such file.
        RecordError: one is no MCAP file, or `out` exists or cannot be written.
    """
    select = select or Select()
    for path in paths:
        open_log(path).close()
    if out.exists():
        raise RecordError(f"{out} exists already", remedy="name a file that does not")
    part = out.with_name(out.name + ".part")
    try:
        with part.open("wb") as file:
            _Copy(Writer(file, chunk_size=CHUNK_BYTES), select, progress).run(paths)
            file.flush()
            os.fsync(file.fileno())
        part.rename(out)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise RecordError(f"cannot write {out}: {error.strerror}", remedy="free space or name another file") from error
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    return info(out)


class _Copy:
    """Gives schemas and channels new numbers: files may announce them more than once, and differently."""

    def __init__(self, writer: Writer, select: Select, progress: Progress) -> None:
        self._writer = writer
        self._select = select
        self._match = select.matcher()
        self._progress = progress
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, int, tuple[tuple[str, str], ...]], int] = {}
        self._attached: set[tuple[str, bytes]] = set()

    def run(self, paths: Sequence[Path]) -> None:
        writer = self._writer
        writer.start(profile="", library=f"swiftbot {VERSION} log")
        streams = [RecordStream(path) for path in paths]
        count = 0
        for _, _, _, number, message in heapq.merge(
            *(self._messages(index, stream) for index, stream in enumerate(streams)), key=lambda each: each[:3]
        ):
            writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
            count += 1
            if count % PROGRESS_EVERY == 0:
                self._progress(count)
        self._progress(count)
        problems = [f"{stream.path.name}: {problem}" for stream in streams for problem in stream.problems]
        made = {"of": ", ".join(path.name for path in paths), "problems": "; ".join(problems)[:2000]}
        window = {"since_ns": self._select.since_ns, "until_ns": self._select.until_ns}
        made |= {key: str(value) for key, value in window.items() if value is not None}
        made |= {"keys": " ".join(self._select.keys), "without": " ".join(self._select.without)}
        writer.add_metadata(EDITED, {key: value for key, value in made.items() if value})
        writer.finish()

    def _messages(self, index: int, stream: RecordStream) -> Iterator[tuple[int, int, int, int, Message]]:
        """Yield the selected messages as (time, file, place in it, new channel number, message)."""
        numbers: dict[int, int] = {}
        latest = place = 0
        for record in stream:
            if isinstance(record, Metadata):
                self._writer.add_metadata(record.name, record.metadata)
                continue
            if isinstance(record, Attachment):
                self._attach(record)
                continue
            if isinstance(record, Channel):
                numbers.pop(record.id, None)
                continue
            if not isinstance(record, Message) or not self._select.within(record.log_time):
                continue
            channel = stream.channels[record.channel_id]
            if not self._match(logged(channel, record).key):
                continue
            if record.channel_id not in numbers:
                numbers[record.channel_id] = self._number(channel, stream.schemas.get(channel.schema_id))
            # Merged by the latest time so far, so that a file's own order stays.
            latest = max(latest, record.log_time)
            place += 1
            yield latest, index, place, numbers[record.channel_id], record

    def _attach(self, record: Attachment) -> None:
        """Carry an attachment over, once: files of one recorder all begin with the same."""
        if (record.name, record.data) not in self._attached:
            self._attached.add((record.name, record.data))
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

    def _number(self, channel: Channel, schema: Schema | None) -> int:
        schema_number = 0
        if schema is not None:
            shape = (schema.name, schema.encoding, schema.data)
            schema_number = self._schemas.get(shape) or self._writer.register_schema(*shape)
            self._schemas[shape] = schema_number
        like = (channel.topic, channel.message_encoding, schema_number, tuple(sorted(channel.metadata.items())))
        number = self._channels.get(like) or self._writer.register_channel(
            channel.topic, channel.message_encoding, schema_number, channel.metadata
        )
        self._channels[like] = number
        return number


SHOWN_BYTES = 20
"""Of a payload that is no text, as hexadecimal."""


class Line(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One message as a JSON line. `value` is a JSON payload, `text` another text, `hex` anything else."""

    at_ns: int
    key: str
    encoding: str = ""
    deleted: bool = False
    value: Any = None
    text: str | None = None
    hex: str | None = None


def cat(
    paths: Sequence[Path],
    select: Select,
    *,
    grep: str = "",
    limit: int = 0,
    as_json: bool = False,
    write: Callable[[str], object],
) -> list[str]:
    """Write the selected messages, a line each; returns sentences about damage met on the way.

    Raises:
        ConfigError: `grep` is no regular expression.
        NotFoundError, RecordError: as `reader.read`.
    """
    try:
        pattern = re.compile(grep)
    except re.error as error:
        raise ConfigError(f"--grep {grep[:80]!r} is no regular expression: {error}") from error
    match = select.matcher()
    problems: list[str] = []
    left = limit or -1
    for path in paths:
        found: list[str] = []
        for message in read(path, problems=found):
            if not match(message.key) or not select.within(message.at_ns):
                continue
            line = json_line(message) if as_json else text_line(message)
            if grep and not pattern.search(line):
                continue
            write(line + "\n")
            left -= 1
            if left == 0:
                return problems
        problems += [f"{path.name}: {each}" for each in found]
    return problems


def text_line(message: LoggedMessage) -> str:
    """Return time, key and payload; control characters are escaped, so that no log can steer a terminal."""
    at = datetime.fromtimestamp(message.at_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    if message.deleted:
        body = "deleted"
    else:
        text = _text(message.payload)
        body = _hex(message.payload) if text is None else text.encode("unicode_escape").decode("ascii")
        if text is not None and text.isprintable():
            body = text
    return f"{at}.{message.at_ns % 10**9 // 1000:06d}Z {message.key} {body}"


def json_line(message: LoggedMessage) -> str:
    """Return the message as one line of JSON, its payload as JSON where it is."""
    line = Line(at_ns=message.at_ns, key=message.key, encoding=message.encoding, deleted=message.deleted)
    if not message.deleted:
        try:
            line = msgspec.structs.replace(line, value=msgspec.json.decode(message.payload))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            text = _text(message.payload)
            more = {"hex": message.payload.hex()} if text is None else {"text": text}
            line = msgspec.structs.replace(line, **more)
    return msgspec.json.encode(line).decode()


def _text(payload: bytes) -> str | None:
    try:
        return payload.decode()
    except UnicodeDecodeError:
        return None


def _hex(payload: bytes) -> str:
    more = "…" if len(payload) > SHOWN_BYTES else ""
    return f"<{len(payload)} bytes {payload[:SHOWN_BYTES].hex()}{more}>"
