"""What operators order of a task, as the state machine takes it; pure, like `machine` and `revising`.

- A first plan that has to be approved makes the task `proposed`: nothing runs. `approved` begins it, with the plan that
  was proposed or an edited one; `rejected` cancels it. The same two end the wait of a plan after a failure.
- `paused` keeps subtasks from being started; `resumed` takes that back. A task may be paused for several reasons, an
  operator's wish and a soft stop of a robot, and goes on when the last has gone.
- `held` leaves a run for a later attempt: its number fences late news of it off, and it counts for no failure.
- `retried` begins a task that has failed or was cancelled again, or one of its subtasks: what has succeeded is kept,
  and attempts count on from where they were.
"""

from collections.abc import Callable

from msgspec.structs import replace

from appliance.model import (
    Attempt,
    Decision,
    Plan,
    Proposal,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.tasks import revising
from appliance.tasks.steering.hashing import plan_hash
from appliance.tasks.transition import StaleTransitionError, Transition, TransitionKind

MOST_PAUSES = 16
"""Reasons for one pause that are told apart: more stops of one task's robots make it no more paused."""
_LIVE = (TaskState.ACCEPTED, TaskState.PROPOSED, TaskState.RUNNING)
_AGAIN = (SubtaskState.FAILED, SubtaskState.CANCELLED)


def begun(record: TaskRecord, plan: Plan) -> TaskRecord:
    """Return a task as it begins with a plan."""
    subtasks = tuple(
        SubtaskRecord(subtask=subtask, state=SubtaskState.WAITING if subtask.after else SubtaskState.READY)
        for subtask in plan.subtasks
    )
    return replace(record, state=TaskState.RUNNING, plan=plan, subtasks=subtasks, proposal=None)


def proposed(record: TaskRecord, event: Transition) -> TaskRecord:
    """Keep a plan until it takes effect: the first one, or one after a failure (`revising`)."""
    if event.subtask:
        return revising.proposed(record, event)
    if record.state is not TaskState.ACCEPTED or event.plan is None:
        raise StaleTransitionError(f"a first plan for task {record.id}, which is {record.state}")
    proposal = Proposal(
        plan=event.plan,
        note=event.note,
        waits=True,
        hash=plan_hash(event.plan),
        since_s=event.elapsed_s,
        expires_s=event.expires_s,
        at_ns=event.at_ns,
    )
    return replace(record, state=TaskState.PROPOSED, proposal=proposal)


def approved(record: TaskRecord, event: Transition) -> TaskRecord:
    """Let a plan that waits take effect, or an edited one in its place."""
    proposal = _waiting(record, event)
    decision = event.decision
    plan = proposal.plan
    if event.plan is not None:
        # Where the plan before came from stays known: what was wrong with it is learned from.
        before = proposal.plan.provenance
        origin = replace(before, edited=True) if before is not None else event.plan.provenance
        plan = replace(event.plan, provenance=origin)
        decision = _of_plan(decision, proposal)
    if record.state is TaskState.PROPOSED:
        return replace(begun(record, plan), decision=decision)
    changed = replace(proposal, waits=False, plan=plan, hash=plan_hash(plan))
    return replace(record, proposal=changed, decision=decision)


def rejected(record: TaskRecord, event: Transition) -> TaskRecord:
    """Turn a plan down: the task is cancelled, or fails with what the plan was to mend."""
    decision = _of_plan(event.decision, _waiting(record, event))
    if record.state is TaskState.PROPOSED:
        return replace(record, state=TaskState.CANCELLED, proposal=None, decision=decision, cancelled_by=event.word)
    return replace(revising.replan_failed(record, event), decision=decision)


def _of_plan(decision: Decision | None, proposal: Proposal) -> Decision | None:
    """Have a decision say of which plan it is, and why that plan waited: the proposal goes with it."""
    return None if decision is None else replace(decision, plan=proposal.plan, note=proposal.note)


def paused(record: TaskRecord, event: Transition) -> TaskRecord:
    """Start nothing from now on."""
    pause = event.pause
    if pause is None or record.state not in _LIVE:
        raise StaleTransitionError(f"a pause of task {record.id}, which is {record.state}")
    if any(each.stop == pause.stop for each in record.pauses) or len(record.pauses) >= MOST_PAUSES:
        raise StaleTransitionError(f"task {record.id} is paused for that already")
    changed = replace(record, pauses=(*record.pauses, pause))
    return _noted(changed, changed.paused)


def resumed(record: TaskRecord, event: Transition) -> TaskRecord:
    """End one reason of a pause."""
    pause = event.pause
    left = tuple(each for each in record.pauses if pause is None or each.stop != pause.stop)
    if pause is None or len(left) == len(record.pauses):
        raise StaleTransitionError(f"task {record.id} is not paused for that")
    changed = replace(record, pauses=left)
    return _noted(changed, changed.paused)


def held(record: TaskRecord, event: Transition) -> TaskRecord:
    """Leave a run; its subtask is ready for the next attempt."""
    target = _of(record, event.subtask)
    if record.state is not TaskState.RUNNING or target.state not in revising.ACTIVE or event.attempt != target.attempt:
        raise StaleTransitionError(f"attempt {event.attempt} of {event.subtask} is not under way any more")
    return _with(record, _left(target, event.note))


def retried(record: TaskRecord, event: Transition) -> TaskRecord:
    """Begin again what has not succeeded."""
    if record.state in (TaskState.FAILED, TaskState.CANCELLED):
        return _anew(record, event)
    if record.state is not TaskState.RUNNING:
        raise StaleTransitionError(f"task {record.id} is {record.state}")
    target = _of(record, event.subtask)
    if target.state in revising.ACTIVE:
        return replace(_with(record, _left(target, event.note)), retried_by=event.word)
    if target.state not in _AGAIN:
        raise StaleTransitionError(f"{event.subtask} is {target.state}")
    proposal = record.proposal if record.proposal is None or record.proposal.subtask != event.subtask else None
    again = replace(_again(target, event.note), state=SubtaskState.READY)
    return replace(_with(record, again), proposal=proposal, retried_by=event.word)


def _anew(record: TaskRecord, event: Transition) -> TaskRecord:
    """A task that has ended; without subtasks it had no plan that took effect, and is planned once more."""
    if event.subtask and _of(record, event.subtask).state not in _AGAIN:
        raise StaleTransitionError(f"{event.subtask} has {_of(record, event.subtask).state}")
    return replace(
        record,
        state=TaskState.RUNNING if record.subtasks else TaskState.ACCEPTED,
        subtasks=tuple(_again(each, event.note) if each.state in _AGAIN else each for each in record.subtasks),
        failure=None,
        proposal=None,
        cancelled_by=None,
        pauses=(),
        deadline_s=event.deadline_s,
        retried_by=event.word,
        retries=record.retries + 1,
    )


def _again(target: SubtaskRecord, note: str) -> SubtaskRecord:
    """Waiting again (`machine` draws whether it is ready); the failures so far count no more."""
    attempts: tuple[Attempt, ...] = tuple(
        replace(each, left=note) if each.failure is not None else each for each in target.attempts
    )
    return replace(
        target, state=SubtaskState.WAITING, attempts=attempts, failure=None, note="", condition="", progress=0.0
    )


def _left(target: SubtaskRecord, note: str) -> SubtaskRecord:
    last = replace(target.attempts[-1], left=note)
    return replace(
        target, state=SubtaskState.READY, attempts=(*target.attempts[:-1], last), note=note, condition="", partial=None
    )


def _noted(record: TaskRecord, note: str) -> TaskRecord:
    """Say of the subtasks that could start why they do not."""
    return replace(
        record,
        subtasks=tuple(
            replace(each, note=note) if each.state is SubtaskState.READY else each for each in record.subtasks
        ),
    )


def _waiting(record: TaskRecord, event: Transition) -> Proposal:
    proposal = record.proposal
    live = record.state in (TaskState.PROPOSED, TaskState.RUNNING)
    if not live or proposal is None or not proposal.waits or event.decision is None:
        raise StaleTransitionError(f"no plan of task {record.id} waits for an operator")
    return proposal


def _of(record: TaskRecord, subtask: str) -> SubtaskRecord:
    try:
        return record.of(subtask)
    except KeyError:
        raise StaleTransitionError(f"task {record.id} has no subtask {subtask!r}") from None


def _with(record: TaskRecord, changed: SubtaskRecord) -> TaskRecord:
    return replace(
        record,
        subtasks=tuple(changed if each.subtask.id == changed.subtask.id else each for each in record.subtasks),
    )


HANDLERS: dict[TransitionKind, Callable[[TaskRecord, Transition], TaskRecord]] = {
    TransitionKind.PROPOSED: proposed,
    TransitionKind.APPROVED: approved,
    TransitionKind.REJECTED: rejected,
    TransitionKind.PAUSED: paused,
    TransitionKind.RESUMED: resumed,
    TransitionKind.HELD: held,
    TransitionKind.RETRIED: retried,
}
"""By kind; `proposed` takes the place of the one in `revising`, which it calls."""
