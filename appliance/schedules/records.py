"""Keys of schedules and saved instructions, and which of two versions stands after a partition.

Of a schedule what its operators changed last stands, a removal above all; up to where it was handled is the later of
both, so that nothing is submitted again that either side has submitted. Of a saved instruction the one saved last.
"""

import re
from typing import TypeVar

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import NotFoundError, PayloadError
from appliance.model import encode, keyspace
from appliance.model.keys import check_name
from appliance.model.schedules import SavedInstruction, Schedule
from appliance.plane.records import Record

SCHEDULES = keyspace.SCHEDULE_RECORD.prefix
INSTRUCTIONS = keyspace.INSTRUCTION_RECORD.prefix
MAX_NAME = 40
"""A task is named after its schedule and the time, in 63 characters."""
KEEP_REMOVED_S = 90 * 86_400.0
"""How long a removed schedule is remembered: a gateway that was off for less, or was restored from a backup beside
others, does not bring it back. The plane forgets removals of records much earlier (`plane.tombstone_hours`)."""
MOST_REMOVED = 500
"""Removed ones that a gateway's shard remembers; beyond it the oldest are forgotten earlier."""
T = TypeVar("T", bound=Struct)


def schedule_key(name: str) -> str:
    """Key of a schedule's record; PayloadError for a name that cannot be one."""
    return f"{SCHEDULES}{_checked(name, 'schedule')}"


def instruction_key(name: str) -> str:
    """Key of a saved instruction's record; PayloadError for a name that cannot be one."""
    return f"{INSTRUCTIONS}{_checked(name, 'instruction')}"


def _checked(name: str, what: str) -> str:
    if len(check_name(name, what)) > MAX_NAME:
        raise PayloadError(f"{what} {name!r} has more than {MAX_NAME} characters", remedy="give a shorter name")
    return name


def is_ours(key: str) -> bool:
    """Whether a key is that of a schedule or saved instruction."""
    return key.startswith((SCHEDULES, INSTRUCTIONS))


def read(value: bytes, kind: type[T]) -> T:
    """Decode a record; PayloadError where it is none of that kind."""
    try:
        return msgspec.json.decode(value, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(f"not a {kind.__name__}: {error}") from error


def no_schedule(name: str) -> NotFoundError:
    """The error where there is no schedule of that name."""
    return NotFoundError(f"no schedule {name[:60]!r}", remedy="`swiftbot schedule list` shows them")


def no_instruction(name: str) -> NotFoundError:
    """The error where there is no saved instruction of that name."""
    return NotFoundError(f"no saved instruction {name[:60]!r}", remedy="`swiftbot instructions list` shows them")


def resolve(key: str, one: Record, other: Record) -> Record:
    """Return which of two concurrent versions stands; a removal above any value."""
    if one.deleted or other.deleted:
        return max(one, other, key=lambda record: (record.deleted, record.value, record.write))
    try:
        value = _schedule(one.value, other.value) if key.startswith(SCHEDULES) else _saved(one.value, other.value)
    except PayloadError:
        return max(one, other, key=lambda record: (record.value, record.write))
    winner = max(one, other, key=lambda record: (record.value == value, record.value, record.write))
    # No longer what either wrote: a writer of one of them must not take it for its own.
    return winner if winner.value == value else replace(winner, value=value, write="")


def _schedule(one: bytes, other: bytes) -> bytes:
    def rank(pair: tuple[Schedule, bytes]) -> tuple[bool, int, int, bytes]:
        return pair[0].removed is not None, pair[0].edited_ns, pair[0].handled_ns, pair[1]

    pairs = ((read(one, Schedule), one), (read(other, Schedule), other))
    (stands, value), (loses, _) = sorted(pairs, key=rank, reverse=True)
    fired = max(stands, loses, key=lambda each: (each.fired_ns, each.task))
    missed = max(stands, loses, key=lambda each: (each.missed_ns, each.missed_why))
    merged = replace(
        stands, handled_ns=max(stands.handled_ns, loses.handled_ns), fired=max(stands.fired, loses.fired),
        fired_ns=fired.fired_ns, task=fired.task, missed=max(stands.missed, loses.missed), missed_ns=missed.missed_ns,
        missed_why=missed.missed_why,
    )  # fmt: skip
    return value if merged == stands else encode(merged)


def _saved(one: bytes, other: bytes) -> bytes:
    def rank(value: bytes) -> tuple[int, bytes]:
        saved = read(value, SavedInstruction).saved
        return (saved.at_ns if saved is not None else 0), value

    return max(one, other, key=rank)


def made_name(text: str) -> str:
    """Return a name made of the first words of an instruction."""
    words = re.sub(r"[^a-z0-9_]+", "-", text.casefold()).strip("-")[:MAX_NAME].rstrip("-")
    return words or "schedule"
