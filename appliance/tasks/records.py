"""What a task record may hold: bounds of what enters it, validation of one from elsewhere, unknown fields kept.

**Bounds.** Run events come from handlers (people's code) and over the network; a record that holds something that
cannot be encoded, or decoded by the next coordinator, would stop its task on every gateway in turn. So what enters a
record is cut to size first: it stays small, shallow and writable as JSON.

**Validation.** Records come from other gateways, of other versions too, and a stranger on the network can write one.
One that can never end (a cycle), or is beyond all bounds, is ended with the reason instead of being driven.

**Unknown fields.** A coordinator writes a task's record again and again. While a fleet is being upgraded, it may run an
older version than the one that wrote the record before it; fields that only the newer version knows are kept as they
were, in the record and in anything in it.

Pure.
"""

from functools import cache
from graphlib import CycleError, TopologicalSorter
from typing import Any, NamedTuple, cast

import msgspec
from msgspec import Struct, field, inspect
from msgspec.structs import replace

from appliance.errors import PayloadError
from appliance.llm.checks.schema import MAX_SUBTASKS
from appliance.model import Failure, RunEvent, RunEventKind, Split, TaskRecord, encode

MAX_DEPTH = 64
"""Nesting of parameters and results: far beyond any use, far below what JSON decoders refuse (about 1,000)."""
MAX_NOTE = 500
MAX_TEXT = 2000
MAX_CODE = 40
MAX_RUN_S = 86_400.0
"""Longest that a plan may ask of a run beyond its skill's own time."""


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


def clean(text: str, limit: int) -> str:
    """Return text without lone surrogates, which no JSON can carry, and at most `limit` characters."""
    return text[:limit].encode(errors="replace").decode()


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
