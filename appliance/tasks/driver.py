"""Drives one task from acceptance to its end: the thin shell around `machine`.

One asyncio task a driver, with an inbox: run events, lost gateways, cancels and timers come in one at a time;
each becomes a transition, the record is written to the DHT under compare-and-set *before* anything follows
from it, then the orders go out. If the write finds that the record has moved on, another gateway coordinates
the task: this driver reads again and, unless the key is its own, stops. So two coordinators never start the
same attempt.

Here are the loop and its inbox; the parts are `planning`, `dispatching`, `hearing` (news of runs), `checking` with the
`monitor`, `replanning` and `steering` (operators' orders), around the `keeper` of the record.
"""

import asyncio
import time
from collections.abc import Callable

import structlog

from appliance.errors import UnreachableError
from appliance.model import Failure, RunEventKind, SubtaskState, TaskRecord, TaskState, VersionVector
from appliance.tasks import machine
from appliance.tasks.checking import Checking
from appliance.tasks.deadline import left_s, passed
from appliance.tasks.dispatching import Dispatching
from appliance.tasks.healing import OVERTAKEN, heal
from appliance.tasks.hearing import Hearing
from appliance.tasks.keeper import Keeper, SupersededError
from appliance.tasks.machine import TransitionKind
from appliance.tasks.monitor import Monitor
from appliance.tasks.orders import Orders
from appliance.tasks.pace import Pace
from appliance.tasks.planning import plan_it
from appliance.tasks.replanning import Replanning
from appliance.tasks.steering.driving import Steering
from appliance.tasks.surroundings import (
    CancelAsked,
    GatewayLost,
    Input,
    MoveReady,
    PlanMade,
    RunHeld,
    RunNews,
    Steered,
    Surroundings,
    Wake,
)
from appliance.tasks.unknown import Unknown

log = structlog.get_logger(__name__)

LOOK_AHEAD_S = 5.0
"""How often what comes is worked out anew while no subtask changes."""
_LEAST = (RunEventKind.PROGRESS, RunEventKind.PARTIAL, RunEventKind.CHECKPOINT)
_NEVER_LEFT = (CancelAsked, PlanMade, Steered, RunHeld)
"""News that are few and that no check would find out."""
_TIMED = (TaskState.RUNNING, TaskState.PROPOSED)
"""States in which a deadline or an operator ends a task by a transition; while it is planned, planning is ended."""
MAX_INBOX = 1000
"""News that may wait for a driver; beyond it progress is dropped, beyond twice that what checks find out anyway."""


class Driver:
    """Drives one task. `run` ends when the task has ended or another gateway has taken over."""

    def __init__(
        self,
        around: Surroundings,
        record: TaskRecord,
        version: VersionVector,
        *,
        on_change: Callable[[TaskRecord], None],
        give_up: Failure | None = None,
        elapsed_s: float = 0.0,
        unknown: Unknown | None = None,
    ) -> None:
        self._around = around
        self.ended = False
        """Whether the task has ended and its last record is written; one that is final only here has not."""
        self._give_up = give_up
        """Why the task is to be ended instead of driven: earlier drivers of it broke."""
        self.ending = asyncio.Event()
        """The task ends or has ended by its written record, or this driver has done with it."""
        self._inbox: asyncio.Queue[Input] = asyncio.Queue()
        self._keeper = Keeper(around.plane, record, version, on_change, elapsed_s)
        self._keeper.unknown = unknown or Unknown()
        self._keeper.on_written = self._written
        self._keeper.on_published = around.recovery.published
        self._orders = Orders(around, self.tell)
        self._pace = Pace()
        self._hearing = Hearing(around, self._keeper, self._orders, self._pace)
        parts = (around, self._keeper, self._orders, self._hearing)
        self._replanning = Replanning(*parts, self._pace, self.tell)
        self._dispatching = Dispatching(*parts, self._pace, self._replanning)
        self._monitor = Monitor(*parts, self._dispatching)
        self._checking = Checking(*parts, self._monitor)
        self._steering = Steering(around, self._keeper, self._orders, self._pace, self.tell)
        self._hinted_states: tuple[SubtaskState, ...] = ()
        self._hint_at = 0.0

    @property
    def record(self) -> TaskRecord:
        """The task as it stands here."""
        return self._keeper.record

    @property
    def told(self) -> TaskRecord:
        """The task as it was written last."""
        return self._keeper.told

    @property
    def elapsed_s(self) -> float:
        """Seconds since the task was accepted."""
        return self._keeper.elapsed_s

    @property
    def settled(self) -> bool:
        """Whether all that is known is written, and nothing is awaited of this gateway's own runs."""
        return self._keeper.settled

    @property
    def waits(self) -> bool:
        """Whether a subtask waits for a robot or a gateway."""
        return self._pace.waiting

    def tell(self, news: Input) -> None:
        """Hand in what happened; never blocks. What is of no use, or too much, is dropped: checks make up for it."""
        if isinstance(news, RunNews):
            self._monitor.seen(news.event)
            if not self._hearing.useful(news.event):
                return
        least = isinstance(news, Wake) or (isinstance(news, RunNews) and news.event.kind in _LEAST)
        if self._inbox.qsize() >= (MAX_INBOX if least else 2 * MAX_INBOX) and not isinstance(news, _NEVER_LEFT):
            return
        self._inbox.put_nowait(news)

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
                if time.monotonic() >= self._checking.next_at:
                    self._look_ahead(time.monotonic())
                    await self._checking.check()
            await self._flush()
            self.ended = True
            await self._around.forget_checkpoints(self.record)
        except SupersededError as error:
            log.info("task is coordinated elsewhere", task=self.record.id, reason=error.message)
        finally:
            self.ending.set()
            self._replanning.close()
            self._steering.close()
            for news in self._left():
                news.refuse(UnreachableError("the task's coordination has ended here", remedy="ask again"))
            self._orders.close()

    async def _flush(self) -> None:
        await self._keeper.flush()
        if self.told.state is TaskState.CANCELLING or self.told.state.final:
            self.ending.set()

    async def _next(self) -> Input:
        try:
            async with asyncio.timeout(self._pause_s()):
                return await self._inbox.get()
        except TimeoutError:
            return Wake()

    def _pause_s(self) -> float:
        now = time.monotonic()
        partial_at = self._hearing.next_partial_at
        wake_at = (
            *self._pace.not_before.values(), self._checking.next_at, *(() if partial_at is None else (partial_at,))
        )  # fmt: skip
        due = [at - now for at in wake_at if at > now]
        if self.record.state in _TIMED:
            due.append(left_s(self.record, self._keeper.elapsed_s))
        return max(0.01, min([self._around.config.check_s, *due]))

    async def _resume(self) -> None:
        """Take the task over if another gateway coordinated it, ask after its runs, and plan it if need be."""
        keeper, healing = self._keeper, heal(self.record)
        if self.record.sequence > 1 or self.record.coordinator != self._around.plane.gateway:
            before, began = self.record.coordinator, time.monotonic()
            keeper.apply(keeper.transition(TransitionKind.ADOPTED))
            await keeper.flush()
            wrote_ms = round((time.monotonic() - began) * 1e3, 1)
            log.info("task adopted", task=self.record.id, before=before, wrote_ms=wrote_ms)
        if healing is not None:
            await healing.settle(self._around.plane, keeper)
            for each in healing.superseded:
                self._hearing.attempt_failed(self.record.of(each), OVERTAKEN, None)
        if self._give_up is not None and self.record.state in (TaskState.ACCEPTED, *_TIMED):
            kind = TransitionKind.CANCEL if self.record.subtasks else TransitionKind.PLAN_FAILED
            keeper.apply(keeper.transition(kind, failure=self._give_up))
        await self._checking.ask_after(machine.active(self.record))
        if self.record.state is TaskState.ACCEPTED:
            await plan_it(self._around, keeper, self._inbox)

    def _advance(self) -> None:
        """Do what follows from the record."""
        now = time.monotonic()
        if self.record.state in _TIMED and left_s(self.record, self._keeper.elapsed_s) <= 0:
            self._keeper.apply(self._keeper.transition(TransitionKind.CANCEL, failure=passed(self.record)))
        self._steering.advance()
        if self.record.state is not TaskState.CANCELLING:
            self._hearing.tell_partials(now)
        self._replanning.advance(now)
        self._dispatching.advance(now)

    async def _handle(self, news: Input) -> None:
        match news:
            case RunNews(event):
                await self._hearing.hear(event)
            case GatewayLost(gateway):
                self._hearing.gateway_lost(gateway)
            case CancelAsked(word):
                if self.record.state in (TaskState.RUNNING, TaskState.PROPOSED):
                    self._keeper.apply(self._keeper.transition(TransitionKind.CANCEL, word=word))
            case MoveReady():
                self._dispatching.move(news)
            case PlanMade():
                self._replanning.take_up(news)
            case Steered():
                self._steering.take(news)
            case RunHeld():
                self._steering.run_held(news)
            case Wake():
                self._pace.look_again()

    def _left(self) -> list[Steered]:
        """Orders of operators that came too late to be looked at."""
        left: list[Steered] = []
        while not self._inbox.empty():
            news = self._inbox.get_nowait()
            if isinstance(news, Steered):
                left.append(news)
        return left

    def _written(self) -> None:
        self._orders.go()
        self._steering.written()
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
