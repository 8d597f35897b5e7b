"""Frames out of bytes by header and checksum alone: what a MAVLink router needs of each, and nothing else.

A frame's fields are decoded when somebody first asks for its `message`. pymavlink's stream parser is not used: it
resynchronises across datagrams and hides what it drops, and a gateway must count each damaged frame and keep the raw
bytes of each good one.
"""

from msgspec import Struct

from appliance.robots.mavlink.kinds import KINDS, LAST_V1, Message, checksum, decode, plain_lengths
from appliance.robots.mavlink.signing import SIGNATURE_BYTES, SIGNED_FLAG

MARKER_V2 = 0xFD
MARKER_V1 = 0xFE
_STATUSTEXT = 253
HEADER_V2, HEADER_V1, _CHECKSUM = 10, 6, 2


class Frame(Struct, gc=False, eq=False):
    """A frame whose checksum was right: who sent it, which message (`HEARTBEAT`, ...), whom it is for, its bytes.

    Targets are 0 where the message has none, or means all.
    """

    system: int
    component: int
    sequence: int
    name: str
    raw: bytes
    target_system: int = 0
    target_component: int = 0
    number: int = 0
    decoded: Message = None

    @property
    def message(self) -> Message:
        """Its fields by name; decoded when first asked for."""
        if self.decoded is None:
            self.decoded = decode(self.raw)
        return self.decoded


class Damage(Struct, frozen=True):
    """Bytes that made no frame, or one that is not believed.

    `checksum`, `unknown_message`, `truncated`, `incompatible`, `noise`; `signed` (there is no key here), `unsigned`,
    `bad_signature`, `replayed`. Damage is reported when it is seen, and its bytes, where they are not sure to be lost
    then, behind it (`counted` is false): the two are one damage.
    """

    kind: str
    length: int
    counted: bool = True


def frame_length(data: bytes, at: int) -> int | None:
    """Return the length that the header at `at` announces, None when the header is not whole."""
    if len(data) - at < 3:
        return None
    if data[at] == MARKER_V1:
        return HEADER_V1 + data[at + 1] + _CHECKSUM
    return HEADER_V2 + data[at + 1] + _CHECKSUM + (SIGNATURE_BYTES if data[at + 2] & SIGNED_FLAG else 0)


def next_marker(data: bytes, start: int) -> int:
    """Return where a frame may begin from `start` on; the end of the data when nowhere."""
    found = [place for place in (data.find(MARKER_V2, start), data.find(MARKER_V1, start)) if place >= 0]
    return min(found, default=len(data))


def check(raw: bytes) -> Frame | Damage:
    """Return the frame that these bytes are (of the length that their header announces), or what is wrong with them."""
    size = raw[1]
    if raw[0] == MARKER_V2:
        if raw[2] & ~SIGNED_FLAG:
            return Damage("incompatible", len(raw))
        start, place, number = HEADER_V2, 4, raw[7] | raw[8] << 8 | raw[9] << 16
    else:
        start, place, number = HEADER_V1, 2, raw[5]
    kind = KINDS.get(number)
    if kind is None:
        return Damage("unknown_message", len(raw))
    end = start + size
    if checksum(raw[1:end] + kind.extra) != raw[end] | raw[end + 1] << 8:
        return Damage("checksum", len(raw))
    return Frame(
        raw[place + 1],
        raw[place + 2],
        raw[place],
        kind.name,
        raw,
        raw[start + kind.system_at] if kind.system_at < size else 0,
        raw[start + kind.component_at] if kind.component_at < size else 0,
        number,
    )


def marked(raw: bytes, number: int, *, signed: bool) -> bytes:
    """Return an unsigned MAVLink 2 frame with the header saying (not) signed; the checksum covers the header."""
    body = bytearray(raw[:-_CHECKSUM])
    body[2] = body[2] | SIGNED_FLAG if signed else body[2] & ~SIGNED_FLAG
    return bytes(body) + checksum(bytes(body[1:]) + KINDS[number].extra).to_bytes(2, "little")


def as_v2(raw: bytes) -> bytes:
    """Return a MAVLink 1 frame as one of MAVLink 2 with room for the checksum; others as they are."""
    if raw[0] != MARKER_V1:
        return raw
    length, sequence, system, component, number = raw[1:6]
    header = bytes((MARKER_V2, length, 0, 0, sequence, system, component, number, 0, 0))
    return header + raw[HEADER_V1:]


def as_v1(raw: bytes) -> bytes:
    """Return a frame as one of MAVLink 1, without extension fields and signature; empty where that has no such message.

    Source: MAVLink guide, "Packet Serialization": there payloads always have their full length.
    """
    if raw[0] == MARKER_V1:
        return raw
    size, sequence, system, component = raw[1], raw[4], raw[5], raw[6]
    number = raw[7] | raw[8] << 8 | raw[9] << 16
    length = plain_lengths().get(number)
    if number > LAST_V1 or length is None:
        return b""
    payload = raw[HEADER_V2 : HEADER_V2 + size].ljust(length, b"\0")[:length]
    if number == _STATUSTEXT and size > length and not any(payload[1:]):
        return b""  # the empty part that ends a text: without its id it would be a text of its own
    body = bytes((length, sequence, system, component, number)) + payload
    return bytes((MARKER_V1,)) + body + checksum(body + KINDS[number].extra).to_bytes(2, "little")
