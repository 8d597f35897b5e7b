"""Holes in the numbers that speakers give to their messages."""

from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import LogLine, RunEvent, RunEventKind, encode, keyspace
from appliance.model.keys import Keys
from appliance.record.models import LoggedMessage
from appliance.record.reader import info
from appliance.record.recorder import MOST_SOURCES, Pipeline, Sequences
from appliance.record.segments import LogWriter
from appliance.record.settings import RecordConfig

KEYS = Keys("f1")


def _line(number: int) -> bytes:
    return encode(LogLine(at_ns=1, level="info", source="g", event='"number": 99', number=number))


@given(st.sets(st.integers(1, 60), min_size=1))
def test_every_missing_number_is_counted(heard: set[int]) -> None:
    """Whichever of a speaker's numbers arrive, those missing in between are counted."""
    sequences = Sequences(KEYS)
    for number in sorted(heard):
        sequences.heard("log", KEYS(keyspace.LOG, "g1"), b'{"number":%d}' % number)
    assert sequences.missing.get("log", 0) == max(heard) - min(heard) + 1 - len(heard)


def test_speakers_are_told_apart() -> None:
    """Another gateway, another attempt, a new coordinator, a process that counts from one: none of them is a hole."""
    sequences = Sequences(KEYS)
    for key, payload in (
        (KEYS(keyspace.LOG, "g1"), b'{"number":7}'),
        (KEYS(keyspace.LOG, "g2"), b'{"number":3}'),
        (KEYS(keyspace.LOG, "g1"), b'{"number":1}'),
    ):
        assert sequences.heard("log", key, payload) is None
    for attempt, number in ((1, 1), (1, 2), (2, 1), (2, 2)):
        payload = b'{"attempt":%d,"number":%d}' % (attempt, number)
        assert sequences.heard("run", KEYS(keyspace.RUN_EVENT, "t", "s"), payload) is None
    for coordinator, number in ((b"g1", 1), (b"g1", 2), (b"g2", 9), (b"g2", 10)):
        payload = b'{"sequence":%d,"coordinator":"%s"}' % (number, coordinator)
        assert sequences.heard("transition", KEYS(keyspace.TRANSITION, "t"), payload) is None
    assert sequences.missing == {}


def test_only_a_speakers_own_number_counts() -> None:
    """Numbers in what a line or a run tells about are not its own, in front of it or in its place."""
    sequences = Sequences(KEYS)
    for number in range(1, 6):
        line = LogLine(
            at_ns=1, level="info", source="g", event="x", fields={"number": 100 * number, "sequence": 1}, number=number
        )
        assert sequences.heard("log", KEYS(keyspace.LOG, "g1"), encode(line)) is None
        result = {"number": 7 * number, "attempt": number}
        event = RunEvent(task="t", subtask="s", attempt=1, kind=RunEventKind.PARTIAL, result=result, number=number)
        assert sequences.heard("run", KEYS(keyspace.RUN_EVENT, "t", "s"), encode(event)) is None
    unnumbered = LogLine(at_ns=1, level="info", source="g", event="x", fields={"number": 50})
    assert sequences.heard("log", KEYS(keyspace.LOG, "g1"), encode(unnumbered)) is None
    for payload in (
        b"",
        b"{",
        b"[1]",
        b'{"number":"x"}',
        b'{"number":1e30}',
        b'{"number":-3}',
        b'{"number":' + b"9" * 30,
    ):
        assert sequences.heard("log", KEYS(keyspace.LOG, "g1"), payload) is None
    hole = sequences.heard("log", KEYS(keyspace.LOG, "g1"), b'{ "fields": {"number": 6}, "number" : 9 }')
    assert hole is not None
    assert hole.missing == 3


def test_frames_that_are_sent_have_no_holes() -> None:
    """Of what a link sends each other end gets a part: what went to another one is not missing."""
    sequences = Sequences(KEYS)
    for key in (KEYS(keyspace.MAVLINK, "r1", "tx"), KEYS(keyspace.LINK_FRAMES, "g1", "0", "tx")):
        assert sequences.kind_of(key) == ""
    for key in (KEYS(keyspace.MAVLINK, "r1", "rx"), KEYS(keyspace.LINK_FRAMES, "g1", "0", "rx")):
        assert sequences.kind_of(key) == "mavlink"


@pytest.mark.parametrize("header", [b"\xfd\x09\x00\x00", b"\xfe\x09"], ids=["MAVLink 2", "MAVLink 1"])
def test_frames_count_in_a_byte(header: bytes) -> None:
    """The number after 255 is 0; a frame that was overtaken is no hole; components count for themselves."""
    sequences = Sequences(KEYS)
    key = KEYS(keyspace.MAVLINK, "r1", "rx")

    def frame(number: int, component: int = 1) -> bytes:
        return header + bytes((number, 1, component)) + bytes(12)

    for number in (254, 255, 0, 1):
        assert sequences.heard("mavlink", key, frame(number)) is None
    assert sequences.heard("mavlink", key, frame(40, component=2)) is None
    hole = sequences.heard("mavlink", key, frame(5))
    assert hole is not None
    assert hole.missing == 3
    assert sequences.heard("mavlink", key, frame(4)) is None
    assert sequences.heard("mavlink", key, b"\xfd") is None


def _heard(numbers: Iterable[int]) -> int:
    """Return how many frames are missing where these numbers come."""
    sequences = Sequences(KEYS)
    for number in numbers:
        sequences.heard("mavlink", KEYS(keyspace.MAVLINK, "r1", "rx"), bytes((0xFE, 9, number % 256, 1, 1)) + bytes(12))
    return sequences.missing.get("mavlink", 0)


def test_frames_out_of_order_are_counted_once() -> None:
    """What was missing when a later frame came counts; that it comes after all, or again, makes no further hole."""
    assert _heard((5, 7, 6, 8)) == 1
    assert _heard((5, 5, 6, 6, 5, 7)) == 0
    assert _heard((10, 7, 8, 11)) == 0
    assert _heard((250, 2, 255, 0, 3)) == 7


@given(st.integers(0, 255), st.lists(st.integers(0, 20), max_size=30))
def test_repetitions_are_no_holes(first: int, again: list[int]) -> None:
    """However many of the last frames are repeated, and when: nothing is missing of those that all came."""
    numbers: list[int] = []
    for number in range(60):
        numbers.append(first + number)
        if number < len(again):
            numbers.append(first + number - min(number, again[number]))
    assert _heard(numbers) == 0


def test_a_component_that_begins_again_is_followed() -> None:
    """After a restart its numbers count from three frames on, and what is missing from then on is seen."""
    assert _heard((200, 201, 202, 3, 4, 5, 6, 7)) == 56, "it may have lost so many: the same byte, an hour later"
    assert _heard((100, 101, 3, 4, 5, 6, 9)) == 2


def test_speakers_are_forgotten_beyond_a_bound() -> None:
    """A flood of names does not fill the memory."""
    sequences = Sequences(KEYS)
    for number in range(MOST_SOURCES + 50):
        sequences.heard("log", f"swiftbot/f1/gw/g{number}/log", b'{"number":1}')
    assert len(sequences._last) == MOST_SOURCES


def test_holes_are_in_the_log_apart_from_what_was_dropped(tmp_path: Path) -> None:
    """A log says how many messages never came, and from whom; that is not the recorder's loss."""
    config = RecordConfig(directory=str(tmp_path), free_bytes=0, fsync=False)
    writer = LogWriter(config, fleet="f1")
    writer.prepare()
    pipeline = Pipeline(config, fleet="f1", writer=writer)
    for number in (1, 2, 6):
        pipeline.write(LoggedMessage(KEYS(keyspace.LOG, "g1"), 5, _line(number), "application/json"))
    pipeline.tick()
    writer.close()
    told = info(writer.files[0])
    assert (told.not_heard, told.dropped) == (3, 0)
    assert writer.not_heard == {"log": 3}
