"""Which key carries which kind of message, told in the terms of MCAP, so that a log opens in Foxglove.

Foxglove wants a JSON schema whose root is an object and which has no unions; msgspec writes references and
`anyOf` with null. `flat_schema` inlines both. Keys without a known struct are logged as JSON without schema, raw
MAVLink frames with the message encoding `mavlink`, everything else under its Zenoh encoding.
"""

from functools import cache
from typing import Any, cast

import msgspec
from msgspec import Struct

from appliance.model import (
    ContainerInfo,
    GatewayStatus,
    LogLine,
    Notice,
    RobotCommand,
    RobotInfo,
    RunEvent,
    TaskRecord,
    TaskRequest,
)
from appliance.plane.keys import Keys
from appliance.record.expressions import compile_expression
from appliance.record.facts import Deletion, Gap, LoggedMessage, RecorderStatus

JsonSchema = dict[str, Any]

_TIME: JsonSchema = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
}

COMPRESSED_IMAGE: JsonSchema = {
    "title": "foxglove.CompressedImage",
    "description": "A compressed image",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": {"type": "string"},
    },
}
"""Well-known schema of the image panel."""

FOXGLOVE_LOG: JsonSchema = {
    "title": "foxglove.Log",
    "description": "A log message",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "level": {"type": "integer", "description": "0 unknown, 1 debug, 2 info, 3 warning, 4 error, 5 fatal"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer", "minimum": 0},
    },
}
"""Well-known schema of the log panel."""

_LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "exception": 4, "critical": 5, "fatal": 5}


class ChannelKind(Struct, frozen=True):
    """How messages of a key are described in a log: schema name and text (both empty: none), message encoding."""

    schema: str
    schema_text: bytes
    encoding: str


class FoxgloveTime(Struct, frozen=True):
    """A time as Foxglove's schemas have it."""

    sec: int
    nsec: int


class FoxgloveLog(Struct, frozen=True):
    """`foxglove.Log`: made by the recorder from log lines and notices, beside the originals."""

    timestamp: FoxgloveTime
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


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


IMAGE_KIND = ChannelKind("foxglove.CompressedImage", msgspec.json.encode(COMPRESSED_IMAGE), "json")
LOG_KIND = ChannelKind("foxglove.Log", msgspec.json.encode(FOXGLOVE_LOG), "json")
MAVLINK_KIND = ChannelKind("", b"", "mavlink")
PLAIN_JSON = ChannelKind("", b"", "json")


def _outline(name: str, **properties: str) -> ChannelKind:
    """A kind whose struct belongs to a room above: the fields that are always there, and whatever else comes."""
    schema = {"title": name, "type": "object", "properties": {key: {"type": kind} for key, kind in properties.items()}}
    return ChannelKind(f"swiftbot.{name}", msgspec.json.encode(schema), "json")


class KeySchemas:
    """The kinds of one fleet's keys. `kind_of` is asked once per key and encoding, not once per message."""

    def __init__(self, keys: Keys) -> None:
        self.keys = keys
        typed: list[tuple[str, ChannelKind]] = [
            (keys.status(), struct_kind(GatewayStatus)),
            (keys.container(), struct_kind(ContainerInfo)),
            (keys.log(), struct_kind(LogLine)),
            (keys.task(), struct_kind(TaskRecord)),
            (
                keys.transition(),
                _outline(
                    "Transition",
                    task="string",
                    sequence="integer",
                    kind="string",
                    at_ns="integer",
                    coordinator="string",
                    subtask="string",
                    attempt="integer",
                    gateway="string",
                    note="string",
                ),
            ),
            (
                keys.transfer(),
                _outline("Transfer", what="string", state="string", done_bytes="number", size_bytes="number"),
            ),
            (keys.exchange(), _outline("Exchange", verb="string", gateway="string", duration_ms="number")),
            (keys.run(), struct_kind(RunEvent)),
            (keys.robot(), struct_kind(RobotInfo)),
            (keys.commanded(), struct_kind(RobotCommand)),
            (keys.camera(), IMAGE_KIND),
            (keys.mavlink(), MAVLINK_KIND),
            (keys.intake(), struct_kind(TaskRequest)),
            (keys.notice(), struct_kind(Notice)),
            (keys.recorder_status(), struct_kind(RecorderStatus)),
            (keys.recorder_gap("*"), struct_kind(Gap)),
            (keys.recorder_deleted("*"), struct_kind(Deletion)),
            (keys.recorder_log("*"), LOG_KIND),
        ]
        self._typed = [(compile_expression(expression), kind) for expression, kind in typed]
        self._lines = compile_expression(keys.log())
        self._notices = compile_expression(keys.notice())

    def kind_of(self, key: str, encoding: str) -> ChannelKind:
        """Return how messages of `key`, put with Zenoh encoding `encoding`, are described in a log."""
        for pattern, kind in self._typed:
            if pattern.fullmatch(key):
                if kind.encoding == "json" and not _is_json(encoding):
                    break  # a stranger's put: keep it, but do not call it what it is not
                return kind
        if _is_json(encoding):
            return PLAIN_JSON
        return ChannelKind("", b"", encoding.partition(";")[0] or "application/octet-stream")

    def is_news(self, key: str) -> bool:
        """Whether messages of `key` also go to Foxglove's log panel."""
        return bool(self._lines.fullmatch(key) or self._notices.fullmatch(key))

    def as_foxglove_log(self, message: LoggedMessage) -> bytes | None:
        """Return a log line or notice as `foxglove.Log` JSON; None when its payload is malformed."""
        try:
            if self._notices.fullmatch(message.key):
                notice = msgspec.json.decode(message.payload, type=Notice)
                at_ns, level, text, name = notice.at_ns, 2, f"to {notice.to}: {notice.text}", notice.gateway
            else:
                line = msgspec.json.decode(message.payload, type=LogLine)
                fields = " ".join(f"{key}={value}" for key, value in line.fields.items())
                at_ns, name = line.at_ns, line.source
                level, text = _LEVELS.get(line.level.lower(), 0), f"{line.event} {fields}".rstrip()
        except msgspec.MsgspecError:
            return None
        seconds, nanos = divmod(max(0, at_ns or message.at_ns), 1_000_000_000)
        return msgspec.json.encode(FoxgloveLog(FoxgloveTime(seconds, nanos), level, text, name))


def _is_json(encoding: str) -> bool:
    """Whether a Zenoh encoding means JSON; a put without one is `zenoh/bytes`, which on a typed key is not trusted."""
    return encoding.partition(";")[0] in ("application/json", "text/json")
