"""One channel for all keys of a kind: few channels whatever the load, and every message under its own key again."""

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import (
    ContainerInfo,
    ContainerState,
    RobotInfo,
    RunEvent,
    RunEventKind,
    TaskRecord,
    encode,
    keyspace,
)
from appliance.model.keys import Keys
from appliance.model.plane_api import Exchange
from appliance.record.channels import FIELDS, TEMPLATE, shared_for, shared_of
from appliance.record.edit import Select, cat, copy
from appliance.record.layout import layout
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from appliance.record.segments import JSON, LogWriter
from appliance.record.settings import RecordConfig
from tests.unit.test_cli_faults_seen import run

KEYS = Keys("f1")
NAMES = st.from_regex(r"[a-z0-9][a-z0-9_.-]{0,20}", fullmatch=True)


def message(key: str, payload: bytes, number: int = 0) -> LoggedMessage:
    """Return a put of JSON."""
    return LoggedMessage(key, 1_000_000_000 + number, payload, JSON)


def busy(tasks: int, robots: int) -> list[LoggedMessage]:
    """Return what a fleet puts while it does so many tasks with so many robots."""
    found: list[tuple[str, bytes]] = []
    for number in range(tasks):
        task = f"t-{number}"
        found.append((KEYS(keyspace.TASK_UPDATE, task), encode(TaskRecord(id=task, instruction="x"))))
        for subtask in ("s1", "s2"):
            event = RunEvent(task=task, subtask=subtask, attempt=1, kind=RunEventKind.STARTED, gateway="gw-1")
            found.append((KEYS(keyspace.RUN_EVENT, task, subtask), encode(event)))
        container = ContainerInfo(id=f"c{number}", gateway="gw-1", image="base", state=ContainerState.READY)
        found.append((KEYS(keyspace.CONTAINER, "gw-1", f"c{number}"), encode(container)))
        verb = f"verb_{number % 50}"
        exchange = Exchange(verb=verb, gateway="gw-2", request=msgspec.Raw(b"{}"), duration_ms=1.0)
        found.append((KEYS(keyspace.EXCHANGE, "gw-2", verb), encode(exchange)))
    for number in range(robots):
        robot = f"drone_{number}"
        found.append((KEYS(keyspace.ROBOT, robot), encode(RobotInfo(id=robot, kind="mavlink"))))
        found += [(KEYS(keyspace.MAVLINK, robot, way), b"\xfd\x00") for way in ("rx", "tx")]
    return [message(key, payload, number) for number, (key, payload) in enumerate(found)]


def written(folder: Path, messages: list[LoggedMessage]) -> Path:
    """Record messages into one file."""
    writer = LogWriter(RecordConfig(directory=str(folder)), fleet="f1")
    for each in messages:
        writer.write(each)
    writer.close()
    (path,) = folder.glob("*.mcap")
    return path


def test_a_busy_hour_has_few_channels_and_every_message_its_key(tmp_path: Path) -> None:
    """Two thousand tasks and 64 vehicles: at most 200 channels, and what is read is what was put."""
    messages = busy(2000, 64)
    path = written(tmp_path, messages)
    found = info(path)
    assert found.messages == len(messages)
    assert len(found.channels) <= 200
    assert "swiftbot/f1/task/record" in {each.key for each in found.channels}
    assert [(each.key, each.payload) for each in read(path)] == [(each.key, each.payload) for each in messages]


def test_keys_select_messages_of_shared_channels(tmp_path: Path) -> None:
    """Reading, cutting and merging go by the key of a message, not by its channel."""
    path = written(tmp_path, busy(5, 2))
    keys = [each.key for each in read(path, keys="**/task/t-3/**")]
    assert keys == ["swiftbot/f1/task/t-3/record", "swiftbot/f1/task/t-3/run/s1", "swiftbot/f1/task/t-3/run/s2"]
    copy([path], tmp_path / "cut", Select(keys=("swiftbot/f1/gw/gw-1/pool/c4",)))
    assert [each.key for each in read(tmp_path / "cut")] == ["swiftbot/f1/gw/gw-1/pool/c4"]


@pytest.mark.parametrize(
    ("key", "payload"),
    [
        ("swiftbot/f1/task/t-1/record", b'{"id":"t-2","instruction":"x"}'),
        ("swiftbot/f1/task/t-1/record", b'{"id":7}'),
        ("swiftbot/f1/task/t-1/record", b"[" * 100_000),
        ("swiftbot/f1/task/t-1/record", b"\xff"),
        ("swiftbot/f1/task/t-1/run/s1", b'{"task":"t-1"}'),
        ("swiftbot/f1/task/a/b/record", b'{"id":"a/b"}'),
        ("elsewhere/task/t-1/record", b'{"id":"t-1"}'),
    ],
)
def test_what_says_something_else_than_its_key_keeps_its_own(key: str, payload: bytes, tmp_path: Path) -> None:
    """It is recorded and read as it was put; nothing is taken for another task's."""
    assert shared_for(key, payload) is None
    path = written(tmp_path, [message(key, payload)])
    assert [(each.key, each.payload) for each in read(path)] == [(key, payload)]


@settings(deadline=None)
@given(NAMES, NAMES, NAMES)
def test_a_key_and_its_message_lead_to_each_other(fleet: str, task: str, subtask: str) -> None:
    """Whatever the names are, as long as they can be names."""
    key = Keys(fleet)(keyspace.RUN_EVENT, task, subtask)
    payload = encode(RunEvent(task=task, subtask=subtask, attempt=1, kind=RunEventKind.ALIVE, gateway="g"))
    shared = shared_for(key, payload)
    assert shared is not None
    again = shared_of(shared.topic, shared.metadata)
    assert again is not None
    assert again.key_of(payload) == key


@settings(deadline=None)
@given(st.text(max_size=20), st.dictionaries(st.sampled_from((TEMPLATE, FIELDS)), st.text(max_size=20)))
def test_metadata_of_strangers_make_no_channel_of_ours(topic: str, metadata: dict[str, str]) -> None:
    """Logs come from anywhere."""
    shared = shared_of(topic, metadata)
    assert shared is None or shared.topic == topic


def test_a_task_can_be_looked_at_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`log cat --task`: its record, transitions and runs, and no other's."""
    path = written(tmp_path, busy(12, 1))
    assert run("log", "cat", str(path), "--task", "t-1", "--json") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [each["key"].partition("/task/")[2] for each in lines] == ["t-1/record", "t-1/run/s1", "t-1/run/s2"]


def test_every_topic_that_shares_a_channel_says_so_in_its_payload() -> None:
    """The fields are there, as many as there are names in the key."""
    for topic in keyspace.TOPICS:
        if topic.inside:
            assert len(topic.inside) == len(topic.fields), topic.text
            known: dict[str, Any] = {each.encode_name: each for each in msgspec.structs.fields(topic.payload)}
            assert all(known[name].required for name in topic.inside), topic.text


def test_the_layout_names_channels_that_a_log_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each topic in it is one that the recorder writes; it is printed as JSON."""
    text = msgspec.json.encode(layout("f1", "recorder")).decode()
    for topic in ("task/record", "task/transition", "robot/state", "recorder/recorder/robots/transform"):
        assert f"swiftbot/f1/{topic}" in text
    assert run("log", "layout", "--fleet", "f1") == 0
    assert json.loads(capsys.readouterr().out) == layout("f1", "recorder")
    del tmp_path


def test_cat_prints_the_keys(tmp_path: Path) -> None:
    """In text as in JSON the key is the message's."""
    lines: list[str] = []
    cat([written(tmp_path, busy(1, 0))], Select(), write=lines.append)
    assert "swiftbot/f1/task/t-0/run/s2" in "".join(lines)
