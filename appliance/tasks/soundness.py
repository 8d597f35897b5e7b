"""What a task record from elsewhere must be like to be driven. Pure.

Records come from other gateways, of other versions too, and a stranger on the network can write one. One that can
never end (a cycle), or is beyond all bounds, is ended with the reason instead of being driven.
"""

from graphlib import CycleError, TopologicalSorter

from appliance.llm.checks.schema import MAX_SUBTASKS
from appliance.model import Failure, TaskRecord
from appliance.tasks.bounds import MAX_DEPTH, clean, too_deep

MOST_SUBTASKS = 8 * MAX_SUBTASKS
"""Of a record: a plan's, and those that revisions have added."""


def unsound(record: TaskRecord) -> Failure | None:
    """Return why a record cannot be driven to an end; None when it can."""
    if reason := _reason(record):
        message = f"the task's record is unsound: {reason}"
        return Failure(code="payload", message=message, remedy="hand the task in anew")
    return None


def _reason(record: TaskRecord) -> str:
    if len(record.subtasks) > MOST_SUBTASKS:
        return f"{len(record.subtasks):,} subtasks, at most {MOST_SUBTASKS} are possible"
    before = {each.subtask.id: each.subtask.after for each in record.subtasks}
    if len(before) < len(record.subtasks):
        return "two subtasks have the same id"
    for each in record.subtasks:
        if missing := [other for other in each.subtask.after if other not in before]:
            return f"{_short(each.subtask.id)} comes after {_short(missing[0])}, which there is not"
        if too_deep(each.subtask.params) or too_deep(each.result):
            return f"{_short(each.subtask.id)} has data nested more than {MAX_DEPTH} deep"
    try:
        # In time that grows with the record: what comes after what may fill megabytes.
        TopologicalSorter(before).prepare()
    except CycleError as error:
        circle: list[str] = error.args[1][:-1]
        return f"{', '.join(_short(name) for name in sorted(circle)[:5])} wait for each other"
    return ""


def _short(name: str) -> str:
    return repr(clean(name, 40))
