"""A stream with damaged and foreign frames: what a false header announces is not waited for, however it is cut."""

import itertools
from collections import Counter
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from appliance.robots.mavlink.dialect import Codec, Damage, Frame, Stream, make

BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}
HELD_LONG = bytes.fromhex("fd06000000050161ea0001020304fdff2ab4")
"""A whole frame of a foreign dialect whose body seems to begin one of 267 bytes."""
HELD_LAST = bytes.fromhex("fd03000000010161ea0001020387fd")
"""One whose last byte is a marker."""


def beats(count: int, system: int = 7) -> list[bytes]:
    """Return heartbeats of a vehicle, one behind the other."""
    codec = Codec(system, 1)
    return [codec.pack(make("HEARTBEAT", **BEAT)) for _ in range(count)]


def tunnel(payload: bytes) -> bytes:
    """Return a TUNNEL frame that carries any bytes."""
    fields = {"target_system": 1, "target_component": 1, "payload_type": 0, "payload_length": len(payload)}
    return Codec(3, 1).pack(make("TUNNEL", payload=list(payload.ljust(128, b"\0")), **fields))


def read(*pieces: bytes, end: bool = False) -> tuple[list[bytes], Counter[str]]:
    """Return the frames and the counters of a stream that came in these pieces."""
    stream = Stream(Codec(245, 191))
    found: list[Frame | Damage] = []
    for piece in pieces:
        found += stream.feed(piece)
        assert stream.pending <= 3 * 280
    if end:
        found += stream.end()
        assert stream.pending == 0
    length = sum(each.length if isinstance(each, Damage) else len(each.raw) for each in found)
    assert length + stream.pending == sum(map(len, pieces))
    counted = Counter(each.kind for each in found if isinstance(each, Damage) and each.counted)
    return [each.raw for each in found if isinstance(each, Frame)], counted


@pytest.mark.parametrize("foreign", [HELD_LONG, HELD_LAST], ids=["within", "last byte"])
def test_frames_behind_a_foreign_one_are_read_when_they_come(foreign: bytes) -> None:
    """Each heartbeat is found with its last byte, and the foreign frame is counted, once, with its own."""
    stream = Stream(Codec(245, 191))
    assert [each.kind for each in stream.feed(foreign) if isinstance(each, Damage)] == ["unknown_message"]
    for beat in beats(20):
        assert not [each for each in stream.feed(beat[:-1]) if isinstance(each, Frame)]
        frames_now = list(stream.feed(beat[-1:]))
        assert [each.raw for each in frames_now if isinstance(each, Frame)] == [beat]
        assert not [each for each in frames_now if isinstance(each, Damage) and each.counted]


@pytest.mark.parametrize("place", range(21))
@pytest.mark.parametrize("value", [0, 1, 0x20, 0xFD, 0xFE, 0xFF])
@pytest.mark.parametrize("size", [1, 21, 1000])
def test_one_damaged_byte_holds_no_heartbeat_back(place: int, value: int, size: int) -> None:
    """Whichever byte of a heartbeat became whatever, length and marker too: those behind are read as they come."""
    first, *others = beats(20)
    damaged = bytearray(first)
    damaged[place] = value
    if bytes(damaged) == first:
        return
    whole = bytes(damaged) + b"".join(others)
    frames, counted = read(*(whole[at : at + size] for at in range(0, len(whole), size)))
    assert frames == others
    assert counted.total() == 1, counted
    stream = Stream(Codec(245, 191))
    list(stream.feed(bytes(damaged)))
    frames_now = [len([each for each in stream.feed(other) if isinstance(each, Frame)]) for other in others]
    assert frames_now[:2] in ([1, 1], [0, 2]), "one that the damaged bytes cover comes with the next"
    assert set(frames_now[2:]) == {1}


def test_two_damaged_frames_in_a_row_hold_nothing_back() -> None:
    """The second does not prove the first one's end, and a false header in either is not waited for."""
    others = beats(3)
    for second in (HELD_LAST, HELD_LONG, beats(1)[0][:-1] + b"\xfd"):
        frames, counted = read(HELD_LONG, second, *others)
        assert frames == others
        assert counted.total() == 2


def test_a_header_in_noise_is_not_waited_for() -> None:
    """The bytes behind a lost beginning are a frame's rest; the marker in them begins nothing."""
    others = beats(3)
    frames, counted = read(HELD_LONG[1:], *others)
    assert (frames, counted) == (others, Counter(noise=1))
    frames, counted = read(b"\x00" * 1000, *others)
    assert (frames, counted) == (others, Counter(noise=4))


def test_what_a_frame_carries_is_no_frame_of_the_link() -> None:
    """A command in a payload is not read: not of a good frame, nor of a foreign one that a good one follows."""
    command = Codec(255, 190).pack(
        make("COMMAND_LONG", target_system=1, target_component=1, command=400, confirmation=0,
             **{f"param{number}": 1.0 for number in range(1, 8)})
    )  # fmt: skip
    outer, beat = tunnel(command), beats(1)[0]
    for size in (1, 7, 1000):
        whole = outer + HELD_LONG + outer + beat
        frames, _ = read(*(whole[at : at + size] for at in range(0, len(whole), size)))
        assert frames == [outer, outer, beat]
        foreign = bytearray(tunnel(command))
        foreign[9] = 0xE0  # a message that nobody knows
        whole = bytes(foreign) + bytes(foreign) + beat
        frames, counted = read(*(whole[at : at + size] for at in range(0, len(whole), size)))
        assert (frames, counted) == ([beat], Counter(unknown_message=2))


def test_frames_swallowed_by_a_false_length_come_back() -> None:
    """A length that may be one and covers good frames is found out by where they end, also just where it ends."""
    outer = bytearray(tunnel(b"x" * 100))
    first, second = beats(2)
    cut = bytes(outer[: len(outer) - 2 * 21])
    for size in (1, 21, 1000):
        for tail in (b"", b"x", b"xx"):
            whole = cut[: len(cut) - len(tail)] + first + second + tail + b"".join(beats(1, 9))
            frames, _ = read(*(whole[at : at + size] for at in range(0, len(whole), size)))
            assert frames[-1:] == beats(1, 9)
            if not tail:
                assert frames == [first, second, *beats(1, 9)]


_FRAMES = [
    *beats(3),
    Codec(255, 190, v1=True).pack(make("HEARTBEAT", **BEAT)),
    tunnel(b"\xfd\xfe" * 60),
    Codec(1, 1).pack(make("STATUSTEXT", severity=4, text=b"\xfd\xff\x00 and \xfe", id=0, chunk_seq=0)),
    Codec(2, 1).pack(make("PARAM_VALUE", param_id=b"X", param_value=1.0, param_type=9, param_count=1, param_index=0)),
]
_CARRIERS = [*_FRAMES, tunnel(beats(1)[0]), tunnel(HELD_LONG + beats(1)[0])]
"""Where pymavlink has lost step it takes what a frame carries for frames of the link."""


@st.composite
def streams(draw: st.DrawFn, frames: list[bytes]) -> bytes:
    """Draw a stream of frames: good, damaged, cut, foreign, and noise."""
    found = bytearray()
    for _ in range(draw(st.integers(1, 8))):
        raw = bytearray(draw(st.sampled_from(frames)))
        match draw(st.sampled_from(["good", "good", "flip", "cut", "foreign", "noise"])):
            case "flip":
                for _ in range(draw(st.integers(1, 3))):
                    raw[draw(st.integers(0, len(raw) - 1))] = draw(st.sampled_from([0, 1, 0xFD, 0xFE, 0xFF, 0x30]))
            case "cut":
                del raw[draw(st.integers(0, len(raw) - 1)) :]
            case "foreign":
                raw = bytearray(draw(st.sampled_from([HELD_LONG, HELD_LAST])))
            case "noise":
                raw = bytearray(draw(st.binary(max_size=12) | st.just(b"\xfd\xff\x01") | st.just(b"\xfe\x10")))
            case _:
                pass
        found += raw
    return bytes(found)


@given(streams(_CARRIERS), st.lists(st.integers(0, 1200), max_size=12))
@example(HELD_LONG + b"".join(beats(2)), list(range(60)))
@example(HELD_LAST + b"".join(beats(2)), list(range(60)))
def test_any_cut_of_a_stream_tells_the_same(whole: bytes, cuts: list[int]) -> None:
    """The same frames and the same counters, at once: also up to every byte, and at the end."""
    places = [0, *sorted(each for each in cuts if each < len(whole)), len(whole)]
    pieces = [whole[one:two] for one, two in itertools.pairwise(places)]
    singly = [whole[at : at + 1] for at in range(len(whole))]
    for end in (False, True):
        assert read(whole, end=end) == read(*pieces, end=end) == read(*singly, end=end)
    seen: list[bytes] = []
    counted: Counter[str] = Counter()
    for piece in pieces:
        seen.append(piece)
        frames, now = read(b"".join(seen))
        assert (frames, now) == read(*seen)
        assert not counted - now, "what was reported is not taken back"
        counted = now


def _pymavlink(whole: bytes) -> list[bytes]:
    """Return the frames that pymavlink finds in a stream."""
    parser: Any = ardupilotmega.MAVLink(None)
    parser.robust_parsing = True
    found: list[Any] = parser.parse_buffer(bytearray(whole)) or []
    return [bytes(each.get_msgbuf()) for each in found if not each.get_type().startswith(("BAD_DATA", "UNKNOWN"))]


def _within(few: list[bytes], many: list[bytes]) -> bool:
    """Whether the few are among the many, in that order."""
    rest = iter(many)
    return all(any(each == other for other in rest) for each in few)


@given(streams(_FRAMES), st.integers(1, 300))
def test_whatever_pymavlink_finds_is_found(whole: bytes, size: int) -> None:
    """In that order, and nothing that was not sent; what a false header may still cover at the end is let come."""
    whole += b"".join(beats(20, 9))
    frames, _ = read(*(whole[at : at + size] for at in range(0, len(whole), size)))
    assert _within(_pymavlink(whole), frames)
    assert all(each in _FRAMES or each in beats(20, 9) for each in frames)


@given(st.lists(st.tuples(st.sampled_from(_FRAMES), st.integers(3, 200), st.integers(0, 255)), max_size=12))
def test_a_good_frame_is_found_with_its_last_byte(sent: list[tuple[bytes, int, int]]) -> None:
    """Whatever the bodies of those before it have become: lengths are right, so nothing else is waited for."""
    stream = Stream(Codec(245, 191))
    for raw, place, value in sent:
        damaged = bytearray(raw)
        if place < len(raw):
            damaged[place] = value
        if raw[0] == 0xFE and damaged[5] != raw[5]:
            damaged[5] = 0xB4  # of another dialect
        found = [each for at in range(len(raw)) for each in stream.feed(bytes(damaged[at : at + 1]))]
        frames_now = [each.raw for each in found if isinstance(each, Frame)]
        counted = [each for each in found if isinstance(each, Damage) and each.counted]
        assert (frames_now, len(counted)) == (([raw], 0) if bytes(damaged) == raw else ([], 1))
