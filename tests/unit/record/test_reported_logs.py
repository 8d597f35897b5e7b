"""Logs that broke rosbag2 and MCAP's tools, as their users reported; the table is in tests/reports."""

import io
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from appliance.errors import RecordError
from appliance.model import keyspace
from appliance.record.edit import copy, recover
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from tests.unit.record.test_edit import write
from tests.unit.record.test_reader import MESSAGES, PACKED, PLAIN
from tests.unit.record.test_segments import JSON, KEYS, Clock, Disk, LogWriter, RecordConfig, _gaps, _message, _numbers
from tests.unit.record.test_segments import _writer as writer_of

SECOND = 10**9


def log(folder: Path, data: bytes) -> Path:
    """Write a file."""
    path = folder / "log.mcap"
    path.write_bytes(data)
    return path


def made(**options: Any) -> bytes:
    """Return a log of three messages as the library writes it."""
    out = io.BytesIO()
    writer = Writer(out, **options)
    writer.start()
    channel = writer.register_channel("k", "json", 0)
    for number in range(3):
        writer.add_message(channel, number, b'{"n":%d}' % number, number)
    writer.finish()
    return out.getvalue()


def test_a_file_cut_in_mid_chunk_gives_its_whole_chunks_to_a_new_one(tmp_path: Path) -> None:
    """Power is lost between two writes of a chunk: the rest is found, told and made a file with an index.

    Reported as foxglove/mcap#385.
    """
    cut = log(tmp_path, PACKED[: len(PACKED) // 3])
    expected = list(read(cut))
    assert 0 < len(expected) < len(MESSAGES)
    assert expected == MESSAGES[: len(expected)]
    told = recover(cut, tmp_path / "out.mcap")
    assert (told.messages, told.recovered) == (len(expected), False)
    assert list(read(tmp_path / "out.mcap")) == expected


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 0.97, 0.99])
def test_a_recovered_file_is_read_by_everybody(tmp_path: Path, share: float) -> None:
    """Cut in the summary too: the library's indexed reader opens what came out, statistics and all.

    Reported as foxglove/mcap#1474.
    """
    cut = log(tmp_path, PACKED[: int(len(PACKED) * share)])
    told = recover(cut, tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == told.messages == sum(1 for _ in reader.iter_messages())


def test_a_damaged_chunk_does_not_end_the_recovery(tmp_path: Path) -> None:
    """Chunks behind it are read, and the recovery says what it left out (foxglove/mcap#1390)."""
    damaged = bytearray(PACKED)
    at = PACKED.index(b"zstd", len(PACKED) // 3)
    damaged[at + 20] ^= 0xFF
    bad = log(tmp_path, bytes(damaged))
    problems: list[str] = []
    found = list(read(bad, problems=problems))
    assert found[-1] == MESSAGES[-1]
    assert 0 < len(MESSAGES) - len(found) < len(MESSAGES) // 2
    assert any("chunk" in each for each in problems)
    told = recover(bad, tmp_path / "out.mcap")
    assert told.messages == len(found)
    assert list(read(tmp_path / "out.mcap")) == found


def test_a_cut_file_is_told_in_words(tmp_path: Path) -> None:
    """That it was not finished, and how much at its end could not be read (foxglove/mcap#697)."""
    (problem,) = info(log(tmp_path, PLAIN[: len(PLAIN) // 2])).problems
    assert "was not finished" in problem
    assert "bytes at its end were not" in problem


def test_an_end_that_is_none_is_noticed(tmp_path: Path) -> None:
    """A whole data section with a wrong end is not called sound (foxglove/mcap#535)."""
    told = info(log(tmp_path, PACKED[:-8] + b"notmagic"))
    assert told.messages == len(MESSAGES)
    assert told.recovered or told.problems


@pytest.mark.parametrize("length", [2**31, 2**40, 2**63, 2**64 - 1])
def test_a_record_that_claims_the_memory_is_not_loaded(tmp_path: Path, length: int) -> None:
    """A length of any size is no reason to ask for so much (foxglove/mcap#1220)."""
    data = PACKED[:8] + b"\x01" + length.to_bytes(8, "little") + PACKED[17:]
    problems: list[str] = []
    assert list(read(log(tmp_path, data), problems=problems)) == []
    assert info(tmp_path / "log.mcap").messages == 0
    later = PACKED[: len(PACKED) // 2] + b"\x06" + length.to_bytes(8, "little") + b"x" * 100
    assert list(read(log(tmp_path, later), problems=problems))


def test_a_changed_byte_is_no_message(tmp_path: Path) -> None:
    """Checksums of chunks are looked at, in files without compression too (foxglove/mcap#652)."""
    damaged = bytearray(PLAIN)
    damaged[PLAIN.index(b'{"n":20,') + 6] = ord("9")
    problems: list[str] = []
    found = list(read(log(tmp_path, bytes(damaged)), problems=problems))
    assert all(each in MESSAGES for each in found)
    assert problems
    with pytest.raises(RecordError, match="is damaged"):
        list(read(tmp_path / "log.mcap"))


def test_chunks_without_an_index_of_their_messages_are_read(tmp_path: Path) -> None:
    """The chunk index alone does not say that there is nothing in it (foxglove/mcap#1179)."""
    data = made(chunk_size=20, index_types=IndexType.CHUNK, compression=CompressionType.NONE)
    path = log(tmp_path, data)
    assert [each.payload for each in read(path)] == [b'{"n":%d}' % number for number in range(3)]
    assert info(path).messages == info(path, verify=True).messages == 3


def test_channels_without_a_schema_are_read(tmp_path: Path) -> None:
    """Schema 0 is none, and no error (foxglove/mcap#782)."""
    path = log(tmp_path, made())
    assert len(list(read(path))) == 3


def test_a_log_with_channels_without_a_schema_is_summed_up(tmp_path: Path) -> None:
    """They are shown with nothing as their schema (foxglove/mcap#584)."""
    told = info(log(tmp_path, made()))
    assert [(each.key, each.schema, each.messages) for each in told.channels] == [("k", "", 3)]
    assert told.problems == ()


def test_times_at_the_beginning_of_time(tmp_path: Path) -> None:
    """A message at time 0 has neither end before start nor is it missing (foxglove/mcap#581)."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    writer.add_message(writer.register_channel("k", "json", 0), 0, b"{}", 0)
    writer.finish()
    path = log(tmp_path, out.getvalue())
    told = info(path)
    assert (told.start_ns, told.end_ns, told.messages) == (0, 0, 1)
    assert len(list(read(path))) == 1
    assert copy([path], tmp_path / "out.mcap").messages == 1


def test_a_file_of_another_kind_is_told_as_such(tmp_path: Path) -> None:
    """At once, and not at the first message (foxglove/mcap#971)."""
    path = log(tmp_path, b"some bytes longer than the magic at the beginning")
    for act in (lambda: info(path), lambda: list(read(path)), lambda: recover(path, tmp_path / "out.mcap")):
        with pytest.raises(RecordError, match="not an MCAP file"):
            act()


def test_a_damaged_attachment_costs_no_message(tmp_path: Path) -> None:
    """One byte of an attachment is wrong: all messages are read and recovered (foxglove/mcap#1647)."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    writer.add_attachment(1, 1, "map.png", "image/png", b"PNG" * 100)
    channel = writer.register_channel("k", "json", 0)
    writer.add_message(channel, 5, b"{}", 5)
    writer.finish()
    data = bytearray(out.getvalue())
    data[data.index(b"PNGPNG") + 7] ^= 1
    path = log(tmp_path, bytes(data))
    problems: list[str] = []
    assert len(list(read(path, problems=problems))) == 1
    assert recover(path, tmp_path / "out.mcap").messages == 1


# --- recording ---------------------------------------------------------------------------------------------------

_KILLED = """
import sys, time
from pathlib import Path
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.record.models import LoggedMessage
from appliance.record.settings import RecordConfig
from appliance.record.segments import LogWriter
config = RecordConfig(directory=sys.argv[1], free_bytes=0, total_bytes=0, chunk_bytes=2000, flush_s=0.05)
writer = LogWriter(config, fleet="f1")
writer.prepare()
number = 0
while True:
    key = Keys("f1")(keyspace.TRANSITION, "t1")
    writer.write(LoggedMessage(key, number + 1, b'{"n":%d}' % number, "application/json"))
    writer.tick()
    number += 1
    if number % 50 == 0:
        print(number, flush=True)
    time.sleep(0.001)
"""


def test_power_that_goes_costs_the_last_moments_only(tmp_path: Path, project_root: Path) -> None:
    """The recording process is killed in mid-write: the log can be read up to half a second before.

    Reported as ros2/rosbag2#2133.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", _KILLED, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=project_root
    )
    assert process.stdout is not None
    seen = 0
    while seen < 400:
        seen = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    (path,) = tmp_path.glob("*.mcap")
    numbers = [msgspec.json.decode(each.payload)["n"] for each in read(path, keys=KEYS(keyspace.TRANSITION))]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) > seen // 2
    assert info(path).recovered
    assert not recover(path, tmp_path / "whole.mcap").recovered


def test_a_file_needs_nothing_beside_it(tmp_path: Path) -> None:
    """No metadata file that may be missing: what it is of is in each log, also in one that was cut.

    Reported as ros2/rosbag2#395.
    """
    writer = writer_of(tmp_path / "logs")
    writer.write(_message(1))
    writer.tick()
    writer.close()
    (source,) = writer.files
    alone = tmp_path / "elsewhere.mcap"
    alone.write_bytes(source.read_bytes()[:-60])
    told = info(alone)
    assert told.metadata["fleet"] == "f1"
    assert told.messages >= 1


def test_times_that_are_none_do_not_get_into_a_log(tmp_path: Path) -> None:
    """A time that has rolled over is replaced by that of arrival, and the file stays in one piece.

    Reported as ros2/rosbag2#2389.
    """
    writer = writer_of(tmp_path)
    writer._wall = lambda: 77
    for at_ns in (2**64 - 5, 2**63, -(2**63), 5):
        assert writer.write(LoggedMessage(KEYS(keyspace.TRANSITION, "t1"), at_ns, b"{}", JSON))
    writer.close()
    told = info(writer.files[0])
    assert (told.start_ns, told.end_ns, told.problems) == (5, 77, ())


def test_recording_stops_before_the_disk_is_full(tmp_path: Path) -> None:
    """At the floor that was set, with a reason, and goes on when there is room (ros2/rosbag2#2477)."""
    clock, disk = Clock(), Disk(5000)
    config = RecordConfig(directory=str(tmp_path), free_bytes=1000, fsync=False)
    writer = LogWriter(config, fleet="f1", clock=clock, free=disk.free)
    assert writer.write(_message(0))
    disk.left = 500
    clock.now += 1
    writer.tick()
    assert not writer.write(_message(1))
    assert "bytes free" in writer.problem
    disk.left = 5000
    clock.now += 60
    assert writer.write(_message(2))
    writer.close()
    assert _numbers(writer.files) == [0, 2]
    assert not any(info(path).recovered for path in writer.files)


def test_what_was_not_recorded_is_counted_in_the_log(tmp_path: Path) -> None:
    """By reason, with its number and its times (ros2/rosbag2#477)."""
    writer = writer_of(tmp_path)
    writer.write(_message(0))
    for number in range(7):
        writer.drop("queue full", "k", 10, 1000 + number)
    writer.miss("gw-2", 3, "k", 2000)
    writer.tick()
    writer.close()
    told = info(writer.files[0])
    assert (told.dropped, told.not_heard) == (7, 3)
    assert {(each.reason, each.dropped) for each in _gaps(writer.files)} == {("queue full", 7), ("not heard", 3)}


@pytest.mark.parametrize("source", ["ros2/rosbag2#2108", "ros2/rosbag2#1579"])
def test_no_message_is_lost_between_two_files(tmp_path: Path, source: str) -> None:
    """Large files and small ones: each message is in one of them, once and in order."""
    size = {"ros2/rosbag2#2108": 200_000, "ros2/rosbag2#1579": 3_000}[source]
    writer = writer_of(tmp_path, chunk_bytes=1000, rotate_bytes=size, compression="none")
    count = 4000 if size > 10_000 else 300
    for number in range(count):
        writer.write(_message(number, size=100))
        if number % 3 == 0:
            writer.tick()
    writer.close()
    assert len(writer.files) > 2
    assert _numbers(writer.files) == list(range(count))


def test_messages_of_one_time_stay_in_their_order(tmp_path: Path) -> None:
    """Hundreds with the same time come back as they were written, merged as well (ros2/rosbag2#2173)."""
    path = write(tmp_path / "a.mcap", [(7, "k/one", b'{"n":%d}' % number) for number in range(200)])
    expected = [b'{"n":%d}' % number for number in range(200)]
    assert [each.payload for each in read(path)] == expected
    other = write(tmp_path / "b.mcap", [(7, "k/two", b"{}")] * 50)
    copy([path, other], tmp_path / "out.mcap")
    assert [each.payload for each in read(tmp_path / "out.mcap", keys="k/one")] == expected


def test_times_across_two_files_are_put_in_order(tmp_path: Path) -> None:
    """The second file begins before the first one ends: merged, they come by time (ros2/rosbag2#857)."""
    one = write(tmp_path / "a.mcap", [(at, "k", b"{}") for at in (1, 2, 5, 8)])
    two = write(tmp_path / "b.mcap", [(at, "l", b"{}") for at in (3, 4, 6, 9)])
    copy([one, two], tmp_path / "out.mcap")
    assert [each.at_ns for each in read(tmp_path / "out.mcap")] == [1, 2, 3, 4, 5, 6, 8, 9]


def test_a_recording_of_nothing_is_a_log(tmp_path: Path) -> None:
    """A recorder that heard nothing leaves no file that others stumble over (ros2/rosbag2#39)."""
    writer = writer_of(tmp_path)
    writer.tick()
    writer.close()
    for path in writer.files:
        told = info(path)
        assert (told.messages, told.recovered, told.problems) == (0, False, ())
        assert list(read(path)) == []
    assert list(tmp_path.glob("*.mcap")) == writer.files
