"""Drives one task from acceptance to its end: the thin shell around `machine`.

One asyncio task a driver, with an inbox: run events, lost gateways, cancels and timers come in one at a time;
each becomes a transition, the record is written to the DHT under compare-and-set *before* anything follows
from it, then the orders go out. If the write finds that the record has moved on, another gateway coordinates
the task: this driver reads again and, unless the key is its own, stops. So two coordinators never start the
same attempt.
"""

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import structlog

from appliance.errors import NotFoundError, PlanError, SwiftbotError
from appliance.model import (
    Failure,
    Plan,
    RunEvent,
    RunEventKind,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    VersionVector,
)
from appliance.tasks import machine
from appliance.tasks.api import RunStatus
from appliance.tasks.bounds import MAX_NOTE, MAX_RUN_S, clean, tidy
from appliance.tasks.keeper import Keeper, SupersededError
from appliance.tasks.machine import TransitionKind
from appliance.tasks.orders import Orders, request_for
from appliance.tasks.partials import Partials, shown
from appliance.tasks.surroundings import (
    CancelAsked,
    GatewayLost,
    Input,
    RunNews,
    Surroundings,
    Wake,
    deadline_s,
)

log = structlog.get_logger(__name__)

LOOK_AHEAD_S = 5.0
"""How often what comes is worked out anew while no subtask changes."""
_LEAST = (RunEventKind.PROGRESS, RunEventKind.PARTIAL, RunEventKind.CHECKPOINT)
MAX_INBOX = 1000
"""News that may wait for a driver; beyond it progress is dropped, beyond twice that what checks find out anyway."""


class Driver(Keeper):
    """Drives one task. `run` ends when the task has ended or another gateway has taken over."""

    def __init__(
        self,
        around: Surroundings,
        record: TaskRecord,
        version: VersionVector,
        *,
        on_change: Callable[[TaskRecord], None],
        give_up: Failure | None = None,
    ) -> None:
        self._around = around
        super().__init__(around.plane, record, version, on_change)
        self.ended = False
        """Whether the task has ended and its last record is written; one that is final only here has not."""
        self._give_up = give_up
        """Why the task is to be ended instead of driven: earlier drivers of it broke."""
        self._inbox: asyncio.Queue[Input] = asyncio.Queue()
        self._not_before: dict[str, float] = {}
        self._waiting: dict[str, str] = {}
        self._orders = Orders(around, self.tell)
        self._partials = Partials()
        self._hinted_states: tuple[SubtaskState, ...] = ()
        self._hint_at = 0.0
        self._cancelled_at: float | None = None
        self._cancel_at: dict[str, float] = {}
        self._check_at = time.monotonic() + around.config.check_s

    @property
    def waits(self) -> bool:
        """Whether a subtask waits for a robot or a gateway."""
        return bool(self._waiting)

    def tell(self, news: Input) -> None:
        """Hand in what happened; never blocks. What is of no use, or too much, is dropped: checks make up for it."""
        if isinstance(news, RunNews) and not self._useful(news.event):
            return
        least = isinstance(news, Wake) or (isinstance(news, RunNews) and news.event.kind in _LEAST)
        if self._inbox.qsize() >= (MAX_INBOX if least else 2 * MAX_INBOX) and not isinstance(news, CancelAsked):
            return
        self._inbox.put_nowait(news)

    def _useful(self, event: RunEvent) -> bool:
        """Whether an event is of a current attempt and tells something that the record keeps."""
        if event.kind is RunEventKind.LOG:
            return False
        current = next((each for each in self.record.subtasks if each.subtask.id == event.subtask), None)
        return current is not None and event.attempt == current.attempt and not current.state.final

    async def run(self) -> None:
        """Drive to the end."""
        try:
            await self._resume()
            while not self.record.state.final:
                self._advance()
                await self._flush()
                if self.record.state.final:
                    break
                await self._handle(await self._next())
                while not self._inbox.empty():
                    await self._handle(self._inbox.get_nowait())
                # By the clock, not when nothing else happens: one talkative run must not hide a silent one.
                await self._check()
            await self._flush()
            self.ended = True
            await self._around.forget_checkpoints(self.record)
        except SupersededError as error:
            log.info("task is coordinated elsewhere", task=self.record.id, reason=error.message)
        finally:
            self._orders.close()

    async def _next(self) -> Input:
        try:
            async with asyncio.timeout(self._pause_s()):
                return await self._inbox.get()
        except TimeoutError:
            return Wake()

    def _pause_s(self) -> float:
        now = time.monotonic()
        partial_at = self._partials.next_at()
        wake_at = (*self._not_before.values(), self._check_at, *(() if partial_at is None else (partial_at,)))
        due = [at - now for at in wake_at if at > now]
        return max(0.01, min([self._around.config.check_s, *due]))

    # --- taking up ------------------------------------------------------------------------------------------

    async def _resume(self) -> None:
        """Take the task over if another gateway coordinated it, ask after its runs, and plan it if need be."""
        if self.record.sequence > 1 or self.record.coordinator != self._plane.gateway:
            self._apply(self._transition(TransitionKind.ADOPTED))
            await self._flush()
        if self._give_up is not None and self.record.state in (TaskState.ACCEPTED, TaskState.RUNNING):
            kind = TransitionKind.CANCEL if self.record.subtasks else TransitionKind.PLAN_FAILED
            self._apply(self._transition(kind, failure=self._give_up))
        await self._ask_after(machine.active(self.record))
        if self.record.state is TaskState.ACCEPTED:
            await self._plan()

    async def _plan(self) -> None:
        """Get a plan, unless a cancel comes first."""
        planning = asyncio.ensure_future(self._around.plan(self.record))
        try:
            if await self._cancelled_before(planning):
                self._apply(self._transition(TransitionKind.CANCEL))
                return
            self._apply(self._transition(TransitionKind.PLANNED, plan=planning.result()))
        except SwiftbotError as error:
            self._apply(self._transition(TransitionKind.PLAN_FAILED, failure=_plan_failure(error)))
        except Exception as error:  # the boundary to the planner: whatever breaks in it, the submitter is told
            log.exception("planning broke", task=self.record.id)
            failure = Failure(code="internal", message=clean(f"planning broke: {type(error).__name__}: {error}", 500))
            self._apply(self._transition(TransitionKind.PLAN_FAILED, failure=failure))
        finally:
            planning.cancel()

    async def _cancelled_before(self, planning: "asyncio.Future[Plan]") -> bool:
        """Wait for the plan; True if a cancel came first."""
        while not planning.done():
            asking = asyncio.ensure_future(self._inbox.get())
            try:
                await asyncio.wait({planning, asking}, return_when=asyncio.FIRST_COMPLETED)
                if asking.done() and isinstance(asking.result(), CancelAsked):
                    return True
            finally:
                asking.cancel()
        return False

    # --- what follows from the record ---------------------------------------------------------------------

    def _advance(self) -> None:
        """Dispatch what can be dispatched; on the way to the end, cancel what still runs."""
        if self.record.state is TaskState.CANCELLING:
            self._end_runs()
            return
        now = time.monotonic()
        for event in self._partials.due(now):
            partial = self._transition(
                TransitionKind.PARTIAL, subtask=event.subtask, attempt=event.attempt, result=shown(event.result)
            )
            self._take(partial, durable=False)
        for each in machine.ready(self.record):
            self._ready_ns.setdefault(each.subtask.id, time.monotonic_ns())
            if self.record.state is TaskState.RUNNING and self._not_before.get(each.subtask.id, 0.0) <= now:
                self._not_before.pop(each.subtask.id, None)
                self._dispatch(each)

    def _dispatch(self, target: SubtaskRecord) -> None:
        subtask = target.subtask
        try:
            manifest = self._around.manifest(subtask.skill)
        except NotFoundError as error:
            # Planned on a gateway that knows more skills than this one, or before this one forgot it.
            failure = Failure(code=error.code, message=error.message, remedy=error.remedy)
            self._apply(
                self._transition(
                    TransitionKind.ATTEMPT_FAILED,
                    subtask=subtask.id,
                    attempt=target.attempt + 1,
                    failure=failure,
                    give_up=True,
                )
            )
            return
        robot = None
        if subtask.robot is not None:
            robot, reason = self._around.bind(self.record, target)
            if robot is None:
                self._wait(target, reason)
                return
        placement = self._around.place(self.record, target, robot)
        if not placement.order:
            self._wait(target, f"waits for a gateway: {placement.why}")
            return
        self._waiting.pop(subtask.id, None)
        request = request_for(self.record, target, manifest, robot=robot, coordinator=self._plane.gateway)
        gateway = placement.order[0]
        self._apply(
            self._transition(
                TransitionKind.DISPATCHED,
                subtask=subtask.id,
                attempt=request.attempt,
                gateway=gateway,
                robot=robot,
                placed=clean(placement.why, MAX_NOTE),
            )
        )
        self._orders.add(gateway, request)

    def _wait(self, target: SubtaskRecord, reason: str) -> None:
        """Tell people why it waits, once per reason, and look again soon.

        Written to the record, since every gateway must be able to say why nothing goes on.
        """
        self._not_before[target.subtask.id] = time.monotonic() + 0.5
        if self._waiting.get(target.subtask.id) != reason:
            self._waiting[target.subtask.id] = reason
            self._apply(
                self._transition(
                    TransitionKind.PROGRESS, subtask=target.subtask.id, attempt=target.attempt, note=clean(reason, 500)
                )
            )

    def _end_runs(self) -> None:
        now = time.monotonic()
        if self._cancelled_at is None:
            self._cancelled_at = now
        for each in machine.active(self.record):
            if now - self._cancelled_at > self._around.config.grace_s:
                failure = Failure(code="cancelled", message=f"{each.gateway} did not confirm the cancel in time")
                self._attempt_failed(each, failure, None)
            elif self._cancel_at.get(each.subtask.id, 0.0) <= now:
                # Again and again: the first may overtake the order to run, or be lost.
                self._cancel_at[each.subtask.id] = now + self._around.config.check_s
                self._orders.cancel(each, self.record.id)

    # --- what happened --------------------------------------------------------------------------------------

    async def _handle(self, news: Input) -> None:
        match news:
            case RunNews(event):
                if event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
                    await self._orders.answered(event.subtask, event.attempt)
                self._run_news(event)
            case GatewayLost(gateway):
                for each in machine.active(self.record):
                    if each.gateway == gateway:
                        failure = Failure(code="unreachable", message=f"{gateway} was lost", retryable=True)
                        self._attempt_failed(each, failure, None)
            case CancelAsked():
                if self.record.state is TaskState.RUNNING:
                    self._apply(self._transition(TransitionKind.CANCEL))
            case Wake():
                for subtask in self._waiting:
                    self._not_before.pop(subtask, None)

    def _run_news(self, event: RunEvent) -> None:
        try:
            target = self.record.of(event.subtask)
        except KeyError:
            return
        if event.attempt != target.attempt or target.state.final:
            return
        event = tidy(event, max_result_bytes=self._around.config.max_result_bytes)
        common: dict[str, Any] = {
            "subtask": event.subtask,
            "attempt": event.attempt,
            "gateway": event.gateway,
            "container": event.container,
            "phase": event.phase,
        }
        choice = self._orders.choice(event.subtask, event.attempt)
        match event.kind:
            case RunEventKind.STARTED:
                ready_ns = self._ready_ns.get(event.subtask)
                startup_ms = (time.monotonic_ns() - ready_ns) / 1e6 if ready_ns else event.startup_ms
                self._take(self._transition(TransitionKind.STARTED, startup_ms=startup_ms, choice=choice, **common))
            case RunEventKind.PROGRESS:
                self._take(
                    self._transition(TransitionKind.PROGRESS, progress=event.progress, note=event.note, **common),
                    durable=False,
                )
            case RunEventKind.SUCCEEDED:
                self._partials.drop(event.subtask)
                succeeded = self._transition(
                    TransitionKind.SUCCEEDED,
                    result=event.result,
                    duration_ms=event.duration_ms,
                    choice=choice,
                    **common,
                )
                if self._take(succeeded) and event.duration_ms is not None:
                    self._around.took(target.subtask.skill, event.duration_ms)
            case RunEventKind.FAILED:
                failure = event.failure or Failure(code="internal", message="the run failed without a reason")
                self._attempt_failed(target, failure, event.duration_ms)
            case RunEventKind.PARTIAL:
                self._partials.add(event)
            case RunEventKind.CHECKPOINT:
                # The first one is written at once: whoever comes later must know that there is something to remove.
                self._take(self._transition(TransitionKind.CHECKPOINT, **common), durable=not target.checkpoint_ns)
            case RunEventKind.LOG:
                pass

    def _attempt_failed(self, target: SubtaskRecord, failure: Failure, duration_ms: float | None) -> None:
        judged = _with_failure(target, failure)
        give_up = machine.gives_up(judged, failure, retries=self._retries(target) + 1)
        taken = self._take(
            self._transition(
                TransitionKind.ATTEMPT_FAILED,
                subtask=target.subtask.id,
                attempt=target.attempt,
                gateway=target.gateway,
                failure=failure,
                give_up=give_up,
                duration_ms=duration_ms,
                choice=self._orders.choice(target.subtask.id, target.attempt),
            )
        )
        self._partials.drop(target.subtask.id)
        if taken and not give_up:
            self._ready_ns[target.subtask.id] = time.monotonic_ns()
            self._not_before[target.subtask.id] = time.monotonic() + machine.retry_delay_s(target.attempt)

    def _retries(self, target: SubtaskRecord) -> int:
        try:
            return self._around.manifest(target.subtask.skill).retries
        except NotFoundError:
            return 0

    def _limit_s(self, target: SubtaskRecord) -> float:
        """How long a run may take; for a skill that only its gateway knows, as long as any."""
        try:
            return deadline_s(self._around.manifest(target.subtask.skill), target.subtask.params)
        except NotFoundError:
            return MAX_RUN_S

    async def _check(self) -> None:
        """When it is time: ask after runs, in case an event was lost, and give up the silent past their deadline."""
        now = time.monotonic()
        if now < self._check_at:
            return
        self._check_at = now + self._around.config.check_s
        self._look_ahead(now)
        members = self._plane.members()
        asked: list[SubtaskRecord] = []
        for each in machine.active(self.record):
            limit = self._limit_s(each)
            silent_s = now - self._orders.silent_since(each.subtask.id, now)
            if each.gateway not in members:
                await self._handle(GatewayLost(each.gateway))
            elif silent_s > limit + self._around.config.grace_s:
                failure = Failure(code="deadline", message=f"nothing came of it within {limit:.0f} s")
                self._attempt_failed(each, failure, None)
            elif silent_s > self._around.config.check_s:
                asked.append(each)
        await self._ask_after(asked)
        # Answers may have taken a while; the next look is a whole interval away from them.
        self._check_at = time.monotonic() + self._around.config.check_s

    async def _ask_after(self, targets: Sequence[SubtaskRecord]) -> None:
        """Learn from their gateways what became of runs."""
        answers = await asyncio.gather(*(self._orders.ask(each, self.record.id, "run_status") for each in targets))
        for target, status in zip(targets, answers, strict=True):
            self._learn(target, status)

    def _learn(self, target: SubtaskRecord, status: RunStatus | None) -> None:
        lost = ""
        if status is None:
            if target.gateway not in self._plane.members():
                lost = f"{target.gateway} was lost"
        elif status.last is None:
            sent = self._orders.sent_at(target.subtask.id)
            if not status.running and time.monotonic() - sent > self._around.config.run_timeout_s:
                lost = f"{target.gateway} does not know the run"
        elif status.last.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            self._run_news(status.last)
        elif not status.running:
            lost = f"{target.gateway} lost the run"
        elif status.last.kind is RunEventKind.STARTED:
            self._run_news(status.last)
        if lost:
            self._attempt_failed(target, Failure(code="unreachable", message=lost, retryable=True), None)

    def _written(self) -> None:
        self._orders.go()
        self._look_ahead(time.monotonic())

    def _look_ahead(self, now: float) -> None:
        """Have pools told what comes, when subtasks have moved, and now and then since times pass."""
        states = tuple(each.state for each in self.record.subtasks)
        waited = SubtaskState.WAITING in self._hinted_states
        if not (waited or SubtaskState.WAITING in states) or (states == self._hinted_states and now < self._hint_at):
            return
        self._hinted_states, self._hint_at = states, now + LOOK_AHEAD_S
        running_s = {
            each.subtask.id: now - self._orders.silent_since(each.subtask.id, now)
            for each in machine.active(self.record)
        }
        self._around.plan_moved(self.record, running_s)


def _with_failure(target: SubtaskRecord, failure: Failure) -> SubtaskRecord:
    if not target.attempts or target.state is SubtaskState.READY:
        return target
    last = msgspec.structs.replace(target.attempts[-1], failure=failure)
    return msgspec.structs.replace(target, attempts=(*target.attempts[:-1], last))


def _plan_failure(error: SwiftbotError) -> Failure:
    problems = error.problems if isinstance(error, PlanError) else ()
    message = error.message if not problems else f"{error.message}: {'; '.join(problems[:5])}"
    return Failure(code=error.code, message=message, remedy=error.remedy)
