"""What is left of a partition when two versions of a task have met: doubled runs are ended, later attempts fenced off.

The version that stands says which others lost (`TaskRecord.splits`, made by `resolve`). Its coordinator settles each of
them once: the highest attempt that either side made becomes the fence below the next one, runs of the other side are
ended where they are, what they still tell is refused, and people get a notice. A run of the version that stands goes on
unless the other side has sent a higher attempt of it to a robot: the robot would refuse it, so it is repeated.
"""

import asyncio
import time

import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import SwiftbotError
from appliance.model import Failure, LostRun, Notice, RunEvent, Split, SubtaskRecord, SubtaskState, TaskRecord, encode
from appliance.plane.node import Plane
from appliance.tasks.api import RunAsk, RunStatus
from appliance.tasks.bounds import MAX_NOTE, clean
from appliance.tasks.keeper import Keeper
from appliance.tasks.transition import TransitionKind

log = structlog.get_logger(__name__)

END_S = 2.0
"""How long a gateway may take to answer that it ends a run; one that does not hears of the record."""
NOTICED = "operator"
OVERTAKEN = Failure(
    code="unreachable", message="a later attempt had been made on the other side of a partition", retryable=True
)
_ACTIVE = (SubtaskState.DISPATCHED, SubtaskState.RUNNING)


def unsettled(record: TaskRecord) -> tuple[Split, ...]:
    """Versions that lost and are not dealt with yet."""
    return tuple(each for each in record.splits if not each.settled)


def unheard(stored: TaskRecord, driven: TaskRecord) -> bool:
    """Whether a stored record knows of versions that lost of which the one that is driven does not."""
    known = {(each.coordinator, each.sequence) for each in driven.splits}
    return any((each.coordinator, each.sequence) not in known for each in unsettled(stored))


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
    """What people are told; none where nothing was doubled."""
    noted: tuple[str, ...]
    """Which version each note is about: whoever settles it, it is the same notice."""

    async def settle(self, plane: Plane, keeper: Keeper) -> None:
        """Write it into the record, then end what is doubled and tell people."""
        keeper.apply(keeper.transition(TransitionKind.HEALED, splits=self.splits, fences=self.fences))
        await keeper.flush()
        task = keeper.record.id
        await asyncio.gather(*(_end(plane, task, run) for run in self.ends))
        for name, note in zip(self.noted, self.notes, strict=True):
            notice = Notice(
                id=f"{task}/healed/{name}",
                to=NOTICED,
                text=note,
                task=task,
                gateway=plane.gateway,
                at_ns=time.time_ns(),
            )
            plane.session.put(plane.keys.notice(NOTICED), encode(notice))
            log.warning("a partition has healed", task=task, note=note)


async def _end(plane: Plane, task: str, run: LostRun) -> None:
    ask = RunAsk(task=task, subtask=run.subtask, attempt=run.attempt)
    try:
        await plane.rpc.call(run.gateway, "run_cancel", ask, RunStatus, timeout_s=END_S)
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
        if doubled:
            note = clean(
                f"a partition has healed: task {record.id} had gone on on both sides; the version of "
                f"{split.coordinator} ({split.state}) lost to that of {record.coordinator} ({record.state}); "
                f"doubled: {'; '.join(doubled)}",
                MAX_NOTE,
            )
            notes.append(note)
            noted.append(f"{split.coordinator}-{split.sequence}")
        settled.append(replace(split, settled=True, note=note))
    others = tuple(each for each in record.splits if each.settled)
    return Healing(
        splits=tuple(sorted((*others, *settled), key=lambda each: (each.coordinator, each.sequence))),
        fences=fences,
        ends=tuple(ends.values()),
        superseded=tuple(sorted(superseded)),
        notes=tuple(notes),
        noted=tuple(noted),
    )


def _same(own: SubtaskRecord, run: LostRun) -> bool:
    """Whether a run of the other version is one of this version too.

    Not one that was taken for lost and repeated here while it went on, or succeeded, on the other side.
    """
    known = any(each.number == run.attempt and each.gateway == run.gateway for each in own.attempts)
    went_on = run.state in _ACTIVE or run.state is SubtaskState.SUCCEEDED
    return known and not (went_on and run.attempt < own.attempt)


def _became(run: LostRun) -> str:
    return "ended now" if run.state in _ACTIVE else f"it had {run.state}"
