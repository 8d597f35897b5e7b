"""The life of a task as a pure state machine, so that the daemon, the tests and a log's replay run the same code.

`apply` folds one `Transition` into a `TaskRecord`; it does no I/O, reads no clock and knows no configuration:
all that a decision depended on stands in the transition (for instance `give_up`, the outcome of the retry
policy). `ready`, `active` and `fits` say what a record asks for next. The coordinator publishes each transition it
applies, in order, so that folding the logged ones over nothing must give the record that was logged last.

    accepted ──planned──► running ──all succeeded──► succeeded
       │                     ├──an attempt given up──► cancelling ──runs ended──► failed
       └──plan failed──►     └──cancel──► cancelling ──runs ended──► cancelled
          failed

A subtask: waiting → ready → dispatched → running → succeeded; an attempt that failed and may be repeated goes
back to ready with the next attempt number; results of other attempts than the current one are stale.

**Revisions.** A subtask that was given up with `replan` stands as failed in a task that goes on running. What is done
about it comes as one transition each: `rebound` (another robot), `substituted` (an alternative skill) and `replanned`
(a new plan of the decomposer, which was `proposed` and perhaps `approved` before) carry the whole plan from then on,
which is checked here against what the record holds:

- what has succeeded or is under way is in it, unchanged, so that nothing is done twice and no run is left behind;
- what was begun keeps its id only as the same subtask; ids that are new were never of this task before, since the
  effects of handlers are known by them;
- it has no cycle and names only what is in it.

`replan failed` ends the task with the failure that nothing could be done about.

**Operators' orders.**

- A first plan that has to be approved makes the task `proposed`: nothing runs. `approved` begins it, with the plan that
  was proposed or an edited one; `rejected` cancels it. The same two end the wait of a plan after a failure. An operator
  gives a plan by its hash, which may be cut short.
- `paused` keeps subtasks from being started; `resumed` takes that back. A task may be paused for several reasons, an
  operator's wish and a soft stop of a robot, and goes on when the last has gone.
- `ranked` changes its priority and its place among the tasks that wait for the same robot.
- `held` leaves a run for a later attempt: its number fences late news of it off, and it counts for no failure.
- `retried` begins a task that has failed or was cancelled again, or one of its subtasks: what has succeeded is kept,
  and attempts count on from where they were.
"""

from collections.abc import Callable, Mapping

from msgspec.structs import replace

from appliance.model import (
    MAX_SUBTASKS,
    Attempt,
    Decision,
    Dropped,
    Failure,
    Plan,
    Proposal,
    Revision,
    RevisionKind,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    plan_hash,
)
from appliance.model.transitions import StaleTransitionError, Transition, TransitionKind

SHORTEST = 8
"""Characters of a hash that an approval must give at least: a person reads them from a screen."""


def matches(given: str, known: str) -> bool:
    """Whether a hash that an operator gives, or the beginning of it, means this plan."""
    return len(given) >= SHORTEST and known.startswith(given.lower())


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


MOST_PAUSES = 16
"""Reasons for one pause that are listed: more stops of one task's robots make it no more paused."""
_LIVE = (TaskState.ACCEPTED, TaskState.PROPOSED, TaskState.RUNNING)
_AGAIN = (SubtaskState.FAILED, SubtaskState.CANCELLED)


def begun(record: TaskRecord, plan: Plan) -> TaskRecord:
    """Return a task as it begins with a plan."""
    subtasks = tuple(
        SubtaskRecord(subtask=subtask, state=SubtaskState.WAITING if subtask.after else SubtaskState.READY)
        for subtask in plan.subtasks
    )
    return replace(record, state=TaskState.RUNNING, plan=plan, subtasks=subtasks, proposal=None)


def awaiting_approval(record: TaskRecord, event: Transition) -> TaskRecord:
    """Keep a plan until it takes effect: the first one, or one after a failure (`revising`)."""
    if event.subtask:
        return proposed(record, event)
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
    return replace(replan_failed(record, event), decision=decision)


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


def ranked(record: TaskRecord, event: Transition) -> TaskRecord:
    """Change its place among those that wait for the same robot."""
    return replace(record, priority=event.priority, place_ns=event.place_ns, ranked_by=event.word)


def held(record: TaskRecord, event: Transition) -> TaskRecord:
    """Leave a run; its subtask is ready for the next attempt."""
    target = _of(record, event.subtask)
    if record.state is not TaskState.RUNNING or target.state not in ACTIVE or event.attempt != target.attempt:
        raise StaleTransitionError(f"attempt {event.attempt} of {event.subtask} is not under way any more")
    return _with(record, _left(target, event.note))


def retried(record: TaskRecord, event: Transition) -> TaskRecord:
    """Begin again what has not succeeded."""
    if record.state in (TaskState.FAILED, TaskState.CANCELLED):
        return _anew(record, event)
    if record.state is not TaskState.RUNNING:
        raise StaleTransitionError(f"task {record.id} is {record.state}")
    target = _of(record, event.subtask)
    if target.state in ACTIVE:
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


HANDLERS: dict[TransitionKind, Callable[[TaskRecord, Transition], TaskRecord]] = {
    TransitionKind.PROPOSED: awaiting_approval,
    TransitionKind.APPROVED: approved,
    TransitionKind.REJECTED: rejected,
    TransitionKind.PAUSED: paused,
    TransitionKind.RESUMED: resumed,
    TransitionKind.HELD: held,
    TransitionKind.RETRIED: retried,
    TransitionKind.RANKED: ranked,
}
"""By kind; `proposed` takes the place of the one in `revising`, which it calls."""


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
    return begun(replace(record, note=event.note or record.note), event.plan)


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
            others=event.others,
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
    TransitionKind.NOTICED: noticed,
    TransitionKind.REBOUND: revised,
    TransitionKind.SUBSTITUTED: revised,
    TransitionKind.REPLANNED: revised,
    TransitionKind.REPLAN_FAILED: replan_failed,
    **HANDLERS,
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
