"""Frames out of bytes: whatever comes, counted and never raised."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.robots.mavlink.dialect import Codec, Damage, Frame, Stream, constant, label, make

_CODEC = Codec(7, 1)


def heartbeat() -> bytes:
    """Return a vehicle's heartbeat frame."""
    return _CODEC.pack(
        make("HEARTBEAT", type=2, autopilot=3, base_mode=0, custom_mode=4, system_status=4, mavlink_version=3)
    )


def read(data: bytes) -> list[Frame | Damage]:
    """Read bytes as a gateway does."""
    return list(Codec(245, 191).read(data))


def test_a_frame_is_read_with_its_bytes() -> None:
    """Sender, name, fields and the very bytes come back."""
    raw = heartbeat()
    (frame,) = read(raw)
    assert isinstance(frame, Frame)
    assert (frame.system, frame.component, frame.name, frame.raw) == (7, 1, "HEARTBEAT", raw)
    assert frame.message.custom_mode == 4


@given(st.binary(max_size=600))
def test_no_bytes_raise_and_none_are_left_over(data: bytes) -> None:
    """Any bytes at all are split into frames and damage whose lengths add up."""
    found = read(data)
    assert sum(len(each.raw) if isinstance(each, Frame) else each.length for each in found) == len(data)


@given(noise=st.binary(max_size=40).filter(lambda data: b"\xfd" not in data and b"\xfe" not in data))
def test_frames_between_noise_are_found(noise: bytes) -> None:
    """Noise before, between and behind costs no frame."""
    raw = heartbeat()
    found = read(noise + raw + noise + raw + noise)
    assert sum(isinstance(each, Frame) for each in found) == 2


@given(place=st.integers(1, 20), flip=st.integers(1, 255))
def test_a_damaged_frame_costs_no_other(place: int, flip: int) -> None:
    """One flipped byte of the first frame is damage; the two frames behind it are read."""
    raw = heartbeat()
    damaged = bytearray(raw)
    damaged[place] ^= flip
    found = read(bytes(damaged) + raw + raw)
    assert isinstance(found[0], Damage)
    assert sum(isinstance(each, Frame) for each in found) == 2


def _with(raw: bytes, place: int, value: int) -> bytes:
    changed = bytearray(raw)
    changed[place] = value
    return bytes(changed)


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (_with(heartbeat(), 12, 99), "checksum"),
        (_with(heartbeat(), 8, 0xF0), "unknown_message"),
        (_with(heartbeat(), 2, 0x02), "incompatible"),
        (heartbeat()[:-3], "truncated"),
        (b"GET / HTTP/1.1", "noise"),
    ],
)
def test_kinds_of_damage(data: bytes, kind: str) -> None:
    """Bad checksum, unknown dialect, unknown flags, cut datagrams and other protocols each have their counter."""
    assert [each.kind for each in read(data) if isinstance(each, Damage)] == [kind]


def test_signed_frames_are_refused_and_the_next_is_read() -> None:
    """A signature cannot be checked without a key, so a signed frame counts as such, at its full length."""
    signer = Codec(7, 1)
    signer._mav.signing.secret_key = b"k" * 32
    signer._mav.signing.sign_outgoing = True
    raw = signer.pack(
        make("HEARTBEAT", type=2, autopilot=3, base_mode=0, custom_mode=4, system_status=4, mavlink_version=3)
    )
    first, second = read(raw + heartbeat())
    assert first == Damage("signed", len(raw))
    assert isinstance(second, Frame)


def test_numbers_have_names() -> None:
    """Enum values are told by name, unknown ones by number."""
    assert label("MAV_RESULT", constant("MAV_RESULT_DENIED")) == "MAV_RESULT_DENIED"
    assert label("MAV_RESULT", 77) == "77"
    assert label("NO_SUCH", 1) == "1"


_BEAT = heartbeat()


@given(st.lists(st.one_of(st.just(_BEAT), st.binary(max_size=30)), max_size=6), st.integers(1, 50))
def test_a_stream_in_pieces_loses_nothing(parts: list[bytes], size: int) -> None:
    """However a stream is cut and whatever is in between, its frames are found and at most one frame waits."""
    whole = b"".join(parts) + _BEAT * 15  # longer than any frame that noise may seem to begin
    stream = Stream(Codec(245, 191))
    found: list[Frame | Damage] = []
    for start in range(0, len(whole), size):
        found += stream.feed(whole[start : start + size])
        assert stream.pending <= 280
    frames = [each.raw for each in found if isinstance(each, Frame)]
    assert frames.count(_BEAT) >= parts.count(_BEAT) + 1
    length = sum(len(each.raw) if isinstance(each, Frame) else each.length for each in found)
    assert length + stream.pending == len(whole)
