"""Which tasks a question for them means, and a page of those. Pure.

Each gateway filters the records that it owns; the one that was asked puts the answers together. A page ends where the
first of them had to stop, so that nothing is left out between two pages. The next page begins after the last task of
the one before: tasks are ordered by the moment at which they were accepted, newest first, and never change place.
"""

from collections.abc import Iterable, Mapping, Sequence

from appliance.model import TaskRecord, encode
from appliance.model.task_api import TaskList, TasksAsk
from appliance.tasks.views import status

Place = tuple[int, str]
"""Where a task stands in the order: when it was accepted, Unix nanoseconds, and its id."""


def place(record: TaskRecord) -> Place:
    """Return where a task stands in the order; the greater, the newer."""
    return record.created_ns, record.id


def is_filtered(ask: TasksAsk) -> bool:
    """Whether a question is about some of the tasks, instead of the newest of all."""
    return bool(ask.status or ask.robot or ask.by or ask.since_ns or ask.text or ask.before_ns or ask.remembered)


def matches(record: TaskRecord, ask: TasksAsk) -> bool:
    """Whether a task is one that a question means."""
    if ask.before_ns and place(record) >= (ask.before_ns, ask.before):
        return False
    if record.created_ns < ask.since_ns:
        return False
    if ask.status and not {str(record.state), status(record)} & set(ask.status):
        return False
    if ask.by and record.submitter.casefold() != ask.by.casefold():
        return False
    if ask.robot and ask.robot not in robots_of(record):
        return False
    return not ask.text or ask.text.casefold() in _text(record).casefold()


def robots_of(record: TaskRecord) -> tuple[str, ...]:
    """Return the robots of a task's subtasks, each once, in the order of the plan; none where it has no plan."""
    return tuple(dict.fromkeys(robot for each in record.subtasks for robot in each.robots))


def _text(record: TaskRecord) -> str:
    failure = record.failure
    return "\n".join((record.id, record.instruction, failure.message if failure is not None else ""))


def newest(records: Iterable[TaskRecord], ask: TasksAsk, *, most_bytes: int) -> TaskList:
    """Return the newest tasks that a question means, as many as it asks for and as fit; `more`: there are others.

    Args:
        records: each task once.
        ask: which, and how many.
        most_bytes: of an answer; the first task is given however large it is.
    """
    found = sorted((each for each in records if matches(each, ask)), key=place, reverse=True)
    kept: list[TaskRecord] = []
    left = most_bytes
    for record in found[: max(0, ask.limit)]:
        left -= len(encode(record))
        if left < 0 and kept:
            break
        kept.append(record)
    return TaskList(tasks=tuple(kept), more=len(kept) < len(found))


def together(answers: Sequence[TaskList]) -> tuple[dict[str, TaskRecord], bool]:
    """Return the tasks of several answers by id, the newest version of each, and whether there are more.

    What is older than the last task of an answer that had to stop there is left out: the next page has it, together
    with what that answer left out.
    """
    floor = max((place(answer.tasks[-1]) for answer in answers if answer.more and answer.tasks), default=None)
    found: dict[str, TaskRecord] = {}
    cut = False
    for record in (record for answer in answers for record in answer.tasks):
        if floor is not None and place(record) < floor:
            cut = True
        elif record.id not in found or found[record.id].sequence < record.sequence:
            found[record.id] = record
    return found, cut or any(answer.more for answer in answers)


def flat(record: TaskRecord) -> Mapping[str, str | int | float]:
    """Return a task as a row of a table of text: what `task export --csv` writes."""
    failure = record.failure
    return {
        "id": record.id,
        "status": status(record),
        "submitter": record.submitter,
        "robots": " ".join(robots_of(record)),
        "created_ns": record.created_ns,
        "updated_ns": record.updated_ns,
        "elapsed_s": round(record.elapsed_s, 3),
        "priority": record.priority,
        "coordinator": record.coordinator,
        "instruction": record.instruction,
        "error": failure.code if failure is not None else "",
        "message": failure.message if failure is not None else "",
    }
