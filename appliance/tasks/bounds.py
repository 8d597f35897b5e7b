"""What may enter a task from outside, cut to size: a record must stay small, shallow and writable as JSON.

Run events come from handlers (people's code) and over the network; a record that holds something that cannot be
encoded, or decoded by the next coordinator, would stop its task on every gateway in turn.
"""

from typing import Any, cast

import msgspec
from msgspec.structs import replace

from appliance.errors import PayloadError
from appliance.model import Failure, RunEvent, RunEventKind, TaskRecord, encode

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
