"""Subtasks in an order in which they can be done; what comes before what."""

import hashlib
from collections.abc import Iterable

from appliance.model import Subtask, TaskRecord


def in_order(subtasks: Iterable[Subtask]) -> tuple[Subtask, ...]:
    """Return subtasks so that each stands after those it comes after, otherwise as they stood."""
    waiting = list(subtasks)
    known = {each.id for each in waiting}
    done: set[str] = set()
    ordered: list[Subtask] = []
    while waiting:
        free = [each for each in waiting if done.issuperset(known.intersection(each.after))]
        if not free:
            return (*ordered, *waiting)  # a cycle: whoever checks the plan will say so
        ordered.extend(free)
        done.update(each.id for each in free)
        waiting = [each for each in waiting if each.id not in done]
    return tuple(ordered)


def before(subtask: str, subtasks: Iterable[Subtask]) -> frozenset[str]:
    """Return the ids of all that a subtask comes after, directly or not."""
    after = {each.id: each.after for each in subtasks}
    found: set[str] = set()
    open_ids = list(after.get(subtask, ()))
    while open_ids:
        name = open_ids.pop()
        if name not in found:
            found.add(name)
            open_ids.extend(after.get(name, ()))
    return frozenset(found)


def fresh_ids(record: TaskRecord, count: int) -> list[str]:
    """Return ids for new subtasks of a task's next revision, none of them used before in this task.

    They differ by coordinator, since the two sides of a partition may both revise a plan: the effects of handlers are
    known by these ids, and a robot must not take a command of the one for that of the other.
    """
    taken = {*(each.subtask.id for each in record.subtasks), *record.retired}
    digest = hashlib.sha256(record.coordinator.encode()).digest()
    mark = "".join(chr(ord("a") + byte % 26) for byte in digest[:3])
    found: list[str] = []
    number = 0
    while len(found) < count:
        number += 1
        name = f"r{record.revised + 1}{mark}_{number}"
        if name not in taken:
            found.append(name)
    return found
