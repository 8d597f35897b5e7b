"""Which of two concurrent versions of a task stands: the same answer on every gateway, without asking anybody.

A partition lets two coordinators write one task. When they meet again the order of `algorithms.md` (Versions)
decides: a final state first, then more finished subtasks, then more applied transitions, then the lower
coordinator id; the bytes themselves settle what is left, so the order is total.
"""

import msgspec

from appliance.model import SubtaskState, TaskRecord
from appliance.plane.dht import Record
from appliance.pool import lineage
from appliance.tasks import checkpoints


def stronger(one: bytes, other: bytes) -> bytes:
    """Return the version of a task record that stands; commutative and associative."""
    return max(one, other, key=_rank)


def _rank(value: bytes) -> tuple[int, int, int, tuple[int, ...], bytes]:
    try:
        record = msgspec.json.decode(value, type=TaskRecord)
    except msgspec.DecodeError:
        return (-1, 0, 0, (), value)
    finished = sum(each.state is SubtaskState.SUCCEEDED for each in record.subtasks)
    # Lower id wins, so it must rank higher: compare negated code points, the end of the shorter id highest.
    coordinator = (*(-ord(char) for char in record.coordinator), 1)
    return (int(record.state.final), finished, record.sequence, coordinator, value)


def resolver(key: str, one: Record, other: Record) -> Record:
    """Choose between concurrent versions of any record: those of known rooms by what they say, others by bytes."""
    if key.startswith("task/"):
        return one if stronger(one.value, other.value) == one.value else other
    if key.startswith(checkpoints.PREFIX) and one.deleted == other.deleted:
        return one if checkpoints.stronger(one.value, other.value) == one.value else other
    if key.startswith(lineage.KEY) and one.deleted == other.deleted:
        return one if lineage.stronger(one.value, other.value) == one.value else other
    return max(one, other, key=lambda record: (record.deleted, record.value))
