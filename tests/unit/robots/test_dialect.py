"""Frames out of bytes: whatever comes, counted and never raised."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v10 import ardupilotmega as v1_dialect
from pymavlink.dialects.v20 import ardupilotmega

from appliance.robots.mavlink.dialect import KINDS, Codec, Damage, Frame, Stream, constant, label, make
from appliance.robots.mavlink.signing import Signer

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


def test_a_message_that_pymavlink_leaves_out() -> None:
    """COMMAND_CANCEL's CRC extra is that of its definition in common.xml; it is read in both versions, and made."""
    crc = ardupilotmega.x25crc()
    crc.accumulate(b"COMMAND_CANCEL ")
    for field in (b"uint16_t command ", b"uint8_t target_system ", b"uint8_t target_component "):
        crc.accumulate(field)
    assert KINDS[80].extra == bytes(((crc.crc & 0xFF) ^ (crc.crc >> 8),))
    for v1 in (False, True):
        raw = Codec(255, 190, v1=v1).pack(make("COMMAND_CANCEL", command=31010, target_system=1, target_component=191))
        (frame,) = read(raw)
        assert isinstance(frame, Frame)
        assert raw[0] == (0xFE if v1 else 0xFD)
        assert (frame.name, frame.target_system, frame.target_component) == ("COMMAND_CANCEL", 1, 191)
        assert (frame.message.command, frame.message.target_system) == (31010, 1)


def test_every_message_of_mavlink_1_is_as_pymavlink_makes_it() -> None:
    """Put into its form, payloads have their full length and no extension fields; a v1 station reads what was said."""
    station, theirs = v1_dialect.MAVLink(None), Codec(7, 1)
    ours = Codec(9, 1, v1=True)
    count = 0
    for number, kind in v1_dialect.mavlink_map.items():
        if number not in ardupilotmega.mavlink_map:
            continue
        fields = {name: _value(kind, name) for name in kind.fieldnames}
        (frame,) = theirs.read(theirs.pack(make(kind.msgname, **fields)))
        assert isinstance(frame, Frame)
        raw = ours.pass_on(frame)
        heard = station.decode(bytearray(raw))
        assert (heard.get_srcSystem(), heard.get_type()) == (7, kind.msgname)
        told = heard.to_dict()
        said = kind(**fields)
        assert raw[6:-2] == bytes(said.pack(v1_dialect.MAVLink(None)))[6:-2], kind.msgname
        assert told.keys() >= fields.keys()
        count += 1
    assert count > 150


def _value(kind: Any, name: str) -> Any:
    """Return something that a field of that type holds."""
    place = kind.ordered_fieldnames.index(name)
    letter, length = kind.fieldtypes[kind.fieldnames.index(name)], kind.array_lengths[place]
    if letter == "char":
        return b"x" * max(1, length - 1)
    single = 1.5 if letter in ("float", "double") else place % 100 + 1
    return [single] * length if length else single


def test_what_mavlink_1_has_no_message_for() -> None:
    """It is neither made nor passed on; signatures and frames of MAVLink 1 themselves are no hindrance."""
    codec = Codec(9, 1, v1=True)
    payload = {"payload_type": 5, "payload_length": 1, "payload": [0] * 128}
    tunnel = make("TUNNEL", target_system=1, target_component=1, **payload)
    assert codec.pack(tunnel) == b""
    (frame,) = read(Codec(7, 1).pack(tunnel))
    assert isinstance(frame, Frame)
    assert codec.pass_on(frame) == b""
    beat = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}
    sequences = [codec.pack(make("HEARTBEAT", **beat))[2] for _ in range(3)]
    assert sequences == [0, 1, 2], "what was not sent leaves no hole"
    old = Codec(7, 1, v1=True).pack(make("HEARTBEAT", **beat))
    (frame,) = read(old)
    assert isinstance(frame, Frame)
    assert codec.pass_on(frame) == old
    signed = Codec(7, 1, signer=Signer(bytes(32), link_id=1)).pack(make("HEARTBEAT", **beat))
    (frame,) = Codec(8, 1, signer=Signer(bytes(32), link_id=2)).read(signed)
    assert isinstance(frame, Frame)
    (plain,) = read(codec.pass_on(frame))
    assert isinstance(plain, Frame)
    assert (plain.name, plain.system, plain.message.custom_mode) == ("HEARTBEAT", 7, 4)


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
    """Enum values are shown by name, unknown ones by number."""
    assert label("MAV_RESULT", constant("MAV_RESULT_DENIED")) == "MAV_RESULT_DENIED"
    assert label("MAV_RESULT", 77) == "77"
    assert label("NO_SUCH", 1) == "1"


_BEAT = heartbeat()


@given(st.lists(st.one_of(st.just(_BEAT), st.binary(max_size=30)), max_size=6), st.integers(1, 50))
def test_a_stream_in_pieces_loses_nothing(parts: list[bytes], size: int) -> None:
    """However a stream is cut and whatever is in between, its frames are found and at most three frames wait."""
    whole = b"".join(parts) + _BEAT * 15  # longer than any frame that noise may seem to begin
    stream = Stream(Codec(245, 191))
    found: list[Frame | Damage] = []
    for start in range(0, len(whole), size):
        found += stream.feed(whole[start : start + size])
        assert stream.pending <= 3 * 280
    frames = [each.raw for each in found if isinstance(each, Frame)]
    assert frames.count(_BEAT) >= parts.count(_BEAT) + 1
    length = sum(len(each.raw) if isinstance(each, Frame) else each.length for each in found)
    assert length + stream.pending == len(whole)
