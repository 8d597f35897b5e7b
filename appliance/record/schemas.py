"""Which key carries which kind of message, in the terms of MCAP, and the fleet's messages in Foxglove's own schemas.

Foxglove wants a JSON schema whose root is an object and which has no unions; msgspec writes references and
`anyOf` with null. `flat_schema` inlines both. Keys without a known struct are logged as JSON without schema, raw
MAVLink frames with the message encoding `mavlink`, everything else under its Zenoh encoding.

The originals stay as they were put. `Foxglove` derives further messages from them, on channels of the recorder's own,
so that Foxglove's panels show them as they are: frame transforms for the 3D panel, locations for the map, lines for the
log panel; those of all robots on one channel each, as panels expect it. Field names and units are those of
docs.foxglove.dev, "Message schemas", in their JSON form. Pure functions.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import msgspec
from msgspec import Struct

from appliance.model import LogLine, Notice, RobotInfo, Site, keyspace
from appliance.model.keys import Keys, Untyped
from appliance.model.site import to_globe
from appliance.record.models import LoggedMessage, compile_expression

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
        self._topics = {what: keys(keyspace.RECORDER_VIEW, recorder, what) for what in _OF_VIEW}
        self._makers: tuple[tuple[Any, Derive], ...] = (
            (compile_expression(keys(keyspace.LOG)), self._of_line),
            (compile_expression(keys(keyspace.NOTICE)), self._of_notice),
            (compile_expression(keys(keyspace.ROBOT)), self._of_robot),
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
        return (Derived(self._keys(keyspace.RECORDER_LOG, self._recorder), LOG_KIND, msgspec.json.encode(made)),)

    def _of_robot(self, message: LoggedMessage) -> tuple[Derived, ...]:
        # By the key, not by what the payload says of itself: one who lies about its id moves nobody else.
        (name,) = keyspace.ROBOT.names(message.key)
        try:
            robot = msgspec.json.decode(message.payload, type=RobotInfo)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return ()
        pose = robot.pose
        if pose is None or not all(map(math.isfinite, (pose.x, pose.y, pose.z, pose.heading_deg))):
            return ()
        at, position, rotation = time_of(message.at_ns), Vector(pose.x, pose.y, pose.z), facing(pose.heading_deg)
        made: list[tuple[str, ChannelKind, Struct]] = [
            ("transform", TRANSFORM_KIND, FrameTransform(at, SITE_FRAME, name, position, rotation)),
        ]
        if self._site is not None:
            made.append(
                ("location", LOCATION_KIND, LocationFix(at, name, *to_globe(self._site, pose.x, pose.y, pose.z)))
            )
        return tuple(Derived(self._topics[what], kind, msgspec.json.encode(value)) for what, kind, value in made)


def flat_schema(kind: type[Struct]) -> JsonSchema:
    """Return the JSON schema of a struct with references inlined and "or null" dropped; the root is an object."""
    whole = msgspec.json.schema(kind)
    definitions = cast("dict[str, JsonSchema]", whole.get("$defs", {}))
    return _flatten(whole, definitions)


def _flatten(node: JsonSchema, definitions: dict[str, JsonSchema]) -> JsonSchema:
    if "$ref" in node:
        return _flatten(definitions[str(node["$ref"]).rsplit("/", 1)[-1]], definitions)
    if "anyOf" in node:
        others = [part for part in cast("list[JsonSchema]", node["anyOf"]) if part.get("type") != "null"]
        return _flatten(others[0], definitions)
    out = {name: value for name, value in node.items() if name not in ("$defs", "default", "required")}
    if "enum" in out:
        out.setdefault("type", "string")
    properties = cast("dict[str, JsonSchema]", out.get("properties", {}))
    if properties:
        out["properties"] = {name: _flatten(part, definitions) for name, part in properties.items()}
    if isinstance(out.get("items"), dict):
        out["items"] = _flatten(cast("JsonSchema", out["items"]), definitions)
    if isinstance(out.get("additionalProperties"), dict):
        out["additionalProperties"] = _flatten(cast("JsonSchema", out["additionalProperties"]), definitions)
    return out


@cache
def struct_kind(kind: type[Struct]) -> ChannelKind:
    """Return how a model struct is logged: as `swiftbot.<Name>`, JSON."""
    return ChannelKind(f"swiftbot.{kind.__name__}", msgspec.json.encode(flat_schema(kind)), "json")


MAVLINK_DIALECT = "ardupilotmega"
"""What frames are read with: it has all messages of `common`, and those of ArduPilot's vehicles beside."""
PLAIN_JSON = ChannelKind("", b"", "json")


def mavlink_kind(direction: str) -> ChannelKind:
    """Return how raw frames of one direction are logged: MCAP has no schema for them, so the metadata says it."""
    told = {"dialect": MAVLINK_DIALECT, "direction": direction if direction in ("rx", "tx") else "other"}
    return ChannelKind("", b"", "mavlink", tuple(told.items()))


_EXCHANGE = _kind(
    _object(
        "swiftbot.Exchange", "What a gateway was asked and answered", verb=_STRING, gateway=_STRING, duration_ms=_NUMBER
    )
)
"""Request and reply are JSON of any form."""
_SIMPLE = ("string", "integer", "number", "boolean")


@cache
def _short_kind(kind: type[Struct]) -> ChannelKind:
    """How a struct is logged whose whole schema would be larger than most logs: with its simple fields alone."""
    whole = flat_schema(kind)
    fields = {name: part for name, part in whole["properties"].items() if part.get("type") in _SIMPLE}
    return ChannelKind(f"swiftbot.{kind.__name__}", msgspec.json.encode(whole | {"properties": fields}), "json")


_OF_VIEW = {"transform": TRANSFORM_KIND, "location": LOCATION_KIND}


def _kind_of(key: str) -> ChannelKind | None:
    """How what is put on a key of ours is logged; None where that is not JSON of one form."""
    topic = keyspace.topic_of(key)
    if topic is None or topic.form in ("query", "token"):
        return None
    if topic is keyspace.MAVLINK or topic is keyspace.LINK_FRAMES:
        return mavlink_kind(topic.names(key)[-1])
    if topic is keyspace.TRANSITION:
        return _short_kind(topic.payload)
    if topic is keyspace.EXCHANGE:
        return _EXCHANGE
    if topic is keyspace.CAMERA:
        return IMAGE_KIND
    if topic is keyspace.RECORDER_LOG:
        return LOG_KIND
    if topic is keyspace.RECORDER_VIEW:
        return _OF_VIEW.get(topic.names(key)[-1])
    return None if issubclass(topic.payload, Untyped) else struct_kind(topic.payload)


class KeySchemas:
    """The kinds of one fleet's keys. `kind_of` is asked once per key and encoding, not once per message."""

    def __init__(self, keys: Keys) -> None:
        self.keys = keys

    def kind_of(self, key: str, encoding: str) -> ChannelKind:
        """Return how messages of `key`, put with Zenoh encoding `encoding`, are described in a log."""
        kind = _kind_of(key)
        # A stranger's put on a key of ours is kept, but not called what it is not.
        if kind is not None and (kind.encoding != "json" or _is_json(encoding)):
            return kind
        if _is_json(encoding):
            return PLAIN_JSON
        return ChannelKind("", b"", encoding.partition(";")[0] or "application/octet-stream")


def _is_json(encoding: str) -> bool:
    """Whether a Zenoh encoding means JSON; a put without one is `zenoh/bytes`, which on a typed key is not trusted."""
    return encoding.partition(";")[0] in ("application/json", "text/json")
