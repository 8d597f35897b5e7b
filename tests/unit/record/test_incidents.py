"""Incidents: which messages are one, and what is kept around them."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Plan, RobotInfo, SoftStop, Subtask, TaskRecord, TaskState, encode, keyspace
from appliance.model.keys import Keys
from appliance.model.recorder_api import Incident, Trigger
from appliance.record.incidents import EACH, EVERY, Ring, Triggers
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from appliance.record.recorder import Pipeline
from appliance.record.segments import LogWriter
from appliance.record.settings import RecordConfig

KEYS = Keys("f1")
JSON = "application/json"
FAILED = TaskRecord(id="t1", instruction="x", state=TaskState.FAILED)


def _of(key: str, payload: bytes) -> LoggedMessage:
    return LoggedMessage(key, 1000, payload, JSON)


def _incident(triggers: Triggers, key: str, payload: bytes) -> Incident | None:
    kind = triggers.watches(key)
    return triggers.incident(kind, _of(key, payload)) if kind else None


def test_a_failed_task_is_an_incident_once() -> None:
    """When it fails, not each time its record is published again; one of its subtasks failing is none."""
    triggers = Triggers(KEYS, "rec")
    running = encode({"id": "t1", "state": "running", "subtasks": [{"state": "failed"}]})
    assert _incident(triggers, KEYS(keyspace.TASK_UPDATE, "t1"), running) is None
    found = _incident(triggers, KEYS(keyspace.TASK_UPDATE, "t1"), encode(FAILED))
    assert found is not None
    assert (found.reason, found.key) == ("task failed", KEYS(keyspace.TASK_UPDATE, "t1"))
    assert _incident(triggers, KEYS(keyspace.TASK_UPDATE, "t1"), encode(FAILED)) is None
    assert _incident(triggers, KEYS(keyspace.TASK_UPDATE, "t2"), encode(FAILED)) is not None


def test_a_failsafe_is_an_incident_when_it_begins() -> None:
    """A robot's state tells it several times a second; the next failsafe is another incident."""
    triggers = Triggers(KEYS, "rec")
    calm = encode(RobotInfo(id="r1", kind="mavlink"))
    unwell = encode({"id": "r1", "failsafe": "battery low"})
    told = [_incident(triggers, KEYS(keyspace.ROBOT, "r1"), each) for each in (calm, unwell, unwell, calm, unwell)]
    assert [each.reason if each else "" for each in told] == ["", "failsafe", "", "", "failsafe"]


@pytest.mark.parametrize(
    "calm",
    [
        b'{"id": "r1", "failsafe": ""}',
        b'{"id": "r1", "failsafe" : null }',
        b'{"id": "r1", "failsafe": false, "note": "the \\"failsafe\\": fence has ended"}',
        b'{"id":"r1","note":"x","limits":{"failsafe":"of something else"}}',
        b'{"id": "r1", "failsafe": [], "failsafes": 0}',
    ],
)
def test_a_robot_that_is_well_is_no_incident(calm: bytes) -> None:
    """However it writes that it has no failsafe, with spaces too; so that the next one is not taken for an old one."""
    triggers = Triggers(KEYS, "rec")
    assert _incident(triggers, KEYS(keyspace.ROBOT, "r1"), calm) is None
    found = _incident(triggers, KEYS(keyspace.ROBOT, "r1"), b'{"id": "r1", "failsafe": "battery low"}')
    assert found is not None
    assert found.reason == "failsafe"


@pytest.mark.parametrize("payload", [b'{"failsafe":', b'["failsafe"]', b'{"failsafe":' + b"[" * 20_000, b'"failsafe"'])
def test_states_that_are_none_are_no_incident(payload: bytes) -> None:
    """A stranger's put on a robot's key stops nobody."""
    assert _incident(Triggers(KEYS, "rec"), KEYS(keyspace.ROBOT, "r1"), payload) is None


def test_a_soft_stop_is_an_incident_once() -> None:
    """The gateway that keeps it tells it again; a second stop is another."""
    triggers = Triggers(KEYS, "rec")
    stop = encode(SoftStop(id="a1", by="kim"))
    told = [_incident(triggers, KEYS(keyspace.STOP, act), stop) for act in ("a1", "a1", "a2")]
    assert [each.reason if each else "" for each in told] == ["stop", "", "stop"]


@pytest.mark.parametrize(("recorder", "heard"), [("rec", True), (EVERY, True), ("other", False)])
def test_somebody_asks(recorder: str, heard: bool) -> None:
    """A trigger is heard by the recorder it names, and by all if it names all; a malformed one by none."""
    triggers = Triggers(KEYS, "rec")
    found = _incident(
        triggers, KEYS(keyspace.RECORDER_TRIGGER, recorder), encode(Trigger(reason="odd noise", by="kim"))
    )
    assert (found is not None) == heard
    if found is not None:
        assert (found.reason, found.detail) == ("asked", "odd noise (by kim)")
    assert _incident(triggers, KEYS(keyspace.RECORDER_TRIGGER, recorder), b"{") is None


@given(st.lists(st.tuples(st.floats(0, 3), st.integers(0, 50)), max_size=60))
def test_the_ring_holds_the_last_seconds_within_its_bytes(steps: list[tuple[float, int]]) -> None:
    """What it gives back is the newest part of what came, in order, neither too old nor too large."""
    ring, now, came = Ring(seconds=5.0, most_bytes=1200), 0.0, []
    for wait, size in steps:
        now += wait
        message = LoggedMessage("k", len(came) + 1, b"x" * size)
        came.append((now, message))
        ring.hold(message, now)
    held, back_s = ring.release(now)
    assert held == [each for _, each in came][len(came) - len(held) :]
    assert sum(len(each.payload) + 1 + EACH for each in held) <= 1200
    assert back_s <= 5.0 + 1e-9
    assert len(ring) == 0


def test_the_ring_takes_no_more_than_it_may() -> None:
    """Small messages count with all that keeping them takes, not by the few bytes of their payload."""
    most = 2 * 2**20
    ring = Ring(seconds=1e9, most_bytes=most)
    tracemalloc.start()
    try:
        for number in range(40_000):
            key = f"swiftbot/f1/robot/r{number % 40}/state"
            ring.hold(LoggedMessage(key, 10**18 + number, b"%020d" % number, JSON), float(number))
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most / 3 < taken <= most


@pytest.fixture
def recorder(tmp_path: Path) -> Callable[[list[float]], tuple[Pipeline, LogWriter]]:
    """Return what makes a recorder for incidents, with a clock that the test moves."""

    def make(now: list[float]) -> tuple[Pipeline, LogWriter]:
        config = RecordConfig(
            directory=str(tmp_path), free_bytes=0, fsync=False, mode="incidents", before_s=10.0, after_s=5.0
        )
        writer = LogWriter(config, fleet="f1", clock=lambda: now[0])
        writer.prepare()
        return Pipeline(config, fleet="f1", writer=writer, clock=lambda: now[0]), writer

    return make


def test_only_what_is_around_an_incident_is_written(
    recorder: Callable[[list[float]], tuple[Pipeline, LogWriter]],
) -> None:
    """Nothing while all is well; then the seconds before, the incident and the seconds after, in a file of its own."""
    now = [100.0]
    pipeline, writer = recorder(now)

    def second(number: int) -> None:
        now[0] = 100.0 + number
        if number in (20, 60):
            pipeline.write(_of(KEYS(keyspace.TASK_UPDATE, f"t{number}"), encode(FAILED)))
        pipeline.write(LoggedMessage(KEYS(keyspace.NOTICE, "ops"), number + 1, b'{"n":%d}' % number, JSON))
        pipeline.tick()

    for number in range(100):
        second(number)
    writer.close()
    assert len(writer.files) == 2
    found = [
        [msgspec.json.decode(each.payload)["n"] for each in read(path, keys=KEYS(keyspace.NOTICE))]
        for path in writer.files
    ]
    assert found == [list(range(10, 26)), list(range(50, 66))]
    told = [info(path) for path in writer.files]
    assert [each.recovered for each in told] == [False, False]
    assert [(each.incidents[0].reason, each.incidents[0].before_s) for each in told] == [("task failed", 10.0)] * 2
    assert pipeline.gate.incidents == 2


def test_gaps_alone_are_no_incident(recorder: Callable[[list[float]], tuple[Pipeline, LogWriter]]) -> None:
    """What was not heard waits until a file is begun for another reason, and stands in that one."""
    now = [100.0]
    pipeline, writer = recorder(now)
    for number in range(20):
        now[0] += 1.0
        writer.miss("gw-1", 1, "gw/gw-1/mavlink/0/rx", number + 1)
        pipeline.tick()
    assert not writer.files
    pipeline.write(_of(KEYS(keyspace.TASK_UPDATE, "t1"), encode(FAILED)))
    pipeline.tick()
    writer.close()
    assert len(writer.files) == 1


def test_plans_are_attached(tmp_path: Path) -> None:
    """The plan that a transition brings is attached under its task and place, so that it is found at once."""
    config = RecordConfig(directory=str(tmp_path), free_bytes=0, fsync=False)
    writer = LogWriter(config, fleet="f1")
    writer.prepare()
    pipeline = Pipeline(config, fleet="f1", writer=writer)
    plan = Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="goto"),))
    planned = {"task": "t-1", "sequence": 2, "kind": "planned", "plan": plan, "at_ns": 1, "coordinator": "g1"}
    pipeline.write(_of(KEYS(keyspace.TRANSITION, "t-1"), encode(planned)))
    for number, (kind, its) in enumerate(
        (("dispatched", None), ("proposed", plan), ("approved", plan), ("approved", None), ("replanned", plan)), start=3
    ):
        pipeline.write(
            _of(KEYS(keyspace.TRANSITION, "t-1"), encode(planned | {"sequence": number, "kind": kind, "plan": its}))
        )
    writer.close()
    assert info(writer.files[0]).attachments == tuple(f"plan-t-1-{number}.json" for number in (2, 4, 5, 7))
