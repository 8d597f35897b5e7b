"""Making a log's decisions again: the same when nothing has changed, the first difference when something has."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.writer import Writer
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import RecordError
from appliance.model import (
    ContainerInfo,
    ContainerState,
    Failure,
    GatewayStatus,
    Need,
    Plan,
    RobotInfo,
    Subtask,
    SubtaskRecord,
    TaskRecord,
    TaskState,
    VolumeInfo,
    keyspace,
)
from appliance.model.keys import Keys
from appliance.model.transitions import fingerprint
from appliance.pool.decisions import EvictionCase, selection_case
from appliance.pool.policies import Idle
from appliance.pool.selection import Candidate, Facts, Link, select
from appliance.pool.settings import PoolConfig
from appliance.tasks import machine
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.placement import Asked, place, placement_case
from appliance.tasks.replay import check
from appliance.tasks.settings import TasksConfig

KEYS = Keys("f")
PLAN = Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="goto"),))
LOST = Failure(code="unreachable", message="gw-1 was lost", retryable=True)
STEPS: tuple[tuple[TransitionKind, dict[str, Any]], ...] = (
    (TransitionKind.ACCEPTED, {"instruction": "x"}),
    (TransitionKind.PLANNED, {"plan": PLAN}),
    (TransitionKind.DISPATCHED, {"subtask": "s1", "attempt": 1, "gateway": "gw-1"}),
    (TransitionKind.ATTEMPT_FAILED, {"subtask": "s1", "attempt": 1, "failure": LOST, "give_up": False, "retries": 1}),
    (TransitionKind.DISPATCHED, {"subtask": "s1", "attempt": 2, "gateway": "gw-2"}),
    (TransitionKind.SUCCEEDED, {"subtask": "s1", "attempt": 2, "gateway": "gw-2", "result": {}}),
)


def history(*steps: tuple[TransitionKind, dict[str, Any]]) -> list[tuple[str, Struct]]:
    """Return the transitions of a task with the record after each, under their keys."""
    told: list[tuple[str, Struct]] = []
    record: TaskRecord | None = None
    for number, (kind, fields) in enumerate(steps, start=1):
        event = Transition(
            **({"task": "t-1", "sequence": number, "kind": kind, "at_ns": number, "coordinator": "gw-1"} | fields)
        )
        record = machine.apply(record, event)
        told += [(KEYS(keyspace.TRANSITION, "t-1"), event), (KEYS(keyspace.TASK_UPDATE, "t-1"), record)]
    return told


def write(path: Path, told: Iterable[tuple[str, Struct]]) -> Path:
    """Write a log."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        topics: dict[str, int] = {}
        for at, (key, value) in enumerate(told, start=1):
            if key not in topics:
                topics[key] = writer.register_channel(key, "json", 0)
            writer.add_message(topics[key], at, msgspec.json.encode(value), at)
        writer.finish()
    return path


def test_an_unchanged_history_comes_out_the_same(tmp_path: Path) -> None:
    """Each transition, each record and the retry policy is checked."""
    report = check([write(tmp_path / "a.mcap", history(*STEPS))])
    assert report.same
    assert report.checked == {"machine": 6, "record": 6, "retry": 1}
    assert report.unchecked == {}


def test_the_first_difference_is_shown_with_both_sides(tmp_path: Path) -> None:
    """A record that does not follow from the transitions before it is found where it is, not at the end."""
    told = history(*STEPS)
    key, record = told[9]
    assert isinstance(record, TaskRecord)
    changed = replace(record, subtasks=(replace(record.subtasks[0], gateway="gw-9"),))
    told[9] = (key, changed)
    report = check([write(tmp_path / "a.mcap", told)])
    assert report.diverged == 1
    first = report.divergences[0]
    assert (first.decider, first.at_ns, first.log) == ("machine", 10, "a.mcap")
    assert "after transition 5" in first.what
    assert "gw-9" in first.logged
    assert "gw-2" in first.now


def test_another_word_of_the_retry_policy_is_a_difference(tmp_path: Path) -> None:
    """A failed attempt that was given up although its skill allows another."""
    own = Failure(code="skill", message="slipped", retryable=True)
    failed = (
        TransitionKind.ATTEMPT_FAILED,
        {"subtask": "s1", "attempt": 1, "failure": own, "give_up": True, "retries": 2},
    )
    report = check([write(tmp_path / "a.mcap", history(*STEPS[:3], failed))])
    assert [(each.decider, each.logged, each.now) for each in report.divergences] == [
        ("retry", "given up", "is repeated")
    ]


def test_what_a_killed_gateway_took_with_it_is_no_difference(tmp_path: Path) -> None:
    """Where transitions are missing the task is followed again from its next record, and they are counted."""
    told = history(*STEPS)
    report = check([write(tmp_path / "a.mcap", told[:4] + told[6:])])
    assert report.same
    assert sum(report.unchecked.values()) == 2
    assert report.checked["machine"] == 4


def test_a_new_coordinator_goes_on_from_what_was_written(tmp_path: Path) -> None:
    """Progress that was told and not written is forgotten by the next coordinator; that is as it should be."""
    steps = [
        *STEPS[:3],
        (TransitionKind.STARTED, {"subtask": "s1", "attempt": 1, "gateway": "gw-1"}),
        (TransitionKind.ADOPTED, {"coordinator": "gw-2"}),
    ]
    told = history(*steps)
    unwritten = Transition(
        task="t-1", sequence=5, kind=TransitionKind.PROGRESS, at_ns=5, coordinator="gw-1", subtask="s1", attempt=1
    )
    report = check([write(tmp_path / "a.mcap", [*told[:8], (KEYS(keyspace.TRANSITION, "t-1"), unwritten), *told[8:]])])
    assert report.same, report.divergences
    assert report.checked["machine"] == 6


def _cut(*ours: tuple[TransitionKind, dict[str, Any]]) -> list[tuple[str, Struct]]:
    """A task on both sides of a cut: gw-2 repeats the run, gw-1 goes on with these steps of its own."""
    shared = STEPS[:3]
    theirs = [
        *shared,
        (TransitionKind.ADOPTED, {"coordinator": "gw-2"}),
        (TransitionKind.ATTEMPT_FAILED, {**STEPS[3][1], "coordinator": "gw-2"}),
        (TransitionKind.DISPATCHED, {"subtask": "s1", "attempt": 2, "gateway": "gw-2", "coordinator": "gw-2"}),
    ]
    return [*history(*theirs), *history(*shared, *ours)[6:]]


def test_a_side_whose_last_step_is_missing_is_not_taken_for_the_other(tmp_path: Path) -> None:
    """It heals from a version that is not in the log, and the other side's is as long: no difference, but counted."""
    ours: tuple[tuple[TransitionKind, dict[str, Any]], ...] = (
        (TransitionKind.STARTED, {"subtask": "s1", "attempt": 1, "gateway": "gw-1"}),
        (TransitionKind.PROGRESS, {"subtask": "s1", "attempt": 1, "progress": 0.5}),
        (TransitionKind.PROGRESS, {"subtask": "s1", "attempt": 1, "progress": 0.7}),
        (TransitionKind.HEALED, {}),
    )
    told = _cut(*ours)
    # gw-1's transition 6 and its record are missing; gw-2 has a transition 6 of its own.
    missing = [each for number, each in enumerate(told) if number not in (len(told) - 4, len(told) - 3)]
    report = check([write(tmp_path / "a.mcap", missing)])
    assert report.same, report.divergences
    assert report.unchecked["record after what is not in the log"] == 1
    whole = check([write(tmp_path / "b.mcap", told)])
    assert whole.same, whole.divergences
    assert not whole.unchecked
    # Where nothing is missing, another record than follows is a difference as ever.
    key, last = told[-1]
    assert isinstance(last, TaskRecord)
    wrong = replace(last, subtasks=(replace(last.subtasks[0], gateway="gw-9"),))
    assert not check([write(tmp_path / "c.mcap", [*told[:-1], (key, wrong)])]).same


def test_a_takeover_is_followed_from_the_version_that_it_names(tmp_path: Path) -> None:
    """Several coordinators wrote as many transitions: the version named counts; if it is missing, none does."""
    shared = STEPS[:3]
    lost = {**STEPS[3][1], "give_up": False}
    side = history(*shared, (TransitionKind.ADOPTED, {"coordinator": "gw-2"}))
    other = history(*shared, (TransitionKind.ATTEMPT_FAILED, lost))
    base = other[-1][1]
    assert isinstance(base, TaskRecord)
    taken = history(
        *shared,
        (TransitionKind.ATTEMPT_FAILED, lost),
        (TransitionKind.ADOPTED, {"coordinator": "gw-3", "base": fingerprint(base)}),
    )[-2:]
    whole = check([write(tmp_path / "whole.mcap", [*other, *side[-2:], *taken])])
    assert whole.same, whole.divergences
    assert not whole.unchecked
    missing = check([write(tmp_path / "missing.mcap", [*side, *taken])])
    assert missing.same, missing.divergences
    assert missing.unchecked == {"after what is not in the log": 1, "record after what is not in the log": 1}


def _placed(config: TasksConfig) -> Struct:
    gateways = {
        name: GatewayStatus(id=name, fleet="f", load=load, overloaded="busy" if name == "gw-3" else "")
        for name, load in (("gw-1", 0.9), ("gw-2", 0.2), ("gw-3", 0.0))
    }
    ready = ContainerInfo(id="c1", gateway="gw-1", image="base", state=ContainerState.READY, compatible=("vision",))
    asked = Asked(
        need=Need(image="vision"),
        here="gw-1",
        gateways=gateways,
        containers={"gw-1": {"c1": ready}},
        holds={"gw-2": 1.0},
        robot=RobotInfo(id="r1", kind="zenoh", gateway="gw-3"),
        avoid=frozenset({"gw-1"}),
        stale_s={"gw-2": 4.0},
        config=config,
    )
    placement = place(
        asked.need, here=asked.here, gateways=gateways, containers=asked.containers, holds=asked.holds,
        robot=asked.robot, avoid=asked.avoid, config=config, stale_s=asked.stale_s,
    )  # fmt: skip
    record = TaskRecord(id="t-1", instruction="x", state=TaskState.RUNNING)
    case = placement_case(placement, asked, record, SubtaskRecord(subtask=PLAN.subtasks[0]))
    assert case is not None
    return case


def _selected() -> Struct:
    config, need = PoolConfig(), Need(image="base", volumes=("map",))
    here = ContainerInfo(id="c1", gateway="gw-1", image="base", state=ContainerState.READY)
    there = replace(here, id="c2", gateway="gw-2", volumes=("map",))
    facts = Facts(
        inputs={"gw-2": 5_000},
        volumes={"map": (VolumeInfo(name="map", gateway="gw-2", size_bytes=40_000_000),)},
        links={"gw-2": Link(bytes_per_s=1e7)},
    )
    offers = [Candidate(container=there, round_trip_ms=2.0)]
    decision = select(need, [here], offers, 2_000.0, config, gateway="gw-1", facts=facts)
    return selection_case(
        decision, need=need, local=[here], remote=offers, cold_ms=2_000.0, config=config, gateway="gw-1", facts=facts
    )


def _evicted() -> EvictionCase:
    idle = tuple(Idle(id=f"c{n}", image="base", memory_mb=100, runs=1, cold_ms=1.0, since=1.0) for n in range(3))
    return EvictionCase(gateway="gw-1", idle=idle, worths=(3.0, 1.0, 2.0), slots=1, memory_mb=150, chosen=("c1", "c2"))


def test_placement_selection_and_eviction_are_made_again(tmp_path: Path) -> None:
    """What they rested on is in the message; made again by the same code they come out the same."""
    told = [
        (KEYS(keyspace.DECIDED, "gw-1", "placement"), _placed(TasksConfig())),
        (KEYS(keyspace.DECIDED, "gw-1", "selection"), _selected()),
        (KEYS(keyspace.DECIDED, "gw-1", "eviction"), _evicted()),
    ]
    report = check([write(tmp_path / "a.mcap", told)])
    assert report.same, report.divergences
    assert report.checked == {"placement": 1, "selection": 1, "eviction": 1}


@pytest.mark.parametrize(
    ("what", "case", "logged"),
    [
        ("placement", replace(_placed(TasksConfig()), order=("gw-3", "gw-2", "gw-1")), "gw-3"),  # type: ignore[type-var]
        ("selection", replace(_selected(), container="c9"), "c9"),  # type: ignore[type-var]
        ("eviction", replace(_evicted(), chosen=("c0",)), "c0"),
    ],
)
def test_other_decisions_are_differences(tmp_path: Path, what: str, case: Struct, logged: str) -> None:
    """A decision that the code does not make is shown with what it makes instead."""
    report = check([write(tmp_path / "a.mcap", [(KEYS(keyspace.DECIDED, "gw-1", what), case)])])
    assert report.diverged == 1
    assert report.divergences[0].decider == what
    assert logged in report.divergences[0].logged
    assert report.divergences[0].logged != report.divergences[0].now


def test_malformed_decisions_are_counted(tmp_path: Path) -> None:
    """A stranger's put on a key of decisions is no difference and no crash; a log without any decision is an error."""
    told = [(KEYS(keyspace.DECIDED, "gw-1", "placement"), PLAN), (KEYS(keyspace.TRANSITION, "t-1"), PLAN)]
    report = check([write(tmp_path / "a.mcap", told)])
    assert report.unchecked == {"malformed": 2}
    with pytest.raises(RecordError, match="no decision"):
        check([write(tmp_path / "b.mcap", [("k", PLAN)])])
