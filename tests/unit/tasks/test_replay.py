"""Replaying a log: the same states when it is whole, and the difference named when it is not."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.writer import Writer
from msgspec.structs import replace

from appliance.errors import RecordError
from appliance.model import Failure, Plan, Split, Subtask, TaskRecord, TaskState
from appliance.tasks import machine
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.replay import replay

PLAN = Plan(
    domain="navigation", subtasks=(Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "dock 1"}),)
)


def history(*steps: tuple[TransitionKind, dict[str, object]]) -> tuple[list[Transition], TaskRecord]:
    """Build the transitions of a task and its last record."""
    transitions: list[Transition] = []
    record: TaskRecord | None = None
    for number, (kind, fields) in enumerate(steps, start=1):
        event = Transition(task="t-1", sequence=number, kind=kind, at_ns=number, coordinator="gw-1", **fields)  # type: ignore[arg-type]
        record = machine.apply(record, event)
        transitions.append(event)
    assert record is not None
    return transitions, record


def write(path: Path, transitions: Sequence[Transition], *records: TaskRecord) -> Path:
    """Write a log of transitions and records."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        topics: dict[str, int] = {}
        for at, (topic, value) in enumerate(
            [("transition", each) for each in transitions] + [("record", each) for each in records]
        ):
            key = f"swiftbot/f/task/t-1/{topic}"
            if key not in topics:
                topics[key] = writer.register_channel(key, "json", 0)
            writer.add_message(topics[key], at, msgspec.json.encode(value), at)
        writer.finish()
    return path


STEPS: tuple[tuple[TransitionKind, dict[str, object]], ...] = (
    (TransitionKind.ACCEPTED, {"instruction": "x"}),
    (TransitionKind.PLANNED, {"plan": PLAN}),
    (TransitionKind.DISPATCHED, {"subtask": "s1", "attempt": 1, "gateway": "gw-1"}),
    (TransitionKind.STARTED, {"subtask": "s1", "attempt": 1, "gateway": "gw-1"}),
    (TransitionKind.SUCCEEDED, {"subtask": "s1", "attempt": 1, "gateway": "gw-1", "result": {"place": "dock 1"}}),
)


def test_a_whole_log_replays_to_the_same_state(tmp_path: Path) -> None:
    """Folding the logged transitions gives the logged record."""
    transitions, record = history(*STEPS)
    report = replay(write(tmp_path / "a.mcap", transitions, record))
    assert report.same
    assert report.tasks[0].replayed == "succeeded"


def test_a_missing_transition_is_named(tmp_path: Path) -> None:
    """A gap in the log is a difference, with the place where it is."""
    transitions, record = history(*STEPS)
    report = replay(write(tmp_path / "a.mcap", transitions[:2] + transitions[3:], record))
    assert not report.same
    assert any("gap before transition 4" in each for each in report.tasks[0].differences)


def test_another_end_state_is_named(tmp_path: Path) -> None:
    """A record that its transitions do not give is reported with both states."""
    transitions, record = history(*STEPS)
    wrong = msgspec.structs.replace(record, state=TaskState.FAILED, failure=Failure(code="x", message="x"))
    report = replay(write(tmp_path / "a.mcap", transitions, wrong))
    assert "task: logged failed, replayed succeeded" in report.tasks[0].differences


def test_a_takeover_goes_on_from_the_last_written_record(tmp_path: Path) -> None:
    """Progress the dead coordinator published but did not write is rewound, as the new one did."""
    transitions, written = history(*STEPS[:4])
    told = Transition(
        task="t-1",
        sequence=5,
        kind=TransitionKind.PROGRESS,
        at_ns=5,
        coordinator="gw-1",
        subtask="s1",
        attempt=1,
        progress=0.5,
    )
    adopted = Transition(task="t-1", sequence=5, kind=TransitionKind.ADOPTED, at_ns=6, coordinator="gw-2")
    after = machine.apply(written, adopted)
    done = Transition(
        task="t-1", sequence=6, kind=TransitionKind.SUCCEEDED, at_ns=7, coordinator="gw-2", subtask="s1", attempt=1
    )
    report = replay(write(tmp_path / "a.mcap", [*transitions, told, adopted, done], machine.apply(after, done)))
    assert report.same, report


def test_a_log_without_tasks_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    """There is nothing to compare, which is not the same as no difference."""
    with pytest.raises(RecordError, match="holds no task"):
        replay(write(tmp_path / "a.mcap", []))


def test_unreadable_payloads_are_counted(tmp_path: Path) -> None:
    """Garbage under a task's key does not end the replay."""
    transitions, record = history(*STEPS)
    path = write(tmp_path / "a.mcap", transitions, record)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        first = writer.register_channel("swiftbot/f/task/t-1/transition", "json", 0)
        second = writer.register_channel("swiftbot/f/task/t-1/record", "json", 0)
        writer.add_message(first, 0, b"\xffnot json", 0)
        for each in transitions:
            writer.add_message(first, each.sequence, msgspec.json.encode(each), each.sequence)
        writer.add_message(second, 9, msgspec.json.encode(record), 9)
        writer.finish()
    report = replay(path)
    assert report.unreadable == 1
    assert report.same


def test_a_log_of_both_sides_of_a_partition_replays_to_the_version_that_stands(tmp_path: Path) -> None:
    """What the side that lost went on telling is left out; the other's move, adoption and healing are folded."""
    common, _ = history(*STEPS[:4])
    gw2 = {"coordinator": "gw-2"}

    def step(kind: TransitionKind, sequence: int, **fields: object) -> Transition:
        named: dict[str, Any] = {"task": "t-1", "sequence": sequence, "kind": kind, "at_ns": 1, "coordinator": "gw-1"}
        return Transition(**(named | fields))

    split = Split(coordinator="gw-1", sequence=6, state=TaskState.RUNNING, settled=True)
    mine = [
        step(TransitionKind.MOVED, 5, subtask="s1", attempt=1, gateway="gw-3", note="moved", **gw2),
        step(TransitionKind.HEALED, 6, splits=(split,), fences={"s1": 4}, **gw2),
        step(TransitionKind.SUCCEEDED, 7, subtask="s1", attempt=2, gateway="gw-3", result={"place": "x"}, **gw2),
    ]
    adopted = [step(TransitionKind.ADOPTED, 5, **gw2), *(replace(each, sequence=each.sequence + 1) for each in mine)]
    failure = Failure(code="unreachable", message="x")
    lost = [
        step(TransitionKind.PROGRESS, 5, subtask="s1", attempt=1, progress=0.5),
        step(TransitionKind.ATTEMPT_FAILED, 6, subtask="s1", attempt=1, failure=failure),
    ]
    record: TaskRecord | None = None
    for each in (*common, *adopted):
        record = machine.apply(record, each)
    assert record is not None
    assert record.subtasks[0].attempts[0].left == "moved"
    log = [*common, adopted[0], lost[0], *adopted[1:3], lost[1], *adopted[3:]]
    (outcome,) = replay(write(tmp_path / "x.mcap", log, record)).tasks
    assert outcome.same, outcome.differences
    assert outcome.stale == 2
