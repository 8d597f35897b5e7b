"""Which key is logged as what."""

from typing import Any

import msgspec
import pytest
from msgspec import Struct

from appliance.model import LogLine, Notice, TaskRecord, encode, keyspace
from appliance.model.keys import Keys
from appliance.model.learning import ClientStatus, RunMetric
from appliance.record.models import LoggedMessage
from appliance.record.schemas import LOG_KIND, Foxglove, KeySchemas, flat_schema

KEYS = Keys("f1")
SCHEMAS = KeySchemas(KEYS)


def _log_of(message: LoggedMessage) -> bytes | None:
    """Return what the log panel is given of a message."""
    derive = Foxglove(KEYS, "rec").deriving(message.key)
    assert derive is not None
    made = derive(message)
    assert all(each.kind is LOG_KIND and each.topic == KEYS(keyspace.RECORDER_LOG, "rec") for each in made)
    return made[0].payload if made else None


@pytest.mark.parametrize(
    ("key", "schema", "encoding"),
    [
        (KEYS(keyspace.STATUS, "g1"), "swiftbot.GatewayStatus", "json"),
        (KEYS(keyspace.CONTAINER, "g1", "c1"), "swiftbot.ContainerInfo", "json"),
        (KEYS(keyspace.LOG, "g1"), "swiftbot.LogLine", "json"),
        (KEYS(keyspace.TASK_UPDATE, "t1"), "swiftbot.TaskRecord", "json"),
        (KEYS(keyspace.RUN_EVENT, "t1", "s1"), "swiftbot.RunEvent", "json"),
        (KEYS(keyspace.ROBOT, "r1"), "swiftbot.RobotInfo", "json"),
        (KEYS(keyspace.COMMANDED, "r1"), "swiftbot.RobotCommand", "json"),
        (KEYS(keyspace.CAMERA, "r1"), "foxglove.CompressedImage", "json"),
        (KEYS(keyspace.MAVLINK, "r1", "rx"), "", "mavlink"),
        (KEYS(keyspace.LINK_FRAMES, "g1", "udp-1", "tx"), "", "mavlink"),
        (KEYS(keyspace.ACT, "g1"), "swiftbot.Act", "json"),
        (KEYS(keyspace.STOP, "a1"), "swiftbot.SoftStop", "json"),
        (KEYS(keyspace.INTAKE, "r1"), "swiftbot.TaskRequest", "json"),
        (KEYS(keyspace.NOTICE, "ops"), "swiftbot.Notice", "json"),
        (KEYS(keyspace.RECORDER_STATUS, "rec"), "swiftbot.RecorderStatus", "json"),
        (KEYS(keyspace.TRANSITION, "t1"), "swiftbot.Transition", "json"),
        (KEYS(keyspace.EXCHANGE, "g1", "submit"), "swiftbot.Exchange", "json"),
        (KEYS(keyspace.LEARN_RUN, "r"), "swiftbot.RunRecord", "json"),
        (KEYS(keyspace.LEARN_ROUND, "r"), "swiftbot.RoundRecord", "json"),
        (KEYS(keyspace.LEARN_CLIENT, "r", "part-000"), "swiftbot.ClientStatus", "json"),
        (KEYS(keyspace.LEARN_METRIC, "r"), "swiftbot.RunMetric", "json"),
    ],
)
def test_each_key_has_its_kind(key: str, schema: str, encoding: str) -> None:
    """Every key of the fleet is logged under its struct's name, or without schema where none is known."""
    kind = SCHEMAS.kind_of(key, "application/json")
    assert (kind.schema, kind.encoding) == (schema, encoding)


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (ClientStatus, ("progress", "samples_s", "eta_s", "loss", "epoch_s")),
        (RunMetric, ("took_s", "all_s", "loss", "accuracy", "test_loss")),
    ],
)
def test_what_is_plotted_of_learning_is_a_number_in_a_field_of_its_own(
    kind: type[Struct], fields: tuple[str, ...]
) -> None:
    """Foxglove plots numbers by their path: each is one at the root, also those that may be missing."""
    properties = flat_schema(kind)["properties"]
    assert {properties[field]["type"] for field in fields} == {"number"}


def test_strangers_put_is_not_called_json() -> None:
    """Bytes put on a typed key under another encoding are kept under that encoding, without schema."""
    kind = SCHEMAS.kind_of(KEYS(keyspace.STATUS, "g1"), "zenoh/bytes")
    assert (kind.schema, kind.encoding) == ("", "zenoh/bytes")


def _nodes(node: Any) -> list[dict[str, Any]]:
    if isinstance(node, dict):
        return [node, *(found for value in node.values() for found in _nodes(value))]
    return []


@pytest.mark.parametrize(
    "key",
    [
        KEYS(keyspace.STATUS),
        KEYS(keyspace.CONTAINER),
        KEYS(keyspace.LOG),
        KEYS(keyspace.TASK_UPDATE),
        KEYS(keyspace.RUN_EVENT),
        KEYS(keyspace.ROBOT),
        KEYS(keyspace.COMMANDED),
        KEYS(keyspace.INTAKE),
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
    made = _log_of(LoggedMessage(KEYS(keyspace.LOG, "g1"), 1, encode(line)))
    assert made is not None
    assert msgspec.json.decode(made) == {
        "timestamp": {"sec": 1, "nsec": 500_000_000},
        "level": 3,
        "message": "container died id=c1",
        "name": "pool",
        "file": "",
        "line": 0,
    }
    assert _log_of(LoggedMessage(KEYS(keyspace.LOG, "g1"), 1, b"{")) is None


def test_notices_become_foxglove_log() -> None:
    """A notice to a person is in the log panel too, at its arrival when it has no time of its own."""
    made = _log_of(LoggedMessage(KEYS(keyspace.NOTICE, "ops"), 7, encode(Notice(id="n", to="ops", text="done"))))
    assert made is not None
    decoded = msgspec.json.decode(made)
    assert decoded["message"] == "to ops: done"
    assert decoded["timestamp"] == {"sec": 0, "nsec": 7}
