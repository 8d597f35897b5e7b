"""The task state machine: what follows from what, and that nothing else does."""

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import (
    Decision,
    Failure,
    Group,
    Pause,
    Phase,
    Plan,
    Split,
    Subtask,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.tasks import machine
from appliance.tasks.machine import StaleTransitionError, Transition, TransitionKind, apply

PLAN = Plan(
    domain="perception",
    subtasks=(
        Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "shelf"}),
        Subtask(id="s2", skill="photograph", robot="rover_1", params={"target": "shelf"}, after=("s1",)),
        Subtask(id="s3", skill="notify", params={"to": "operator"}, after=("s1",)),
    ),
)


def step(record: TaskRecord | None, kind: TransitionKind, **fields: object) -> TaskRecord:
    """Apply the next transition of a record."""
    sequence = record.sequence + 1 if record else 1
    return apply(
        record,
        Transition(task="t", sequence=sequence, kind=kind, at_ns=sequence, coordinator="gw-1", **fields),  # type: ignore[arg-type]
    )


def planned(plan: Plan = PLAN) -> TaskRecord:
    """Return a record with a plan."""
    return step(step(None, TransitionKind.ACCEPTED, instruction="x"), TransitionKind.PLANNED, plan=plan)


def dispatched(record: TaskRecord, subtask: str, attempt: int = 1) -> TaskRecord:
    """Dispatch a ready subtask."""
    return step(record, TransitionKind.DISPATCHED, subtask=subtask, attempt=attempt, gateway="gw-1", robot="rover_1")


def test_roots_are_ready_and_others_wait_for_them() -> None:
    """A plan's roots may start at once; a successor becomes ready when all before it have succeeded."""
    record = planned()
    assert [each.state for each in record.subtasks] == ["ready", "waiting", "waiting"]
    record = dispatched(record, "s1")
    record = step(record, TransitionKind.STARTED, subtask="s1", attempt=1, gateway="gw-2", phase=Phase.REMOTE_WARM)
    record = step(record, TransitionKind.SUCCEEDED, subtask="s1", attempt=1, gateway="gw-2", result={"place": "shelf"})
    assert [each.state for each in record.subtasks] == ["succeeded", "ready", "ready"]
    assert record.of("s1").gateway == "gw-2"


def test_all_succeeded_ends_the_task() -> None:
    """The task succeeds with its last subtask, and nothing more is taken then."""
    record = planned()
    for subtask in ("s1", "s2", "s3"):
        record = dispatched(record, subtask)
        record = step(record, TransitionKind.SUCCEEDED, subtask=subtask, attempt=1)
    assert record.state is TaskState.SUCCEEDED
    with pytest.raises(StaleTransitionError, match="already succeeded"):
        step(record, TransitionKind.CANCEL)


def test_a_group_stands_in_the_record_and_has_its_root_among_its_members() -> None:
    """The transition `grouped` sets it, a later one replaces it; one whose root is no member does not fit."""
    record = step(planned(), TransitionKind.GROUPED, group=Group(members=("gw-2", "gw-1"), root="gw-1", why="x"))
    record = step(record, TransitionKind.GROUPED, group=Group(members=("gw-1",), root="gw-1", number=2))
    assert record.group == Group(members=("gw-1",), root="gw-1", number=2)
    for wrong in (None, Group(members=(), root=""), Group(members=("gw-1",), root="gw-2")):
        with pytest.raises(StaleTransitionError):
            step(record, TransitionKind.GROUPED, group=wrong)


def test_time_since_acceptance_only_grows() -> None:
    """A coordinator that knows of less elapsed time than the record does not turn it back."""
    record = step(planned(), TransitionKind.ADOPTED, elapsed_s=7.5)
    assert record.elapsed_s == 7.5
    assert step(record, TransitionKind.ADOPTED, elapsed_s=3.0).elapsed_s == 7.5


def test_result_of_an_outdated_attempt_is_stale() -> None:
    """After a retry, the first attempt's late success is refused (fencing by attempt number)."""
    record = dispatched(planned(), "s1")
    lost = Failure(code="unreachable", message="gw-1 was lost", retryable=True)
    record = step(record, TransitionKind.ATTEMPT_FAILED, subtask="s1", attempt=1, failure=lost)
    assert record.of("s1").state is SubtaskState.READY
    record = dispatched(record, "s1", attempt=2)
    with pytest.raises(StaleTransitionError):
        step(record, TransitionKind.SUCCEEDED, subtask="s1", attempt=1, result={"late": True})
    record = step(record, TransitionKind.SUCCEEDED, subtask="s1", attempt=2)
    assert [attempt.number for attempt in record.of("s1").attempts] == [1, 2]


def test_given_up_attempt_fails_the_task_and_stops_the_rest() -> None:
    """A subtask that is given up fails the task with its reason; what has not started is cancelled."""
    record = dispatched(planned(), "s1")
    record = step(
        record,
        TransitionKind.ATTEMPT_FAILED,
        subtask="s1",
        attempt=1,
        failure=Failure(code="robot", message="no path to shelf"),
        give_up=True,
    )
    assert record.state is TaskState.FAILED
    assert record.failure is not None
    assert "s1 (goto): no path to shelf" in record.failure.message
    assert [each.state for each in record.subtasks] == ["failed", "cancelled", "cancelled"]


def test_cancel_waits_for_runs_in_progress() -> None:
    """A cancelled task ends only when its runs have, and then as cancelled."""
    record = dispatched(planned(), "s1")
    record = step(record, TransitionKind.CANCEL)
    assert record.state is TaskState.CANCELLING
    assert record.of("s2").state is SubtaskState.CANCELLED
    ended = Failure(code="cancelled", message="stopped")
    record = step(record, TransitionKind.ATTEMPT_FAILED, subtask="s1", attempt=1, failure=ended, give_up=True)
    assert record.state is TaskState.CANCELLED
    assert record.of("s1").state is SubtaskState.CANCELLED


def test_cancel_before_the_plan_ends_at_once() -> None:
    """There is nothing to wait for before a plan."""
    record = step(step(None, TransitionKind.ACCEPTED, instruction="x"), TransitionKind.CANCEL)
    assert record.state is TaskState.CANCELLED


def test_no_plan_fails_the_task_with_the_reason() -> None:
    """An instruction without a valid plan is a failed task that says why."""
    record = step(None, TransitionKind.ACCEPTED, instruction="asdf")
    record = step(record, TransitionKind.PLAN_FAILED, failure=Failure(code="plan", message="nothing understood"))
    assert record.state is TaskState.FAILED
    assert record.failure is not None
    assert record.failure.message == "nothing understood"


def test_lost_gateways_do_not_use_up_a_skills_retries() -> None:
    """Attempts lost with gateways are bounded by themselves; a skill's own failures by its retries."""
    record = planned()
    lost = Failure(code="unreachable", message="lost", retryable=True)
    own = Failure(code="handler", message="blurred", retryable=True)
    for attempt in range(1, 4):
        record = dispatched(record, "s1", attempt)
        assert not machine.gives_up(record.of("s1"), lost, retries=1)
        record = step(record, TransitionKind.ATTEMPT_FAILED, subtask="s1", attempt=attempt, failure=lost)
    record = dispatched(record, "s1", 4)
    target = record.of("s1")
    judged = msgspec.structs.replace(
        target, attempts=(*target.attempts[:-1], msgspec.structs.replace(target.attempts[-1], failure=own))
    )
    assert machine.gives_up(judged, own, retries=1)
    assert machine.gives_up(target, Failure(code="handler", message="wrong object"), retries=5)


KINDS = st.sampled_from([kind for kind in TransitionKind if kind is not TransitionKind.ACCEPTED])


@given(
    st.lists(
        st.tuples(KINDS, st.sampled_from(["s1", "s2", "s3", "s9"]), st.integers(0, 3), st.booleans(), st.booleans()),
        max_size=40,
    )
)
@settings(max_examples=300, deadline=None)
def test_any_sequence_of_events_keeps_the_record_sound(
    events: list[tuple[TransitionKind, str, int, bool, bool]],
) -> None:
    """Whatever comes in whatever order: final states stay, order is kept, and a refused event changes nothing.

    Only an operator who has something tried again takes an end back.
    """
    record = planned()
    finals: dict[str, SubtaskState] = {}
    for kind, subtask, attempt, give_up, retryable in events:
        before = record
        try:
            record = step(
                record,
                kind,
                subtask=subtask,
                attempt=attempt,
                give_up=give_up,
                gateway="gw-1",
                plan=PLAN,
                failure=Failure(code="x", message="x", retryable=retryable),
                pause=Pause(by="ann"),
                decision=Decision(approved=give_up, by="ann"),
            )
        except StaleTransitionError:
            assert record is before
            continue
        if kind is TransitionKind.RETRIED:  # an operator's word alone takes an end back, and never a success
            finals = {name: state for name, state in finals.items() if state is SubtaskState.SUCCEEDED}
        for each in record.subtasks:
            if each.subtask.id in finals:
                assert each.state is finals[each.subtask.id]
            if each.state.final:
                finals[each.subtask.id] = each.state
            if each.state in (SubtaskState.DISPATCHED, SubtaskState.RUNNING, SubtaskState.SUCCEEDED):
                assert all(record.of(parent).state is SubtaskState.SUCCEEDED for parent in each.subtask.after)
            assert [a.number for a in each.attempts] == list(range(1, len(each.attempts) + 1))
        if record.state.final:
            assert all(each.state.final for each in record.subtasks) or record.state is TaskState.FAILED
        again = msgspec.json.decode(msgspec.json.encode(record), type=TaskRecord)
        assert again == record


def moved(record: TaskRecord, subtask: str, attempt: int = 1, **fields: object) -> TaskRecord:
    """Move a run away to gw-2."""
    return step(record, TransitionKind.MOVED, subtask=subtask, attempt=attempt, gateway="gw-2", note="full", **fields)


def test_a_move_is_a_new_attempt_elsewhere_that_keeps_what_was_told() -> None:
    """The old attempt says why it was left, its results are stale; partial result and checkpoint stay for the next."""
    record = step(dispatched(planned(), "s1"), TransitionKind.STARTED, subtask="s1", attempt=1, gateway="gw-1")
    record = step(record, TransitionKind.PARTIAL, subtask="s1", attempt=1, result={"seen": 1})
    record = step(record, TransitionKind.CHECKPOINT, subtask="s1", attempt=1)
    record = moved(record, "s1", load=0.25, free=3)
    found = record.of("s1")
    assert (found.state, found.attempt, found.gateway) == (SubtaskState.DISPATCHED, 2, "gw-2")
    assert (found.attempts[0].left, found.attempts[0].failure) == ("full", None)
    assert (found.attempts[1].load, found.attempts[1].free) == (0.25, 3)
    assert found.partial == {"seen": 1}
    assert found.checkpoint_ns
    with pytest.raises(StaleTransitionError):
        step(record, TransitionKind.SUCCEEDED, subtask="s1", attempt=1, result={})
    record = step(record, TransitionKind.STARTED, subtask="s1", attempt=2, gateway="gw-2")
    assert record.of("s1").gateway == "gw-2"


def test_a_move_fits_only_a_run_of_a_task_that_goes_on() -> None:
    """Not a subtask that is ready, nor an outdated attempt, nor a task that is being ended."""
    record = planned()
    with pytest.raises(StaleTransitionError):
        moved(record, "s1")
    record = dispatched(record, "s1")
    with pytest.raises(StaleTransitionError):
        moved(record, "s1", attempt=2)
    with pytest.raises(StaleTransitionError):
        moved(step(record, TransitionKind.CANCEL), "s1")


@pytest.mark.parametrize("code", ["skill", "unreachable"])
def test_moves_do_not_use_up_attempts(code: str) -> None:
    """Neither the retries of the skill nor the bound on attempts lost to gateways."""
    record = dispatched(planned(), "s1")
    for attempt in range(1, 20):
        record = moved(record, "s1", attempt=attempt)
    failure = Failure(code=code, message="x", retryable=True)
    target = record.of("s1")
    judged = replace(target, attempts=(*target.attempts[:-1], replace(target.attempts[-1], failure=failure)))
    assert not machine.gives_up(judged, failure, retries=2)


def test_a_healed_record_numbers_its_attempts_above_those_made_elsewhere() -> None:
    """After a partition the next attempt is higher than any of either side; a task that has ended takes the note."""
    split = Split(coordinator="gw-9", sequence=7, state=TaskState.RUNNING, settled=True)
    record = step(planned(), TransitionKind.HEALED, splits=(split,), fences={"s1": 4})
    with pytest.raises(StaleTransitionError):
        dispatched(record, "s1")
    record = dispatched(record, "s1", attempt=5)
    assert record.of("s1").attempt == 5
    for subtask, attempt in (("s1", 5), ("s2", 1), ("s3", 1)):
        record = dispatched(record, subtask, attempt) if subtask != "s1" else record
        record = step(record, TransitionKind.SUCCEEDED, subtask=subtask, attempt=attempt)
    assert record.state is TaskState.SUCCEEDED
    assert step(record, TransitionKind.HEALED, splits=(split,)).splits == (split,)
