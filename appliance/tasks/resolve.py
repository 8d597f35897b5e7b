"""Which of two concurrent versions of a task stands: the same answer on every gateway, without asking anybody.

A partition lets two coordinators write one task. When they meet again the order of `algorithms.md` (Versions)
decides: a final state first, then further progress (finished subtasks, then what the others have told of theirs), then
the lower load and the more ready containers of the gateways that its runs were given to, as the record itself has
them, then the lower coordinator id, then more transitions; the bytes themselves settle what is left, so the order is
total. The version that stands carries what is known of those that lost (`splits`), so that their runs can be ended and
people told; that too comes out the same in whatever order the versions meet.
"""

import msgspec

from appliance.model import LostOrder, LostRun, Split, SubtaskState, TaskRecord, encode
from appliance.plane.dht import Record
from appliance.pool import lineage
from appliance.tasks import checkpoints
from appliance.tasks.steering import enquiries

MOST_SPLITS = 8
"""Versions that lost and are remembered in the one that stands: a fleet falls into few parts."""


def stronger(one: bytes, other: bytes) -> bytes:
    """Return the version of a task record that stands; commutative and associative."""
    return max(one, other, key=_rank)


def merged(one: bytes, other: bytes) -> bytes:
    """Return the version that stands, with what is known of those that lost; commutative and associative.

    Where the other version cannot be read, or is the same but for what it knows of others, there is none that lost.
    """
    winner, loser = (one, other) if stronger(one, other) == one else (other, one)
    stands, lost = _decoded(winner), _decoded(loser)
    if stands is None or lost is None:
        return winner
    found = {*stands.splits, *lost.splits}
    if _core(winner) != _core(loser):
        found.add(split_of(lost))
    kept = _kept(found)
    if kept == stands.splits:
        return winner
    # Field by field, so that those of a newer version of the appliance are kept.
    return encode(msgspec.json.decode(winner, type=dict[str, msgspec.Raw]) | {"splits": msgspec.Raw(encode(kept))})


def split_of(record: TaskRecord) -> Split:
    """Return what is remembered of a version that lost."""
    return Split(
        coordinator=record.coordinator,
        sequence=record.sequence,
        state=record.state,
        runs=tuple(
            LostRun(subtask=each.subtask.id, attempt=each.attempt, gateway=each.gateway, state=each.state)
            for each in record.subtasks
            if each.attempt
        ),
        orders=orders_of(record),
    )


def orders_of(record: TaskRecord) -> tuple[LostOrder, ...]:
    """Return the operators' orders that a record shows to be carried out, the last of each kind.

    Not a `resume`: it leaves nothing in the record but the absence of the pause.
    """
    decision = record.decision
    said = [
        ("cancel", record.cancelled_by),
        ("retry", record.retried_by),
        ("approve" if decision is not None and decision.approved else "reject", decision),
        *(("pause", each) for each in record.pauses if not each.stop),
    ]
    return tuple(
        LostOrder(verb=verb, by=word.by, act=word.act, at_ns=word.at_ns) for verb, word in said if word is not None
    )


def _kept(found: set[Split]) -> tuple[Split, ...]:
    """One of each version, the settled one if there is, and at most so many: the same of any parts in any order."""
    by_version: dict[tuple[str, int], Split] = {}
    for each in sorted(found, key=lambda split: (split.settled, split)):
        by_version[each.coordinator, each.sequence] = each
    return tuple(by_version[key] for key in sorted(by_version)[:MOST_SPLITS])


def _core(value: bytes) -> bytes:
    """A version without what it knows of others."""
    fields = msgspec.json.decode(value, type=dict[str, msgspec.Raw])
    fields.pop("splits", None)
    return encode(fields)


def _decoded(value: bytes) -> TaskRecord | None:
    try:
        return msgspec.json.decode(value, type=TaskRecord)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


_Rank = tuple[int, int, float, float, int, tuple[int, ...], int, bytes, bytes]


def _rank(value: bytes) -> _Rank:
    record = _decoded(value)
    if record is None:
        return (-1, 0, 0.0, 0.0, 0, (), 0, b"", value)
    finished = sum(each.state is SubtaskState.SUCCEEDED for each in record.subtasks)
    active = [each for each in record.subtasks if each.state in (SubtaskState.DISPATCHED, SubtaskState.RUNNING)]
    told = round(sum(each.progress for each in active), 3)
    given = [each.attempts[-1] for each in active if each.attempts]
    load = round(sum(each.load for each in given) / len(given), 3) if given else 0.0
    free = sum(each.free for each in given)
    # Lower id wins, so it must rank higher: compare negated code points, the end of the shorter id highest.
    coordinator = (*(-ord(char) for char in record.coordinator), 1)
    return (int(record.state.final), finished, told, -load, free, coordinator, record.sequence, _core(value), value)


def resolver(key: str, one: Record, other: Record) -> Record:
    """Choose between concurrent versions of any record: those of known rooms by what they say, others by bytes."""
    if key.startswith("task/") and one.deleted == other.deleted:
        winner = one if stronger(one.value, other.value) == one.value else other
        value = merged(one.value, other.value)
        # No longer what anybody wrote: a writer of one of them must not take it for its own.
        return winner if value == winner.value else msgspec.structs.replace(winner, value=value, write="")
    if key.startswith(checkpoints.PREFIX) and one.deleted == other.deleted:
        return one if checkpoints.stronger(one.value, other.value) == one.value else other
    if key.startswith(lineage.KEY) and one.deleted == other.deleted:
        return one if lineage.stronger(one.value, other.value) == one.value else other
    if key.startswith(enquiries.PREFIX) and one.deleted == other.deleted:
        return one if enquiries.stronger(one.value, other.value) == one.value else other
    return max(one, other, key=lambda record: (record.deleted, record.value))
