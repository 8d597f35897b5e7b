"""Reading logs back: what is in one, and its messages.

A finished file is summed up from its index at once; any other is streamed (see `records`). Messages come in the
order in which they were recorded, which is what a replay wants.
"""

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.summary import Summary

from appliance.errors import RecordError
from appliance.plane.backlog import UNKNOWN, kind_of
from appliance.record.expressions import compile_expression
from appliance.record.facts import ChannelInfo, Deletion, Gap, Incident, LoggedMessage, LogInfo
from appliance.record.records import BROKEN, RecordStream, chunk_at, open_log
from appliance.record.writer import METADATA, VEHICLE

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
                want(record.topic) or _DELETIONS.fullmatch(record.topic) is not None
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
    """Return a record as the message it stands for: a deletion as the deletion of its key."""
    if _DELETIONS.fullmatch(channel.topic):
        try:
            deletion = msgspec.json.decode(message.data, type=Deletion)
        except _MALFORMED:
            pass  # a stranger's put on that key: give it as it is
        else:
            return LoggedMessage(deletion.key, message.log_time, b"", "", deleted=True)
    encoding = channel.metadata.get("encoding", channel.message_encoding)
    return LoggedMessage(channel.topic, message.log_time, message.data, encoding)


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
                    continue  # not of what is told; where the messages have no index, every chunk may be
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
