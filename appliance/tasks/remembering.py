"""What stays of a task whose record is trimmed: its id and what came of it, so that the id is never done again. Pure.

A finished record is kept whole while it is among the newest (`tasks.keep_finished`); then it is replaced in place by a
small one without plan, subtasks and results (a tombstone), under the same key and version history, so that at no moment
the id is free. Whoever hands the id in again gets the outcome. Tombstones go after `tasks.remember_days`, or sooner,
the oldest first, where there are more than `tasks.remember_most`.
"""

import hashlib
from collections.abc import Collection
from datetime import UTC, datetime
from typing import NamedTuple

from msgspec.structs import replace

from appliance.errors import RefusedError
from appliance.model import Plan, Remembered, TaskRecord, TaskRequest, encode
from appliance.plane.dht import LeaveOut
from appliance.tasks.bounds import MAX_NOTE, clean
from appliance.tasks.healing import unsettled

MAX_INSTRUCTION = 80
"""Characters of the instruction that stay, to recognise the task by."""
TRIMMED = LeaveOut(has=b'"remembered":{', lacks=b'"plan":')
"""What tells a tombstone as it is stored from a whole record, without decoding it.

Within a JSON text quotes are escaped, so that the mark can only be a field's name: this one, or a parameter's, which
only a record with a plan has.
"""
_DAY_NS = 86_400 * 10**9


class Kept(NamedTuple):
    """A finished task's record, of one gateway's shard."""

    key: str
    ended_ns: int
    """Unix nanoseconds, on the clock of whoever coordinated it."""
    trimmed: bool
    """Whether it is a tombstone already."""


class Due(NamedTuple):
    """What is to be done, by key."""

    trim: tuple[str, ...]
    forget: tuple[str, ...]
    early: frozenset[str]
    """Those of `forget` whose time is not over: there are more than may be remembered."""


def due(kept: Collection[Kept], *, now_ns: int, keep: int, days: float, most: int) -> Due:
    """Return which finished tasks are to be trimmed, and which to be forgotten for good.

    Args:
        kept: all finished records of the shard.
        now_ns: Unix nanoseconds.
        keep: how many stay whole, the newest.
        days: how long after its end an id is remembered; 0: not at all.
        most: how many tombstones there may be; the oldest beyond it are forgotten.
    """
    whole = sorted((each for each in kept if not each.trimmed), key=_newest)
    surplus = whole[max(0, keep) :]
    small = sorted((*surplus, *(each for each in kept if each.trimmed)), key=_newest)
    since_ns = now_ns - int(days * _DAY_NS)
    fresh = [each for each in small if days > 0 and each.ended_ns >= since_ns]
    stay = {each.key for each in fresh[: max(0, most)]}
    early = frozenset(each.key for each in fresh[max(0, most) :])
    return Due(
        trim=tuple(each.key for each in surplus if each.key in stay),
        forget=tuple(each.key for each in small if each.key not in stay),
        early=early,
    )


def _newest(each: Kept) -> tuple[int, str]:
    return (-each.ended_ns, each.key)


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
        raise RefusedError(f"task {record.id}: {done_text(record)}; its plan is not kept", remedy="submit it anew")


def done_text(record: TaskRecord) -> str:
    """When a trimmed task was done, what came of it, and where its details are; empty for any other."""
    if record.remembered is None:
        return ""
    at = datetime.fromtimestamp(record.updated_ns / 1e9, tz=UTC)
    where = f"the log {record.remembered.log}" if record.remembered.log else "the logs of that day, if any were kept"
    return f"done on {at:%Y-%m-%d %H:%M:%S} UTC ({record.state}), details are in {where}"
