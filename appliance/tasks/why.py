"""Why each attempt of a task was served where it was: a record's reasons, flat, as `swiftbot pool why` prints them."""

from msgspec import Struct

from appliance.errors import NotFoundError
from appliance.model import Attempt, Choice, Failure, SubtaskRecord, TaskRecord


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


class SubtaskWhy(Struct, frozen=True, kw_only=True):
    """A subtask with its attempts; `note` says what one without any waits for."""

    id: str
    skill: str
    state: str
    note: str
    attempts: tuple[AttemptWhy, ...]


class TaskWhy(Struct, frozen=True, kw_only=True):
    """A task with the reasons for where its subtasks ran."""

    id: str
    state: str
    coordinator: str
    subtasks: tuple[SubtaskWhy, ...]


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
    )


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
