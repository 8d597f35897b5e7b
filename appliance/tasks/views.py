"""A task's record as people and tools want it: flat. Pure.

The record in the DHT is shaped for the state machine. `view` is what `submit --json` and `task show --json` print, with
every field there, so that `jq` needs no cases. `why` gives the reasons why each attempt was served where it was, as
`swiftbot pool why` prints them; `swiftbot task why` prints the same with what the task's coordinator knows besides
(`endpoints.explain`).
"""

from collections.abc import Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import NotFoundError
from appliance.model import (
    Attempt,
    Decision,
    Failure,
    Group,
    Proposal,
    Revision,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Word,
)
from appliance.model.task_api import AttemptWhy, SubtaskWhy, TaskWhy, Waits
from appliance.tasks.records import done_text

WAITS = "waits for "
"""How the note of a subtask begins that waits for something outside of the task."""


def why(record: TaskRecord, subtask: str = "") -> TaskWhy:
    """Return the reasons of a task, or of one of its subtasks; NotFoundError when the plan has none of that id."""
    done = done_text(record)
    chosen = [each for each in record.subtasks if subtask in ("", each.subtask.id)]
    if subtask and not chosen and not done:
        known = ", ".join(each.subtask.id for each in record.subtasks)
        raise NotFoundError(
            f"task {record.id} has no subtask {subtask[:60]!r}", remedy=f"it has: {known or 'none, it is not planned'}"
        )
    return TaskWhy(
        id=record.id,
        state=str(record.state),
        coordinator=record.coordinator,
        subtasks=tuple(_subtask_why(each) for each in chosen),
        submitter=record.submitter,
        priority=record.priority,
        deadline_s=record.deadline_s,
        note=record.note,
        group=record.group,
        waits=waits_for(record),
        done=done,
    )


def waits_for(record: TaskRecord) -> str:
    """What a task or subtasks of it wait for, in words; empty when it is nothing."""
    if record.state is TaskState.PROPOSED and record.proposal is not None:
        return f"an operator to approve its plan {record.proposal.hash[:12]}: {record.proposal.note}"
    if record.state is not TaskState.RUNNING or record.paused:
        return record.paused
    notes = [each.note for each in record.subtasks if not each.state.final and each.note.startswith(WAITS)]
    return "; ".join(dict.fromkeys(note.removeprefix(WAITS) for note in notes))


STATUSES = (*map(str, TaskState), "paused", "needs approval", "blocked")
"""What `status` may return."""


def status(record: TaskRecord) -> str:
    """Return a task's state as people see it.

    A task whose robots are stopped, whose plan nobody has approved, or of which nothing runs for want of something
    outside, is `running` in its record and does not move: `paused`, `needs approval`, `blocked`.
    """
    if record.state.final:
        return str(record.state)
    if record.paused:
        return "paused"
    if record.proposal is not None and record.proposal.waits:
        return "needs approval"
    active = (SubtaskState.DISPATCHED, SubtaskState.RUNNING)
    held = [each for each in record.subtasks if not each.state.final and each.note.startswith(WAITS)]
    moving = [each for each in record.subtasks if each.state in active and each not in held]
    return "blocked" if record.state is TaskState.RUNNING and held and not moving else str(record.state)


def with_waits(found: TaskWhy, waits: Mapping[str, Waits], *, left_s: float | None) -> TaskWhy:
    """Return the reasons with what each subtask waits for, by id."""
    subtasks = tuple(replace(each, waits=waits.get(each.id)) for each in found.subtasks)
    return replace(found, subtasks=subtasks, left_s=left_s)


def _subtask_why(record: SubtaskRecord) -> SubtaskWhy:
    return SubtaskWhy(
        id=record.subtask.id,
        skill=record.subtask.skill,
        state=str(record.state),
        note=record.note,
        attempts=tuple(_attempt(each) for each in record.attempts),
    )


def _attempt(attempt: Attempt) -> AttemptWhy:
    return AttemptWhy(
        number=attempt.number,
        gateway=attempt.gateway,
        container=attempt.container or None,
        phase=str(attempt.phase) if attempt.phase else None,
        placed=attempt.placed,
        choice=attempt.choice,
        failure=attempt.failure,
    )


class SubtaskView(Struct, frozen=True, kw_only=True):
    """One subtask; None where there is nothing (yet)."""

    id: str
    skill: str
    robot: str | None
    others: tuple[str, ...]
    """The further robots of a joint skill."""
    params: dict[str, Any]
    after: tuple[str, ...]
    state: str
    gateway: str | None
    container: str | None
    phase: str | None
    startup_ms: float | None
    """Ready to the first line of the handler."""
    duration_ms: float | None
    """First line of the handler to its result."""
    attempts: int
    progress: float
    note: str
    partial: dict[str, Any] | None
    """The last partial result, while there is none yet."""
    checkpoint_ns: int | None
    """When its last checkpoint was kept."""
    way: str | None
    """How its container came to serve the last attempt."""
    condition: str | None
    """What the monitor finds of it now: `stuck`, `straggling`."""
    cpu_ms: float | None
    peak_mb: float | None
    result: dict[str, Any] | None
    error: Failure | None


class TaskView(Struct, frozen=True, kw_only=True):
    """A task; `tier` and `confidence` are the plan's, None before there is one."""

    id: str
    instruction: str
    state: str
    """Of the state machine."""
    status: str
    """As people see it: the state, or `paused`, `needs approval`, `blocked`."""
    submitter: str
    coordinator: str
    priority: int
    deadline_s: float | None
    """Seconds from acceptance; None without one."""
    elapsed_s: float
    """Seconds since acceptance, at its last transition."""
    group: Group | None
    """The gateways that serve it and its root; None before the first subtask was placed."""
    domain: str | None
    tier: str | None
    confidence: float | None
    plan_ms: float | None
    created_ns: int
    updated_ns: int
    error: Failure | None
    revisions: tuple[Revision, ...]
    """What was changed about its plan after failures, oldest first."""
    proposal: Proposal | None
    """A plan that has not taken effect yet: the first one, or a new one after a failure."""
    decision: Decision | None
    """The last word of an operator on a plan of it."""
    paused: str | None
    """Why no subtask is started."""
    waits: str | None
    """What it or its subtasks wait for: an operator's approval, a robot that was lost, room."""
    cancelled_by: Word | None
    retried_by: Word | None
    subtasks: tuple[SubtaskView, ...]
    notes: tuple[str, ...]
    """What people should know of its course: what a partition doubled, and what was done about it."""
    done: str | None
    """Of a task whose record was trimmed: when it was done, and where its details are."""


def view(record: TaskRecord) -> TaskView:
    """Flatten a record."""
    plan = record.plan
    return TaskView(
        id=record.id,
        instruction=record.instruction,
        state=str(record.state),
        status=status(record),
        submitter=record.submitter,
        coordinator=record.coordinator,
        priority=record.priority,
        deadline_s=record.deadline_s or None,
        elapsed_s=record.elapsed_s,
        group=record.group,
        domain=plan.domain if plan else None,
        tier=str(plan.tier) if plan else None,
        confidence=plan.confidence if plan else None,
        plan_ms=plan.latency_ms if plan else None,
        created_ns=record.created_ns,
        updated_ns=record.updated_ns,
        error=record.failure,
        revisions=record.revisions,
        proposal=record.proposal,
        decision=record.decision,
        paused=record.paused or None,
        waits=waits_for(record) or None,
        cancelled_by=record.cancelled_by,
        retried_by=record.retried_by,
        subtasks=tuple(_subtask_view(each) for each in record.subtasks),
        notes=(
            *(each.note for each in record.splits if each.note),
            *([record.note] if record.remembered is not None and record.note else []),
        ),
        done=done_text(record) or None,
    )


def _subtask_view(record: SubtaskRecord) -> SubtaskView:
    subtask = record.subtask
    choice = record.attempts[-1].choice if record.attempts else None
    return SubtaskView(
        id=subtask.id,
        skill=subtask.skill,
        robot=record.bound_robot or subtask.robot,
        others=record.robots[1:],
        params=subtask.params,
        after=subtask.after,
        state=str(record.state),
        gateway=record.gateway or None,
        container=record.container or None,
        phase=str(record.phase) if record.phase else None,
        startup_ms=record.startup_ms,
        duration_ms=record.duration_ms,
        attempts=record.attempt,
        progress=record.progress,
        note=record.note,
        partial=record.partial,
        checkpoint_ns=record.checkpoint_ns or None,
        way=str(choice.way) if choice else None,
        condition=record.condition or None,
        cpu_ms=record.attempts[-1].cpu_ms if record.attempts else None,
        peak_mb=record.attempts[-1].peak_mb if record.attempts else None,
        result=record.result,
        error=record.failure,
    )
