"""The life of a task as a pure state machine, so that the daemon, the tests and a log's replay run the same code.

`apply` folds one `Transition` into a `TaskRecord`; it does no I/O, reads no clock and knows no configuration:
all that a decision depended on stands in the transition (for instance `give_up`, the outcome of the retry
policy). `actions` says what a record asks for next. The coordinator publishes each transition it applies, in
order, so that folding the logged ones over nothing must give the record that was logged last.

    accepted ──planned──► running ──all succeeded──► succeeded
       │                     ├──an attempt given up──► cancelling ──runs ended──► failed
       └──plan failed──►     └──cancel──► cancelling ──runs ended──► cancelled
          failed

A plan that an operator has to approve makes the task `proposed` first; `steering.transitions` has that, pauses, and
how a task that has ended is tried again.

A subtask: waiting → ready → dispatched → running → succeeded; an attempt that failed and may be repeated goes
back to ready with the next attempt number; results of other attempts than the current one are stale. One that is
given up with `replan` leaves its task running until its plan is revised (`revising`) or cannot be.
"""

from collections.abc import Callable

from msgspec.structs import replace

from appliance.model import (
    Attempt,
    Failure,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.tasks import revising
from appliance.tasks.steering import transitions as steering
from appliance.tasks.transition import StaleTransitionError, Transition, TransitionKind


def apply(record: TaskRecord | None, event: Transition) -> TaskRecord:
    """Fold one transition into a record.

    Args:
        record: the task so far; None only for `accepted`.
        event: what happened; its sequence must be the record's plus one.

    Returns:
        The record after it.

    Raises:
        StaleTransitionError: it does not fit; the record stands as it was.
    """
    if record is None:
        if event.kind is not TransitionKind.ACCEPTED or event.sequence != 1:
            raise StaleTransitionError(f"{event.kind} (sequence {event.sequence}) before the task was accepted")
        return TaskRecord(
            id=event.task,
            instruction=event.instruction,
            submitter=event.submitter,
            priority=event.priority,
            deadline_s=event.deadline_s,
            within=event.within,
            note=event.note,
            plan=event.plan,
            handed_in=event.plan is not None,
            approval=event.approval,
            coordinator=event.coordinator,
            created_ns=event.at_ns,
            updated_ns=event.at_ns,
            sequence=1,
        )
    if event.task != record.id:
        raise StaleTransitionError(f"transition of task {event.task} applied to {record.id}")
    if event.sequence != record.sequence + 1:
        raise StaleTransitionError(f"sequence {event.sequence} after {record.sequence}")
    if record.state.final and event.kind not in _AFTER_THE_END:
        raise StaleTransitionError(f"task {record.id} has already {record.state}")
    handler = _HANDLERS.get(event.kind)
    if handler is None:
        raise StaleTransitionError(f"{event.kind} of a task that was accepted before")
    changed = _settle(handler(record, event))
    return replace(
        changed,
        sequence=event.sequence,
        updated_ns=event.at_ns,
        coordinator=event.coordinator,
        elapsed_s=max(record.elapsed_s, event.elapsed_s),
    )


def fits(record: TaskRecord, event: Transition) -> bool:
    """Whether `apply` would take the transition."""
    try:
        apply(record, event)
    except StaleTransitionError:
        return False
    return True


def _planned(record: TaskRecord, event: Transition) -> TaskRecord:
    if record.state is not TaskState.ACCEPTED or event.plan is None:
        raise StaleTransitionError(f"a plan for task {record.id}, which is {record.state}")
    return steering.begun(replace(record, note=event.note or record.note), event.plan)


def _plan_failed(record: TaskRecord, event: Transition) -> TaskRecord:
    if record.state not in (TaskState.ACCEPTED, TaskState.PROPOSED, TaskState.CANCELLING):
        raise StaleTransitionError(f"no plan for task {record.id}, which is {record.state}")
    return replace(record, state=TaskState.FAILED, failure=event.failure, proposal=None)


def _adopted(record: TaskRecord, _: Transition) -> TaskRecord:
    return record


def _grouped(record: TaskRecord, event: Transition) -> TaskRecord:
    if event.group is None or not event.group.members or event.group.root not in event.group.members:
        raise StaleTransitionError(f"a group of task {record.id} without members, or with a root that is none")
    return replace(record, group=event.group)


def _dispatched(record: TaskRecord, event: Transition) -> TaskRecord:
    target = _subtask(record, event)
    if record.state is not TaskState.RUNNING or target.state is not SubtaskState.READY or record.pauses:
        raise StaleTransitionError(f"dispatch of {event.subtask}, which is {record.paused or target.state}")
    if event.attempt != target.next_attempt:
        raise StaleTransitionError(f"attempt {event.attempt} of {event.subtask}, which is at {target.attempt}")
    return _with(
        record,
        replace(
            target,
            state=SubtaskState.DISPATCHED,
            bound_robot=event.robot,
            gateway=event.gateway,
            container="",
            phase=None,
            startup_ms=None,
            duration_ms=None,
            progress=0.0,
            note=event.note,
            failure=None,
            condition="",
            attempts=(
                *_faded(target.attempts),
                _attempt(event.attempt, event),
            ),
        ),
    )


def _attempt(number: int, event: Transition) -> Attempt:
    return Attempt(
        number=number,
        gateway=event.gateway,
        placed=event.placed,
        load=event.load,
        free=event.free,
        robot=event.robot,
    )


def _moved(record: TaskRecord, event: Transition) -> TaskRecord:
    """Leave a run for a new attempt elsewhere; what it told so far stays until the new one tells more."""
    target = _current(record, event, SubtaskState.DISPATCHED, SubtaskState.RUNNING)
    if record.state is not TaskState.RUNNING:
        raise StaleTransitionError(f"a move of {event.subtask} while task {record.id} is {record.state}")
    left = replace(target.attempts[-1], left=event.note, choice=event.choice or target.attempts[-1].choice)
    return _with(
        record,
        replace(
            target,
            state=SubtaskState.DISPATCHED,
            gateway=event.gateway,
            container="",
            phase=None,
            startup_ms=None,
            duration_ms=None,
            note=event.note,
            condition="",
            attempts=(
                *_faded((*target.attempts[:-1], left)),
                replace(_attempt(target.next_attempt, event), robot=target.bound_robot),
            ),
        ),
    )


def _healed(record: TaskRecord, event: Transition) -> TaskRecord:
    """Note versions that lost, and fence their attempts off; also of a task that has ended."""
    subtasks = tuple(
        replace(each, fence=max(each.fence, event.fences.get(each.subtask.id, 0))) for each in record.subtasks
    )
    return replace(record, subtasks=subtasks, splits=event.splits)


def _started(record: TaskRecord, event: Transition) -> TaskRecord:
    target = _current(record, event, SubtaskState.DISPATCHED)
    return _with(
        record,
        replace(
            target,
            state=SubtaskState.RUNNING,
            gateway=event.gateway,
            container=event.container,
            phase=event.phase,
            startup_ms=event.startup_ms,
            note="",
            attempts=_served(target, event),
        ),
    )


def _served(target: SubtaskRecord, event: Transition) -> tuple[Attempt, ...]:
    """The attempts, the last with what is known now of where and how it was served."""
    last = target.attempts[-1]
    attempt = replace(
        last,
        gateway=event.gateway or last.gateway,
        container=event.container or last.container,
        phase=event.phase or last.phase,
        choice=event.choice or last.choice,
        cpu_ms=event.cpu_ms,
        peak_mb=event.peak_mb,
    )
    return (*target.attempts[:-1], attempt)


def _faded(attempts: tuple[Attempt, ...]) -> tuple[Attempt, ...]:
    """The attempts so far, only the latest with all that was considered: a record must stay small."""
    return (
        tuple(
            replace(each, choice=replace(each.choice, considered=()))
            if each.choice and each.choice.considered
            else each
            for each in attempts[: 1 - KEPT_CHOICES]
        )
        + attempts[1 - KEPT_CHOICES :]
    )


def _progress(record: TaskRecord, event: Transition) -> TaskRecord:
    target = _subtask(record, event)
    if target.state.final or event.attempt != target.attempt:
        raise StaleTransitionError(f"progress of attempt {event.attempt} of {event.subtask}, which is {target.state}")
    gateway = target.gateway if target.state is SubtaskState.READY else event.gateway or target.gateway
    return _with(record, replace(target, progress=event.progress, note=event.note, gateway=gateway))


def _partial(record: TaskRecord, event: Transition) -> TaskRecord:
    target = _current(record, event, SubtaskState.DISPATCHED, SubtaskState.RUNNING)
    return _with(record, replace(target, partial=event.result))


def _checkpoint(record: TaskRecord, event: Transition) -> TaskRecord:
    target = _current(record, event, SubtaskState.DISPATCHED, SubtaskState.RUNNING)
    return _with(record, replace(target, checkpoint_ns=event.at_ns))


def _succeeded(record: TaskRecord, event: Transition) -> TaskRecord:
    # A run that ends at once can be heard of by its result first: dispatched is as good as running here.
    target = _current(record, event, SubtaskState.DISPATCHED, SubtaskState.RUNNING)
    done = replace(
        target,
        state=SubtaskState.SUCCEEDED,
        progress=1.0,
        note="",
        condition="",
        partial=None,
        result=event.result or {},
        duration_ms=event.duration_ms,
        gateway=event.gateway or target.gateway,
        container=event.container or target.container,
        phase=event.phase or target.phase,
        attempts=_served(target, event),
    )
    return _with(record, done)


def _attempt_failed(record: TaskRecord, event: Transition) -> TaskRecord:
    target = _subtask(record, event)
    if event.failure is None:
        raise StaleTransitionError("a failed attempt without a reason")
    if target.state is SubtaskState.READY and event.attempt == target.next_attempt and event.give_up:
        # Given up before it could be sent anywhere: nobody can run it.
        attempts = target.attempts
    else:
        target = _current(record, event, SubtaskState.DISPATCHED, SubtaskState.RUNNING)
        last = replace(
            target.attempts[-1],
            failure=event.failure,
            choice=event.choice or target.attempts[-1].choice,
            cpu_ms=event.cpu_ms,
            peak_mb=event.peak_mb,
        )
        attempts = (*target.attempts[:-1], last)
    ended = replace(target, attempts=attempts, failure=event.failure, duration_ms=event.duration_ms, note="")
    if record.state is TaskState.CANCELLING:
        return _with(record, replace(ended, state=SubtaskState.CANCELLED))
    if not event.give_up:
        return _with(record, replace(ended, state=SubtaskState.READY, note=f"repeats: {event.failure.message}"))
    if event.replan:
        return _with(record, replace(ended, state=SubtaskState.FAILED, note="is to be replanned"))
    failure = replace(event.failure, message=f"{event.subtask} ({target.subtask.skill}): {event.failure.message}")
    failed = _with(record, replace(ended, state=SubtaskState.FAILED))
    return _stop_rest(replace(failed, state=TaskState.CANCELLING, failure=failure))


def _cancel(record: TaskRecord, event: Transition) -> TaskRecord:
    """Stop everything; with a `failure` it is the appliance that gives the task up, not a person."""
    if record.state is TaskState.CANCELLING:
        raise StaleTransitionError(f"task {record.id} is being cancelled already")
    proposal = None if record.state is TaskState.PROPOSED else record.proposal
    return _stop_rest(
        replace(record, state=TaskState.CANCELLING, failure=event.failure, cancelled_by=event.word, proposal=proposal)
    )


def _stop_rest(record: TaskRecord) -> TaskRecord:
    """Cancel what has not been sent anywhere; runs in progress end by their own events."""
    return replace(
        record,
        subtasks=tuple(
            replace(each, state=SubtaskState.CANCELLED, note="")
            if each.state in (SubtaskState.WAITING, SubtaskState.READY)
            else each
            for each in record.subtasks
        ),
    )


def _settle(record: TaskRecord) -> TaskRecord:
    """Draw what follows by itself: predecessors done makes ready, all done ends the task."""
    if record.state is TaskState.RUNNING:
        done = {each.subtask.id for each in record.subtasks if each.state is SubtaskState.SUCCEEDED}
        subtasks = tuple(
            replace(each, state=SubtaskState.READY, note=record.paused or each.note)
            if each.state is SubtaskState.WAITING and done.issuperset(each.subtask.after)
            else each
            for each in record.subtasks
        )
        state = TaskState.SUCCEEDED if len(done) == len(subtasks) else TaskState.RUNNING
        return replace(record, subtasks=subtasks, state=state)
    if record.state is TaskState.CANCELLING and all(each.state.final for each in record.subtasks):
        return replace(record, state=TaskState.FAILED if record.failure else TaskState.CANCELLED)
    return record


def _subtask(record: TaskRecord, event: Transition) -> SubtaskRecord:
    try:
        return record.of(event.subtask)
    except KeyError:
        raise StaleTransitionError(f"task {record.id} has no subtask {event.subtask!r}") from None


def _current(record: TaskRecord, event: Transition, *states: SubtaskState) -> SubtaskRecord:
    target = _subtask(record, event)
    if target.state not in states or event.attempt != target.attempt:
        raise StaleTransitionError(
            f"{event.kind} of attempt {event.attempt} of {event.subtask}, which is {target.state} at {target.attempt}"
        )
    return target


def _with(record: TaskRecord, changed: SubtaskRecord) -> TaskRecord:
    return replace(
        record,
        subtasks=tuple(changed if each.subtask.id == changed.subtask.id else each for each in record.subtasks),
    )


_HANDLERS: dict[TransitionKind, Callable[[TaskRecord, Transition], TaskRecord]] = {
    TransitionKind.PLANNED: _planned,
    TransitionKind.PLAN_FAILED: _plan_failed,
    TransitionKind.ADOPTED: _adopted,
    TransitionKind.GROUPED: _grouped,
    TransitionKind.DISPATCHED: _dispatched,
    TransitionKind.STARTED: _started,
    TransitionKind.PROGRESS: _progress,
    TransitionKind.PARTIAL: _partial,
    TransitionKind.CHECKPOINT: _checkpoint,
    TransitionKind.SUCCEEDED: _succeeded,
    TransitionKind.ATTEMPT_FAILED: _attempt_failed,
    TransitionKind.MOVED: _moved,
    TransitionKind.HEALED: _healed,
    TransitionKind.CANCEL: _cancel,
    TransitionKind.NOTICED: revising.noticed,
    TransitionKind.REBOUND: revising.revised,
    TransitionKind.SUBSTITUTED: revising.revised,
    TransitionKind.REPLANNED: revising.revised,
    TransitionKind.REPLAN_FAILED: revising.replan_failed,
    **steering.HANDLERS,
}
_AFTER_THE_END = (TransitionKind.HEALED, TransitionKind.RETRIED)


def ready(record: TaskRecord) -> tuple[SubtaskRecord, ...]:
    """Subtasks that may be dispatched now; none while the task is paused."""
    if record.state is not TaskState.RUNNING or record.pauses:
        return ()
    return tuple(each for each in record.subtasks if each.state is SubtaskState.READY)


def active(record: TaskRecord) -> tuple[SubtaskRecord, ...]:
    """Subtasks with a run somewhere."""
    return tuple(each for each in record.subtasks if each.state in (SubtaskState.DISPATCHED, SubtaskState.RUNNING))


def retry_delay_s(attempt: int) -> float:
    """Pause before the attempt after this one, seconds: 0.2, 0.4, 0.8, ... up to 5."""
    return min(5.0, 0.2 * 2 ** max(0, attempt - 1))


def gives_up(target: SubtaskRecord, failure: Failure, *, retries: int) -> bool:
    """Whether a failed attempt is the last: not worth repeating, or the skill's retries are used up.

    An attempt that was lost with its gateway (`unreachable`, `orphaned`) or its container (`stopped`), or refused by
    a full or draining one (`refused`), says nothing about the subtask: those do not use up the skill's own retries but
    a bound of their own.
    """
    if not failure.retryable:
        return True
    # Attempts that were moved away or held count for neither, nor those before an operator had it tried again.
    own = [a for a in target.attempts if a.failure and not a.left and a.failure.code not in _NOT_ITS_FAULT]
    others = sum(not a.left for a in target.attempts) - len(own)
    if failure.code in _NOT_ITS_FAULT:
        return others >= MAX_DISPLACEMENTS
    return len(own) >= retries


_NOT_ITS_FAULT = ("unreachable", "refused", "pool", "stopped", "orphaned")
KEPT_CHOICES = 3
"""Attempts of a subtask whose record says all that was considered for them; of earlier ones what was decided."""
MAX_DISPLACEMENTS = 8
"""Attempts lost to gateways before a subtask is given up: more than a fleet loses at once, yet bounded."""
