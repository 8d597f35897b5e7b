"""What a task record from elsewhere must be like to be driven, and what of it is kept though not understood. Pure.

Records come from other gateways, of other versions too, and a stranger on the network can write one. One that can
never end (a cycle), or is beyond all bounds, is ended with the reason instead of being driven; fields that this version
does not know stay in it, for those that do.
"""

from typing import Any, cast

import msgspec

from appliance.llm.validate import MAX_SUBTASKS
from appliance.model import Failure, SubtaskRecord, TaskRecord, encode
from appliance.tasks.bounds import MAX_DEPTH, clean, too_deep

MOST_SUBTASKS = 8 * MAX_SUBTASKS
"""Of a record: a plan's, and those that revisions have added."""

Unknown = dict[str, dict[str, Any]]
"""Fields by where they stand: "" for the record itself, else a subtask's id."""


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
    done: set[str] = set()
    while ready := [name for name, after in before.items() if name not in done and done.issuperset(after)]:
        done.update(ready)
    if len(done) < len(before):
        circle = sorted(name for name in before if name not in done)
        return f"{', '.join(_short(name) for name in circle[:5])} wait for each other"
    return ""


def _short(name: str) -> str:
    return repr(clean(name, 40))


def unknown(value: bytes) -> Unknown:
    """Return the fields of a stored record that this version does not know; empty for one that cannot be read."""
    try:
        raw = msgspec.json.decode(value)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return {}
    if not isinstance(raw, dict):
        return {}
    table = cast("dict[str, Any]", raw)
    found: Unknown = {}
    if extra := _extra(table, TaskRecord):
        found[""] = extra
    subtasks: object = table.get("subtasks")
    for each in cast("list[Any]", subtasks) if isinstance(subtasks, list) else []:
        if isinstance(each, dict) and (more := _extra(cast("dict[str, Any]", each), SubtaskRecord)):
            found[str(cast("dict[str, Any]", each).get("subtask", {}).get("id", ""))] = more
    return found


def _extra(table: dict[str, Any], kind: type[msgspec.Struct]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key not in kind.__struct_fields__}


def with_unknown(record: TaskRecord, fields: Unknown) -> bytes:
    """Encode a record with those fields as they were; a subtask that is gone takes its own along."""
    if not fields:
        return encode(record)
    table: dict[str, Any] = msgspec.to_builtins(record)
    table |= fields.get("", {})
    for each in cast("list[dict[str, Any]]", table.get("subtasks", [])):
        each |= fields.get(each["subtask"]["id"], {})  # noqa: PLW2901 - changed in place
    return encode(table)
