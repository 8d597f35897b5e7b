"""Messages into files: rotation, gaps, full disks."""

import errno
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from appliance.errors import ConfigError, RecordError
from appliance.model import LogLine, encode, keyspace
from appliance.model.keys import Keys
from appliance.model.recorder_api import Gap, Incident
from appliance.record.mcap_writer import LogFile
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from appliance.record.segments import MOST_MARKS, LogWriter, file_prefix
from appliance.record.settings import RecordConfig

KEYS = Keys("f1")
JSON = "application/json"


class Clock:
    """A clock that stands until it is moved."""

    now = 100.0

    def __call__(self) -> float:
        """Return the time it stands at."""
        return self.now


class Disk:
    """A disk with so many bytes left: files on it fail as real ones do, in the middle of a write."""

    def __init__(self, left: int) -> None:
        self.left = left

    def open(self, path: Path) -> "DiskFile":
        """Open a file on it."""
        return DiskFile(path, self)

    def free(self, _folder: Path) -> int:
        """Return what is left."""
        return self.left


class DiskFile(LogFile):
    """A file on a `Disk`."""

    def __init__(self, path: Path, disk: Disk) -> None:
        self._disk = disk
        super().__init__(path)

    def write(self, data: bytes) -> int:
        """Write as much as there is room for."""
        if len(data) > self._disk.left:
            super().write(data[: self._disk.left])
            self._disk.left = 0
            raise OSError(errno.ENOSPC, "No space left on device")
        self._disk.left -= len(data)
        return super().write(data)


def _message(number: int, size: int = 20) -> LoggedMessage:
    return LoggedMessage(KEYS(keyspace.TRANSITION, "t1"), 1000 + number, encode({"n": number, "x": "y" * size}), JSON)


def _writer(folder: Path, clock: Clock | None = None, **changes: Any) -> LogWriter:
    plain = {"directory": str(folder), "free_bytes": 0, "fsync": False, "total_bytes": 0}
    config = RecordConfig(**(plain | changes))
    writer = LogWriter(config, fleet="f1", clock=clock or Clock())
    writer.prepare()
    return writer


def _numbers(files: list[Path]) -> list[int]:
    return [
        msgspec.json.decode(message.payload)["n"]
        for path in files
        for message in read(path, keys=KEYS(keyspace.TRANSITION))
    ]


def _gaps(files: list[Path]) -> list[Gap]:
    return [
        msgspec.json.decode(message.payload, type=Gap)
        for path in files
        for message in read(path, keys=KEYS(keyspace.RECORDER_GAP, "*"))
    ]


def _marks(files: list[Path]) -> list[str]:
    return [incident.reason for path in files for incident in info(path).incidents]


def test_finished_file_is_valid_mcap(tmp_path: Path) -> None:
    """The mcap library's own indexed reader opens a finished file and finds schemas, statistics, times and metadata."""
    writer = _writer(tmp_path)
    line = LogLine(at_ns=5, level="info", source="gateway", event="started")
    writer.write(LoggedMessage(KEYS(keyspace.LOG, "g1"), 5, encode(line), JSON))
    writer.write(LoggedMessage(KEYS(keyspace.MAVLINK, "r1", "rx"), 6, b"\xfd\x09", "application/octet-stream"))
    writer.write(LoggedMessage(KEYS(keyspace.CONTAINER, "g1", "c1"), 7, b"", "", deleted=True))
    writer.close()
    with writer.files[0].open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 4  # with the copy for Foxglove's log panel
        assert {schema.name for schema in summary.schemas.values()} >= {"swiftbot.LogLine", "foxglove.Log"}
        assert next(reader.iter_metadata()).metadata["fleet"] == "f1"
        found = [(channel.topic, message.log_time) for _, channel, message in reader.iter_messages()]
    assert (KEYS(keyspace.LOG, "g1"), 5) in found
    assert (KEYS(keyspace.MAVLINK, "r1", "rx"), 6) in found


def test_a_file_says_whose_it_is_and_what_its_frames_are(tmp_path: Path) -> None:
    """Foxglove finds its device, named or by fleet and recorder; frames tell their dialect and direction."""
    written = {
        tmp_path / "a": ({}, {"deviceName": "f1-recorder"}),
        tmp_path / "b": (
            {"device_name": "yard-7", "device_id": "dev_0aB1"},
            {"deviceName": "yard-7", "deviceId": "dev_0aB1"},
        ),
    }
    for folder, (changes, device) in written.items():
        writer = _writer(folder, **changes)
        for key in (KEYS(keyspace.MAVLINK, "r1", "rx"), KEYS(keyspace.LINK_FRAMES, "g1", "0", "tx")):
            writer.write(LoggedMessage(key, 6, b"\xfd\x09", "application/mavlink"))
        writer.close()
        with writer.files[0].open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            assert {each.name: each.metadata for each in reader.iter_metadata()}["foxglove"] == device
            summary = reader.get_summary()
            assert summary is not None
            assert {each.compression for each in summary.chunk_indexes} == {"zstd"}
            told = {each.topic: each.metadata for each in summary.channels.values()}
        assert (
            told[KEYS(keyspace.MAVLINK, "r1", "rx")].items() >= {"dialect": "ardupilotmega", "direction": "rx"}.items()
        )
        assert (
            told[KEYS(keyspace.LINK_FRAMES, "g1", "0", "tx")].items()
            >= {"dialect": "ardupilotmega", "direction": "tx"}.items()
        )


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    """Keys, times, payloads, encodings and deletions come back; copies made for Foxglove do not."""
    writer = _writer(tmp_path)
    messages = [
        LoggedMessage(KEYS(keyspace.LOG, "g1"), 5, encode(LogLine(at_ns=5, level="info", source="a", event="b")), JSON),
        LoggedMessage(KEYS(keyspace.MAVLINK, "r1", "tx"), 6, b"\xfd\x09", "zenoh/bytes"),
        LoggedMessage("swiftbot/f1/unheard/of", 7, b"", "text/plain"),
        LoggedMessage(KEYS(keyspace.CONTAINER, "g1", "c1"), 8, b"", "", deleted=True),
    ]
    for message in messages:
        assert writer.write(message)
    writer.close()
    assert list(read(writer.files[0])) == messages
    assert list(read(writer.files[0], keys=KEYS(keyspace.CONTAINER))) == [messages[3]]


def test_rotation_by_size(tmp_path: Path) -> None:
    """A file that has reached its size is finished and the next one begun; no message is lost between."""
    writer = _writer(tmp_path, chunk_bytes=1000, rotate_bytes=4000, compression="none")
    for number in range(300):
        writer.write(_message(number))
        writer.tick()
    writer.close()
    assert len(writer.files) > 3
    assert _numbers(writer.files) == list(range(300))
    assert not any(info(path).recovered for path in writer.files)


def test_it_says_which_files_go_next(tmp_path: Path) -> None:
    """As soon as there are enough to tell by that the budget is nearly spent, before any has gone."""
    clock = Clock()
    writer = _writer(tmp_path, clock, rotate_bytes=2_000, total_bytes=60_000, chunk_bytes=300, compression="none")
    for number in range(400):
        writer.write(_message(number))
        clock.now += 1
        writer.tick()
        if writer.going:
            break
    writer.close()
    assert "are removed within 24 h" in writer.going
    assert not writer.removed


def test_old_files_go_when_the_budget_is_spent(tmp_path: Path) -> None:
    """All files together stay within `total_bytes`; what is left are the newest, unbroken, and it is counted."""
    clock = Clock()
    writer = _writer(tmp_path, clock, rotate_bytes=2_000, total_bytes=8_000, chunk_bytes=300, compression="none")
    for number in range(400):
        writer.write(_message(number))
        clock.now += 1
        writer.tick()
    writer.close()
    left = sorted(tmp_path.glob("*.mcap"))
    assert sum(path.stat().st_size for path in left) <= 8_000 + 2_000  # a file's index comes on top of its messages
    assert writer.removed == len(writer.files) - len(left) > 0
    numbers = _numbers(left)
    assert numbers == list(range(numbers[0], 400))


def test_rotation_by_time_and_by_channels(tmp_path: Path) -> None:
    """A file is also finished when it is old, or when it has many keys."""
    clock = Clock()
    writer = _writer(tmp_path, clock, rotate_s=60.0, max_channels=3)
    writer.write(_message(0))
    clock.now += 61
    writer.tick()
    for number in range(1, 7):
        writer.write(LoggedMessage(KEYS(keyspace.TRANSITION, f"t{number}"), 5, encode({"n": number}), JSON))
        writer.tick()
    writer.close()
    assert _numbers(writer.files) == list(range(7))
    assert [len(info(path).channels) for path in writer.files] == [1, 3, 3]


def test_flushed_when_due(tmp_path: Path) -> None:
    """After half a second a message is in a whole chunk on the disk, synced, while the file is still open."""
    clock = Clock()
    synced: list[Path] = []

    class Synced(LogFile):
        def sync(self) -> None:
            synced.append(self.path)

    config = RecordConfig(directory=str(tmp_path), free_bytes=0)
    writer = LogWriter(config, fleet="f1", clock=clock, open_file=Synced)
    writer.write(_message(0))
    clock.now += 0.4
    writer.tick()
    assert _numbers(writer.files) == []
    clock.now += 0.2
    writer.tick()
    assert _numbers(writer.files) == [0]
    assert info(writer.files[0]).recovered
    assert synced == writer.files
    clock.now += 0.6
    writer.tick()  # nothing new: the disk is left alone
    assert len(synced) == 1
    writer.close()


def test_two_starts_in_a_second_make_two_files(tmp_path: Path) -> None:
    """A file that is there is never written over."""
    first, second = _writer(tmp_path), _writer(tmp_path)
    for number, writer in enumerate((first, second)):
        writer._wall = lambda: 1_000_000_000
        writer.write(_message(number))
        writer.close()
    assert len({*first.files, *second.files}) == 2
    assert _numbers([*first.files, *second.files]) == [0, 1]


names = st.text("ab.-", min_size=1, max_size=5).filter(lambda each: each[0] in "ab")


@given(st.tuples(names, names), st.tuples(names, names))
def test_no_two_recorders_have_the_same_file_names(one: tuple[str, str], other: tuple[str, str]) -> None:
    """Recorders that share a folder call their files differently whatever dashes are in names."""
    assert (file_prefix(*one) == file_prefix(*other)) == (one == other)
    assert file_prefix("a-b", "c") != file_prefix("a", "b-c")


def test_the_budget_of_one_fleet_leaves_the_files_of_another(tmp_path: Path) -> None:
    """Recorder `c` of fleet `a-b` in a folder with recorder `b-c` of fleet `a` removes old files of its own only."""
    clock = Clock()
    plain = {"directory": str(tmp_path), "free_bytes": 0, "fsync": False, "chunk_bytes": 300, "compression": "none"}
    other = LogWriter(RecordConfig(name="b-c", **plain), fleet="a", clock=clock)
    other.write(_message(0))
    other.close()
    config = RecordConfig(name="c", rotate_bytes=2_000, total_bytes=4_000, **plain)
    writer = LogWriter(config, fleet="a-b", clock=clock)
    for number in range(100):
        writer.write(_message(number))
        clock.now += 1
        writer.tick()
    writer.close()
    assert writer.removed
    assert other.files[0].exists()


def test_drops_are_written_down(tmp_path: Path) -> None:
    """What the intake dropped is in the log as one gap with number, bytes and times, and in the file's account."""
    writer = _writer(tmp_path)
    writer.write(_message(0))
    writer.drop("queue full", "k1", 10, 2000, count=3)
    writer.drop("queue full", "k2", 5, 3000)
    writer.tick()
    writer.close()
    assert _gaps(writer.files) == [
        Gap(
            reason="queue full",
            dropped=4,
            payload_bytes=15,
            since_ns=2000,
            until_ns=3000,
            last_key="k2",
            keys={"k1": 3, "k2": 1},
        )
    ]
    told = info(writer.files[0])
    assert (told.dropped, told.missed) == (4, {"k1": 3, "k2": 1})
    assert writer.missed == {"k1": 3, "k2": 1}
    assert writer.dropped == {"queue full": 4}


def test_too_large_message_is_counted(tmp_path: Path) -> None:
    """A payload over the bound is not written, and the log says so."""
    writer = _writer(tmp_path, message_bytes=100)
    assert not writer.write(_message(0, size=200))
    writer.close()
    assert _gaps(writer.files)[0].reason == "too large"


def test_free_disk_floor(tmp_path: Path) -> None:
    """Below the floor the file is finished properly and recording waits; above it a new file tells of the gap."""
    clock, disk = Clock(), Disk(2000)
    config = RecordConfig(directory=str(tmp_path), free_bytes=1000, fsync=False)
    writer = LogWriter(config, fleet="f1", clock=clock, free=disk.free)
    writer.write(_message(0))
    disk.left = 900
    clock.now += 1
    writer.tick()
    assert not writer.recording
    assert "900" not in writer.problem
    assert "less than 1000 bytes free" in writer.problem
    assert not writer.write(_message(1))
    disk.left = 1050  # over the floor, but not by an eighth
    clock.now += 2
    assert not writer.write(_message(2))
    disk.left = 5000
    clock.now += 2
    assert writer.write(_message(3))
    assert writer.problem == ""
    writer.close()
    assert not info(writer.files[0]).recovered
    assert _numbers(writer.files) == [0, 3]
    assert [(gap.reason, gap.dropped) for gap in _gaps(writer.files)] == [("disk full", 2)]


def test_incidents_wait_for_room(tmp_path: Path) -> None:
    """What happens while the disk is full is marked once there is room; until then it is counted as waiting."""
    clock, disk = Clock(), Disk(900)
    config = RecordConfig(directory=str(tmp_path), free_bytes=1000, fsync=False)
    writer = LogWriter(config, fleet="f1", clock=clock, free=disk.free)
    for number in range(2):
        writer.mark(Incident(reason=f"no room {number}", at_ns=1000 + number))
    assert (writer.waiting_marks, writer.files) == (2, [])
    disk.left = 5000
    clock.now += 2
    writer.mark(Incident(reason="room", at_ns=1010))
    assert writer.waiting_marks == 0
    writer.close()
    assert _marks(writer.files) == ["no room 0", "no room 1", "room"]
    assert writer.dropped == {}


def test_incidents_wait_without_messages(tmp_path: Path) -> None:
    """Where only incidents are recorded, and nothing comes any more: what waits is written when there is room."""
    clock, disk = Clock(), Disk(900)
    config = RecordConfig(directory=str(tmp_path), free_bytes=1000, fsync=False, mode="incidents")
    writer = LogWriter(config, fleet="f1", clock=clock, free=disk.free)
    writer.mark(Incident(reason="no room", at_ns=1000))
    disk.left = 5000
    clock.now += 2
    writer.tick()
    writer.close()
    assert _marks(writer.files) == ["no room"]


def test_incidents_beyond_the_bound_are_counted(tmp_path: Path) -> None:
    """Of a flood of incidents on a full disk the first are kept; the log tells how many more there were."""
    clock, disk = Clock(), Disk(900)
    config = RecordConfig(directory=str(tmp_path), free_bytes=1000, fsync=False)
    writer = LogWriter(config, fleet="f1", clock=clock, free=disk.free)
    for number in range(MOST_MARKS + 5):
        writer.mark(Incident(reason=str(number), at_ns=1000 + number))
    disk.left = 1 << 30
    clock.now += 60
    writer.tick()
    writer.close()
    assert _marks(writer.files) == [str(number) for number in range(MOST_MARKS)]
    assert [(gap.reason, gap.dropped) for gap in _gaps(writer.files)] == [("disk full", 5)]


@settings(max_examples=60, deadline=None)
@given(left=st.integers(0, 6000), more=st.integers(0, 6000))
def test_full_disk_at_every_byte(tmp_path_factory: pytest.TempPathFactory, left: int, more: int) -> None:
    """Wherever the disk runs full: every message is in a readable file or in a gap, none in both; all incidents are."""
    clock, disk = Clock(), Disk(left)
    config = RecordConfig(
        directory=str(tmp_path_factory.mktemp("log")), free_bytes=0, fsync=False, chunk_bytes=500, compression="none"
    )
    writer = LogWriter(config, fleet="f1", clock=clock, open_file=disk.open, free=lambda _: 1 << 40)
    for number in range(120):
        writer.write(_message(number))
        if number % 10 == 0:
            writer.mark(Incident(reason=str(number), at_ns=1000 + number))
        clock.now += 0.2
        writer.tick()
        if number == 60:
            disk.left += more
    disk.left = 1 << 30
    clock.now += 60
    writer.write(_message(120))
    writer.close()
    numbers = _numbers(writer.files)
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 120
    assert len(numbers) + sum(gap.dropped for gap in _gaps(writer.files)) == 121
    assert writer.messages == len(numbers)
    assert _marks(writer.files) == [str(number) for number in range(0, 120, 10)]
    for path in writer.files:
        with path.open("rb") as stream:
            assert sum(1 for _ in make_reader(stream).iter_messages()) == info(path).messages


def test_folder_that_cannot_be_written(tmp_path: Path) -> None:
    """A folder that cannot be made is an error with the remedy, before anything is recorded."""
    (tmp_path / "file").write_text("")
    writer = LogWriter(RecordConfig(directory=str(tmp_path / "file" / "log")), fleet="f1")
    with pytest.raises(RecordError, match=r"set record\.directory"):
        writer.prepare()


@pytest.mark.parametrize(
    "changes", [{"compression": "rar"}, {"chunk_bytes": 0}, {"flush_s": 0.0}, {"max_channels": 70_000}, {"name": "a/*"}]
)
def test_settings_that_cannot_work(changes: dict[str, Any]) -> None:
    """Each wrong setting is named."""
    with pytest.raises(ConfigError, match=f"record.{next(iter(changes))}"):
        RecordConfig(**changes).check()


def test_hostile_times_are_replaced(tmp_path: Path) -> None:
    """A time that MCAP has no room for becomes the time of arrival."""
    writer = _writer(tmp_path)
    writer._wall = lambda: 77
    for at_ns in (-5, 0, 2**70):
        assert writer.write(LoggedMessage(KEYS(keyspace.TRANSITION, "t1"), at_ns, b"{}", JSON))
    writer.close()
    assert [message.at_ns for message in read(writer.files[0])] == [77, 77, 77]
