"""Why a task waits, as its coordinator knows it just now: who could serve it, who could not, and when it may start.

What has been decided stands in the record (`why`); this adds what is in no record because it changes by the second.
"""

import asyncio
import time
from collections.abc import Mapping

from appliance.errors import NotFoundError, SwiftbotError
from appliance.model import SubtaskRecord, SubtaskState, TaskRecord
from appliance.plane.node import Plane
from appliance.tasks.api import RunAsk, RunStatus
from appliance.tasks.deadline import left_s
from appliance.tasks.durations import Durations
from appliance.tasks.hints import expected_starts
from appliance.tasks.scheduling import Scheduler
from appliance.tasks.why import WAITS, CandidateWhy, TaskWhy, Waits, why, with_waits

STATUS_S = 1.0
MOST_ASKED = 32
"""Runs of one task whose gateways are asked where they stand."""


async def explain(
    record: TaskRecord,
    subtask: str,
    *,
    plane: Plane,
    scheduler: Scheduler,
    durations: Durations,
    elapsed_s: float,
) -> TaskWhy:
    """Return the reasons of a task that is coordinated here, or of one of its subtasks.

    Args:
        record: the task.
        subtask: the one of interest; "" for all.
        plane: the fleet.
        scheduler: where its subtasks go.
        durations: how long subtasks take.
        elapsed_s: since it was accepted.

    Raises:
        NotFoundError: the plan has no such subtask.
    """
    found = why(record, subtask)
    seconds = {each.subtask.id: durations.of(each.subtask.skill, each.subtask.params) for each in record.subtasks}
    starts = expected_starts(record, seconds, {})
    chosen = [each for each in record.subtasks if subtask in ("", each.subtask.id) and not each.state.final]
    sent = [each for each in chosen if each.state is SubtaskState.DISPATCHED][:MOST_ASKED]
    answers = await asyncio.gather(*(_status(plane, record, each) for each in sent))
    statuses = {each.subtask.id: answer for each, answer in zip(sent, answers, strict=True)}
    waits = {each.subtask.id: _waits(record, each, scheduler, statuses, starts) for each in chosen}
    left = left_s(record, elapsed_s)
    return with_waits(found, waits, left_s=None if record.deadline_s == 0 else round(left, 1))


def _waits(
    record: TaskRecord,
    target: SubtaskRecord,
    scheduler: Scheduler,
    statuses: Mapping[str, RunStatus | None],
    starts: Mapping[str, float],
) -> Waits:
    name = target.subtask.id
    match target.state:
        case SubtaskState.RUNNING:
            held = target.note.startswith(WAITS)
            return Waits(reason=target.note.removeprefix(WAITS) if held else "nothing: it runs")
        case SubtaskState.WAITING:
            open_ones = [each for each in target.subtask.after if not record.of(each).state.final]
            return Waits(reason=f"comes after {', '.join(open_ones)}", expected_s=_rounded(starts.get(name)))
        case SubtaskState.DISPATCHED:
            status = statuses.get(name)
            if status is None or not status.position:
                return Waits(reason=f"{target.gateway} has it, and has not told of its first line", at=target.gateway)
            return Waits(
                reason=f"a container of {target.gateway}",
                at=target.gateway,
                position=status.position,
                waiting=status.queue,
                expected_s=_rounded(status.expected_s),
            )
        case _:
            pass
    if record.paused:
        return Waits(reason=record.paused)
    place = scheduler.line.place_of((record.id, name), time.monotonic())
    robot, reason = scheduler.bind(record, target) if target.subtask.robot else (None, "")
    try:
        placement = scheduler.place(record, target, robot)
    except NotFoundError as error:
        return Waits(reason=error.message)
    candidates = [CandidateWhy(gateway=each, score=placement.scores.get(each)) for each in placement.order]
    candidates += [CandidateWhy(gateway=each, excluded=text) for each, text in placement.excluded.items()]
    if place.position:
        reason = f"room at {', '.join(placement.order)}"
    elif not reason:
        reason = target.note or "nothing: it is being sent"
    return Waits(
        reason=reason.removeprefix(WAITS),
        position=place.position,
        waiting=place.waiting,
        expected_s=_rounded(place.expected_s),
        candidates=tuple(candidates),
    )


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 1)


async def _status(plane: Plane, record: TaskRecord, target: SubtaskRecord) -> RunStatus | None:
    ask = RunAsk(task=record.id, subtask=target.subtask.id, attempt=target.attempt)
    try:
        return await plane.rpc.call(target.gateway, "run_status", ask, RunStatus, timeout_s=STATUS_S)
    except SwiftbotError:
        return None
