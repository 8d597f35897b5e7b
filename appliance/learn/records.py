"""Keys of a run's records, how they are read, and which of two versions stands after a partition.

**Which stands**: of two versions of a run the one with more closed rounds, then the one whose last round had more
samples, then the greater digest; operators' words (pause, stop, excluded clients) of either side hold. Of a round the
one that is closed, then the one with more that counted. Of an update the parts of both. The same on every gateway, in
whatever order they meet.

Rounds that the losing side has closed make no models, but its clients' work is not lost: the run's record lists them
(`apart`), a round's record how each side closed it (`sides`), and `unclaimed` are the updates that the standing side
has not counted. They count in the next round as late ones.
"""

from collections.abc import Iterable, Mapping
from typing import TypeVar

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import NotFoundError, PayloadError
from appliance.model import encode, keyspace
from appliance.model.keys import check_name
from appliance.model.learning import PartialUpdate, RoundRecord, RunRecord, RunState, Side, UpdateRecord
from appliance.plane.records import Record

PREFIX = keyspace.LEARN_RECORD.prefix
T = TypeVar("T", bound=Struct)


def run_key(run: str) -> str:
    """Key of a run's record."""
    return f"{PREFIX}{check_name(run, 'run')}"


def round_key(run: str, number: int) -> str:
    """Key of a round's record; its owner is the round's coordinator."""
    return f"{run_key(run)}/{number}"


def update_key(run: str, number: int, client: str) -> str:
    """Key of the record of what a client adds to a round."""
    return f"{round_key(run, number)}/{check_name(client, 'client')}"


def taken_apart(key: str) -> tuple[str, int | None, str]:
    """Return run, round and client of a record's key; no round, no client where it has none. PayloadError otherwise."""
    run, *rest = key.removeprefix(PREFIX).split("/")
    if not key.startswith(PREFIX) or len(rest) > 2 or (rest and not rest[0].isdecimal()):
        raise PayloadError(f"{key[:80]!r} is no key of a run")
    return run, int(rest[0]) if rest else None, rest[1] if len(rest) > 1 else ""


def task_of(run: str, number: int) -> str:
    """Name under which the runs of a round's clients are published, in the place of a task's id."""
    return f"{run}.{number}"


def round_of(task: str) -> tuple[str, int] | None:
    """Return run and round of such a name; None where it is none."""
    run, dot, number = task.rpartition(".")
    return (run, int(number)) if dot and run and number.isdecimal() and len(number) < 10 else None


def read(value: bytes, kind: type[T]) -> T:
    """Decode a record; PayloadError where it is none of that kind."""
    try:
        return msgspec.json.decode(value, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(f"not a {kind.__name__}: {error}") from error


def no_run(run: str) -> NotFoundError:
    """The error where there is no run of that id."""
    return NotFoundError(f"no run {run[:60]!r}", remedy="`swiftbot learn list` shows the runs")


def unclaimed(run: RunRecord, rounds: Mapping[int, RoundRecord], updates: Iterable[UpdateRecord]) -> list[UpdateRecord]:
    """Return which updates that another side of a partition has accepted may count in a run's open round.

    Those that are not too late and that no round of the side that stands has counted or refused; of a client the
    newest.

    Args:
        run: the record that stands.
        rounds: the closed ones since the oldest of `run.apart`, by number.
        updates: the records of the updates of those in `run.apart`.
    """
    digests = {line.number: line.digest for line in run.history}
    claimed: set[tuple[str, int]] = set()
    for number, record in rounds.items():
        sides = {record.model: record.counted, **{side.model: side.counted for side in record.sides}}
        claimed |= {(each.client, number - each.staleness) for each in sides.get(digests.get(number, ""), ())}
    found: dict[str, UpdateRecord] = {}
    for update in updates:
        late = run.round - max((part.round for part in update.parts), default=run.round)
        fresh = 0 < late <= run.recipe.rounds.max_staleness and (update.client, run.round - late) not in claimed
        known = found.get(update.client)
        if fresh and (known is None or known.parts[0].round < run.round - late):
            found[update.client] = update
    return [found[client] for client in sorted(found)]


# --- versions that met after a partition


def resolve(key: str, one: Record, other: Record) -> Record:
    """Return which of two concurrent versions of a record of learning stands; a removal above any value."""
    if one.deleted or other.deleted:
        return max(one, other, key=lambda record: (record.deleted, record.value, record.write))
    try:
        _, number, client = taken_apart(key)
        if number is None:
            value = _run(one.value, other.value)
        elif client:
            value = _update(one.value, other.value)
        else:
            value = _round(one.value, other.value)
    except PayloadError:
        return max(one, other, key=lambda record: (record.value, record.write))
    winner = max(one, other, key=lambda record: (record.value == value, record.value, record.write))
    # No longer what anybody wrote: a writer of one of them must not take it for its own.
    return winner if winner.value == value else replace(winner, value=value, write="")


def _run(one: bytes, other: bytes) -> bytes:
    first, second = read(one, RunRecord), read(other, RunRecord)

    def rank(pair: tuple[RunRecord, bytes]) -> tuple[int, int, str, bytes, bytes]:
        run, value = pair
        last = run.history[-1] if run.history else None
        # Without what is taken from the other side, so that the same side stands when the result meets one of them.
        own = encode(replace(run, apart=(), state=RunState.RUNNING, why="", clients=()))
        return (run.model.number, last.samples if last else 0, run.model.digest, own, value)

    stands, loses = sorted(((first, one), (second, other)), key=rank, reverse=True)
    excluded = {client.name: client.excluded for client in loses[0].clients if client.excluded}
    clients = tuple(
        replace(client, excluded=client.excluded or excluded.get(client.name, "")) for client in stands[0].clients
    )
    oldest = stands[0].round - stands[0].recipe.rounds.max_staleness
    apart = {*stands[0].apart, *loses[0].apart, *_closed_otherwise(stands[0], loses[0])}
    merged = replace(stands[0], clients=clients, apart=tuple(sorted(number for number in apart if number >= oldest)))
    if not merged.state.final and (loses[0].state.final or loses[0].state is RunState.PAUSED):
        merged = replace(merged, state=loses[0].state, why=loses[0].why)
    return stands[1] if merged == stands[0] else encode(merged)


def _closed_otherwise(stands: RunRecord, loses: RunRecord) -> set[int]:
    """Return the rounds that a side has closed with another model than the side that stands, or alone."""
    ours = {line.number: line.digest for line in stands.history}
    return {line.number for line in loses.history if ours.get(line.number) != line.digest}


def _round(one: bytes, other: bytes) -> bytes:
    first, second = read(one, RoundRecord), read(other, RoundRecord)

    def rank(record: RoundRecord) -> tuple[bool, int, int, bytes]:
        counted = sum(each.samples for each in record.counted)
        return (record.closed, counted, record.target, encode(replace(record, sides=())))

    sides: dict[str, Side] = {}
    for record in (first, second):
        own = (Side(model=record.model, counted=record.counted),) if record.closed and record.model else ()
        for side in (*record.sides, *own):
            sides[side.model] = max(side, sides.get(side.model, side), key=encode)
    kept = tuple(sides[model] for model in sorted(sides)) if len(sides) > 1 else ()
    merged = replace(max(first, second, key=rank), sides=kept)
    return one if merged == first else other if merged == second else encode(merged)


def _update(one: bytes, other: bytes) -> bytes:
    first, second = read(one, UpdateRecord), read(other, UpdateRecord)
    parts: dict[tuple[int, int], PartialUpdate] = {}
    for part in sorted((*first.parts, *second.parts), key=lambda each: (each.attempt, encode(each))):
        parts[part.round, part.part] = part
    # One base a client and round: of two the later one's.
    newest = max((number for number, _ in parts), default=0)
    merged = replace(first, parts=tuple(parts[key] for key in sorted(parts) if key[0] == newest))
    return one if merged == first else other if merged == second else encode(merged)
