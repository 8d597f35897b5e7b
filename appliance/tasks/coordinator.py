"""The coordinator of one task, from acceptance to its end: the shell around `decide`.

`Coordinator` is one asyncio task with an inbox: run events, lost gateways, cancels and timers come in one at a time.
Each becomes transitions of the record, the record is written to the DHT under compare-and-set *before* anything follows
from it, then the instructions are carried out, each as a task of its own, so that a slow gateway holds up nobody. What
comes of one is an event like any other. If the write finds that the record has moved on, another gateway coordinates
the task: this coordinator stops, and its gateway reads the record again. So two coordinators never start the same
attempt.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine
from typing import Any

import structlog
from msgspec.structs import replace

from appliance.background import Background
from appliance.errors import PlanError, SwiftbotError, UnreachableError
from appliance.model import (
    Failure,
    RunEvent,
    RunEventKind,
    RunRequest,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    VersionVector,
    keyspace,
)
from appliance.model.keys import Verb
from appliance.model.task_api import HoldAsk, RunAsk, RunStatus
from appliance.tasks import machine
from appliance.tasks.checkpoints import read_checkpoint, remove_checkpoint
from appliance.tasks.conflicts import heal
from appliance.tasks.context import Context
from appliance.tasks.decide import Decider
from appliance.tasks.events import (
    Answer,
    AskRun,
    CancelAsked,
    CancelRun,
    Dispatch,
    EndRun,
    Event,
    HoldRun,
    Instruction,
    MakePlan,
    Measured,
    MoveReady,
    MoveRun,
    Notify,
    OperatorAsked,
    PlanMade,
    Replan,
    Replanned,
    ResumeRun,
    RunChecked,
    RunHeld,
    RunReported,
    StopPlanning,
    Wake,
)
from appliance.tasks.machine import TransitionKind
from appliance.tasks.orders import LEAVE_S
from appliance.tasks.placement import tell
from appliance.tasks.record_writer import Draft, RecordWriter, SupersededError
from appliance.tasks.records import Unknown, clean

log = structlog.get_logger(__name__)

ANSWER_S = 0.25
"""How long the end of a run waits for the answer to its order, which says how its container was chosen. It is on its
way: a run that takes no time can be heard of before it."""
OWN_ANSWER_S = 60.0
"""How long this gateway itself may take to accept a run: its answer is not lost on the way, so it is waited for."""
ASK_S = 2.0
"""How long a gateway may take to answer a question about a run."""
HOLD_S = 20.0
"""How long a run may take to come to a point where it can be left: the end of a robot command, a checkpoint."""
END_TRIES = 5
"""How often a run that is left is asked to end, `tasks.check_s` apart; then its attempt number alone fences it off."""
LOOK_AHEAD_S = 5.0
"""How often what comes is worked out again while no subtask changes."""
MAX_INBOX = 1000
"""Events that may wait for a coordinator; beyond it progress is dropped, beyond twice that what checks find out."""
_LEAST = (RunEventKind.PROGRESS, RunEventKind.PARTIAL, RunEventKind.CHECKPOINT)
_NEVER_DROPPED = (CancelAsked, PlanMade, Replanned, OperatorAsked, RunHeld, RunChecked)
"""Events that are few and that no check would find out."""


class Coordinator:
    """Drives one task. `run` ends when the task has ended or another gateway has taken over.

    Args:
        context: the parts of this gateway.
        record: the task.
        version: of its record.
        on_change: gets each record that is written.
        give_up: why the task is to be ended instead of driven: earlier coordinators of it broke.
        elapsed_s: since the task was accepted, as far as it is known here.
        unknown: fields of the record that this version of the appliance does not know.
    """

    def __init__(
        self,
        context: Context,
        record: TaskRecord,
        version: VersionVector,
        *,
        on_change: Callable[[TaskRecord], None],
        give_up: Failure | None = None,
        elapsed_s: float = 0.0,
        unknown: Unknown | None = None,
    ) -> None:
        self.ended = False
        """Whether the task has ended and its last record is written; one that is final only here has not."""
        self.ending = asyncio.Event()
        """The task ends or has ended by its written record, or this coordinator has done with it."""
        self._context = context
        self._plane = context.plane
        self._give_up = give_up
        self._inbox: asyncio.Queue[Event] = asyncio.Queue()
        self._draft = Draft(record, context.plane.gateway, elapsed_s)
        self._writer = RecordWriter(
            context.plane,
            self._draft,
            version,
            unknown=unknown,
            on_written=self._carry_out,
            on_published=context.on_transition,
            on_change=on_change,
        )
        self._decider = Decider(context, self._draft, time.monotonic())
        self._instructions: list[Instruction] = []
        """What follows when the record is written."""
        self._tasks = Background()
        self._planning = Background()
        self._sending: dict[tuple[str, int], asyncio.Task[None]] = {}
        """Subtask and attempt -> their order on its way."""
        self._hinted_states: tuple[SubtaskState, ...] = ()
        self._hint_at = 0.0

    @property
    def record(self) -> TaskRecord:
        """The task as it stands here."""
        return self._draft.record

    @property
    def written(self) -> TaskRecord:
        """The task as it was written last."""
        return self._writer.written

    @property
    def overtaken(self) -> bool:
        """Whether the record has moved on under this coordinator: it stops, and its copy is no answer to anybody."""
        return self._writer.overtaken

    def copy_changed(self, version: VersionVector) -> bool:
        """Note that this gateway's copy of the record has changed; returns whether that was somebody else's doing.

        While a write of its own is under way it is not known: the coordinator looks when that returns.
        """
        return self._writer.copy_changed(version)

    @property
    def elapsed_s(self) -> float:
        """Seconds since the task was accepted."""
        return self._draft.elapsed_s

    @property
    def settled(self) -> bool:
        """Whether all that is known is written, and nothing is awaited of this gateway's own runs."""
        return self._draft.settled

    @property
    def waits(self) -> bool:
        """Whether a subtask waits for a robot or a gateway."""
        return self._decider.waiting

    def put(self, event: Event) -> None:
        """Hand in an event; never blocks. What is of no use, or too much, is dropped: checks make up for it."""
        if isinstance(event, RunReported) and not self._decider.seen(event.event, time.monotonic()):
            return
        least = isinstance(event, Wake) or (isinstance(event, RunReported) and event.event.kind in _LEAST)
        if self._inbox.qsize() >= (MAX_INBOX if least else 2 * MAX_INBOX) and not isinstance(event, _NEVER_DROPPED):
            return
        self._inbox.put_nowait(event)

    async def run(self) -> None:
        """Drive to the end."""
        try:
            await self._resume()
            while not self.record.state.final:
                self._instructions += self._decider.advance(time.monotonic())
                await self._flush()
                if self.record.state.final:
                    break
                await self._handle(await self._next())
                while not self._inbox.empty():
                    await self._handle(self._inbox.get_nowait())
            await self._flush()
            self.ended = True
            for target in self.record.subtasks:
                if target.checkpoint_ns:
                    await remove_checkpoint(self._plane.dht, self.record.id, target.subtask.id)
            await asyncio.sleep(0)  # the last instructions are on their way
        except SupersededError as error:
            log.info("task is coordinated elsewhere", task=self.record.id, reason=error.message)
        finally:
            self.ending.set()
            self._close()

    def _close(self) -> None:
        """Answer those who wait, and give up what is on its way."""
        late: list[OperatorAsked | MoveReady] = [*self._decider.late()]
        late += [each.to for each in self._instructions if isinstance(each, Answer)]
        while not self._inbox.empty():
            event = self._inbox.get_nowait()
            if isinstance(event, OperatorAsked | MoveReady):
                late.append(event)
        gone = UnreachableError("the task's coordination here has ended before it was written", remedy="ask again")
        for event in late:
            if not event.outcome.done():
                event.outcome.set_exception(gone)
        self._tasks.cancel()
        self._planning.cancel()

    async def _resume(self) -> None:
        """Take the task over if another gateway coordinated it, and settle what a partition left."""
        draft, healing = self._draft, heal(self.record)
        if self.record.sequence > 1 or self.record.coordinator != self._plane.gateway:
            before, began = self.record.coordinator, time.monotonic()
            draft.apply(TransitionKind.ADOPTED)
            await self._writer.flush()
            wrote_ms = round((time.monotonic() - began) * 1e3, 1)
            log.info("task adopted", task=self.record.id, before=before, wrote_ms=wrote_ms)
        if healing is not None:
            await healing.settle(self._plane, self._writer)
        superseded = healing.superseded if healing is not None else ()
        self._instructions += self._decider.resume(
            give_up=self._give_up, superseded=superseded, now=time.monotonic()
        )  # fmt: skip

    async def _next(self) -> Event:
        now = time.monotonic()
        try:
            async with asyncio.timeout(self._decider.next_at(now) - now):
                return await self._inbox.get()
        except TimeoutError:
            return Wake()

    async def _handle(self, event: Event) -> None:
        if isinstance(event, RunReported) and event.event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            # A moment for the answer to the order, which says how the container was chosen.
            sending = self._sending.pop((event.event.subtask, event.event.attempt), None)
            if sending is not None and not sending.done():
                await asyncio.wait({sending}, timeout=ANSWER_S)
        self._instructions += self._decider.handle(event, time.monotonic())

    async def _flush(self) -> None:
        """Write what was decided, and carry out what follows."""
        await self._writer.flush()
        self._carry_out()
        self._look_ahead(time.monotonic())
        if self.written.state is TaskState.CANCELLING or self.written.state.final:
            self.ending.set()

    # --- instructions -----------------------------------------------------------------------------------------------

    def _carry_out(self) -> None:
        """The record is written: do what was decided with it."""
        instructions, self._instructions = self._instructions, []
        now = time.monotonic()
        for instruction in instructions:
            match instruction:
                case Dispatch(gateway=gateway, request=request, case=case):
                    tell(self._plane, case)
                    self._order(request, self._send(gateway, request), at=now)
                case MoveRun(gateway=gateway, request=request, left=left):
                    self._order(request, self._move(gateway, request, left), at=now + LEAVE_S)
                case CancelRun(run):
                    self._start(self._cancel(run))
                case EndRun(run):
                    self._start(self._end(run))
                case AskRun(run):
                    self._start(self._check(run))
                case HoldRun(run=run, why=why):
                    self._start(self._hold(run, why))
                case ResumeRun(run):
                    self._start(self._resume_run(run))
                case MakePlan():
                    self._planning.start(self._plan(), f"plan {self.record.id}")
                case Replan(subtask=subtask, why=why):
                    self._planning.start(self._replan(subtask, why), f"plan {self.record.id}")
                case StopPlanning():
                    self._planning.cancel()
                case Answer(to=event, error=error):
                    self._answer(event, error)
                case Notify(what=what, subtask=target, why=why):
                    self._context.notify(what, self.record, target, why)
                case Measured(skill=skill, duration_ms=duration_ms):
                    self._context.measured(skill, duration_ms)

    def _answer(self, event: OperatorAsked | MoveReady, error: SwiftbotError | None) -> None:
        if event.outcome.done():
            return
        if error is not None:
            event.outcome.set_exception(error)
        elif isinstance(event, OperatorAsked):
            event.outcome.set_result(self.record)
        else:
            event.outcome.set_result(event.next_attempt)

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        self._tasks.start(work, f"task {self.record.id}")

    def _order(self, request: RunRequest, work: Coroutine[Any, Any, None], *, at: float) -> None:
        self._decider.sent(request.subtask, at)
        self._sending[request.subtask, request.attempt] = self._tasks.start(work, f"order {request.run_id}")

    async def _send(self, gateway: str, request: RunRequest) -> None:
        """Order a run, with its last checkpoint; what comes of it is an event."""
        kind, failure = RunEventKind.FAILED, None
        try:
            if request.attempt > 1:
                saved = await read_checkpoint(self._plane.dht, request.task, request.subtask)
                if saved is not None:
                    request = replace(request, resume=saved.data, calls=saved.calls)
            here = gateway == self._plane.gateway
            timeout_s = OWN_ANSWER_S if here else self._context.config.run_timeout_s
            accepted = await self._plane.rpc.call(gateway, keyspace.RUN, request, timeout_s=timeout_s)
            self._decider.answered(request, accepted)
            if accepted.gateway == gateway:
                return
            # Passed on to a warm container: from now on that gateway answers for the run.
            gateway, kind = accepted.gateway, RunEventKind.PROGRESS
        except SwiftbotError as error:
            failure = Failure(
                code=error.code if error.code in ("refused", "pool") else "unreachable",
                message=f"{gateway}: {error.message}",
                remedy=error.remedy,
                retryable=True,
            )
        except Exception as error:  # the boundary to the executor here: the attempt fails, the task goes on
            log.exception("run order broke", run=request.run_id, gateway=gateway)
            failure = Failure(code="internal", message=f"{type(error).__name__}: {error}", retryable=True)
        event = RunEvent(
            task=request.task,
            subtask=request.subtask,
            attempt=request.attempt,
            kind=kind,
            gateway=gateway,
            failure=failure,
        )
        self.put(RunReported(event))

    async def _move(self, gateway: str, request: RunRequest, left: SubtaskRecord) -> None:
        """End the run that is left, so that what it changed is there for the next, then order that."""
        ask = self._ask_of(left)
        try:
            await self._plane.rpc.call(left.gateway, keyspace.RUN_LEAVE, ask, timeout_s=LEAVE_S)
        except SwiftbotError as error:
            # It hears of the record, or is cut off: robots and coordinators refuse its attempt in any case.
            log.warning("a run that was moved is not known to have ended", run=ask.run_id, reason=str(error))
        self._decider.sent(request.subtask, time.monotonic())
        await self._send(gateway, request)

    def _ask_of(self, target: SubtaskRecord) -> RunAsk:
        return RunAsk(task=self.record.id, subtask=target.subtask.id, attempt=target.attempt)

    async def _ask(self, target: SubtaskRecord, verb: Verb[RunAsk, RunStatus]) -> RunStatus | None:
        """Ask a run's gateway about it; None when it does not answer."""
        ask = self._ask_of(target)
        try:
            return await self._plane.rpc.call(target.gateway, verb, ask, timeout_s=ASK_S)
        except SwiftbotError as error:
            log.info("no answer about a run", run=ask.run_id, gateway=target.gateway, reason=str(error))
            return None

    async def _cancel(self, run: SubtaskRecord) -> None:
        await self._ask(run, keyspace.RUN_CANCEL)

    async def _resume_run(self, run: SubtaskRecord) -> None:
        await self._ask(run, keyspace.RUN_RESUME)

    async def _end(self, run: SubtaskRecord) -> None:
        for _ in range(END_TRIES):
            status = await self._ask(run, keyspace.RUN_CANCEL)
            if status is not None and not status.running:
                return
            await asyncio.sleep(self._context.config.check_s)

    async def _check(self, run: SubtaskRecord) -> None:
        status = await self._ask(run, keyspace.RUN_STATUS)
        self.put(RunChecked(subtask=run.subtask.id, attempt=run.attempt, gateway=run.gateway, status=status))

    async def _hold(self, run: SubtaskRecord, why: str) -> None:
        ask = HoldAsk(task=self.record.id, subtask=run.subtask.id, attempt=run.attempt)
        try:
            held = await self._plane.rpc.call(run.gateway, keyspace.RUN_HOLD, ask, timeout_s=HOLD_S)
        except SwiftbotError as error:
            log.info("a run is not held", task=ask.task, subtask=ask.subtask, reason=str(error))
            return
        if held.saved or not held.began:
            self.put(RunHeld(subtask=ask.subtask, attempt=ask.attempt, note=why))

    async def _plan(self) -> None:
        """Have the task planned; what comes of it is an event."""
        plan, failure = None, None
        try:
            plan = await self._context.plans.plan(self.record)
        except SwiftbotError as error:
            problems = error.problems if isinstance(error, PlanError) else ()
            message = error.message if not problems else f"{error.message}: {'; '.join(problems[:5])}"
            failure = Failure(code=error.code, message=message, remedy=error.remedy)
        except Exception as error:  # the boundary to the planner: whatever breaks in it, the submitter gets the reason
            log.exception("planning broke", task=self.record.id)
            message = clean(f"planning broke: {type(error).__name__}: {error}", 500)
            failure = Failure(code="internal", message=message)
        self.put(PlanMade(plan=plan, failure=failure))

    async def _replan(self, subtask: str, note: str) -> None:
        """Have the rest planned again; what comes of it is an event."""
        plan, limit_s = None, self._context.config.replan.ask_s
        try:
            async with asyncio.timeout(limit_s):
                plan = await self._context.plans.replan(self.record)
            why = note
        except PlanError as error:
            said = f": {'; '.join(error.problems[:3])}" if error.problems else ""
            why = f"{note}; the decomposer: {error.message}{said}"
        except SwiftbotError as error:
            why = f"{note}; the decomposer: {error}"
        except TimeoutError:
            why = f"{note}; the decomposer took over {limit_s:g} s"
        except Exception as error:  # the boundary to the planner: whatever breaks in it, the task ends with a reason
            log.exception("replanning broke", task=self.record.id)
            why = f"{note}; replanning broke: {type(error).__name__}: {error}"
        self.put(Replanned(subtask=subtask, plan=plan, why=why))

    def _look_ahead(self, now: float) -> None:
        """Announce to pools what comes, when subtasks have moved, and now and then since times pass."""
        states = tuple(target.state for target in self.record.subtasks)
        waited = SubtaskState.WAITING in self._hinted_states
        if not (waited or SubtaskState.WAITING in states) or (states == self._hinted_states and now < self._hint_at):
            return
        self._hinted_states, self._hint_at = states, now + LOOK_AHEAD_S
        running_s = {
            target.subtask.id: now - self._decider.silent_since(target.subtask.id, now)
            for target in machine.active(self.record)
        }
        self._context.ahead.plan_moved(self.record, running_s)
