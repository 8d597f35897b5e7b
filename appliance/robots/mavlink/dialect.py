"""Encoder and decoder of a link, and MAVLink's numbers by their names.

`ardupilotmega` includes `common`, so one dialect serves ArduPilot and every message of PX4 that is used here. The
generated classes are untyped in practice (fields appear by name), so the rest of the room sees `Frame`.
"""

from collections.abc import Callable, Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as _dialect

from appliance.robots.mavlink.frames import (
    MARKER_V1,
    MARKER_V2,
    Damage,
    Frame,
    as_v1,
    as_v2,
    check,
    frame_length,
    marked,
)
from appliance.robots.mavlink.framing import Reader
from appliance.robots.mavlink.kinds import CommandCancel, Message
from appliance.robots.mavlink.signing import SIGNATURE_BYTES, SIGNED_FLAG, Signer, wall_ticks

__all__ = ["Codec", "Damage", "Frame", "Message", "Stream", "constant", "frame_length", "label", "make"]


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
FRAME_RELATIVE_OLD = constant("MAV_FRAME_GLOBAL_RELATIVE_ALT")
FRAME_GLOBAL = constant("MAV_FRAME_GLOBAL_INT")
MISSION_OK = constant("MAV_MISSION_ACCEPTED")
MISSION_SEQUENCE = constant("MAV_MISSION_INVALID_SEQUENCE")
MISSION_CANCELLED = constant("MAV_MISSION_OPERATION_CANCELLED")
MISSION_NO_SPACE = constant("MAV_MISSION_NO_SPACE")
MISSION_ERROR = constant("MAV_MISSION_ERROR")
MISSION_UNSUPPORTED = constant("MAV_MISSION_UNSUPPORTED")

AUTOPILOT_ARDUPILOT = constant("MAV_AUTOPILOT_ARDUPILOTMEGA")
AUTOPILOT_NONE = constant("MAV_AUTOPILOT_INVALID")
TYPE_GROUND_STATION = constant("MAV_TYPE_GCS")
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
COPTER_MODE_NAMES = {number: name for name, number in COPTER_MODES.items()}
