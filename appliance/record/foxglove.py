"""What the fleet's own messages are in Foxglove's well-known schemas, so that its panels show them as they are.

The originals stay as they were put; these are further messages on channels of the recorder's own: poses and frame
transforms for the 3D panel, locations for the map, lines for the log panel. Field names and units are those of
docs.foxglove.dev, "Message schemas", in their JSON form. Pure functions.
"""

import math
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec import Struct

from appliance.model import LogLine, Notice, RobotInfo, Site
from appliance.model.geo import to_globe
from appliance.plane.keys import Keys
from appliance.record.expressions import compile_expression
from appliance.record.facts import LoggedMessage

JsonSchema = dict[str, Any]
SITE_FRAME = "site"
"""The frame of the site: metres east, north and up of its origin."""


class ChannelKind(Struct, frozen=True):
    """How messages of a key are described in a log: schema name and text (both empty: none), message encoding."""

    schema: str
    schema_text: bytes
    encoding: str
    metadata: tuple[tuple[str, str], ...] = ()
    """What else a reader must know of the channel, such as a dialect."""


def _object(title: str, description: str, **properties: JsonSchema) -> JsonSchema:
    return {"title": title, "description": description, "type": "object", "properties": properties}


_NUMBER: JsonSchema = {"type": "number"}
_STRING: JsonSchema = {"type": "string"}
_WHOLE: JsonSchema = {"type": "integer", "minimum": 0}
_TIME = _object("time", "Seconds and nanoseconds since the epoch", sec=_WHOLE, nsec=_WHOLE)
_VECTOR = _object("foxglove.Vector3", "A vector in 3D space", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", "A rotation in 3D space", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object("foxglove.Pose", "A position and orientation in 3D space", position=_VECTOR, orientation=_QUATERNION)

COMPRESSED_IMAGE = _object(
    "foxglove.CompressedImage",
    "A compressed image",
    timestamp=_TIME,
    frame_id=_STRING,
    data={"type": "string", "contentEncoding": "base64"},
    format=_STRING,
)
FOXGLOVE_LOG = _object(
    "foxglove.Log",
    "A log message",
    timestamp=_TIME,
    level={"type": "integer", "description": "0 unknown, 1 debug, 2 info, 3 warning, 4 error, 5 fatal"},
    message=_STRING,
    name=_STRING,
    file=_STRING,
    line={"type": "integer", "minimum": 0},
)
POSE_IN_FRAME = _object(
    "foxglove.PoseInFrame", "A timestamped pose", timestamp=_TIME, frame_id=_STRING, pose=_POSE
)  # fmt: skip
FRAME_TRANSFORM = _object(
    "foxglove.FrameTransform",
    "A transform between two frames",
    timestamp=_TIME,
    parent_frame_id=_STRING,
    child_frame_id=_STRING,
    translation=_VECTOR,
    rotation=_QUATERNION,
)
LOCATION_FIX = _object(
    "foxglove.LocationFix",
    "A position on the globe",
    timestamp=_TIME,
    frame_id=_STRING,
    latitude=_NUMBER,
    longitude=_NUMBER,
    altitude=_NUMBER,
    position_covariance={"type": "array", "items": _NUMBER, "minItems": 9, "maxItems": 9},
    position_covariance_type={"type": "integer", "description": "0 unknown"},
)


def _kind(schema: JsonSchema) -> ChannelKind:
    return ChannelKind(schema["title"], msgspec.json.encode(schema), "json")


IMAGE_KIND = _kind(COMPRESSED_IMAGE)
LOG_KIND = _kind(FOXGLOVE_LOG)
POSE_KIND = _kind(POSE_IN_FRAME)
TRANSFORM_KIND = _kind(FRAME_TRANSFORM)
LOCATION_KIND = _kind(LOCATION_FIX)

_LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "exception": 4, "critical": 5, "fatal": 5}


class Time(Struct, frozen=True):
    """A time as Foxglove's schemas have it."""

    sec: int
    nsec: int


class Vector(Struct, frozen=True):
    """Metres."""

    x: float
    y: float
    z: float


class Quaternion(Struct, frozen=True):
    """A rotation."""

    x: float
    y: float
    z: float
    w: float


class FoxgloveLog(Struct, frozen=True):
    """`foxglove.Log`."""

    timestamp: Time
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


class PlacedPose(Struct, frozen=True):
    """`foxglove.Pose`."""

    position: Vector
    orientation: Quaternion


class PoseInFrame(Struct, frozen=True):
    """`foxglove.PoseInFrame`."""

    timestamp: Time
    frame_id: str
    pose: PlacedPose


class FrameTransform(Struct, frozen=True):
    """`foxglove.FrameTransform`."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector
    rotation: Quaternion


class LocationFix(Struct, frozen=True):
    """`foxglove.LocationFix`; the covariance is not known."""

    timestamp: Time
    frame_id: str
    latitude: float
    longitude: float
    altitude: float
    position_covariance: tuple[float, ...] = (0.0,) * 9
    position_covariance_type: int = 0


class Derived(Struct, frozen=True):
    """A message made of another: topic, kind, payload."""

    topic: str
    kind: ChannelKind
    payload: bytes


Derive = Callable[[LoggedMessage], tuple[Derived, ...]]
"""Makes them; none of a payload that is malformed."""


def time_of(at_ns: int) -> Time:
    """Return Unix nanoseconds as seconds and nanoseconds; what lies before the epoch is the epoch."""
    return Time(*divmod(max(0, at_ns), 1_000_000_000))


def facing(heading_deg: float) -> Quaternion:
    """Return the rotation of a body that looks along x, for a compass heading: 0 is north, which is y."""
    yaw = math.radians(90.0 - heading_deg)
    return Quaternion(0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))


class Foxglove:
    """Derives messages in Foxglove's schemas from a fleet's.

    Args:
        keys: of the fleet.
        recorder: whose channels they are written on.
        site: where on the globe the site's origin is; without it there are no locations.
    """

    def __init__(self, keys: Keys, recorder: str, *, site: Site | None = None) -> None:
        self._keys = keys
        self._recorder = recorder
        self._site = site
        self._makers: tuple[tuple[Any, Derive], ...] = (
            (compile_expression(keys.log()), self._of_line),
            (compile_expression(keys.notice()), self._of_notice),
            (compile_expression(keys.robot()), self._of_robot),
        )

    def deriving(self, key: str) -> Derive | None:
        """Return what makes messages of those put on `key`, or None; to be asked once a key, not once a message."""
        return next((make for pattern, make in self._makers if pattern.fullmatch(key)), None)

    def _of_line(self, message: LoggedMessage) -> tuple[Derived, ...]:
        try:
            line = msgspec.json.decode(message.payload, type=LogLine)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return ()
        fields = " ".join(f"{key}={value}" for key, value in line.fields.items())
        level, text = _LEVELS.get(line.level.lower(), 0), f"{line.event} {fields}".rstrip()
        return self._news(line.at_ns or message.at_ns, level, text, line.source)

    def _of_notice(self, message: LoggedMessage) -> tuple[Derived, ...]:
        try:
            notice = msgspec.json.decode(message.payload, type=Notice)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return ()
        text = f"to {notice.to}: {notice.text}"
        return self._news(notice.at_ns or message.at_ns, _LEVELS["info"], text, notice.gateway)

    def _news(self, at_ns: int, level: int, text: str, name: str) -> tuple[Derived, ...]:
        made = FoxgloveLog(time_of(at_ns), level, text, name)
        return (Derived(self._keys.recorder_log(self._recorder), LOG_KIND, msgspec.json.encode(made)),)

    def _of_robot(self, message: LoggedMessage) -> tuple[Derived, ...]:
        try:
            robot = msgspec.json.decode(message.payload, type=RobotInfo)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return ()
        pose = robot.pose
        if pose is None or not all(map(math.isfinite, (pose.x, pose.y, pose.z, pose.heading_deg))):
            return ()
        at, position, rotation = time_of(message.at_ns), Vector(pose.x, pose.y, pose.z), facing(pose.heading_deg)
        # By the key, not by what the payload says of itself: one who lies about its id moves nobody else.
        name = message.key.split("/")[3]
        made: list[tuple[str, ChannelKind, Struct]] = [
            ("pose", POSE_KIND, PoseInFrame(at, SITE_FRAME, PlacedPose(position, rotation))),
            ("transform", TRANSFORM_KIND, FrameTransform(at, SITE_FRAME, name, position, rotation)),
        ]
        if self._site is not None:
            made.append(
                ("location", LOCATION_KIND, LocationFix(at, name, *to_globe(self._site, pose.x, pose.y, pose.z)))
            )
        return tuple(
            Derived(self._keys.recorder_view(self._recorder, name, what), kind, msgspec.json.encode(value))
            for what, kind, value in made
        )
