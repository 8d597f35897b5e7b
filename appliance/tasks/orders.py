"""Sends what a driver has decided to the gateways: run orders, cancels, questions after runs; and keeps the answers.

Orders go out only when the record that they follow from is written, each as a task of its own, so that a slow gateway
holds up nobody. What comes of one is handed to the driver like any other news.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine
from typing import Any

import structlog
from msgspec.structs import replace

from appliance.errors import SwiftbotError
from appliance.model import (
    Choice,
    Failure,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    SubtaskRecord,
    TaskRecord,
)
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.api import Held, HoldAsk, RunAsk, RunStatus
from appliance.tasks.context import Input, MoveReady, RunNews, Surroundings, deadline_s, need_of

log = structlog.get_logger(__name__)

ANSWER_S = 0.25
"""How long the end of a run waits for the answer to its order, which says how its container was chosen. It is on its
way: a run that takes no time can be heard of before it."""
LEAVE_S = 8.0
"""How long a run that is left may take to end before the next attempt begins elsewhere: its handler's grace, and
what it changed in volumes being noted. Beyond that it is fenced off by its attempt number alone."""

HOLD_S = 20.0
"""How long a run may take to come to a point where it can be left: the end of a robot command, a checkpoint."""


def request_for(
    record: TaskRecord,
    target: SubtaskRecord,
    manifest: SkillManifest,
    *,
    robot: str | None,
    coordinator: str,
    elapsed_s: float = 0.0,
) -> RunRequest:
    """Return the order for the next attempt at a subtask; `elapsed_s`: since its task was accepted."""
    subtask = target.subtask
    return RunRequest(
        task=record.id,
        subtask=subtask.id,
        attempt=target.next_attempt,
        skill=subtask.skill,
        need=need_of(manifest),
        robot=robot,
        params=subtask.params,
        inputs=_inputs(record, target),
        coordinator=coordinator,
        deadline_s=deadline_s(manifest, subtask.params),
        priority=record.priority,
        due_s=max(0.001, record.deadline_s - elapsed_s) if record.deadline_s else 0.0,
        submitter=record.submitter,
        group=record.within,
        moves=sum(bool(each.left) for each in target.attempts),
        avoid=tuple(sorted({each.gateway for each in target.attempts if each.failure and each.gateway})),
    )


def _inputs(record: TaskRecord, target: SubtaskRecord) -> dict[str, dict[str, Any]]:
    """Results of the subtasks it comes after, directly or not: a report needs the picture two steps back."""
    found: dict[str, dict[str, Any]] = {}
    open_ids = list(target.subtask.after)
    while open_ids:
        before = record.of(open_ids.pop(0))
        if before.subtask.id not in found:
            found[before.subtask.id] = {"skill": before.subtask.skill, **(before.result or {})}
            open_ids.extend(before.subtask.after)
    return found


class Orders:
    """The orders of one task. `tell` gets what comes of them."""

    def __init__(self, around: Surroundings, tell: Callable[[Input], None]) -> None:
        self._around = around
        self._tell = tell
        self._outgoing: list[tuple[str, RunRequest]] = []
        self._moves: list[tuple[MoveReady, RunRequest, SubtaskRecord]] = []
        self._sending: dict[tuple[str, int], asyncio.Task[object]] = {}
        self._tasks: set[asyncio.Task[object]] = set()
        self._accepted: dict[tuple[str, int], RunAccepted] = {}
        self._sent_at: dict[str, float] = {}

    def add(self, gateway: str, request: RunRequest) -> None:
        """Have an order ready for when the record is written."""
        # Until then, too, the new attempt is not one that was ordered as long ago as the one before.
        self._sent_at[request.subtask] = time.monotonic()
        self._outgoing.append((gateway, request))

    def move(self, news: MoveReady, request: RunRequest, *, left: SubtaskRecord) -> None:
        """Have a run ended and its next attempt ordered elsewhere when the record is written."""
        self._sent_at[request.subtask] = time.monotonic() + LEAVE_S
        self._moves.append((news, replace(request, moves=request.moves + 1), left))

    def go(self) -> None:
        """The record is written: send what waited for that."""
        moves, self._moves = self._moves, []
        for news, request, left in moves:
            news.done()
            # Nobody is asked after the new attempt before it was ordered.
            self._sent_at[request.subtask] = time.monotonic() + LEAVE_S
            self._sending[request.subtask, request.attempt] = self._start(self._move(news.gateway, request, left))
        outgoing, self._outgoing = self._outgoing, []
        for gateway, request in outgoing:
            self._sent_at[request.subtask] = time.monotonic()
            self._sending[request.subtask, request.attempt] = self._start(self._send(gateway, request))

    def sent_at(self, subtask: str) -> float:
        """When the last order of a subtask went out; 0 for one that another coordinator sent."""
        return self._sent_at.get(subtask, 0.0)

    def silent_since(self, subtask: str, now: float) -> float:
        """Since when a run is waited for: its order, or the first look at one that another coordinator sent."""
        return self._sent_at.setdefault(subtask, now)

    async def answered(self, subtask: str, attempt: int) -> None:
        """Wait a moment for the answer to an order that is on its way."""
        sending = self._sending.pop((subtask, attempt), None)
        if sending is not None and not sending.done():
            await asyncio.wait({sending}, timeout=ANSWER_S)

    def choice(self, subtask: str, attempt: int) -> Choice | None:
        """How the container of an attempt was chosen, as far as it is known by now."""
        accepted = self._accepted.get((subtask, attempt))
        return accepted.choice if accepted is not None else None

    def passed_on(self, subtask: str, attempt: int, choice: Choice) -> None:
        """Note that a run was passed on while it waited, and why."""
        accepted = self._accepted.get((subtask, attempt))
        if accepted is not None:
            self._accepted[subtask, attempt] = replace(accepted, gateway=choice.gateway, choice=choice)

    def cancel(self, target: SubtaskRecord, task: str) -> None:
        """Have a run end; its final event follows."""
        self._start(self.ask(target, task, "run_cancel"))

    async def ask(self, target: SubtaskRecord, task: str, verb: str) -> RunStatus | None:
        """Ask a run's gateway about it (`run_status`, `run_cancel`); None when it does not answer."""
        ask = RunAsk(task=task, subtask=target.subtask.id, attempt=target.attempt)
        try:
            return await self._around.plane.rpc.call(target.gateway, verb, ask, RunStatus, timeout_s=2.0)
        except SwiftbotError as error:
            log.info("no word of a run", run=ask.run_id, gateway=target.gateway, reason=str(error))
            return None

    async def hold(self, target: SubtaskRecord, task: str) -> bool:
        """Have a run save a checkpoint and send no more commands for a moment; False when it goes on as before."""
        ask = HoldAsk(task=task, subtask=target.subtask.id, attempt=target.attempt)
        try:
            held = await self._around.plane.rpc.call(target.gateway, "run_hold", ask, Held, timeout_s=HOLD_S)
        except SwiftbotError as error:
            log.info("a run is not held", task=task, subtask=target.subtask.id, reason=str(error))
            return False
        return held.saved or not held.began

    def close(self) -> None:
        """Give up what is on its way."""
        for news, _, _ in self._moves:
            news.give_up("the task's coordination has ended before it was written")
        for task in self._tasks:
            task.cancel()

    async def _send(self, gateway: str, request: RunRequest) -> None:
        try:
            if request.attempt > 1:
                saved = await self._around.checkpoint(request.task, request.subtask)
                if saved is not None:
                    request = replace(request, resume=saved.data, calls=saved.calls)
            accepted = await self._around.order(gateway, request)
            self._accepted[request.subtask, request.attempt] = accepted
            if accepted.gateway != gateway:
                # Passed on to a warm container: from now on that gateway answers for the run.
                self._tell(RunNews(_event(request, accepted.gateway, RunEventKind.PROGRESS)))
        except SwiftbotError as error:
            failure = Failure(
                code=error.code if error.code in ("refused", "pool") else "unreachable",
                message=f"{gateway}: {error.message}",
                remedy=error.remedy,
                retryable=True,
            )
            self._tell(RunNews(_event(request, gateway, RunEventKind.FAILED, failure)))
        except Exception as error:  # the boundary to the executor here: the attempt fails, the task goes on
            log.exception("run order broke", run=request.run_id, gateway=gateway)
            failure = Failure(code="internal", message=f"{type(error).__name__}: {error}", retryable=True)
            self._tell(RunNews(_event(request, gateway, RunEventKind.FAILED, failure)))

    async def _move(self, gateway: str, request: RunRequest, left: SubtaskRecord) -> None:
        """End the run that is left, so that what it changed is there for the next, then order that."""
        ask = RunAsk(task=request.task, subtask=request.subtask, attempt=left.attempt)
        try:
            await self._around.plane.rpc.call(left.gateway, "run_leave", ask, RunStatus, timeout_s=LEAVE_S)
        except SwiftbotError as error:
            # It hears of the record, or is cut off: robots and coordinators refuse its attempt in any case.
            log.warning("a run that was moved is not known to have ended", run=ask.run_id, reason=str(error))
        self._sent_at[request.subtask] = time.monotonic()
        await self._send(gateway, request)

    def _start(self, order: Coroutine[Any, Any, object]) -> asyncio.Task[object]:
        task = asyncio.create_task(order)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _event(request: RunRequest, gateway: str, kind: RunEventKind, failure: Failure | None = None) -> RunEvent:
    return RunEvent(
        task=request.task,
        subtask=request.subtask,
        attempt=request.attempt,
        kind=kind,
        gateway=gateway,
        failure=failure,
    )
