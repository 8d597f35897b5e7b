"""MAVLink on the wire: frames found in bytes, a link's encoder and decoder, and the dialect's numbers by their names.

Messages. What a router must know of each without decoding it (its name, CRC extra, and where its targets are) is made
from pymavlink's `ardupilotmega`, which includes `common`, so one dialect serves ArduPilot and every message of PX4 that
is used here. Fields are decoded only for those frames that the gateway itself acts on, when their `message` is first
asked for: making pymavlink's objects costs several times what finding a frame does. The generated classes are untyped
in practice (fields appear by name), so the rest of the room sees `Frame`. Source: MAVLink guide, "Packet Serialization"
(CRC extra, order of fields on the wire, payload truncation).

Frames are found by header and checksum alone. pymavlink's stream parser is not used: it resynchronises across datagrams
and hides what it drops, and a gateway must count each damaged frame and keep the raw bytes of each good one.

Streams (`Reader`): where frames begin and end, damage and foreign frames included. Every decision belongs to one byte:
it is made when that byte has come, by the bytes up to it alone. So any cut of a stream gives the same frames and the
same counters. Four rules:

- In step, a marker where a frame is due is believed: its frame is waited for, and nothing within is looked at, since
  payloads may carry whole frames (TUNNEL, files). One that announces more than its message can hold, or flags that
  nobody knows, is believed only as long as no good frame is found within.
- A whole frame that is damaged or foreign is counted at once. Its end is where the next one is due, as for MAVLink's C
  parser and pymavlink: a good frame there settles it, whatever its body looked like.
- That end was false where no frame begins there, or where a good frame lies across it. Then its bytes are searched.
- Out of step, a marker begins a frame only where message, length and flags may be those of one that could be found
  good; every other is passed over. What such a frame carries is not looked at before it has proved to be none.
"""

import functools
import struct
from collections.abc import Callable, Iterator
from typing import Any

from msgspec import Struct
from pymavlink.dialects.v20 import ardupilotmega as _dialect

from appliance.robots.mavlink.signing import SIGNATURE_BYTES, SIGNED_FLAG, Signer, wall_ticks

# --- messages --------------------------------------------------------------------------------------------------------

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


# --- frames ----------------------------------------------------------------------------------------------------------

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


# --- frames in streams -----------------------------------------------------------------------------------------------

LONGEST = 280
"""Bytes of the longest frame."""


class Reader:
    """Frames out of one stream. `unproven` returns why a frame whose checksum is right is not believed, or nothing."""

    def __init__(self, unproven: Callable[[Frame], str]) -> None:
        self._unproven = unproven
        self._data = b""
        self._at = 0
        """Before it everything is decided."""
        self._ends: list[int] = []
        """Ends of the damaged frames from `_at` on, one behind the other."""
        self._lost = False
        self._from = 0
        """While lost: where the search goes on."""
        self._kind = ""
        self._quiet = 0
        """Bytes up to here belong to damage that was counted; what is lost beyond them is counted as noise."""
        self._base = 0
        self._checked: dict[int, bool] = {}
        """Whether a frame is good, by its place in the stream."""

    @property
    def pending(self) -> int:
        """Bytes that are not decided yet: of two damaged frames and one that has begun, at most."""
        return len(self._data) - self._at

    def feed(self, data: bytes, *, end: bool = False) -> Iterator[Frame | Damage]:
        """Yield what these bytes decide; never raises. `end`: no more will come, so that nothing stays undecided."""
        gone, self._at = self._at, 0
        self._data = self._data[gone:] + data
        self._base += gone
        self._from -= gone
        self._quiet -= gone
        self._ends = [each - gone for each in self._ends]
        while self._at < len(self._data):
            if self._lost:
                found = self._search(end=end)
            elif self._ends:
                found = self._step(end=end)
            else:
                yield from self._frames()
                found = self._step(end=end) if self._at < len(self._data) else ()
            if found is None:
                return
            yield from found

    def _frames(self) -> Iterator[Frame | Damage]:
        """Yield good frames as long as they come one behind the other."""
        data, at = self._data, self._at
        self._checked.clear()
        while at < len(data) and data[at] in (MARKER_V2, MARKER_V1):
            length = frame_length(data, at)
            if length is None or at + length > len(data):
                return
            found = check(data[at : at + length])
            if isinstance(found, Damage) or data[at + 1] > KINDS[found.number].size:
                return
            at = self._at = at + length
            yield self._judged(found)

    def _judged(self, frame: Frame) -> Frame | Damage:
        problem = self._unproven(frame)
        return Damage(problem, len(frame.raw)) if problem else frame

    # --- in step -----------------------------------------------------------------------------------------------

    def _step(self, *, end: bool) -> tuple[Frame | Damage, ...] | None:
        """Decide the next byte that decides anything; None when it has not come."""
        data, at = self._data, self._at
        here = self._ends[-1] if self._ends else at
        whole = self._whole(here)
        refuted, inside = self._refuted(here, whole)
        if refuted is not None and (whole is None or refuted < whole):
            # The byte that shows a third frame to follow ends the doubt about the first of two damaged ones.
            if len(self._ends) > 1 and refuted > here and self._marks(here):
                return self._trim()
            first = ()
            if inside:
                flags = data[here] == MARKER_V2 and data[here + 2] & ~SIGNED_FLAG
                first = self._report("incompatible" if flags else "truncated", here)
            elif not self._ends:
                first = self._report("noise", here)
            self._lose()
            return first
        if len(self._ends) > 1 and self._marks(here):
            return self._trim()
        if whole is not None:
            found = check(data[here:whole])
            if isinstance(found, Damage):
                self._ends.append(whole)
                return self._report(found.kind, whole)
            gone = self._gone(here)
            self._at, self._ends = whole, []
            return (*gone, self._judged(found))
        if not end:
            return None
        if here == len(data):
            self._ends = []
            return self._gone(here)
        first = self._report("truncated", here)
        self._lose()
        return first

    def _whole(self, here: int) -> int | None:
        """Return where the frame that is due here ends, None where none is or it is not whole."""
        if not self._marks(here):
            return None
        length = frame_length(self._data, here)
        return None if length is None or here + length > len(self._data) else here + length

    def _refuted(self, here: int, whole: int | None) -> tuple[int | None, bool]:
        """Return how many bytes tell that no frame is due here, and whether one within what is announced does."""
        data = self._data
        first: int | None = None
        if here < len(data) and not self._marks(here):
            first = here + 1
        # A good frame across the end of a damaged one, or just up to it, was swallowed by a false length.
        start = next_marker(data, self._at + 1) if self._ends else here
        while start < here:
            stop = self._good(start)
            if stop is not None and stop >= here and (first is None or stop < first):
                first = stop
            start = next_marker(data, start + 1)
        inside = False
        seen = self._doubtful(here)
        if seen is not None:
            start = next_marker(data, here + 1)
            while start < min(whole or len(data), first or len(data)):
                stop = self._good(start)
                if stop is not None and (first is None or max(stop, seen) < first):
                    first, inside = max(stop, seen), True
                start = next_marker(data, start + 1)
        return first, inside

    def _doubtful(self, here: int, *, known: bool = False) -> int | None:
        """Return by which byte a header here is seen to announce what cannot be; None when it is not seen to.

        With `known` messages that nobody here knows cannot be either.
        """
        data = self._data
        there = len(data) - here
        if not self._marks(here) or there < 3:
            return None
        if data[here] == MARKER_V1:
            size, number = HEADER_V1, data[here + 5] if there >= HEADER_V1 else -1
        elif data[here + 2] & ~SIGNED_FLAG:
            return here + 3
        else:
            size = HEADER_V2
            number = data[here + 7] | data[here + 8] << 8 | data[here + 9] << 16 if there >= HEADER_V2 else -1
        if number < 0:
            return None
        kind = KINDS.get(number)
        wrong = known if kind is None else data[here + 1] > kind.size
        return here + size if wrong else None

    def _trim(self) -> tuple[Damage, ...]:
        gone = self._gone(self._ends[-2])
        self._ends = self._ends[-1:]
        return gone

    def _report(self, kind: str, upto: int) -> tuple[Damage, ...]:
        self._kind, self._quiet = kind, upto + LONGEST
        return (Damage(kind, 0),)

    def _gone(self, to: int) -> tuple[Damage, ...]:
        """Give up the bytes up to there, which were counted; what goes on for longer than a frame is, again."""
        length, self._at = to - self._at, to
        found = [Damage(self._kind, length, counted=False)] if length else []
        while to > self._quiet:
            found += self._report("noise", self._quiet)
        return tuple(found)

    def _marks(self, at: int) -> bool:
        return at < len(self._data) and self._data[at] in (MARKER_V2, MARKER_V1)

    # --- out of step -------------------------------------------------------------------------------------------

    def _lose(self) -> None:
        self._lost, self._from, self._ends = True, self._at + 1, []

    def _search(self, *, end: bool) -> tuple[Frame | Damage, ...] | None:
        """Find the next good frame; None when it has not come."""
        data = self._data
        start = next_marker(data, self._from)
        while start < len(data):
            length = frame_length(data, start)
            whole = length is not None and start + length <= len(data)
            if self._doubtful(start, known=True) is None and (whole or not end):
                if not whole:
                    break
                # Good or damaged, what is due behind it decides, as in step. It belongs to damage that was counted.
                gone = self._gone(start)
                self._lost = False
                if length is not None and self._good(start) is None:
                    self._ends = [start + length]
                return gone or ()
            start = next_marker(data, start + 1)
        self._from = start
        gone = self._gone(start)
        return gone if gone or end else None

    def _good(self, start: int) -> int | None:
        """Return where the frame that begins there ends; None when it is not whole, or not good."""
        data = self._data
        length = frame_length(data, start)
        if length is None or start + length > len(data):
            return None
        stop = start + length
        good = self._checked.get(self._base + start)
        if good is None:
            good = self._checked[self._base + start] = isinstance(check(data[start:stop]), Frame)
            if len(self._checked) > 8 * LONGEST:
                self._checked = {place: each for place, each in self._checked.items() if place >= self._base + self._at}
        return stop if good else None


# --- encoder and decoder of a link -----------------------------------------------------------------------------------


class Codec:
    """Decoder and encoder of one link. `system` and `component` are what it sends as.

    With a `signer` every frame sent is signed and every frame read must be; without one signed frames are refused. Both
    versions of MAVLink are read; with `v1` the first is sent alone.
    """

    def __init__(
        self,
        system: int,
        component: int,
        *,
        signer: Signer | None = None,
        clock: Callable[[], int] = wall_ticks,
        v1: bool = False,
    ) -> None:
        self._mav: Any = _dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self.system = system
        self.component = component
        self.signer = signer
        self._clock = clock
        self._v1 = v1

    def pack(self, message: Message, *, system: int | None = None) -> bytes:
        """Encode a message as a frame with the next sequence number; empty where MAVLink 1 has no such message.

        `system` is another than the gateway's own when it speaks as a vehicle's onboard computer.
        """
        self._mav.srcSystem = self.system if system is None else system
        raw = bytes(message.pack(self._mav))
        if self._v1:
            raw = as_v1(raw)
            if not raw:
                return raw
        if self.signer is not None:
            raw = self._sign(raw, raw[7] | raw[8] << 8 | raw[9] << 16)
        self._mav.seq = (self._mav.seq + 1) % 256
        return raw

    def pass_on(self, frame: Frame) -> bytes:
        """Return a frame of another link as this one sends it: its bytes, signed or unsigned as this link is.

        Empty where this link speaks MAVLink 1, which has no such message.
        """
        raw = frame.raw
        if self._v1:
            return as_v1(raw)
        if self.signer is not None:
            return self._sign(as_v2(raw), frame.number)
        if raw[0] == MARKER_V2 and raw[2] & SIGNED_FLAG:
            return marked(raw[:-SIGNATURE_BYTES], frame.number, signed=False)
        return raw

    def _sign(self, raw: bytes, number: int) -> bytes:
        assert self.signer is not None  # noqa: S101 - only called with one
        if raw[2] & SIGNED_FLAG:
            raw = raw[:-SIGNATURE_BYTES]
        frame = marked(raw, number, signed=True)
        return frame + self.signer.signature(frame, self.signer.stamp(self._clock()))

    def read(self, data: bytes) -> Iterator[Frame | Damage]:
        """Yield what a datagram (or a log) holds, in order; never raises. Nothing is taken to follow it."""
        if len(data) > 2 and data[0] in (MARKER_V2, MARKER_V1) and frame_length(data, 0) == len(data):
            found = check(data)
            if isinstance(found, Frame):
                yield self.judged(found)
                return
        held: Damage | None = None
        for each in Reader(self.unproven).feed(data, end=True):
            if isinstance(each, Damage) and held is not None and not each.counted:
                held = Damage(held.kind, held.length + each.length)
                continue
            if held is not None:
                yield held
            held = each if isinstance(each, Damage) else None
            if held is None:
                yield each
        if held is not None:
            yield held

    def judged(self, frame: Frame) -> Frame | Damage:
        """Return a frame whose checksum is right, or why it is not believed."""
        problem = self.unproven(frame)
        return Damage(problem, len(frame.raw)) if problem else frame

    def unproven(self, frame: Frame) -> str:
        """Return why a frame whose checksum is right is not believed; empty when it is."""
        raw = frame.raw
        if self.signer is None:
            # No key is shared with this link's vehicles: a signature proves nothing and may be of another's making.
            return "signed" if raw[0] == MARKER_V2 and raw[2] & SIGNED_FLAG else ""
        problem = self.signer.problem(raw, system=frame.system, component=frame.component, now=self._clock())
        # A radio's own account of the link is made by the radio, which has no key (guide: Message Signing).
        return "" if problem == "unsigned" and frame.name == "RADIO_STATUS" else problem


class Stream:
    """Frames out of a stream of bytes (TCP, serial), in which a frame may come in pieces."""

    def __init__(self, codec: Codec) -> None:
        self._reader = Reader(codec.unproven)

    @property
    def pending(self) -> int:
        """Bytes that are not decided yet."""
        return self._reader.pending

    def feed(self, data: bytes) -> Iterator[Frame | Damage]:
        """Yield what these bytes decide; never raises."""
        return self._reader.feed(data)

    def end(self) -> Iterator[Frame | Damage]:
        """Yield what is left to decide when no more will come."""
        return self._reader.feed(b"", end=True)


def make(name: str, /, **fields: Any) -> Message:
    """Make a message by its MAVLink name, such as `make("HEARTBEAT", type=..., ...)`."""
    if name == CommandCancel.name:
        return CommandCancel(**fields)
    kind: Any = getattr(_dialect, f"MAVLink_{name.lower()}_message")
    return kind(**fields)


def constant(name: str) -> int:
    """Return one of MAVLink's numbers by its name in the dialect."""
    return int(getattr(_dialect, name))


def label(enum: str, value: int) -> str:
    """Return the name of an enum's value, its number when it has none."""
    enums: Any = _dialect.enums
    entry: Any = enums.get(enum, {}).get(value)
    return str(value) if entry is None else str(entry.name)


# --- numbers by their names ------------------------------------------------------------------------------------------

ARM = constant("MAV_CMD_COMPONENT_ARM_DISARM")
TAKEOFF = constant("MAV_CMD_NAV_TAKEOFF")
LAND = constant("MAV_CMD_NAV_LAND")
RETURN = constant("MAV_CMD_NAV_RETURN_TO_LAUNCH")
WAYPOINT = constant("MAV_CMD_NAV_WAYPOINT")
SET_MODE = constant("MAV_CMD_DO_SET_MODE")
CHANGE_SPEED = constant("MAV_CMD_DO_CHANGE_SPEED")
MISSION_START = constant("MAV_CMD_MISSION_START")
RUN_PREARM = constant("MAV_CMD_RUN_PREARM_CHECKS")
SET_CURRENT = constant("MAV_CMD_DO_SET_MISSION_CURRENT")
LOITER_TURNS = constant("MAV_CMD_NAV_LOITER_TURNS")
IMAGE_START = constant("MAV_CMD_IMAGE_START_CAPTURE")
VIDEO_START = constant("MAV_CMD_VIDEO_START_CAPTURE")
VIDEO_STOP = constant("MAV_CMD_VIDEO_STOP_CAPTURE")
GRIPPER = constant("MAV_CMD_DO_GRIPPER")
GIMBAL_ANGLES = constant("MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW")
LOOK_AT = constant("MAV_CMD_DO_SET_ROI_LOCATION")
SERVO = constant("MAV_CMD_DO_SET_SERVO")
GET_HOME = constant("MAV_CMD_GET_HOME_POSITION")
CAPABILITIES = constant("MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES")
REQUEST_MESSAGE = constant("MAV_CMD_REQUEST_MESSAGE")
SET_INTERVAL = constant("MAV_CMD_SET_MESSAGE_INTERVAL")

ACCEPTED = constant("MAV_RESULT_ACCEPTED")
TEMPORARILY_REJECTED = constant("MAV_RESULT_TEMPORARILY_REJECTED")
DENIED = constant("MAV_RESULT_DENIED")
UNSUPPORTED = constant("MAV_RESULT_UNSUPPORTED")
FAILED = constant("MAV_RESULT_FAILED")
IN_PROGRESS = constant("MAV_RESULT_IN_PROGRESS")

FRAME_RELATIVE = constant("MAV_FRAME_GLOBAL_RELATIVE_ALT_INT")
FRAME_GLOBAL = constant("MAV_FRAME_GLOBAL_INT")
MISSION_OK = constant("MAV_MISSION_ACCEPTED")
MISSION_SEQUENCE = constant("MAV_MISSION_INVALID_SEQUENCE")
MISSION_CANCELLED = constant("MAV_MISSION_OPERATION_CANCELLED")
MISSION_NO_SPACE = constant("MAV_MISSION_NO_SPACE")
MISSION_ERROR = constant("MAV_MISSION_ERROR")
MISSION_UNSUPPORTED = constant("MAV_MISSION_UNSUPPORTED")

AUTOPILOT_ARDUPILOT = constant("MAV_AUTOPILOT_ARDUPILOTMEGA")
AUTOPILOT_NONE = constant("MAV_AUTOPILOT_INVALID")
TYPE_ONBOARD = constant("MAV_TYPE_ONBOARD_CONTROLLER")
TYPE_QUADROTOR = constant("MAV_TYPE_QUADROTOR")
TYPE_ROVER = constant("MAV_TYPE_GROUND_ROVER")
TYPE_CAMERA = constant("MAV_TYPE_CAMERA")
TYPE_GIMBAL = constant("MAV_TYPE_GIMBAL")
MULTIROTORS = frozenset(
    constant(f"MAV_TYPE_{name}")
    for name in ("QUADROTOR", "HEXAROTOR", "OCTOROTOR", "TRICOPTER", "COAXIAL", "HELICOPTER", "DODECAROTOR")
)
VEHICLES = MULTIROTORS | frozenset(
    constant(f"MAV_TYPE_{name}")
    for name in (
        "FIXED_WING", "AIRSHIP", "FREE_BALLOON", "ROCKET", "GROUND_ROVER", "SURFACE_BOAT", "SUBMARINE", "FLAPPING_WING",
        "KITE", "VTOL_DUOROTOR", "VTOL_QUADROTOR", "VTOL_TILTROTOR", "VTOL_RESERVED2", "VTOL_RESERVED3",
        "VTOL_RESERVED4", "VTOL_RESERVED5", "PARAFOIL", "DECAROTOR", "GENERIC_MULTIROTOR", "SPACECRAFT_ORBITER",
        "GROUND_QUADRUPED", "VTOL_GYRODYNE",
    )
)  # fmt: skip
"""Types of what moves by itself. Any other, also one that is not known here, is a component or a station."""
COMPONENT_AUTOPILOT = constant("MAV_COMP_ID_AUTOPILOT1")
COMPONENT_CAMERA = constant("MAV_COMP_ID_CAMERA")
COMPONENT_GIMBAL = constant("MAV_COMP_ID_GIMBAL")
ARMED_FLAG = constant("MAV_MODE_FLAG_SAFETY_ARMED")
CUSTOM_MODE_FLAG = constant("MAV_MODE_FLAG_CUSTOM_MODE_ENABLED")
STATE_ACTIVE = constant("MAV_STATE_ACTIVE")
STATE_STANDBY = constant("MAV_STATE_STANDBY")
STATE_CRITICAL = constant("MAV_STATE_CRITICAL")

COPTER_MODES: dict[str, int] = {
    "STABILIZE": 0,
    "ALT_HOLD": 2,
    "AUTO": 3,
    "GUIDED": 4,
    "LOITER": 5,
    "RTL": 6,
    "LAND": 9,
    "POSHOLD": 16,
    "BRAKE": 17,
    "SMART_RTL": 21,
}
"""ArduCopter's custom modes (ArduPilot, ArduCopter/mode.h)."""
