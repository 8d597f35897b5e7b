"""Why each attempt of a task was served where it was: a record's reasons, flat, as `swiftbot pool why` prints them.

`swiftbot task why` prints the same with what its coordinator knows besides (`explaining`).
"""

from collections.abc import Mapping

from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import NotFoundError
from appliance.model import PLAIN_PRIORITY, Attempt, Choice, Failure, Group, SubtaskRecord, TaskRecord, TaskState

WAITS = "waits for "
"""How the note of a subtask begins that waits for something outside of the task."""


class AttemptWhy(Struct, frozen=True, kw_only=True):
    """One attempt; `choice` is None where it was never served, or by a version that did not tell."""

    number: int
    gateway: str
    container: str | None
    phase: str | None
    placed: str
    """Why this gateway was asked first: coarse scores, best first."""
    choice: Choice | None
    """Which gateway decided, and what it weighed."""
    failure: Failure | None


class CandidateWhy(Struct, frozen=True, kw_only=True):
    """A gateway with its coarse score for a subtask, or why it is no candidate."""

    gateway: str
    score: float | None = None
    excluded: str = ""


class Waits(Struct, frozen=True, kw_only=True):
    """What a subtask that has not ended waits for, as its coordinator knows it just now."""

    reason: str
    at: str = ""
    """The gateway in whose queue it is; empty: it is with its coordinator."""
    position: int = 0
    """Its place in that queue or among those that wait for room, from 1; 0: in none."""
    waiting: int = 0
    expected_s: float | None = None
    """In how many seconds it is expected to start; None: not known."""
    candidates: tuple[CandidateWhy, ...] = ()
    """The best first, then those that cannot serve it."""


class SubtaskWhy(Struct, frozen=True, kw_only=True):
    """A subtask with its attempts; `note` says what one without any waits for."""

    id: str
    skill: str
    state: str
    note: str
    attempts: tuple[AttemptWhy, ...]
    waits: Waits | None = None
    """None where it has ended, or the coordinator was not asked."""


class TaskWhy(Struct, frozen=True, kw_only=True):
    """A task with the reasons for where its subtasks ran."""

    id: str
    state: str
    coordinator: str
    subtasks: tuple[SubtaskWhy, ...]
    submitter: str = ""
    priority: int = PLAIN_PRIORITY
    deadline_s: float = 0.0
    left_s: float | None = None
    """Seconds until its deadline; None without one, or where the coordinator was not asked."""
    note: str = ""
    """What it had to expect when it was accepted and planned."""
    group: Group | None = None
    """The gateways that serve it, its root, and how that came about."""
    waits: str = ""
    """What the task or subtasks of it wait for: an operator's approval, the end of a pause, a robot that was lost."""


def why(record: TaskRecord, subtask: str = "") -> TaskWhy:
    """Return the reasons of a task, or of one of its subtasks; NotFoundError when the plan has none of that id."""
    chosen = [each for each in record.subtasks if subtask in ("", each.subtask.id)]
    if subtask and not chosen:
        known = ", ".join(each.subtask.id for each in record.subtasks)
        raise NotFoundError(
            f"task {record.id} has no subtask {subtask[:60]!r}", remedy=f"it has: {known or 'none, it is not planned'}"
        )
    return TaskWhy(
        id=record.id,
        state=str(record.state),
        coordinator=record.coordinator,
        subtasks=tuple(_subtask(each) for each in chosen),
        submitter=record.submitter,
        priority=record.priority,
        deadline_s=record.deadline_s,
        note=record.note,
        group=record.group,
        waits=waits_for(record),
    )


def waits_for(record: TaskRecord) -> str:
    """What a task or subtasks of it wait for, in words; empty when it is nothing."""
    if record.state is TaskState.PROPOSED and record.proposal is not None:
        return f"an operator to approve its plan {record.proposal.hash[:12]}: {record.proposal.note}"
    if record.state is not TaskState.RUNNING or record.paused:
        return record.paused
    notes = [each.note for each in record.subtasks if not each.state.final and each.note.startswith(WAITS)]
    return "; ".join(dict.fromkeys(note.removeprefix(WAITS) for note in notes))


def with_waits(found: TaskWhy, waits: Mapping[str, Waits], *, left_s: float | None) -> TaskWhy:
    """Return the reasons with what each subtask waits for, by id."""
    subtasks = tuple(replace(each, waits=waits.get(each.id)) for each in found.subtasks)
    return replace(found, subtasks=subtasks, left_s=left_s)


def _subtask(record: SubtaskRecord) -> SubtaskWhy:
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
