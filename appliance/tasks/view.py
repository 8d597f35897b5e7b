"""A task as tools want it: flat, with every field there, so that `jq` needs no cases.

The record in the DHT is shaped for the state machine; this is what `submit --json` and `task show --json` print.
"""

from typing import Any

from msgspec import Struct

from appliance.model import Decision, Failure, Group, Proposal, Revision, SubtaskRecord, TaskRecord, Word
from appliance.tasks.why import waits_for


class SubtaskView(Struct, frozen=True, kw_only=True):
    """One subtask; None where there is nothing (yet)."""

    id: str
    skill: str
    robot: str | None
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


def view(record: TaskRecord) -> TaskView:
    """Flatten a record."""
    plan = record.plan
    return TaskView(
        id=record.id,
        instruction=record.instruction,
        state=str(record.state),
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
        subtasks=tuple(_subtask(each) for each in record.subtasks),
        notes=tuple(each.note for each in record.splits if each.note),
    )


def _subtask(record: SubtaskRecord) -> SubtaskView:
    subtask = record.subtask
    choice = record.attempts[-1].choice if record.attempts else None
    return SubtaskView(
        id=subtask.id,
        skill=subtask.skill,
        robot=record.bound_robot or subtask.robot,
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
