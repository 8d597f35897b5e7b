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
    Act,
    ContainerInfo,
    Enquiry,
    GatewayStatus,
    Lease,
    Lifted,
    LogLine,
    Notice,
    RobotCommand,
    RobotInfo,
    RunEvent,
    SoftStop,
    TaskRecord,
    TaskRequest,
)
from appliance.plane.keys import Keys
from appliance.record.expressions import compile_expression
from appliance.record.facts import Deletion, Gap, Incident, RecorderStatus, Trigger
from appliance.record.foxglove import IMAGE_KIND, LOCATION_KIND, LOG_KIND, POSE_KIND, TRANSFORM_KIND, ChannelKind

JsonSchema = dict[str, Any]


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
    told = {"dialect": MAVLINK_DIALECT, "direction": direction if direction != "*" else "other"}
    return ChannelKind("", b"", "mavlink", tuple(told.items()))


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
            *(
                (expression, mavlink_kind(each))
                for each in ("rx", "tx", "*")
                for expression in (keys.mavlink(direction=each), keys.link_frames(direction=each))
            ),
            (keys.act(), struct_kind(Act)),
            (keys.soft_stop(), struct_kind(SoftStop)),
            (keys.lifted(), struct_kind(Lifted)),
            (keys.lease(), struct_kind(Lease)),
            (keys.enquiry(), struct_kind(Enquiry)),
            *((keys.link_frames(direction=each), mavlink_kind(each)) for each in ("rx", "tx", "*")),
            (keys.intake(), struct_kind(TaskRequest)),
            (keys.notice(), struct_kind(Notice)),
            (keys.recorder_status(), struct_kind(RecorderStatus)),
            (keys.recorder_trigger(), struct_kind(Trigger)),
            (keys.recorder_incident("*"), struct_kind(Incident)),
            (keys.decided(), _outline("Decided", task="string", subtask="string")),
            (keys.recorder_gap("*"), struct_kind(Gap)),
            (keys.recorder_deleted("*"), struct_kind(Deletion)),
            (keys.recorder_log("*"), LOG_KIND),
            (keys.recorder_view("*", "*", "pose"), POSE_KIND),
            (keys.recorder_view("*", "*", "transform"), TRANSFORM_KIND),
            (keys.recorder_view("*", "*", "location"), LOCATION_KIND),
        ]
        self._typed = [(compile_expression(expression), kind) for expression, kind in typed]

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


def _is_json(encoding: str) -> bool:
    """Whether a Zenoh encoding means JSON; a put without one is `zenoh/bytes`, which on a typed key is not trusted."""
    return encoding.partition(";")[0] in ("application/json", "text/json")
