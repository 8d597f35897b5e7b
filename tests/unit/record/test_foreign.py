"""Logs of other writers, whole and damaged: read as far as they go, with a clear word on the rest."""

import io
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import CompressionType, IndexType, Writer

from appliance.errors import RecordError
from appliance.record.edit import Select, cat, copy
from appliance.record.player import in_order, remapped
from appliance.record.reader import info, read

COMPRESSIONS = [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]
COUNT = 16


def rosbag2(compression: CompressionType, **options: bool) -> bytes:
    """Return a log as rosbag2 writes it: profile ros2, CDR messages, `ros2msg` schemas, topics with a slash."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=400, compression=compression, **options)
    writer.start(profile="ros2", library="libmcap 1.4")
    writer.add_metadata("rosbag2", {"serialized_metadata": "rosbag2_bagfile_information:\n  version: 9\n"})
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
    channels = [
        writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": "- history: 1\n"})
        for topic in ("/chatter", "/robot_1/odom")
    ]
    for number in range(COUNT):
        body = b"\x00\x01\x00\x00" + len(b"hello\x00").to_bytes(4, "little") + b"hello\x00"
        writer.add_message(channels[number % 2], 10**18 + number * 10**6, body, 10**18 + number * 10**6, number)
    writer.finish()
    return out.getvalue()


def px4(compression: CompressionType) -> bytes:
    """Return a log as a small flight recorder writes it: no chunks, no summary, no statistics, no index, no schema."""
    out = io.BytesIO()
    writer = Writer(
        out,
        compression=compression,
        use_chunking=False,
        index_types=IndexType.NONE,
        use_statistics=False,
        use_summary_offsets=False,
        repeat_channels=False,
        repeat_schemas=False,
        enable_crcs=False,
    )
    writer.start(profile="px4", library="ulog2mcap")
    channel = writer.register_channel("vehicle_attitude", "px4", 0)
    for number in range(COUNT):
        writer.add_message(channel, 1_000 + number, bytes(range(24)), 1_000 + number)
    writer.finish()
    return out.getvalue()


WRITERS: dict[str, Callable[[CompressionType], bytes]] = {
    "rosbag2": rosbag2,
    "rosbag2 unindexed": lambda compression: rosbag2(
        compression, repeat_channels=False, repeat_schemas=False, use_statistics=False, use_summary_offsets=False
    ),
    "px4": px4,
}


@pytest.mark.parametrize("compression", COMPRESSIONS, ids=lambda each: each.name)
@pytest.mark.parametrize("name", WRITERS)
def test_logs_of_others_are_read(tmp_path: Path, name: str, compression: CompressionType) -> None:
    """Told, printed, trimmed and made whole: each message as it is, under its topic and encoding."""
    log = tmp_path / "foreign.mcap"
    log.write_bytes(WRITERS[name](compression))
    told = info(log)
    assert (told.messages, told.recovered, told.problems) == (COUNT, False, ())
    found = list(read(log))
    assert len(found) == COUNT
    assert {each.encoding for each in found} == {"px4" if name == "px4" else "cdr"}
    lines: list[str] = []
    assert cat([log], Select(), write=lines.append) == []
    assert len(lines) == COUNT
    half = copy([log], tmp_path / "half.mcap", Select(until_ns=found[COUNT // 2].at_ns))
    assert half.messages == COUNT // 2
    assert list(read(tmp_path / "half.mcap")) == found[: COUNT // 2]
    assert list(in_order([log, tmp_path / "half.mcap"], Select(), [])).count(found[0]) == 2


def test_topics_of_others_become_keys() -> None:
    """A topic that is no key of Zenoh's is played on the nearest one that is; keys of a fleet on another fleet's."""
    assert remapped("/robot_1/odom", (), "replay") == "robot_1/odom"
    assert remapped("//a?b*/c", (), "replay") == "a_b_/c"
    assert remapped("/", (), "replay") == "_"
    assert remapped("swiftbot/demo/gw/g1/status", (), "replay") == "swiftbot/replay/gw/g1/status"
    rules = (("swiftbot/demo/robot/r1", "swiftbot/x/robot/r2"),)
    assert remapped("swiftbot/demo/robot/r1/state", rules, "replay") == "swiftbot/x/robot/r2/state"
    assert remapped("swiftbot/demo/robot/r11/state", rules, "replay") == "swiftbot/replay/robot/r11/state"


@pytest.mark.thorough
@pytest.mark.parametrize("name", WRITERS)
def test_damage_at_every_offset(tmp_path: Path, name: str) -> None:
    """Each byte of a file changed, one at a time: no crash, no message that was not written, no growing memory."""
    whole = WRITERS[name](CompressionType.ZSTD)
    log = tmp_path / "damaged.mcap"
    log.write_bytes(whole)
    topics = {each.key for each in read(log)}
    tracemalloc.start()
    try:
        for where in range(len(whole)):
            log.write_bytes(whole[:where] + bytes((whole[where] ^ 0xFF,)) + whole[where + 1 :])
            problems: list[str] = []
            if where < 8:  # not even the beginning is there
                with pytest.raises(RecordError, match="not an MCAP file"):
                    list(read(log))
                continue
            found = list(read(log, problems=problems))
            told = info(log, verify=True)
            assert told.messages == len(found) <= COUNT, where
            if name != "px4":  # without checksums a changed byte of a message is what was written, for all one can tell
                assert {each.key for each in found} <= topics
                assert len(found) == COUNT or problems or told.recovered or told.problems, where
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 32 * 2**20
