"""Spans of tasks: from real logs of fleets, each gateway alone, and yet one trace a task."""

import hashlib
import re
from collections import Counter, defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Failure, Phase, Plan, RunEvent, RunEventKind, Subtask, TaskRecord, TaskState
from appliance.model.transitions import Transition, TransitionKind
from appliance.observe.spans import Span, Spans, of_call, span_of, trace_of
from appliance.record.reader import read

LOGS = Path(__file__).parents[2] / "replay" / "logs"
S = 10**9


def told(log: Path) -> dict[str, list[Span]]:
    """Return what each gateway of a recorded fleet would have told."""
    spans: defaultdict[str, Spans] = defaultdict(Spans)
    found: defaultdict[str, list[Span]] = defaultdict(list)
    for message in read(log):
        if re.search(r"/task/[^/]+/transition$", message.key):
            event = msgspec.json.decode(message.payload, type=Transition)
            found[event.coordinator] += spans[event.coordinator].of_transition(event)
        elif re.search(r"/task/[^/]+/record$", message.key) and not message.deleted:
            record = msgspec.json.decode(message.payload, type=TaskRecord)
            found[record.coordinator] += spans[record.coordinator].of_record(record)
        elif re.search(r"/task/[^/]+/run/[^/]+$", message.key):
            run = msgspec.json.decode(message.payload, type=RunEvent)
            found[run.gateway] += spans[run.gateway].of_event(run)
    return found


@pytest.mark.parametrize("log", sorted(LOGS.glob("*.mcap")), ids=lambda path: path.stem)
def test_a_recorded_task_is_one_trace(log: Path) -> None:
    """One root a task; each span once, below one that is told, and none ends before it begins."""
    found = told(log)
    spans = [span for each in found.values() for span in each]
    parts = {(span.task, span.part) for span in spans}
    roots = Counter(span.task for span in spans if span.parent is None)
    assert roots
    assert set(roots.values()) == {1}
    assert len(parts) == len(spans)
    lost = [span for span in spans if span.parent is not None and (span.task, span.parent) not in parts]
    assert lost == []
    assert [span for span in spans if span.end_ns < span.start_ns] == []
    kinds = {span.name.split()[0] for span in spans}
    assert {"task", "plan"} <= kinds
    if "no-plan" not in log.stem:
        assert {"attempt", "place", "start", "run"} <= kinds


@pytest.mark.parametrize("name", ["coordinator-killed", "executor-killed"])
def test_a_trace_outlives_a_gateway(name: str) -> None:
    """Several gateways tell of the task; the one that takes over ends it."""
    found = {gateway: spans for gateway, spans in told(LOGS / f"{name}.mcap").items() if spans}
    assert len(found) >= 2
    (root,) = [span for spans in found.values() for span in spans if span.parent is None]
    assert root.failure is None
    assert len({span.task for spans in found.values() for span in spans}) == 1


PLAN = Plan(
    subtasks=(
        Subtask(id="s1", skill="goto", robot="rover_1"),
        Subtask(id="s2", skill="report", robot="rover_1", after=("s1",)),
    ),
    domain="warehouse",
    tier="rules",
    confidence=1.0,
)


def event(kind: TransitionKind, at_s: float, **more: Any) -> Transition:
    """Return a transition of the task t."""
    return Transition(task="t", sequence=1, kind=kind, at_ns=int(at_s * S), coordinator="gw-1", **more)


def record(state: TaskState, at_s: float, **more: Any) -> TaskRecord:
    """Return its record."""
    return TaskRecord(id="t", instruction="go", state=state, created_ns=S, updated_ns=int(at_s * S), **more)


def times(spans: list[Span]) -> dict[str, tuple[float, float]]:
    """Return begin and end of spans by their part, in seconds."""
    return {span.part: (span.start_ns / S, span.end_ns / S) for span in spans}


def test_waits_are_told_from_work() -> None:
    """Planning, approval, placement, attempt: each from when it could begin, a subtask from the end of those before."""
    spans, found = Spans(), []
    for each in (
        event(TransitionKind.ACCEPTED, 1),
        event(TransitionKind.PROPOSED, 2, plan=PLAN, waits=True),
        event(TransitionKind.APPROVED, 5),
        event(TransitionKind.DISPATCHED, 6, subtask="s1", attempt=1, gateway="gw-2"),
        event(TransitionKind.ATTEMPT_FAILED, 7, subtask="s1", attempt=1, failure=Failure(code="busy", message="busy")),
        event(TransitionKind.DISPATCHED, 9, subtask="s1", attempt=2, gateway="gw-1"),
        event(TransitionKind.SUCCEEDED, 12, subtask="s1", attempt=2),
        event(TransitionKind.DISPATCHED, 12.5, subtask="s2", attempt=1, gateway="gw-2"),
        event(TransitionKind.MOVED, 13, subtask="s2", attempt=1, gateway="gw-1"),
        event(TransitionKind.SUCCEEDED, 14, subtask="s2", attempt=2),
    ):
        found += spans.of_transition(each)
    assert spans.of_record(record(TaskState.RUNNING, 14)) == []
    found += spans.of_record(record(TaskState.SUCCEEDED, 15))
    assert times(found) == {
        "plan": (1, 2), f"approval {2 * S}": (2, 5), "s1/1/place": (5, 6), "s1/1": (5, 7), "s1/2/place": (7, 9),
        "s1/2": (7, 12), "s2/1/place": (12, 12.5), "s2/1": (12, 13), "s2/2": (13, 14), "": (1, 15),
    }  # fmt: skip
    assert [span.part for span in found if span.failure is not None] == ["s1/1"]
    assert {span.name for span in found} >= {"attempt goto", "attempt report"}
    assert spans.of_record(record(TaskState.SUCCEEDED, 15)) == []  # the same again is told once


def test_what_is_under_way_ends_with_its_task() -> None:
    """A cancelled task leaves no attempt without an end, and is told as cancelled; a retry is a span below it."""
    spans = Spans()
    for each in (
        event(TransitionKind.ACCEPTED, 1),
        event(TransitionKind.PLANNED, 2, plan=PLAN),
        event(TransitionKind.DISPATCHED, 3, subtask="s1", attempt=1),
    ):
        spans.of_transition(each)
    attempt, root = spans.of_record(record(TaskState.CANCELLED, 4))
    assert (attempt.part, attempt.end_ns) == ("s1/1", 4 * S)
    assert root.failure is not None
    assert spans.of_transition(event(TransitionKind.HEALED, 5)) == []
    assert spans.of_record(record(TaskState.CANCELLED, 5)) == []
    spans.of_transition(event(TransitionKind.RETRIED, 8))
    (again,) = spans.of_record(record(TaskState.SUCCEEDED, 9, retries=1))
    assert (again.part, again.parent, again.start_ns) == ("retry 1", "", 8 * S)


def test_a_plan_that_nobody_approves_ends_its_wait() -> None:
    """The approval is what failed then, not the planning."""
    spans = Spans()
    spans.of_transition(event(TransitionKind.ACCEPTED, 1))
    spans.of_transition(event(TransitionKind.PROPOSED, 2, plan=PLAN, waits=True))
    late = event(TransitionKind.PLAN_FAILED, 9, failure=Failure(code="unapproved", message="nobody did"))
    (span,) = spans.of_transition(late)
    assert (span.name, span.start_ns, span.failure) == ("approval", 2 * S, late.failure)


def test_runs_tell_their_start_and_their_end() -> None:
    """The start begins as long before the first line as it took; a result without a start tells nothing."""
    spans = Spans()
    common = {"task": "t", "subtask": "s1", "attempt": 1, "gateway": "gw-2"}
    (start,) = spans.of_event(
        RunEvent(**common, kind=RunEventKind.STARTED, startup_ms=4.0, phase=Phase.LOCAL_WARM, at_ns=S)
    )
    assert (start.parent, start.start_ns, start.end_ns) == ("s1/1", S - 4_000_000, S)
    assert spans.of_event(RunEvent(**common, kind=RunEventKind.PROGRESS, at_ns=S)) == []
    (run,) = spans.of_event(RunEvent(**common, kind=RunEventKind.SUCCEEDED, at_ns=3 * S, cpu_ms=2.0))
    assert (run.parent, run.start_ns, run.end_ns) == ("s1/1", S, 3 * S)
    assert spans.of_event(RunEvent(**common, kind=RunEventKind.FAILED, at_ns=4 * S)) == []


def test_a_command_hangs_below_its_run() -> None:
    """With the verb in its name and the ID that the robot knows it by."""
    run = SimpleNamespace(task="t", subtask="s1", attempt=2, robot="rover_1")
    call: Any = SimpleNamespace(run=run, number=3, name="command", args={"verb": "goto", "args": {}})
    span = of_call(call, start_ns=1, end_ns=2)
    assert (span.name, span.parent, span.attributes["swiftbot.command"]) == ("command goto", "s1/2/run", "t/s1/3")


def test_what_is_followed_is_bounded() -> None:
    """A gateway that never hears the ends keeps no more than so many."""
    spans = Spans(most=10)
    for number in range(50):
        spans.of_transition(msgspec.structs.replace(event(TransitionKind.ACCEPTED, 1), task=f"t{number}"))
        spans.of_event(RunEvent(task=f"t{number}", subtask="s", attempt=1, kind=RunEventKind.STARTED, at_ns=1))
    assert len(spans._tasks) == len(spans._runs) == 10


STEPS = st.lists(
    st.tuples(
        st.sampled_from(TransitionKind), st.sampled_from(["", "s1", "s2", "s9"]), st.integers(0, 3), st.booleans()
    ),
    max_size=30,
)


@given(STEPS, st.sampled_from(TaskState))
def test_no_order_of_events_breaks_it(steps: list[tuple[TransitionKind, str, int, bool]], state: TaskState) -> None:
    """Whatever comes after whatever, spans end no earlier than they begin, and a task has one root, at its end."""
    spans, found = Spans(), []
    for at_s, (kind, subtask, attempt, waits) in enumerate(steps, start=2):
        plan = PLAN if kind in (TransitionKind.PLANNED, TransitionKind.PROPOSED, TransitionKind.REPLANNED) else None
        found += spans.of_transition(
            event(kind, at_s, subtask=subtask, attempt=attempt, waits=waits, plan=plan)
        )  # fmt: skip
    found += spans.of_record(record(state, len(steps) + 2))
    assert [span for span in found if span.end_ns < span.start_ns] == []
    known = any(kind is not TransitionKind.HEALED for kind, *_ in steps)
    assert sum(span.parent is None for span in found) == (known and state.final)


TEXT = st.text(max_size=30)


@given(TEXT, TEXT, TEXT)
def test_ids_are_the_same_everywhere(fleet: str, task: str, part: str) -> None:
    """They follow from the names alone, fit the protocol's width, and are never its invalid zero."""
    assert trace_of(fleet, task) == trace_of(fleet, task)
    assert 0 < trace_of(fleet, task) < 2**128
    assert 0 < span_of(fleet, task, part) < 2**64


def test_the_trace_of_a_task_is_documented() -> None:
    """A robot's or skill's own program can join it by what docs/monitoring.md says."""
    assert f"{trace_of('yard', 't-1'):032x}" == hashlib.sha256(b"yard/t-1").hexdigest()[:32]
