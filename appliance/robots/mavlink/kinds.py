"""What a router must know of each MAVLink message without decoding it: its name, CRC extra, and where its targets are.

Made from pymavlink's `ardupilotmega`, which includes `common`. Fields are decoded only for those frames that the
gateway itself acts on (`decode`): making pymavlink's objects costs several times what finding a frame does.
Source: MAVLink guide, "Packet Serialization" (CRC extra, order of fields on the wire, payload truncation).
"""

import functools
import struct
from collections.abc import Callable
from typing import Any

from msgspec import Struct
from pymavlink.dialects.v20 import ardupilotmega as _dialect

Message = Any
"""A pymavlink message, or a `CommandCancel`: fields by name."""

NO_FIELD = 255
"""In place of an offset: the message has no such field, and no payload is so long that it reaches there."""


class Kind(Struct, frozen=True, gc=False):
    """One message: number, name, CRC extra as the byte that ends what the checksum covers, offsets of its targets.

    `size` is that of the longest payload, with all extension fields.
    """

    number: int
    name: str
    extra: bytes
    size: int
    system_at: int = NO_FIELD
    component_at: int = NO_FIELD


class CommandCancel:
    """COMMAND_CANCEL (80), which pymavlink leaves out since `common.xml` marks it as work in progress."""

    _wire = struct.Struct("<HBB")
    name = "COMMAND_CANCEL"

    def __init__(self, command: int, target_system: int, target_component: int) -> None:
        self.command = command
        self.target_system = target_system
        self.target_component = target_component

    def get_type(self) -> str:
        """Return its name, as pymavlink's messages do."""
        return self.name

    def pack(self, mav: Any) -> bytes:
        """Return the frame, as pymavlink's messages do; `mav` says from whom and with which sequence number."""
        payload = self._wire.pack(self.command, self.target_system, self.target_component).rstrip(b"\0") or b"\0"
        head = struct.pack("<BBBBBBHB", len(payload), 0, 0, mav.seq, mav.srcSystem, mav.srcComponent, 80, 0)
        return b"\xfd" + head + payload + checksum(head + payload + _CANCEL.extra).to_bytes(2, "little")

    @classmethod
    def read(cls, payload: bytes) -> "CommandCancel":
        """Return the message of a payload, whose trailing zeros may be missing."""
        return cls(*cls._wire.unpack(payload[: cls._wire.size].ljust(cls._wire.size, b"\0")))


_CANCEL = Kind(80, CommandCancel.name, b"\x0e", 4, 2, 3)


def _slowly(data: bytes) -> int:
    return int(_dialect.x25crc(data).crc)


checksum: Callable[[bytes], int] = _dialect.mcrf4xx or _slowly
"""CRC-16/MCRF4XX of bytes, as MAVLink begins it."""


def _table() -> dict[int, Kind]:
    classes: dict[int, Any] = _dialect.mavlink_map
    found = {number: _kind(number, each) for number, each in classes.items()}
    found.setdefault(_CANCEL.number, _CANCEL)
    return found


def _kind(number: int, message: Any) -> Kind:
    formats = bytes(message.native_format).decode().lstrip("<")
    offsets: dict[str, int] = {}
    at = 0
    for name, letter, length in zip(message.ordered_fieldnames, formats, message.array_lengths, strict=True):
        offsets[name] = at
        at += struct.calcsize(f"<{letter}") * max(1, length)
    return Kind(
        number,
        message.msgname,
        bytes((message.crc_extra,)),
        at,
        offsets.get("target_system", NO_FIELD),
        offsets.get("target_component", NO_FIELD),
    )


KINDS: dict[int, Kind] = _table()
"""By message number."""
NAMES = frozenset(each.name for each in KINDS.values())

LAST_V1 = 255
"""MAVLink 1 has one byte for a message's number."""


@functools.cache
def plain_lengths() -> dict[int, int]:
    """Return the payload lengths of the messages that MAVLink 1 has, by number: without extension fields.

    From pymavlink's dialect of MAVLink 1, read when first asked for: it costs as much memory as that of MAVLink 2.
    """
    from pymavlink.dialects.v10 import ardupilotmega as v1  # noqa: PLC0415 - see above

    classes: dict[int, Any] = v1.mavlink_map
    found = {number: int(each.unpacker.size) for number, each in classes.items()}
    found.setdefault(_CANCEL.number, 4)
    return found


_decoder: Any = _dialect.MAVLink(None)


def decode(raw: bytes) -> Message:
    """Return the fields of a frame whose checksum was found right; a short payload is filled with zeros."""
    number = raw[5] if raw[0] == 0xFE else raw[7] | raw[8] << 8 | raw[9] << 16
    if number == _CANCEL.number and number not in _dialect.mavlink_map:
        start = 6 if raw[0] == 0xFE else 10
        return CommandCancel.read(raw[start : start + raw[1]])
    return _decoder.decode(bytearray(raw))
