"""Streams, texts and routes that broke other MAVLink programs, as their users reported; the table is in tests/reports.

The source of each is in the table (`tests/reports/reports.toml`), which names the test.
"""

from collections import Counter
from typing import Any

import pytest

from appliance.robots.mavlink.dialect import KINDS, Codec, Damage, Frame, Stream, checksum, make
from appliance.robots.mavlink.routing import End, RoutingTable, Rules
from appliance.robots.mavlink.signing import Signer
from appliance.robots.mavlink.statustext import NOTICE, Texts, statustext
from tests.unit.robots.links import BEAT, KEY

V1, V2 = 0xFE, 0xFD


def beat(system: int = 7, *, v1: bool = False) -> bytes:
    """Return a heartbeat."""
    return Codec(system, 1, v1=v1).pack(make("HEARTBEAT", **BEAT))


def broken(last: int, *, v1: bool = False) -> bytes:
    """Return a heartbeat whose checksum is wrong and ends in a given byte."""
    raw = bytearray(beat(9, v1=v1))
    right = raw[-1]
    raw[-1] = last
    if last == right:
        raw[-2] ^= 1
    return bytes(raw)


def foreign(last: int = 0, payload: bytes = b"\1\2\3", system: int = 99) -> bytes:
    """Return a whole frame of a message that is in no dialect here; its checksum may be any."""
    return bytes((V2, len(payload), 0, 0, 0, system, system, 0x61, 0xEA, 0)) + payload + bytes((0x87, last))


def attitude(sequence: int) -> bytes:
    """Return an ATTITUDE of 1/1."""
    codec: Any = Codec(1, 1)
    codec._mav.seq = sequence
    fields = dict.fromkeys(("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"), 0.125)
    return bytes(codec.pack(make("ATTITUDE", time_boot_ms=1_083_365, **fields)))


STREAMS: dict[str, tuple[list[bytes], list[bytes], dict[str, int]]] = {
    # source: (pieces that come, frames that are right, counters that are right)
    "ArduPilot/pymavlink#881": ([broken(V2), beat(), beat()], [beat()] * 2, {"checksum": 1}),
    "ArduPilot/pymavlink#387": (
        [broken(V1, v1=True), beat(v1=True), beat(v1=True)], [beat(v1=True)] * 2, {"checksum": 1},
    ),
    "ArduPilot/pymavlink#897": ([foreign(last=V2), beat(), beat()], [beat()] * 2, {"unknown_message": 1}),
    "ArduPilot/pymavlink#1019": ([attitude(V2)[2:], beat(), beat()], [beat()] * 2, {"noise": 1}),
    "ArduPilot/pymavlink#1094": (
        [beat(), b"NMEA $GPGGA,,,,,,0*66\r\n" * 4, beat(), b"\0" * 50, beat()], [beat()] * 3, {"noise": 2},
    ),
    "mavlink/rust-mavlink#225": (
        [b"\x10" * 5 + attitude(1)[:10] + b"\x20" * 4, beat(), beat(), beat()], [beat()] * 3, {"noise": 1},
    ),
    "mavlink-router/mavlink-router#232": ([bytes((V2,)) * 265, beat(), beat(), beat()], [beat()] * 3,
                                          {"incompatible": 1}),
    "mavlink-router/mavlink-router#3": (
        [beat()[:1] + b"\xc0" + beat()[2:], *[beat()] * 20], [beat()] * 20, {"truncated": 1},
    ),
    "mavlink-router/mavlink-router#33": ([foreign(system=254), beat()], [beat()], {"unknown_message": 1}),
    "mavlink/mavlink#1166": (
        [foreign(payload=bytes((V2, 9, 0, 0)) * 20), beat()], [beat()], {"unknown_message": 1},
    ),
}  # fmt: skip


def _read(pieces: list[bytes], size: int) -> tuple[list[bytes], dict[str, int]]:
    whole = b"".join(pieces)
    stream = Stream(Codec(245, 191))
    found = [each for at in range(0, len(whole), size) for each in stream.feed(whole[at : at + size])]
    found += stream.end()
    counted = Counter(each.kind for each in found if isinstance(each, Damage) and each.counted)
    return [each.raw for each in found if isinstance(each, Frame)], dict(counted)


@pytest.mark.parametrize("size", [1, 7, 1000])
@pytest.mark.parametrize("source", STREAMS)
def test_a_reported_stream(source: str, size: int) -> None:
    """However it is cut: every whole frame is found, nothing else is, and each damage is counted once."""
    pieces, frames, counted = STREAMS[source]
    assert _read(pieces, size) == (frames, counted)


def test_messages_of_the_autopilots_own_dialect_are_understood() -> None:
    """ArduPilot's own messages do not count as damage (ArduPilot/ardupilot#12762)."""
    codec = Codec(1, 1)
    for number in (152, 163, 165, 168, 178, 182, 193):
        head = bytes((1, 0, 1, 1, number))
        raw = b"\xfe" + head + b"\7" + checksum(head + b"\7" + KINDS[number].extra).to_bytes(2, "little")
        (frame,) = codec.read(raw)
        assert isinstance(frame, Frame)
        assert frame.message.get_type() == KINDS[number].name


def test_a_target_that_was_trimmed_off_is_everybody() -> None:
    """Zeros at a payload's end are not sent; what lies behind it is no target (mavlink-router/mavlink-router#72)."""
    raw = Codec(255, 190).pack(make("PARAM_REQUEST_LIST", target_system=0, target_component=0))
    assert raw[1] == 1
    (frame,) = Codec(242, 191).read(raw)
    assert isinstance(frame, Frame)
    assert (frame.target_system, frame.target_component) == (0, 0)
    router = RoutingTable([Rules()] * 2, own_system=242)
    ends = [End(number, ("", number)) for number in (0, 1)]
    for end, system in zip(ends, (255, 1), strict=True):
        router.hear(frame if system == 255 else _heard(system), end, 0.0)
    assert router.destinations(frame, ends[0]) == (ends[1],)


def _heard(system: int, component: int = 1) -> Frame:
    (frame,) = Codec(242, 191).read(Codec(system, component).pack(make("HEARTBEAT", **BEAT)))
    assert isinstance(frame, Frame)
    return frame


# --- signatures --------------------------------------------------------------------------------------------------


def _signed(system: int, component: int, *stamps: int, key: bytes = KEY, link: int = 1) -> list[bytes]:
    signer = Signer(key, link_id=link)
    times = iter(stamps)
    codec = Codec(system, component, signer=signer, clock=lambda: next(times))
    return [codec.pack(make("HEARTBEAT", **BEAT)) for _ in stamps]


def _judged(frames: list[bytes], *, now: int = 10_000_000_000) -> list[str]:
    codec = Codec(242, 191, signer=Signer(KEY, link_id=0), clock=lambda: now)
    return [each.kind if isinstance(each, Damage) else "" for raw in frames for each in codec.read(raw)]


NOW = 10_000_000_000


def test_a_time_of_signing_is_compared_with_the_last_and_not_the_first() -> None:
    """A copy of the second frame is refused as one of the first is (ArduPilot/pymavlink#961)."""
    first, second, third = _signed(1, 1, NOW, NOW + 10, NOW + 20)
    assert _judged([first, second, second, third, first, second]) == ["", "", "replayed", "", "replayed", "replayed"]


def test_each_component_has_its_own_time_of_signing() -> None:
    """One component's earlier clock is no replay of another's (ArduPilot/MissionPlanner#3076)."""
    (one,), (other,) = _signed(1, 1, NOW + 600), _signed(1, 191, NOW)
    assert _judged([one, other]) == ["", ""]


def test_a_wrong_signature_moves_no_time() -> None:
    """A forged frame of the far future does not silence the real sender (mavlink/mavlink-devguide#108)."""
    (forged,) = _signed(1, 1, NOW + 10**9, key=b"x" * 32)
    (good,) = _signed(1, 1, NOW)
    assert _judged([forged, good]) == ["bad_signature", ""]


def test_a_signed_frame_that_fails_its_checksum_is_none() -> None:
    """With the checksum wrong and a signature behind it, it is damage (okalachev/mavlink-arduino#4)."""
    (raw,) = _signed(1, 1, NOW)
    damaged = bytearray(raw)
    damaged[-15] ^= 1
    (other,) = _signed(1, 1, NOW, key=b"x" * 32)
    assert _judged([bytes(damaged), other]) == ["checksum", "bad_signature"]


# --- texts -------------------------------------------------------------------------------------------------------


def _told(*parts: tuple[bytes, int, int]) -> list[str]:
    texts = Texts()
    found = [texts.take(4, text, number, part, 0.0) for text, number, part in parts]
    return [each.text for each in (*found, *texts.tick(10.0)) if each is not None]


def test_a_short_text_ends_where_its_bytes_end() -> None:
    """A payload that was trimmed has no terminator, and what lies behind is no text (ArduPilot/pymavlink#1142)."""
    message = make("STATUSTEXT", severity=4, text=b"PreArm: Gyros", id=0, chunk_seq=0)
    frame, _ = Codec(242, 191).read(Codec(1, 1).pack(message) + beat())
    assert isinstance(frame, Frame)
    assert _told((frame.message.text, 0, 0)) == ["PreArm: Gyros"]


def test_a_text_of_fifty_characters_has_no_terminator() -> None:
    """All fifty are sent, and not one byte more (ArduPilot/ardupilot#5862)."""
    assert _told((b"x" * 50, 0, 0)) == ["x" * 50]


def test_a_long_text_is_put_together_from_its_parts() -> None:
    """In whatever order, also when the last part is full (PX4/PX4-Autopilot#14169)."""
    parts = [(b"a" * 50, 3, 0), (b"b" * 50, 3, 1), (b"c" * 50, 3, 2)]
    assert _told(*parts) == ["a" * 50 + "b" * 50 + "c" * 50]
    assert _told(parts[1], (b"end", 3, 2), parts[0]) == ["a" * 50 + "b" * 50 + "end"]


def test_a_text_that_is_longer_than_a_message_is_sent_whole() -> None:
    """What the gateway says is not cut at fifty bytes (ArduPilot/ardupilot#13294)."""
    text = "PreArm: " * 20 + "battery low"
    sent = [(each.text, each.id, each.chunk_seq) for each in statustext(text, NOTICE)]
    assert _told(*sent) == [text]


# --- routes ------------------------------------------------------------------------------------------------------


def test_a_component_gets_what_is_for_it_alone() -> None:
    """Two components of one system at two ends: a target component is heeded (mavlink-router/mavlink-router#207)."""
    router = RoutingTable([Rules()] * 3, own_system=242)
    pilot, gimbal, ground = (End(number, ("", number)) for number in range(3))
    for end, frame in ((pilot, _heard(1, 1)), (gimbal, _heard(1, 154)), (ground, _heard(255, 190))):
        router.hear(frame, end, 0.0)
    fields: dict[str, Any] = {"param_id": b"X", "param_index": -1, "target_system": 1}
    for component, expected in ((154, (gimbal,)), (1, (pilot,)), (0, (pilot, gimbal))):
        asked = make("PARAM_REQUEST_READ", target_component=component, **fields)
        (frame,) = Codec(242, 191).read(Codec(255, 190).pack(asked))
        assert isinstance(frame, Frame)
        assert router.destinations(frame, ground) == expected


def test_a_slow_end_gets_the_messages_that_its_link_lets_out() -> None:
    """Rules keep the flood of a fleet from a gimbal that can read four messages (mavlink-router/mavlink-router#452)."""
    router = RoutingTable([Rules(), Rules(only_out=frozenset({"HEARTBEAT"}))], own_system=242)
    pilot, gimbal = End(0, ("", 0)), End(1, ("", 1))
    router.hear(_heard(1), pilot, 0.0)
    router.hear(_heard(2, 154), gimbal, 0.0)
    (loud,) = Codec(242, 191).read(attitude(1))
    assert isinstance(loud, Frame)
    assert (router.destinations(_heard(1), pilot), router.destinations(loud, pilot)) == ((gimbal,), ())


def test_what_is_sent_again_later_is_no_copy() -> None:
    """Copies stop only what comes within half a second: lost log data sent again goes through.

    Reported as mavlink-router/mavlink-router#323.
    """
    router = RoutingTable(own_system=242, repeat_s=0.5)
    data = beat()
    assert [router.repeated(data, at, sender=(7, 1)) for at in (0.0, 0.4, 1.0)] == [False, True, False]
