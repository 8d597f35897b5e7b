"""Conflict resolution after a partition: which of two versions of a task stands, and what becomes of the one that lost.

**Which stands**: the same answer on every gateway, without asking anybody. A partition lets two coordinators write one
task. When they meet again the order of `algorithms.md` (Versions) decides: a final state first, then further progress
(finished subtasks, then what the others have told of theirs), then the lower load and the more ready containers of the
gateways that its runs were given to, as the record itself has them, then the lower coordinator id, then more
transitions; the bytes themselves settle what is left, so the order is total. The version that stands carries what is
known of those that lost (`TaskRecord.splits`); that too comes out the same in whatever order the versions meet.

**Healing**: the coordinator of the version that stands settles each of those that lost once. The highest attempt that
either side made becomes the fence below the next one, runs of the other side are ended where they are, what they still
tell is refused, and people get a notice. So does the operator of an order that only a version that lost has carried
out: it was answered as done, and is not. A run of the version that stands goes on unless the other side has sent a
higher attempt of it to a robot: the robot would refuse it, so it is repeated.
"""

import asyncio
import time
from collections.abc import Callable, Iterable

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.alerts import rules
from appliance.errors import PayloadError, SwiftbotError
from appliance.model import (
    Failure,
    LostOrder,
    LostRun,
    Notice,
    RunEvent,
    Split,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    encode,
    keyspace,
)
from appliance.model.keys import RecordKind, check_name
from appliance.model.task_api import RunAsk
from appliance.model.transitions import TransitionKind
from appliance.plane.dht import Record
from appliance.plane.node import Plane
from appliance.pool.volumes import lineage
from appliance.tasks import checkpoints, enquiries
from appliance.tasks.record_writer import RecordWriter, SupersededError
from appliance.tasks.records import MAX_NOTE, clean, read_record, task_key, unsettled

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
        ("first", record.ranked_by),
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


_STRONGER: dict[RecordKind, Callable[[bytes, bytes], bytes]] = {
    keyspace.CHECKPOINT_RECORD: checkpoints.stronger,
    keyspace.VOLUME_RECORD: lineage.stronger,
    keyspace.ENQUIRY_RECORD: enquiries.stronger,
    keyspace.ALERT_RECORD: rules.stronger,
}
"""Which of two concurrent values of a kind stands."""


def resolver(key: str, one: Record, other: Record) -> Record:
    """Choose between concurrent versions of any record: those of known rooms by what they say, others by bytes."""
    kind = keyspace.record_kind(key) if one.deleted == other.deleted else None
    if kind is keyspace.TASK_RECORD:
        winner = one if stronger(one.value, other.value) == one.value else other
        value = merged(one.value, other.value)
        # No longer what anybody wrote: a writer of one of them must not take it for its own.
        return winner if value == winner.value else msgspec.structs.replace(winner, value=value, write="")
    if kind is not None and (of_kind := _STRONGER.get(kind)) is not None:
        return one if of_kind(one.value, other.value) == one.value else other
    return max(one, other, key=lambda record: (record.deleted, record.value))


log = structlog.get_logger(__name__)

END_S = 2.0
"""How long a gateway may take to answer that it ends a run; one that does not hears of the record."""
NOTICED = "operator"
OVERTAKEN = Failure(
    code="unreachable", message="a later attempt had been made on the other side of a partition", retryable=True
)
_ACTIVE = (SubtaskState.DISPATCHED, SubtaskState.RUNNING)


def foreign(record: TaskRecord, event: RunEvent) -> bool:
    """Whether an event is of a run of a version that lost, which may have the number of the present attempt."""
    if not record.splits:
        return False
    target = next((each for each in record.subtasks if each.subtask.id == event.subtask), None)
    return target is not None and any(
        (run.subtask, run.attempt, run.gateway) == (event.subtask, event.attempt, event.gateway)
        and run.gateway != target.gateway
        for split in record.splits
        for run in split.runs
    )


class Healing(Struct, frozen=True, kw_only=True):
    """What is to be done about the versions that lost."""

    splits: tuple[Split, ...]
    """All that the record remembers from then on, each settled and with what was done in words."""
    fences: dict[str, int]
    ends: tuple[LostRun, ...]
    """Runs of the other side that are to be ended."""
    superseded: tuple[str, ...]
    """Subtasks of the version that stands whose run is to be repeated under a higher number."""
    notes: tuple[str, ...]
    """Notices for people; none where nothing was doubled and no order lost."""
    noted: tuple[str, ...]
    """Which version or order each note is about: the same notice, whichever gateway settles it."""
    to: tuple[str, ...]
    """Who each note is for: the operator of the order that lost, else any."""

    async def settle(self, plane: Plane, writer: RecordWriter) -> None:
        """Tell people, write it into the record, then end what is doubled.

        The notice comes first: when two gateways settle at once, the mark that it is settled may stand though the write
        of the gateway that made it is refused, or its coordinator ends meanwhile. Given twice it is the same notice, by
        its id. For the same
        reason a refused write ends doubled runs too: those that the record, read again, does not have.

        Raises:
            SupersededError: another gateway has written meanwhile.
        """
        task = writer.draft.record.id
        for name, note, to in zip(self.noted, self.notes, self.to, strict=True):
            notice = Notice(
                id=f"{task}/healed/{name}",
                to=to,
                text=note,
                task=task,
                gateway=plane.gateway,
                at_ns=time.time_ns(),
            )
            plane.session.publish(keyspace.NOTICE, notice, to)
            log.warning("a partition has healed", task=task, note=note)
        writer.draft.apply(TransitionKind.HEALED, splits=self.splits, fences=self.fences)
        try:
            await writer.flush()
        except SupersededError:
            stored = await plane.dht.read(task_key(task))
            standing = read_record(stored.value).subtasks if stored is not None and not stored.deleted else ()
            held = {each.subtask.id: each for each in standing}
            await _end_all(plane, task, [run for run in self.ends if not _held(held.get(run.subtask), run)])
            raise
        await _end_all(plane, task, self.ends)


async def _end_all(plane: Plane, task: str, runs: Iterable[LostRun]) -> None:
    await asyncio.gather(*(_end(plane, task, run) for run in runs))


def _held(own: SubtaskRecord | None, run: LostRun) -> bool:
    """Whether a record has this very run."""
    return own is not None and (own.attempt, own.gateway) == (run.attempt, run.gateway)


async def _end(plane: Plane, task: str, run: LostRun) -> None:
    ask = RunAsk(task=task, subtask=run.subtask, attempt=run.attempt)
    try:
        await plane.rpc.call(run.gateway, keyspace.RUN_CANCEL, ask, timeout_s=END_S)
    except SwiftbotError as error:
        log.info("a doubled run could not be ended", run=ask.run_id, gateway=run.gateway, reason=str(error))


def heal(record: TaskRecord) -> Healing | None:
    """Return what is to be done about versions of a task that lost; None when there is nothing new."""
    fresh = unsettled(record)
    if not fresh:
        return None
    mine = {each.subtask.id: each for each in record.subtasks}
    fences: dict[str, int] = {}
    ends: dict[tuple[str, int, str], LostRun] = {}
    superseded: set[str] = set()
    settled: list[Split] = []
    notes: list[str] = []
    noted: list[str] = []
    recipients: list[str] = []
    for split in fresh:
        doubled: list[str] = []
        for run in split.runs:
            own = mine.get(run.subtask)
            fences[run.subtask] = max(fences.get(run.subtask, 0), run.attempt)
            if own is not None and _same(own, run):
                continue
            doubled.append(f"{run.subtask} (attempt {run.attempt} on {run.gateway}: {_became(run)})")
            if run.state in _ACTIVE:
                ends[run.subtask, run.attempt, run.gateway] = run
            if own is not None and own.state in _ACTIVE and own.bound_robot and run.attempt > own.attempt:
                superseded.add(run.subtask)
        note = ""
        if doubled and not split.settled:
            note = clean(
                f"a partition has healed: task {record.id} had gone on on both sides; the version of "
                f"{split.coordinator} ({split.state}) lost to that of {record.coordinator} ({record.state}); "
                f"doubled: {'; '.join(doubled)}",
                MAX_NOTE,
            )
            notes.append(note)
            noted.append(f"{split.coordinator}-{split.sequence}")
            recipients.append(NOTICED)
        if split.settled:  # people have been told
            settled.append(split)
            continue
        said = [note] if note else []
        for order in overruled(split, record):
            name = f"order-{order.act or f'{order.verb}-{order.at_ns}'}"
            said.append(_lost_order(order, split, record))
            if name not in noted:  # several versions that lost may descend from the one with the order
                notes.append(said[-1])
                noted.append(name)
                recipients.append(_recipient(order.by))
        settled.append(replace(split, settled=True, note=clean("; ".join(said), MAX_NOTE)))
    others = tuple(each for each in record.splits if each not in fresh)
    return Healing(
        splits=tuple(sorted((*others, *settled), key=lambda each: (each.coordinator, each.sequence))),
        fences=fences,
        ends=tuple(ends.values()),
        superseded=tuple(sorted(superseded)),
        notes=tuple(notes),
        noted=tuple(noted),
        to=tuple(recipients),
    )


def overruled(split: Split, record: TaskRecord) -> tuple[LostOrder, ...]:
    """Return the orders of a version that lost which the version that stands neither has nor has had the effect of."""
    mine = orders_of(record)
    decision = record.decision
    stopped = record.state in (TaskState.CANCELLED, TaskState.CANCELLING)
    effective = {
        "cancel": stopped,
        "approve": decision is not None and decision.approved,
        "reject": stopped or (decision is not None and not decision.approved),
        "retry": record.retried_by is not None,
        "first": record.ranked_by is not None,
        "pause": any(not each.stop for each in record.pauses),
    }
    return tuple(each for each in split.orders if each not in mine and not effective.get(each.verb, False))


def _lost_order(order: LostOrder, split: Split, record: TaskRecord) -> str:
    again = f"; if it is still wanted, give it again: swiftbot task {order.verb} {record.id}"
    return clean(
        f"a partition has healed: the {order.verb} of task {record.id} by {order.by or 'an operator'} is void: the "
        f"version of {split.coordinator} that had it ({split.state}) lost to that of {record.coordinator} "
        f"({record.state}){'' if record.state.final else again}",
        MAX_NOTE,
    )


def _recipient(by: str) -> str:
    """Who hears of a lost order: its operator where the name can be part of a key, else any operator."""
    try:
        return check_name(by, "operator")
    except PayloadError:
        return NOTICED


def _same(own: SubtaskRecord, run: LostRun) -> bool:
    """Whether a run of the other version is one of this version too.

    Not one that was taken for lost and repeated here while it went on, or succeeded, on the other side.
    """
    known = any(each.number == run.attempt and each.gateway == run.gateway for each in own.attempts)
    went_on = run.state in _ACTIVE or run.state is SubtaskState.SUCCEEDED
    return known and not (went_on and run.attempt < own.attempt)


def _became(run: LostRun) -> str:
    return "ended now" if run.state in _ACTIVE else f"it had {run.state}"
