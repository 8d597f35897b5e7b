"""Reading logs in whatever state they are in."""

import io
import struct
import tracemalloc
from pathlib import Path

import lz4.frame
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from appliance.errors import NotFoundError, RecordError
from appliance.model import LogLine, encode, keyspace
from appliance.model.keys import Keys
from appliance.record import reader
from appliance.record.edit import Select, cat, recover
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from appliance.record.segments import Attached, LogWriter
from appliance.record.settings import RecordConfig

MAGIC_BYTES = 8


def _log(*, compression: CompressionType = CompressionType.ZSTD, **options: bool) -> tuple[bytes, list[LoggedMessage]]:
    """Return a finished log of 40 messages in several chunks, and the messages."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=300, compression=compression, **options)
    writer.start()
    schema = writer.register_schema("swiftbot.Thing", "jsonschema", b'{"type":"object"}')
    channels = [
        writer.register_channel(f"swiftbot/f1/k{n}", "json", schema, {"encoding": "application/json"}) for n in (0, 1)
    ]
    messages: list[LoggedMessage] = []
    for number in range(40):
        payload = b"" if number == 7 else b'{"n":%d,"x":"abcdefgh"}' % number
        writer.add_message(channels[number % 2], number + 1, payload, number + 1)
        messages.append(LoggedMessage(f"swiftbot/f1/k{number % 2}", number + 1, payload, "application/json"))
    writer.finish()
    return out.getvalue(), messages


PACKED, MESSAGES = _log()
PLAIN, _ = _log(compression=CompressionType.NONE)
LOOSE, _ = _log(use_chunking=False)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file to write over and over."""
    return tmp_path_factory.mktemp("log") / "log.mcap"


@settings(max_examples=300, deadline=None)
@given(data=st.sampled_from([PACKED, PLAIN, LOOSE]), share=st.floats(0, 1))
def test_cut_anywhere(scratch: Path, data: bytes, share: float) -> None:
    """A file cut off at any byte gives a prefix of its messages, exactly as written, and no error."""
    cut = MAGIC_BYTES + int((len(data) - MAGIC_BYTES) * share)
    scratch.write_bytes(data[:cut])
    found = list(read(scratch))
    assert found == MESSAGES[: len(found)]
    told = info(scratch)
    assert told.messages == len(found)
    assert told.recovered == (cut < len(data))


@pytest.mark.parametrize("data", [PACKED, PLAIN, LOOSE], ids=["zstd", "plain", "unchunked"])
def test_every_cut_within_a_record_keeps_the_records_before(scratch: Path, data: bytes) -> None:
    """The number of messages read never falls as more of the file is there, and reaches all of them."""
    counts = []
    for cut in range(MAGIC_BYTES, len(data), 7):
        scratch.write_bytes(data[:cut])
        counts.append(sum(1 for _ in read(scratch)))
    assert counts == sorted(counts)
    assert counts[-1] == len(MESSAGES)


@settings(max_examples=300, deadline=None)
@given(where=st.integers(MAGIC_BYTES, len(PACKED) - 1), flip=st.integers(1, 255))
def test_one_bad_byte(scratch: Path, where: int, flip: int) -> None:
    """A byte changed anywhere never crashes the reader and never gives a message that was not written."""
    damaged = bytearray(PACKED)
    damaged[where] ^= flip
    scratch.write_bytes(damaged)
    problems: list[str] = []
    found = list(read(scratch, problems=problems))
    assert all(message in MESSAGES for message in found)
    told = info(scratch, verify=True)
    assert told.messages == len(found)
    if len(found) < len(MESSAGES):
        assert problems or told.recovered


@settings(max_examples=200, deadline=None)
@given(tail=st.binary(max_size=400))
def test_garbage_after_the_magic(scratch: Path, tail: bytes) -> None:
    """Whatever follows the magic, reading ends with messages or problems, not with a crash."""
    scratch.write_bytes(PACKED[:MAGIC_BYTES] + tail)
    list(read(scratch, problems=[]))
    info(scratch)


def test_damage_raises_after_what_could_be_read(scratch: Path) -> None:
    """A chunk with a bad checksum costs its own messages only; the error at the end says how many were read."""
    damaged = bytearray(PLAIN)
    at = PLAIN.index(b'{"n":20,')
    damaged[at + 5] ^= 1
    scratch.write_bytes(damaged)
    found: list[LoggedMessage] = []

    def read_all() -> None:
        found.extend(read(scratch))  # extend keeps what came before the error

    with pytest.raises(RecordError, match="messages could be read: chunk at byte"):
        read_all()
    assert 0 < len(found) < len(MESSAGES)
    assert found[-1] == MESSAGES[-1]


def test_chunk_that_claims_the_memory(scratch: Path) -> None:
    """A chunk that says it unpacks to a terabyte is refused unread."""
    at = PACKED.index(b"\x04\x00\x00\x00zstd") - 12
    scratch.write_bytes(PACKED[:at] + (1 << 40).to_bytes(8, "little") + PACKED[at + 8 :])
    problems: list[str] = []
    list(read(scratch, problems=problems))
    assert any("claims 1099511627776 bytes" in problem for problem in problems)


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD])
def test_a_chunk_that_unpacks_to_the_memory(
    tmp_path: Path, compression: CompressionType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it claims, a chunk is unpacked up to the limit, also one that the index says has gaps in it."""
    monkeypatch.setattr(reader, "CHUNK_LIMIT", 2**20)
    out = io.BytesIO()
    writer = Writer(out, chunk_size=2**30, compression=compression)
    writer.start()
    channel = writer.register_channel(Keys("f1")(keyspace.RECORDER_GAP, "x"), "json", 0)
    writer.add_message(channel, 1, bytes(2**26), 1)
    writer.finish()
    data = out.getvalue()
    assert len(data) < 2**19
    log = tmp_path / "bomb.mcap"
    name = compression.name.lower().encode()
    at = data.index(len(name).to_bytes(4, "little") + name) - 12
    for claim in (2**26, 100):
        log.write_bytes(data[:at] + claim.to_bytes(8, "little") + data[at + 8 :])
        tracemalloc.start()
        try:
            problems: list[str] = []
            assert list(read(log, problems=problems)) == []
            told = info(log)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert any("chunk at byte" in each for each in problems), problems
        assert told.problems
        assert peak < 2**24
    with pytest.raises(RecordError, match="chunk at byte"):
        list(read(log))


def test_lz4_that_is_cut_is_damage(scratch: Path) -> None:
    """A chunk whose packed data ends before its end costs its messages, and is reported, without a checksum too."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=10_000, compression=CompressionType.NONE, enable_crcs=False)
    writer.start()
    channel = writer.register_channel("k", "json", 0)
    for number in range(20):
        writer.add_message(channel, number + 1, b"x" * 50, number + 1)
    writer.finish()
    plain = out.getvalue()
    start = plain.index(b"\x06")  # the chunk's opcode
    (length,) = struct.unpack_from("<Q", plain, start + 1)
    body = plain[start + 9 : start + 9 + length]
    head, packed = body[:28], lz4.frame.compress(body[40:])[:-20]
    chunk = head + b"\x03\x00\x00\x00lz4" + struct.pack("<Q", len(packed)) + packed
    scratch.write_bytes(plain[:start] + b"\x06" + struct.pack("<Q", len(chunk)) + chunk)
    problems: list[str] = []
    assert list(read(scratch, problems=problems)) == []
    assert any("is damaged" in each for each in problems), problems


@pytest.mark.parametrize("payload", [b"[" * 100_000, b'{"a":' * 100_000, b"\xff\xfe", b'{"dropped":1e999}', b""])
def test_what_a_stranger_puts_on_the_recorders_keys(tmp_path: Path, payload: bytes) -> None:
    """A bomb where gaps, incidents and deletions are written: it is reported, read and copied as it is."""
    writer = LogWriter(RecordConfig(directory=str(tmp_path), free_bytes=0, fsync=False), fleet="f1")
    writer.prepare()
    keys = Keys("f1")
    own = [
        keys(keyspace.RECORDER_GAP, "x"),
        keys(keyspace.RECORDER_INCIDENT, "x"),
        keys(keyspace.RECORDER_DELETED, "x"),
    ]
    for key in (
        *own,
        keys(keyspace.LOG, "g1"),
        keys(keyspace.ROBOT, "r1"),
        keys(keyspace.TRANSITION, "t1"),
        keys(keyspace.TASK_UPDATE, "t1"),
    ):
        writer.write(LoggedMessage(key, 5, payload, "application/json"))
    writer.close()
    (log,) = writer.files
    assert info(log).messages == info(log, verify=True).messages == 7
    assert (info(log).dropped, info(log).incidents) == (0, ())
    assert [each.payload for each in read(log)] == [payload] * 7
    assert recover(log, tmp_path / "again.mcap").messages == 7
    lines: list[str] = []
    assert cat([log], Select(), as_json=True, write=lines.append) == []
    assert len(lines) == 7


@pytest.mark.parametrize("content", [b"", b"\x89", b"garbage, and enough of it to look at", b"\0" * 4096])
def test_not_a_log(scratch: Path, content: bytes) -> None:
    """A file that does not begin as MCAP is an error that says so."""
    scratch.write_bytes(content)
    with pytest.raises(RecordError, match="not an MCAP file"):
        list(read(scratch))
    with pytest.raises(RecordError, match="not an MCAP file"):
        info(scratch)


def test_no_such_log(tmp_path: Path) -> None:
    """An absent file and a folder are distinguished from a bad one."""
    with pytest.raises(NotFoundError, match="no log file"):
        info(tmp_path / "absent.mcap")
    with pytest.raises(RecordError, match="cannot read"):
        info(tmp_path)


def test_summary_without_channels(scratch: Path) -> None:
    """A legal file whose summary does not repeat schemas and channels is summed up by streaming."""
    data, messages = _log(repeat_channels=False, repeat_schemas=False)
    scratch.write_bytes(data)
    told = info(scratch)
    assert told.messages == len(messages)
    assert [channel.schema for channel in told.channels] == ["swiftbot.Thing"] * 2
    assert not told.recovered


def test_file_without_index(scratch: Path) -> None:
    """A legal file without any summary is read."""
    out = io.BytesIO()
    writer = Writer(
        out,
        index_types=IndexType.NONE,
        use_statistics=False,
        use_summary_offsets=False,
        repeat_channels=False,
        repeat_schemas=False,
    )
    writer.start()
    channel = writer.register_channel("k", "json", 0)
    writer.add_message(channel, 3, b"{}", 3)
    writer.finish()
    scratch.write_bytes(out.getvalue())
    told = info(scratch)
    assert (told.messages, told.recovered, told.problems) == (1, False, ())
    assert list(read(scratch)) == [LoggedMessage("k", 3, b"{}", "json")]


def test_keys_are_filtered(scratch: Path) -> None:
    """Only messages whose key an expression includes are given."""
    scratch.write_bytes(PACKED)
    assert list(read(scratch, keys=["swiftbot/*/k1"])) == [
        message for message in MESSAGES if message.key.endswith("k1")
    ]
    assert list(read(scratch, keys="swiftbot/f1/**")) == MESSAGES
    assert list(read(scratch, keys=[])) == []


def test_recovered_file_is_proper(tmp_path: Path) -> None:
    """Recovering a cut file makes one that mcap's own indexed reader opens, with the same messages."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(PACKED[: len(PACKED) // 2])
    expected = list(read(cut))
    told = recover(cut, tmp_path / "whole.mcap")
    assert not told.recovered
    assert list(read(tmp_path / "whole.mcap")) == expected
    with (tmp_path / "whole.mcap").open("rb") as stream:
        assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == len(expected)
    with pytest.raises(RecordError, match="exists already"):
        recover(cut, tmp_path / "whole.mcap")


def test_recovering_garbage_leaves_nothing(tmp_path: Path) -> None:
    """Garbage is not made into an empty log."""
    (tmp_path / "bad").write_bytes(b"garbage")
    with pytest.raises(RecordError, match="not an MCAP file"):
        recover(tmp_path / "bad", tmp_path / "out.mcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad"]


def _recorded(folder: Path) -> Path:
    """Return a file of the recorder's own: lines with what is derived from them, frames, gaps, an attachment."""
    config = RecordConfig(directory=str(folder), free_bytes=0, fsync=False, total_bytes=0)
    attached = Attached("gateway.toml", "application/toml", b'id = "gw-1"\n')
    writer = LogWriter(config, fleet="f1", attached=(attached,))
    writer.prepare()
    keys = Keys("f1")
    for number in range(8):
        line = encode(LogLine(at_ns=1000 + number, level="info", source="gw-1", event=f"started {number}"))
        writer.write(LoggedMessage(keys(keyspace.LOG, "gw-1"), 1000 + number, line, "application/json"))
        writer.write(
            LoggedMessage(
                keys(keyspace.MAVLINK, "r1", "rx"), 1000 + number, bytes(range(30)), "application/octet-stream"
            )
        )
        if number % 3 == 2:
            writer.drop("queue full", keys(keyspace.LOG, "gw-1"), 10, 1000 + number)
            writer.tick()
    writer.close()
    return writer.files[0]


@pytest.mark.thorough
def test_the_recorders_own_file_damaged_at_every_offset(tmp_path: Path) -> None:
    """A byte changed, and the file cut, at each place in turn: what is read was written, and what lacks is reported."""
    whole = _recorded(tmp_path / "logs").read_bytes()
    log = tmp_path / "damaged.mcap"
    log.write_bytes(whole)
    written = list(read(log))
    assert len(written) > 16
    for where in range(MAGIC_BYTES, len(whole)):
        log.write_bytes(whole[:where] + bytes((whole[where] ^ 0xFF,)) + whole[where + 1 :])
        problems: list[str] = []
        found = list(read(log, problems=problems))
        assert all(each in written for each in found), where
        assert len(found) == len(written) or problems or info(log).recovered, where
        if where % 8 == 0:
            log.write_bytes(whole[:where])
            found = list(read(log))
            assert found == written[: len(found)], where
        if where % 128 == 0:
            _check_recovered(log, tmp_path / f"{where}.mcap", written)


def _check_recovered(log: Path, out: Path, written: list[LoggedMessage]) -> None:
    try:
        recover(log, out)
    except RecordError:
        assert not out.exists()
    else:
        assert all(each in written for each in read(out))
