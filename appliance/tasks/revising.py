"""Changes of a task's plan after a failure, as the state machine takes them; pure, like `machine`.

A subtask that was given up with `replan` stands as failed in a task that goes on running. What is done about it comes
as one transition each: `rebound` (another robot), `substituted` (an alternative skill) and `replanned` (a new plan of
the decomposer, which was `proposed` and perhaps `approved` before) carry the whole plan from then on, which is
checked here against what the record holds:

- what has succeeded or is under way is in it, unchanged, so that nothing is done twice and no run is left behind;
- what was begun keeps its id only as the same subtask; ids that are new were never of this task before, since the
  effects of handlers are known by them;
- it has no cycle and names only what is in it.

`replan failed` ends the task with the failure that nothing could be done about.
"""

from collections.abc import Mapping

from msgspec.structs import replace

from appliance.model import (
    MAX_SUBTASKS,
    Dropped,
    Plan,
    Proposal,
    Revision,
    RevisionKind,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.tasks.steering.hashing import plan_hash
from appliance.tasks.transition import StaleTransitionError, Transition, TransitionKind

KEPT_REVISIONS = 8
"""Revisions that a record remembers; more than any task is allowed, unless the limits were raised."""
KEPT_PLANS = 3
"""Of those, how many with the plan before: a plan takes up to 20 kB."""
MAX_INSTEAD_OF = 8

_KINDS = {
    TransitionKind.REBOUND: RevisionKind.ROBOT,
    TransitionKind.SUBSTITUTED: RevisionKind.SKILL,
    TransitionKind.REPLANNED: RevisionKind.PLAN,
}
ACTIVE = (SubtaskState.DISPATCHED, SubtaskState.RUNNING)


def stranded(record: TaskRecord) -> tuple[SubtaskRecord, ...]:
    """Subtasks that were given up while their task goes on: its plan is to be revised."""
    if record.state is not TaskState.RUNNING:
        return ()
    return tuple(each for each in record.subtasks if each.state is SubtaskState.FAILED)


def cyclic(subtasks: tuple[Subtask, ...]) -> bool:
    """Whether subtasks wait for each other in a circle, or for some that are not there (Kahn's algorithm)."""
    waiting = {each.id: set(each.after) for each in subtasks}
    while free := {each for each, before in waiting.items() if not before}:
        waiting = {each: before - free for each, before in waiting.items() if each not in free}
    return bool(waiting)


def revised(record: TaskRecord, event: Transition) -> TaskRecord:
    """Put the plan of a revision in place of the present one."""
    kind = _KINDS[event.kind]
    if record.state is not TaskState.RUNNING or event.plan is None:
        raise StaleTransitionError(f"a revised plan for task {record.id}, which is {record.state}")
    target = _given(record, event.subtask)
    if kind is RevisionKind.PLAN and record.proposal is None:
        raise StaleTransitionError("a new plan that was not proposed")
    planned = {each.id: each for each in event.plan.subtasks}
    before = {each.subtask.id: each for each in record.subtasks}
    _check(record, event.plan, planned, before)
    records = tuple(_carried(each, before.get(each.id), target, event) for each in event.plan.subtasks)
    dropped = tuple(each for each in record.subtasks if each.subtask.id not in planned)
    revision = Revision(
        number=record.revised + 1,
        kind=kind,
        at_ns=event.at_ns,
        subtask=event.subtask,
        why=target.failure.message if target.failure else target.note,
        note=event.note,
        plan=record.plan,
        dropped=tuple(_dropped(each) for each in dropped),
        added=tuple(each for each in planned if each not in before),
    )
    kept = (*record.revisions, revision)[-KEPT_REVISIONS:]
    return replace(
        record,
        plan=event.plan,
        subtasks=records,
        proposal=record.proposal if kind is not RevisionKind.PLAN else None,
        revisions=tuple(replace(each, plan=None) for each in kept[:-KEPT_PLANS]) + kept[-KEPT_PLANS:],
        revised=record.revised + 1,
        replans=record.replans + (kind is RevisionKind.PLAN),
        retired=(*record.retired, *(each.subtask.id for each in dropped)),
    )


def proposed(record: TaskRecord, event: Transition) -> TaskRecord:
    """Keep what the decomposer proposes until it takes effect."""
    if record.proposal is not None or event.plan is None or record.state is not TaskState.RUNNING:
        raise StaleTransitionError(f"a second proposal for task {record.id}, or none at all")
    target = _failed(record, event.subtask)
    proposal = Proposal(
        plan=event.plan,
        subtask=event.subtask,
        note=event.note,
        waits=event.waits,
        hash=plan_hash(event.plan),
        since_s=event.elapsed_s,
        expires_s=event.expires_s,
        at_ns=event.at_ns,
    )
    note = "waits for an operator to agree to the new plan" if event.waits else "a new plan is there"
    return _with(replace(record, proposal=proposal), replace(target, note=note))


def replan_failed(record: TaskRecord, event: Transition) -> TaskRecord:
    """End the task with the failure that nothing could be done about; what has not begun is cancelled."""
    target = _failed(record, event.subtask)
    first = target.failure
    if first is None:
        raise StaleTransitionError(f"{event.subtask} has failed without a reason")
    message = f"{event.subtask} ({target.subtask.skill}): {first.message}"
    failure = replace(first, message=f"{message}; not replanned: {event.note}" if event.note else message)
    subtasks = tuple(
        replace(each, state=SubtaskState.CANCELLED, note="")
        if each.state in (SubtaskState.WAITING, SubtaskState.READY)
        else replace(each, note="")
        if each.state is SubtaskState.FAILED
        else each
        for each in record.subtasks
    )
    return replace(record, state=TaskState.CANCELLING, failure=failure, subtasks=subtasks, proposal=None)


def noticed(record: TaskRecord, event: Transition) -> TaskRecord:
    """Note what the monitor found of a subtask, or how its replanning stands."""
    target = _given(record, event.subtask)
    done = target.state in (SubtaskState.SUCCEEDED, SubtaskState.CANCELLED)
    if done or event.attempt != target.attempt:
        raise StaleTransitionError(f"notice of attempt {event.attempt} of {event.subtask}, which is {target.state}")
    return _with(record, replace(target, note=event.note, condition=event.condition))


def _check(record: TaskRecord, plan: Plan, planned: Mapping[str, Subtask], before: Mapping[str, SubtaskRecord]) -> None:
    """Refuse a plan that would lose, double or orphan something."""
    if len(planned) != len(plan.subtasks) or not planned or len(planned) > MAX_SUBTASKS:
        raise StaleTransitionError(f"a revised plan of {len(plan.subtasks)} subtasks, {len(planned)} of them different")
    if cyclic(plan.subtasks):
        raise StaleTransitionError("subtasks of the revised plan wait for each other, or for none of it")
    for each in record.subtasks:
        name = each.subtask.id
        if (each.state is SubtaskState.SUCCEEDED or each.state in ACTIVE) and planned.get(name) != each.subtask:
            raise StaleTransitionError(f"the revised plan leaves out or changes {name}, which is {each.state}")
    retired = frozenset(record.retired)
    for name, subtask in planned.items():
        if name in retired:
            raise StaleTransitionError(f"the revised plan uses the id {name} again")
        old = before.get(name)
        if old is not None and old.attempts and _what(old.subtask) != _what(subtask):
            raise StaleTransitionError(f"the revised plan makes another subtask of {name}, which was begun")


def _what(subtask: Subtask) -> tuple[object, ...]:
    return (subtask.skill, subtask.robot, subtask.params)


def _carried(subtask: Subtask, old: SubtaskRecord | None, target: SubtaskRecord, event: Transition) -> SubtaskRecord:
    """The record of a subtask of the revised plan, with what is known of it."""
    if old is not None and (old.state is SubtaskState.SUCCEEDED or old.state in ACTIVE):
        return old
    moves = event.kind is TransitionKind.REBOUND and subtask.robot == target.subtask.robot
    robot = event.robot if moves else old.bound_robot if old is not None else None
    if old is not None and old.state is SubtaskState.FAILED and not moves and old is not target:
        return replace(old, subtask=subtask)  # its own turn comes
    if old is not None:
        failure = old.failure if old.attempts else None
        return replace(
            old, subtask=subtask, state=SubtaskState.WAITING, bound_robot=robot, failure=failure, note="", condition=""
        )
    fresh = SubtaskRecord(subtask=subtask, bound_robot=robot)
    if event.kind is TransitionKind.SUBSTITUTED:
        return replace(fresh, instead_of=(*target.instead_of, target.subtask.skill)[-MAX_INSTEAD_OF:])
    return fresh


def _dropped(record: SubtaskRecord) -> Dropped:
    return Dropped(
        id=record.subtask.id,
        skill=record.subtask.skill,
        robot=record.bound_robot or record.subtask.robot,
        state=record.state,
        failure=record.failure,
    )


def _given(record: TaskRecord, subtask: str) -> SubtaskRecord:
    try:
        return record.of(subtask)
    except KeyError:
        raise StaleTransitionError(f"task {record.id} has no subtask {subtask!r}") from None


def _failed(record: TaskRecord, subtask: str) -> SubtaskRecord:
    target = _given(record, subtask)
    if record.state is not TaskState.RUNNING or target.state is not SubtaskState.FAILED:
        raise StaleTransitionError(f"{subtask} of task {record.id}, which is {target.state}, needs no new plan")
    return target


def _with(record: TaskRecord, changed: SubtaskRecord) -> TaskRecord:
    return replace(
        record,
        subtasks=tuple(changed if each.subtask.id == changed.subtask.id else each for each in record.subtasks),
    )
