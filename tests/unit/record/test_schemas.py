"""Which key is logged as what."""

from typing import Any

import msgspec
import pytest

from appliance.model import LogLine, Notice, TaskRecord, encode
from appliance.plane.keys import Keys
from appliance.record.models import LoggedMessage
from appliance.record.schemas import LOG_KIND, Foxglove, KeySchemas, flat_schema

KEYS = Keys("f1")
SCHEMAS = KeySchemas(KEYS)


def _log_of(message: LoggedMessage) -> bytes | None:
    """Return what the log panel is given of a message."""
    derive = Foxglove(KEYS, "rec").deriving(message.key)
    assert derive is not None
    made = derive(message)
    assert all(each.kind is LOG_KIND and each.topic == KEYS.recorder_log("rec") for each in made)
    return made[0].payload if made else None


@pytest.mark.parametrize(
    ("key", "schema", "encoding"),
    [
        (KEYS.status("g1"), "swiftbot.GatewayStatus", "json"),
        (KEYS.container("g1", "c1"), "swiftbot.ContainerInfo", "json"),
        (KEYS.log("g1"), "swiftbot.LogLine", "json"),
        (KEYS.task("t1"), "swiftbot.TaskRecord", "json"),
        (KEYS.run("t1", "s1"), "swiftbot.RunEvent", "json"),
        (KEYS.robot("r1"), "swiftbot.RobotInfo", "json"),
        (KEYS.commanded("r1"), "swiftbot.RobotCommand", "json"),
        (KEYS.camera("r1"), "foxglove.CompressedImage", "json"),
        (KEYS.mavlink("r1", "rx"), "", "mavlink"),
        (KEYS.link_frames("g1", "udp-1", "tx"), "", "mavlink"),
        (KEYS.act("g1"), "swiftbot.Act", "json"),
        (KEYS.soft_stop("a1"), "swiftbot.SoftStop", "json"),
        (KEYS.intake("r1"), "swiftbot.TaskRequest", "json"),
        (KEYS.notice("ops"), "swiftbot.Notice", "json"),
        (KEYS.recorder_status("rec"), "swiftbot.RecorderStatus", "json"),
        (KEYS.transition("t1"), "swiftbot.Transition", "json"),
        (KEYS.exchange("g1", "submit"), "swiftbot.Exchange", "json"),
    ],
)
def test_each_key_has_its_kind(key: str, schema: str, encoding: str) -> None:
    """Every key of the fleet is logged under its struct's name, or without schema where none is known."""
    kind = SCHEMAS.kind_of(key, "application/json")
    assert (kind.schema, kind.encoding) == (schema, encoding)


def test_strangers_put_is_not_called_json() -> None:
    """Bytes put on a typed key under another encoding are kept under that encoding, without schema."""
    kind = SCHEMAS.kind_of(KEYS.status("g1"), "zenoh/bytes")
    assert (kind.schema, kind.encoding) == ("", "zenoh/bytes")


def _nodes(node: Any) -> list[dict[str, Any]]:
    if isinstance(node, dict):
        return [node, *(found for value in node.values() for found in _nodes(value))]
    return []


@pytest.mark.parametrize(
    "key",
    [
        KEYS.status(),
        KEYS.container(),
        KEYS.log(),
        KEYS.task(),
        KEYS.run(),
        KEYS.robot(),
        KEYS.commanded(),
        KEYS.intake(),
    ],
)
def test_schemas_are_what_foxglove_takes(key: str) -> None:
    """Root is an object, nothing refers elsewhere or is a union, and every field says its type."""
    schema = msgspec.json.decode(SCHEMAS.kind_of(key, "application/json").schema_text)
    assert schema["type"] == "object"
    for node in _nodes(schema):
        assert not {"$ref", "anyOf", "$defs"} & node.keys()
        for field in node.get("properties", {}).values():
            assert "type" in field


def test_nested_structs_are_inlined() -> None:
    """A task's subtasks are described down to their plan's skill."""
    schema = flat_schema(TaskRecord)
    subtask = schema["properties"]["subtasks"]["items"]["properties"]["subtask"]
    assert subtask["properties"]["skill"]["type"] == "string"


def test_log_lines_become_foxglove_log() -> None:
    """A log line goes to the log panel with its level, time and fields; a malformed one does not."""
    line = LogLine(at_ns=1_500_000_000, level="warning", source="pool", event="container died", fields={"id": "c1"})
    made = _log_of(LoggedMessage(KEYS.log("g1"), 1, encode(line)))
    assert made is not None
    assert msgspec.json.decode(made) == {
        "timestamp": {"sec": 1, "nsec": 500_000_000},
        "level": 3,
        "message": "container died id=c1",
        "name": "pool",
        "file": "",
        "line": 0,
    }
    assert _log_of(LoggedMessage(KEYS.log("g1"), 1, b"{")) is None


def test_notices_become_foxglove_log() -> None:
    """A notice to a person is in the log panel too, at its arrival when it has no time of its own."""
    made = _log_of(LoggedMessage(KEYS.notice("ops"), 7, encode(Notice(id="n", to="ops", text="done"))))
    assert made is not None
    decoded = msgspec.json.decode(made)
    assert decoded["message"] == "to ops: done"
    assert decoded["timestamp"] == {"sec": 0, "nsec": 7}
