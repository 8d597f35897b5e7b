"""What a task record may hold: bounds of what enters it, validation of one from elsewhere, unknown fields kept.

**Bounds.** Run events come from handlers (people's code) and over the network; a record that holds something that
cannot be encoded, or decoded by the next coordinator, would stop its task on every gateway in turn. So what enters a
record is cut to size first: it stays small, shallow and writable as JSON.

**Validation.** Records come from other gateways, of other versions too, and a stranger on the network can write one.
One that can never end (a cycle), or is beyond all bounds, is ended with the reason instead of being driven.

**Unknown fields.** A coordinator writes a task's record again and again. While a fleet is being upgraded, it may run an
older version than the one that wrote the record before it; fields that only the newer version knows are kept as they
were, in the record and in anything in it.

**Tombstones.** Of a finished task little is kept after a while (`retention`): enough to answer for its id. `trimmed`
makes such a record.

Pure.
"""

import hashlib
from collections.abc import Collection
from datetime import UTC, datetime
from functools import cache
from graphlib import CycleError, TopologicalSorter
from typing import Any, NamedTuple, cast

import msgspec
from msgspec import Struct, field, inspect
from msgspec.structs import replace

from appliance.errors import PayloadError, RefusedError
from appliance.llm.checks.schema import MAX_SUBTASKS
from appliance.model import (
    Failure,
    Plan,
    Remembered,
    RunEvent,
    RunEventKind,
    Split,
    TaskRecord,
    TaskRequest,
    encode,
    keyspace,
)

PREFIX = keyspace.TASK_RECORD.prefix
"""Of the keys of task records in the DHT."""
MAX_DEPTH = 64
"""Nesting of parameters and results: far beyond any use, far below what JSON decoders refuse (about 1,000)."""
MAX_NOTE = 500
MAX_TEXT = 2000
MAX_CODE = 40
MAX_RUN_S = 86_400.0
"""Longest that a plan may ask of a run beyond its skill's own time."""


def task_key(task: str) -> str:
    """Key of a task's record in the DHT."""
    return f"{PREFIX}{task}"


def too_deep(value: object, *, limit: int = MAX_DEPTH) -> bool:
    """Whether lists and tables are nested deeper than `limit`; walks level by level, never recurses."""
    level: list[object] = [value]
    for _ in range(limit + 1):
        below: list[object] = []
        for each in level:
            if isinstance(each, dict):
                below.extend(cast("dict[object, object]", each).values())
            elif isinstance(each, list | tuple):
                below.extend(cast("list[object]", each))
        if not below:
            return False
        level = below
    return True


def result_problem(result: dict[str, Any] | None, *, max_bytes: int) -> Failure | None:
    """Return why a result cannot be kept in a record, or None when it can."""
    if too_deep(result):
        return Failure(
            code="payload", message=f"the result is nested more than {MAX_DEPTH} deep", remedy="return a flatter one"
        )
    try:
        size = len(encode(result))
    except (TypeError, ValueError, OverflowError) as error:
        return Failure(
            code="payload", message=f"the result cannot be written as JSON: {error}"[:MAX_TEXT], remedy="return JSON"
        )
    if size > max_bytes:
        return Failure(
            code="payload",
            message=f"the result has {size:,} bytes of JSON, at most {max_bytes:,} (tasks.max_result_bytes) are kept",
            remedy="have the handler write it into a volume of the skill, or keep it with ctx.put_artifact, and return "
            "where it is",
        )
    return None


def tidy(event: RunEvent, *, max_result_bytes: int) -> RunEvent:
    """Cut an event to size; a success whose result cannot be kept becomes a failure that says so."""
    failure = event.failure and replace(
        event.failure,
        code=clean(event.failure.code, MAX_CODE) or "internal",
        message=clean(event.failure.message, MAX_TEXT),
        remedy=clean(event.failure.remedy, MAX_NOTE),
    )
    kind, result = event.kind, event.result
    if kind is RunEventKind.SUCCEEDED and (problem := result_problem(result, max_bytes=max_result_bytes)):
        kind, failure = RunEventKind.FAILED, problem
    if kind is RunEventKind.FAILED:
        failure, result = failure or Failure(code="internal", message="the run failed without a reason"), None
    return replace(
        event,
        kind=kind,
        result=result,
        failure=failure,
        # The comparison is false for what is not a number, which becomes 0.
        progress=min(1.0, event.progress) if event.progress > 0 else 0.0,
        note=clean(event.note, MAX_NOTE),
    )


_LONG_WORD = 40
"""Characters; a longer word is cut."""


def clean(text: str, limit: int) -> str:
    """Return text without lone surrogates, which no JSON can carry, and at most `limit` characters.

    What is cut ends in an ellipsis, between words where there are any.
    """
    if len(text) > limit:
        whole, blank, _ = text[:limit].rpartition(" ")
        text = f"{(whole if blank and len(whole) > limit - _LONG_WORD else text[: limit - 1]).rstrip()}…"
    return text.encode(errors="replace").decode()


def read_record(value: bytes) -> TaskRecord:
    """Decode a stored task record; PayloadError when it is none."""
    try:
        return msgspec.json.decode(value, type=TaskRecord)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(f"not a task record: {error}") from error


MOST_SUBTASKS = 8 * MAX_SUBTASKS
"""Of a record: a plan's, and those that revisions have added."""


def unsound(record: TaskRecord) -> Failure | None:
    """Return why a record cannot be driven to an end; None when it can."""
    if reason := _reason(record):
        message = f"the task's record is unsound: {reason}"
        return Failure(code="payload", message=message, remedy="submit the task again")
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


class Unknown(Struct):
    """The unknown fields of a struct, and of those in it."""

    fields: dict[str, Any] = field(default_factory=dict[str, Any])
    inside: dict[str, "Unknown"] = field(default_factory=dict[str, "Unknown"])
    """By the known field whose struct they are in."""
    items: dict[str, dict[str, "Unknown"]] = field(default_factory=dict[str, dict[str, "Unknown"]])
    """By the known field, and by which of its structs they are in."""

    def __bool__(self) -> bool:
        """Whether there is any."""
        return bool(self.fields or self.inside or self.items)


class _Shape(NamedTuple):
    """What is known of a kind of struct."""

    names: frozenset[str]
    one: dict[str, type[Struct]]
    """Fields that are a struct, or None."""
    many: dict[str, type[Struct]]
    """Fields that are a row of structs."""


@cache
def _shape(kind: type[Struct]) -> _Shape:
    info = cast("inspect.StructType", inspect.type_info(kind))
    one: dict[str, type[Struct]] = {}
    many: dict[str, type[Struct]] = {}
    for each in info.fields:
        types = each.type.types if isinstance(each.type, inspect.UnionType) else (each.type,)
        for part in types:
            if isinstance(part, inspect.StructType):
                one[each.encode_name] = part.cls
            elif isinstance(part, inspect.ListType | inspect.VarTupleType) and isinstance(
                part.item_type, inspect.StructType
            ):
                many[each.encode_name] = part.item_type.cls
    return _Shape(frozenset(each.encode_name for each in info.fields), one, many)


def unknown(value: bytes) -> Unknown:
    """Return the fields of a stored record that this version does not know; none for one that cannot be read."""
    try:
        raw = msgspec.json.decode(value)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return Unknown()
    return _find(cast("dict[str, Any]", raw), TaskRecord) if isinstance(raw, dict) else Unknown()


def _find(table: dict[str, Any], kind: type[Struct]) -> Unknown:
    shape = _shape(kind)
    found = Unknown({name: value for name, value in table.items() if name not in shape.names})
    for name, of in shape.one.items():
        value = table.get(name)
        if isinstance(value, dict) and (more := _find(cast("dict[str, Any]", value), of)):
            found.inside[name] = more
    for name, of in shape.many.items():
        value = table.get(name)
        for item in cast("list[Any]", value) if isinstance(value, list) else []:
            if isinstance(item, dict) and (more := _find(cast("dict[str, Any]", item), of)):
                found.items.setdefault(name, {})[_which(cast("dict[str, Any]", item), of)] = more
    return found


def _which(table: dict[str, Any], kind: type[Struct]) -> str:
    """What tells one struct of a row from the others, while it changes: its id or number; else what is known of it."""
    for name in ("id", "number", "subtask"):
        value = table.get(name) if name in _shape(kind).names else None
        if name == "subtask":  # a subtask's record has its subtask; elsewhere it is a name, and not the only one of it
            value = cast("dict[str, Any]", value).get("id") if isinstance(value, dict) else None
        if isinstance(value, str | int):
            return f"{name} {value}"
    try:
        return encode(msgspec.convert(table, kind)).decode()
    except msgspec.ValidationError:
        return ""


def with_unknown(record: TaskRecord, kept: Unknown) -> bytes:
    """Encode a record with those fields as they were; what is gone takes its own along."""
    if not kept:
        return encode(record)
    table: dict[str, Any] = msgspec.to_builtins(record)
    _put(table, TaskRecord, kept)
    return encode(table)


def _put(table: dict[str, Any], kind: type[Struct], kept: Unknown) -> None:
    shape = _shape(kind)
    for name, more in kept.inside.items():
        if isinstance(table.get(name), dict):
            _put(table[name], shape.one[name], more)
    for name, rows in kept.items.items():
        for item in cast("list[dict[str, Any]]", table.get(name, [])):
            if (more := rows.get(_which(item, shape.many[name]))) is not None:
                _put(item, shape.many[name], more)
    table |= kept.fields


def unsettled(record: TaskRecord) -> tuple[Split, ...]:
    """Versions that lost and are not dealt with yet, or were dealt with in a version that itself lost later.

    Of the latter the mark that they are settled outlives (`conflicts.merged`), and the fences do not: without them a
    second attempt would be given a number, and its gateway answer with what came of the first.
    """
    return tuple(each for each in record.splits if not each.settled or _unfenced(record, each))


def _unfenced(record: TaskRecord, split: Split) -> bool:
    """Whether an attempt of a version that lost has a number that the next attempt of this version may be given."""
    made = {run.subtask: run.attempt for run in sorted(split.runs, key=lambda run: run.attempt)}
    return any(made.get(each.subtask.id, 0) >= each.next_attempt and not each.state.final for each in record.subtasks)


# --- tombstones ---------------------------------------------------------------------------------------------------

MAX_INSTRUCTION = 80
"""Characters of the instruction that stay, to recognise the task by."""


def may_trim(record: TaskRecord) -> bool:
    """Whether nothing is left to be done about a record: it has ended, and what a partition left of it is settled."""
    return record.state.final and not unsettled(record)


def trimmed(record: TaskRecord, log: str) -> TaskRecord:
    """Return the tombstone of a finished task; `log`: names of the log files of its time, empty where none is known.

    The same from whichever gateway makes it, but for the log's name: copies that meet are resolved like any records.
    """
    failure = record.failure
    return TaskRecord(
        id=record.id,
        instruction=clean(record.instruction, MAX_INSTRUCTION),
        submitter=record.submitter,
        priority=record.priority,
        state=record.state,
        failure=None if failure is None else replace(failure, message=clean(failure.message, MAX_NOTE)),
        cancelled_by=record.cancelled_by,
        coordinator=record.coordinator,
        created_ns=record.created_ns,
        updated_ns=record.updated_ns,
        sequence=record.sequence,
        remembered=Remembered(log=log, request=_digest_of(record)),
    )


def digest(instruction: str, group: Collection[str], plan: Plan | None) -> str:
    """Return 16 hexadecimal digits by which a request is recognised: its text, gateways, and the plan it brought."""
    steps = [(each.id, each.skill, each.params) for each in plan.subtasks] if plan is not None else None
    return hashlib.sha256(encode([instruction, sorted(group), steps])).hexdigest()[:16]


def _digest_of(record: TaskRecord) -> str:
    """The digest of the request a record was made for; empty where its plan is another one by now."""
    edited = record.revised > 0 or (record.decision is not None and record.decision.edited)
    if record.handed_in and edited:
        return ""
    return digest(record.instruction, record.within, record.plan if record.handed_in else None)


def answered(record: TaskRecord, request: TaskRequest) -> TaskRecord:
    """Return what a request is answered whose id is known; a note says where that was of another request."""
    if record.remembered is None or not record.remembered.request:
        return record
    if record.remembered.request == digest(request.instruction, request.group, request.plan):
        return record
    note = (
        f"nothing was begun: task {record.id} was another request ({record.instruction!r}); hand this one in under an "
        "id of its own"
    )
    return replace(record, note=clean(note, MAX_NOTE))


def refuse_trimmed(record: TaskRecord) -> None:
    """Raise RefusedError for a task of which only the outcome is known: there is nothing to try again."""
    if record.remembered is not None:
        raise RefusedError(f"task {record.id}: {done_text(record)}; its plan is not kept", remedy="submit it again")


def done_text(record: TaskRecord) -> str:
    """When a trimmed task was done, what came of it, and where its details are; empty for any other."""
    if record.remembered is None:
        return ""
    at = datetime.fromtimestamp(record.updated_ns / 1e9, tz=UTC)
    where = f"the log {record.remembered.log}" if record.remembered.log else "the logs of that day, if any were kept"
    return f"done on {at:%Y-%m-%d %H:%M:%S} UTC ({record.state}), details are in {where}"
