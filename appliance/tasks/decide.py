"""What the coordinator of a task decides: events in, instructions out, without I/O.

`Decider` holds the draft of the record and what a coordinator knows beside it. Each event becomes transitions of the
draft, and `advance` does what follows from the record and the clock; both return instructions (`events`), which the
shell (`coordinator`) carries out when the record is written. Facts come from the `Context`; times are seconds of this
machine's monotonic clock and passed in.

- **Planning**: the first plan, unless a cancel or the deadline comes first. Operators' orders that come meanwhile are
  looked at afterwards.
- **Dispatching**: ready subtasks go to gateways, or wait with a reason in the record. On the way to the task's end its
  runs are cancelled; one that does not confirm is given up after the grace.
- **Run events** become transitions; what does not fit the record is dropped. Of partial results the record gets the
  last of each subtask, cut to size, at most one a second: each is an event for those who listen, while the record is
  for those who come later and must stay small.
- **Replanning**: when a subtask is given up, as `replan.decide` says. What the decomposer proposes is in the record
  before it takes effect, so that a coordinator that takes over does not ask again; runs that the new plan leaves out
  are ended first, while what finishes meanwhile is finished.
- **Watchdog**: the judgement is that of `durations`. A **stuck** run is ended and its attempt has failed, so that the
  next is made elsewhere. A **straggler** is left for a new attempt on another gateway, with its last checkpoint, where
  its manifest allows it (`speculate`: it commands no robot and writes no volume). MapReduce lets both copies run and
  takes the first; here one attempt at a subtask is current, that is what keeps effects from doubling, and two that are
  current would not be. So speculation is moving on, once for a subtask, and only to a gateway that can have it.
- **Checks**: gateways are asked after silent runs, in case an event was lost or a gateway is deaf.
- **Operators' orders** (`steering` has the rules), soft stops and leases of robots.
"""

import time
from typing import Any

import msgspec
import structlog
from msgspec.structs import replace

from appliance.errors import (
    NotFoundError,
    PlanError,
    RefusedError,
    SwiftbotError,
    TakenError,
    UnapprovedError,
)
from appliance.model import (
    Choice,
    Decision,
    Failure,
    Pause,
    Plan,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.model.task_api import ApproveAsk, FirstAsk, PauseAsk, RejectAsk, ResumeAsk, RetryAsk, RunStatus
from appliance.tasks import machine
from appliance.tasks.conflicts import OVERTAKEN, foreign
from appliance.tasks.context import Context
from appliance.tasks.durations import Condition, Finding, Known, asked_s, judge
from appliance.tasks.events import (
    Answer,
    AskRun,
    CancelAsked,
    CancelRun,
    Dispatch,
    EndRun,
    Event,
    GatewayLost,
    GatewayRelinked,
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
from appliance.tasks.machine import TransitionKind, plan_hash
from appliance.tasks.orders import LEAVE_S, deadline_s, request_for
from appliance.tasks.record_writer import Draft
from appliance.tasks.records import MAX_NOTE, MAX_RUN_S, clean, result_problem, tidy
from appliance.tasks.replan import (
    AskDecomposer,
    GiveUp,
    Rebinding,
    Substitution,
    allowed_robot,
    confirmed,
    decide,
    problems,
    robot_of,
    splice,
    worth_replanning,
)
from appliance.tasks.steering import may_move, may_pause, may_resume, may_retry, needed_robots, proposal_for, word_of
from appliance.tasks.timing import Backoff, left_s, passed
from appliance.tasks.turns import moved_before
from appliance.tasks.views import WAITS

log = structlog.get_logger(__name__)

PARTIAL_EVERY_S = 1.0
MAX_PARTIAL_BYTES = 8 * 1024
"""Of one subtask, as JSON; 64 of them are half a megabyte of a record."""
TAKEN_PAUSE_S = 2.0
"""Before the next attempt with a robot that was taken over at the vehicle."""
_LEFT = "straggling"
"""How the reason of an attempt that was left for speculation begins."""
_TIMED = (TaskState.RUNNING, TaskState.PROPOSED)
"""States in which a deadline or an operator cancels a task; while it is planned, planning is ended."""
_ENDS = (RunEventKind.SUCCEEDED, RunEventKind.FAILED)


class PartialResults:
    """The partial results of one task that are not in its record yet."""

    def __init__(self) -> None:
        self._waiting: dict[str, RunEvent] = {}
        self._not_before: dict[str, float] = {}

    def add(self, event: RunEvent) -> None:
        """Note a partial result; it replaces the one before."""
        self._waiting[event.subtask] = event

    def drop(self, subtask: str) -> None:
        """Forget a subtask whose attempt has ended."""
        self._waiting.pop(subtask, None)
        self._not_before.pop(subtask, None)

    def due(self, now: float) -> list[RunEvent]:
        """Return those that may go into the record now."""
        found = [event for subtask, event in self._waiting.items() if self._not_before.get(subtask, 0.0) <= now]
        for event in found:
            del self._waiting[event.subtask]
            self._not_before[event.subtask] = now + PARTIAL_EVERY_S
        return found

    def next_at(self) -> float | None:
        """When the next one may go into the record; None when there is none."""
        return min((self._not_before.get(subtask, 0.0) for subtask in self._waiting), default=None)


def shown(result: dict[str, Any] | None) -> dict[str, Any]:
    """Return a partial result as the record keeps it: itself, or why it is not there."""
    problem = result_problem(result, max_bytes=MAX_PARTIAL_BYTES)
    return {"left_out": problem.message} if problem is not None else dict(result or {})


class Decider:
    """Decides for one task.

    Args:
        context: the parts of this gateway.
        draft: the task's record.
        now: the time.
    """

    def __init__(self, context: Context, draft: Draft, now: float) -> None:
        self._context = context
        self._draft = draft
        self._out: list[Instruction] = []
        self._backoff = Backoff()
        self._partials = PartialResults()
        self._planning = False
        self._deferred: list[OperatorAsked] = []
        """Operators' orders that came while the task was planned."""
        self._sent_at: dict[str, float] = {}
        """Subtask -> when its last order went out."""
        self._accepted: dict[tuple[str, int], RunAccepted] = {}
        """Subtask and attempt -> the answer to its order."""
        self._asking: set[tuple[str, int]] = set()
        """Runs whose gateways have not answered `AskRun` yet."""
        self._check_at = now + context.config.check_s
        self._began: dict[tuple[str, int], float] = {}
        self._alive: dict[tuple[str, int], float] = {}
        """Subtask and attempt -> the last sign of life."""
        self._cancelled_at: float | None = None
        self._cancel_at: dict[str, float] = {}
        self._replanning = False
        self._leaving: set[str] = set()
        """Subtasks whose runs are being ended because a new plan leaves them out."""
        self._ending_since: float | None = None
        self._end_at: dict[str, float] = {}

    @property
    def record(self) -> TaskRecord:
        """The task as it stands here."""
        return self._draft.record

    @property
    def waiting(self) -> bool:
        """Whether a subtask waits for a robot or a gateway."""
        return self._backoff.waiting

    # --- events in, instructions out ----------------------------------------------------------------------------

    def resume(self, *, give_up: Failure | None, superseded: tuple[str, ...], now: float) -> list[Instruction]:
        """Begin with a record that may have been coordinated elsewhere: its runs are asked after.

        Args:
            give_up: why the task is to be ended instead of driven.
            superseded: subtasks of which the other side of a partition has made a later attempt.
            now: the time.
        """
        for name in superseded:
            self._attempt_failed(self.record.of(name), OVERTAKEN, now)
        if give_up is not None and self.record.state in (TaskState.ACCEPTED, *_TIMED):
            kind = TransitionKind.CANCEL if self.record.subtasks else TransitionKind.PLAN_FAILED
            self._draft.apply(kind, failure=give_up)
        for target in machine.active(self.record):
            self._ask(target)
        return self._drained()

    def handle(self, event: Event, now: float) -> list[Instruction]:
        """Take in an event."""
        match event:
            case RunReported():
                self._run_event(event.event, now)
            case RunChecked():
                self._run_checked(event, now)
            case RunHeld():
                self._run_held(event)
            case GatewayLost():
                self._gateway_lost(event.gateway, now)
            case GatewayRelinked():
                for target in machine.active(self.record):
                    if target.gateway == event.gateway:
                        self._ask(target)
            case PlanMade():
                self._plan_made(event)
            case Replanned():
                self._replanned(event)
            case CancelAsked():
                if self.record.state in (TaskState.ACCEPTED, *_TIMED):
                    self._draft.apply(TransitionKind.CANCEL, word=event.word)
                    self._stop_planning()
            case OperatorAsked():
                self._operator_asked(event)
            case MoveReady():
                self._move_ready(event, now)
            case Wake():
                self._backoff.look_again()
        return self._drained()

    def advance(self, now: float) -> list[Instruction]:
        """Do what follows from the record and the time."""
        if now >= self._check_at:
            self._check(now)
        if self.record.state is TaskState.ACCEPTED:
            self._plan()
        else:
            deferred, self._deferred = self._deferred, []
            for event in deferred:
                self._operator_asked(event)
            if self.record.state in _TIMED and self._left_s() <= 0:
                self._draft.apply(TransitionKind.CANCEL, failure=passed(self.record))
            self._follow_robots()
            self._expire()
            if self.record.state is not TaskState.CANCELLING:
                self._record_partials(now)
            self._replan(now)
            if self.record.state is TaskState.CANCELLING:
                self._cancel_runs(now)
            else:
                self._dispatch_ready(now)
        return self._drained()

    def next_at(self, now: float) -> float:
        """When to look again if nothing happens."""
        partial_at = self._partials.next_at()
        wake_at = [*self._backoff.not_before.values(), self._check_at, *(() if partial_at is None else (partial_at,))]
        due = [at for at in wake_at if at > now]
        if self.record.state in (TaskState.ACCEPTED, *_TIMED):
            due.append(now + self._left_s())
        return max(now + 0.01, min([now + self._context.config.check_s, *due]))

    def late(self) -> list[OperatorAsked]:
        """Operators' orders that were not looked at."""
        return self._deferred

    # --- notes of the shell ---------------------------------------------------------------------------------------

    def seen(self, event: RunEvent, now: float) -> bool:
        """Note a sign of life of a run; returns whether its event tells something that the record keeps.

        Of attempts that nobody ordered nothing is kept.
        """
        target = self._find(event.subtask)
        if target is None or target.attempt != event.attempt:
            return False
        run = (event.subtask, event.attempt)
        if event.kind is RunEventKind.STARTED:
            self._began.setdefault(run, now)
        self._alive[run] = now
        return (
            event.kind not in (RunEventKind.LOG, RunEventKind.ALIVE)
            and not target.state.final
            and not foreign(self.record, event)
        )

    def sent(self, subtask: str, at: float) -> None:
        """Note when an order of a subtask goes out."""
        self._sent_at[subtask] = at

    def answered(self, request: RunRequest, accepted: RunAccepted) -> None:
        """Note the answer to an order: how the container was chosen."""
        self._accepted[request.subtask, request.attempt] = accepted

    def silent_since(self, subtask: str, now: float) -> float:
        """Since when a run is waited for: its order, or the first look at one that another coordinator sent."""
        return self._sent_at.setdefault(subtask, now)

    # --- helpers --------------------------------------------------------------------------------------------------

    def _drained(self) -> list[Instruction]:
        out, self._out = self._out, []
        return out

    def _find(self, subtask: str) -> SubtaskRecord | None:
        return next((target for target in self.record.subtasks if target.subtask.id == subtask), None)

    def _current(self, subtask: str, attempt: int) -> SubtaskRecord | None:
        """The subtask whose run that attempt is, if it is under way."""
        target = self._find(subtask)
        return target if target in machine.active(self.record) and target.attempt == attempt else None

    def _left_s(self) -> float:
        return left_s(self.record, self._draft.elapsed_s)

    def _choice(self, subtask: str, attempt: int) -> Choice | None:
        """How the container of an attempt was chosen, as far as it is known by now."""
        accepted = self._accepted.get((subtask, attempt))
        return accepted.choice if accepted is not None else None

    def _notify(self, what: str, target: SubtaskRecord, why: str) -> None:
        self._out.append(Notify(what=what, subtask=target, why=why))

    def _figures(self, gateway: str) -> dict[str, Any]:
        """What is known of a gateway that is chosen, for the attempt's record: its load and its ready containers."""
        status = self._context.plane.registry.gateways.get(gateway)
        return {"load": round(status.load, 3), "free": status.ready} if status is not None else {}

    # --- planning -------------------------------------------------------------------------------------------------

    def _plan(self) -> None:
        if self._left_s() <= 0:
            self._draft.apply(TransitionKind.PLAN_FAILED, failure=passed(self.record))
            self._stop_planning()
        elif not self._planning:
            self._planning = True
            self._out.append(MakePlan())

    def _stop_planning(self) -> None:
        if self._planning or self._replanning:
            self._planning = self._replanning = False
            self._out.append(StopPlanning())

    def _plan_made(self, event: PlanMade) -> None:
        self._planning = False
        record, context, plan = self.record, self._context, event.plan
        if record.state is not TaskState.ACCEPTED:
            return
        if plan is None:
            self._draft.apply(TransitionKind.PLAN_FAILED, failure=event.failure)
        elif why := context.plans.approval(record, plan):
            expires_s = context.config.approval_s
            self._draft.apply(
                TransitionKind.PROPOSED, plan=plan, note=clean(why, 500), waits=True, expires_s=expires_s
            )  # fmt: skip
        else:
            note = context.expect(plan, deadline_s=record.deadline_s, elapsed_s=self._draft.elapsed_s)
            self._draft.apply(TransitionKind.PLANNED, plan=plan, note=note)

    # --- dispatching ----------------------------------------------------------------------------------------------

    def _dispatch_ready(self, now: float) -> None:
        draft, backoff = self._draft, self._backoff
        if any(backoff.not_before.get(target.subtask.id, 0.0) <= now for target in machine.ready(self.record)):
            group = self._context.scheduler.regroup(self.record)
            if group is not None:
                draft.apply(TransitionKind.GROUPED, group=group)
        for target in machine.ready(self.record):
            draft.ready_ns.setdefault(target.subtask.id, time.monotonic_ns())
            if self.record.paused:
                self._startup_begins(target)
            if self.record.state is TaskState.RUNNING and backoff.may_go(target.subtask.id, now):
                self._dispatch(target, now)

    def _startup_begins(self, target: SubtaskRecord) -> None:
        """Count its startup time from here on: a wait for a robot or a person is no start of a container."""
        self._draft.ready_ns[target.subtask.id] = time.monotonic_ns()

    def _dispatch(self, target: SubtaskRecord, now: float) -> None:
        context, subtask = self._context, target.subtask
        try:
            request = self._request(target, ())
        except NotFoundError as error:
            # Planned on a gateway that knows more skills than this one, or before this one forgot it.
            failure = Failure(code=error.code, message=error.message, remedy=error.remedy)
            self._draft.apply(
                TransitionKind.ATTEMPT_FAILED,
                subtask=subtask.id,
                attempt=target.next_attempt,
                failure=failure,
                give_up=True,
                replan=True,
            )
            return
        robots: tuple[str, ...] = ()
        reason = ""
        if subtask.robot is not None:
            robots, reason = context.scheduler.bind(self.record, target)
            if not robots:
                self._startup_begins(target)
                reason = self._robot_missing(target, reason, now)
                if reason:
                    self._wait(target, reason, now)
                return
            if first := context.scheduler.goes_first(self.record, target, robots):
                self._startup_begins(target)
                self._wait(target, first, now)
                return
        robot, others = next(iter(robots), None), robots[1:]
        placement = context.scheduler.place(self.record, target, robot)
        if not placement.order:
            self._wait(target, f"waits for a gateway: {placement.why}", now)
            return
        turn = context.scheduler.turn(self.record, target, placement, self._left_s())
        if not turn.gateway:
            self._wait(target, f"waits for room: {', '.join(placement.order)} have enough to do", now)
            return
        self._backoff.goes(subtask.id)
        self._draft.apply(
            TransitionKind.DISPATCHED,
            subtask=subtask.id,
            attempt=request.attempt,
            gateway=turn.gateway,
            robot=robot,
            others=others,
            placed=clean(f"{placement.why}; robot: {reason}" if reason else placement.why, MAX_NOTE),
            **self._figures(turn.gateway),
        )
        self._sent_at[subtask.id] = now
        self._out.append(
            Dispatch(
                gateway=turn.gateway,
                request=replace(request, robot=robot, others=others),
                case=context.scheduler.case(self.record, target, placement),
            )
        )

    def _request(self, target: SubtaskRecord, robots: tuple[str, ...]) -> RunRequest:
        """The order for a subtask's next attempt; NotFoundError when its skill is not known here."""
        request = request_for(
            self.record,
            target,
            self._context.manifest(target.subtask.skill),
            robots=robots,
            coordinator=self._context.plane.gateway,
            elapsed_s=self._draft.elapsed_s,
        )
        return replace(request, expected_s=self._context.expected_s(request.skill, request.params))

    def _wait(self, target: SubtaskRecord, reason: str, now: float) -> None:
        """Record why a subtask waits, once per reason, since every gateway must be able to say it; look again soon."""
        if self._backoff.waits(target.subtask.id, reason, now):
            note = clean(reason, 500)
            self._draft.apply(
                TransitionKind.PROGRESS, subtask=target.subtask.id, attempt=target.attempt, note=note
            )  # fmt: skip

    def _cancel_runs(self, now: float) -> None:
        if self._cancelled_at is None:
            self._cancelled_at = now
        config = self._context.config
        for target in machine.active(self.record):
            if now - self._cancelled_at > config.grace_s:
                failure = Failure(code="cancelled", message=f"{target.gateway} did not confirm the cancel in time")
                self._attempt_failed(target, failure, now)
            elif self._cancel_at.get(target.subtask.id, 0.0) <= now:
                # Again and again: the first may overtake the order to run, or be lost.
                self._cancel_at[target.subtask.id] = now + config.check_s
                self._out.append(CancelRun(target))

    def _move_ready(self, event: MoveReady, now: float) -> None:
        """Leave a run for a new attempt on the gateway that was made ready for it, unless it has ended meanwhile."""
        if event.outcome.done():
            return  # the caller has given up
        why = f"attempt {event.attempt} has ended meanwhile"
        target = self._find(event.subtask)
        if target is None or target.subtask.skill not in self._context.catalogue.skills:
            why = "the task has no such subtask, or its coordinator no such skill"
        elif target.next_attempt == event.next_attempt and self._move(
            target, event.attempt, event.gateway, why=event.why, placed=event.placed, now=now, answer=event
        ):
            return
        self._out.append(Answer(to=event, error=RefusedError(why)))

    def _move(
        self,
        target: SubtaskRecord,
        attempt: int,
        gateway: str,
        *,
        why: str,
        placed: str,
        now: float,
        answer: MoveReady | None = None,
    ) -> bool:
        """Leave a run for its next attempt on another gateway; False when it is not under way any more."""
        name = target.subtask.id
        request = self._request(target, target.robots)
        if not self._draft.offer(
            TransitionKind.MOVED,
            subtask=name,
            attempt=attempt,
            gateway=gateway,
            note=clean(why, MAX_NOTE),
            placed=clean(placed, MAX_NOTE),
            choice=self._choice(name, attempt),
            **self._figures(gateway),
        ):
            return False
        self._draft.ready_ns[name] = time.monotonic_ns()
        # Nobody is asked after the new attempt before it was ordered.
        self._sent_at[name] = now + LEAVE_S
        if answer is not None:
            self._out.append(Answer(to=answer))
        self._out.append(MoveRun(gateway=gateway, request=replace(request, moves=request.moves + 1), left=target))
        return True

    # --- run events -----------------------------------------------------------------------------------------------

    def _run_event(self, event: RunEvent, now: float) -> None:
        draft = self._draft
        target = self._find(event.subtask)
        if target is None or event.attempt != target.attempt or target.state.final or foreign(self.record, event):
            return
        event = tidy(event, max_result_bytes=self._context.config.max_result_bytes)
        common: dict[str, Any] = {
            "subtask": event.subtask,
            "attempt": event.attempt,
            "gateway": event.gateway,
            "container": event.container,
            "phase": event.phase,
        }
        choice = self._choice(event.subtask, event.attempt)
        match event.kind:
            case RunEventKind.STARTED:
                ready_ns = draft.ready_ns.get(event.subtask)
                startup_ms = (time.monotonic_ns() - ready_ns) / 1e6 if ready_ns else event.startup_ms
                draft.offer(TransitionKind.STARTED, startup_ms=startup_ms, choice=choice, **common)
            case RunEventKind.PROGRESS:
                if event.choice is not None:
                    self._passed_on(event, event.choice)
                # What it waits for, and that it waits no longer, is for everybody to see at once.
                waits = WAITS in (event.note[: len(WAITS)], target.note[: len(WAITS)]) and event.note != target.note
                draft.offer(
                    TransitionKind.PROGRESS, durable=waits, progress=event.progress, note=event.note, **common
                )  # fmt: skip
            case RunEventKind.SUCCEEDED:
                self._partials.drop(event.subtask)
                succeeded = draft.offer(
                    TransitionKind.SUCCEEDED,
                    result=event.result,
                    duration_ms=event.duration_ms,
                    cpu_ms=event.cpu_ms,
                    peak_mb=event.peak_mb,
                    choice=choice,
                    **common,
                )
                if succeeded and event.duration_ms is not None:
                    self._out.append(Measured(skill=target.subtask.skill, duration_ms=event.duration_ms))
            case RunEventKind.FAILED:
                self._run_failed(target, event, now)
            case RunEventKind.PARTIAL:
                self._partials.add(event)
            case RunEventKind.CHECKPOINT:
                # The first one is written at once: those who come later must know that there is something to remove.
                draft.offer(TransitionKind.CHECKPOINT, durable=not target.checkpoint_ns, **common)
            case RunEventKind.LOG | RunEventKind.ALIVE:
                pass

    def _passed_on(self, event: RunEvent, choice: Choice) -> None:
        """Note that a run was passed on while it waited, and why."""
        key = (event.subtask, event.attempt)
        if (accepted := self._accepted.get(key)) is not None:
            self._accepted[key] = replace(accepted, gateway=choice.gateway, choice=choice)

    def _run_failed(self, target: SubtaskRecord, event: RunEvent, now: float) -> None:
        failure = event.failure or Failure(code="internal", message="the run failed without a reason")
        if failure.code == "cancelled" and self.record.state is TaskState.RUNNING:
            # By its gateway, which drains or heard an outdated record: nothing is wrong with the subtask.
            message = f"ended there, though its task goes on: {failure.message}"
            failure = replace(failure, code="orphaned", message=message, retryable=True)
        if failure.code == TakenError.code:
            # A pilot or a failsafe has taken its robot: nothing is wrong with the subtask or its attempt. It goes on
            # with the next attempt when the robot is given back; until then nobody commands it.
            note = f"waits for {target.bound_robot or 'its robot'}: {failure.message}"
            if self._held(target, note):
                # The roster has it with the next heartbeat; a new attempt before that would meet the same refusal.
                self._backoff.repeats(target.subtask.id, now + TAKEN_PAUSE_S)
                return
        self._attempt_failed(target, failure, now, event=event)

    def _held(self, target: SubtaskRecord, note: str) -> bool:
        return self._draft.offer(
            TransitionKind.HELD, subtask=target.subtask.id, attempt=target.attempt, note=clean(note, MAX_NOTE)
        )

    def _record_partials(self, now: float) -> None:
        for event in self._partials.due(now):
            self._draft.offer(
                TransitionKind.PARTIAL,
                durable=False,
                subtask=event.subtask,
                attempt=event.attempt,
                result=shown(event.result),
            )

    def _gateway_lost(self, gateway: str, now: float) -> None:
        """End the attempts on a gateway that is gone."""
        for target in machine.active(self.record):
            if target.gateway == gateway:
                failure = Failure(code="unreachable", message=f"{gateway} was lost", retryable=True)
                self._attempt_failed(target, failure, now)

    def _attempt_failed(
        self, target: SubtaskRecord, failure: Failure, now: float, *, event: RunEvent | None = None
    ) -> None:
        """Note that an attempt has failed, and whether another will be made; `event`: what its gateway says of it."""
        name, attempt = target.subtask.id, target.attempt
        leaves = name in self._leaving
        manifest = self._context.catalogue.skills.get(target.subtask.skill)
        retries = manifest.retries if manifest is not None else 0
        give_up = leaves or machine.gives_up(_with_failure(target, failure), failure, retries=retries + 1)
        replan = leaves or worth_replanning(failure.code)
        fits = self._draft.offer(
            TransitionKind.ATTEMPT_FAILED,
            subtask=name,
            attempt=attempt,
            gateway=target.gateway,
            failure=failure,
            give_up=give_up,
            retries=None if leaves else retries,
            replan=give_up and replan and self.record.state is TaskState.RUNNING,
            duration_ms=event.duration_ms if event else None,
            cpu_ms=event.cpu_ms if event else None,
            peak_mb=event.peak_mb if event else None,
            choice=self._choice(name, attempt),
        )
        self._partials.drop(name)
        if fits and not give_up:
            self._draft.ready_ns[name] = time.monotonic_ns()
            self._backoff.repeats(name, now + machine.retry_delay_s(attempt))

    # --- checks and watchdog --------------------------------------------------------------------------------------

    def _check(self, now: float) -> None:
        """Ask after silent runs, in case an event was lost; give up those past their deadline."""
        config = self._context.config
        self._check_at = now + config.check_s
        members = self._context.plane.members()
        for target in machine.active(self.record):
            limit = self._limit_s(target)
            silent_s = now - self.silent_since(target.subtask.id, now)
            if target.gateway not in members:
                self._gateway_lost(target.gateway, now)
            elif silent_s > limit + config.grace_s:
                failure = Failure(code="deadline", message=f"nothing came of it within {limit:.0f} s")
                self._attempt_failed(target, failure, now)
            elif silent_s > config.check_s:
                self._ask(target)

    def _limit_s(self, target: SubtaskRecord) -> float:
        """How long a run may take; for a skill that only its gateway knows, as long as any."""
        manifest = self._context.catalogue.skills.get(target.subtask.skill)
        return deadline_s(manifest, target.subtask.params) if manifest is not None else MAX_RUN_S

    def _ask(self, target: SubtaskRecord) -> None:
        run = (target.subtask.id, target.attempt)
        if run not in self._asking:
            self._asking.add(run)
            self._out.append(AskRun(target))

    def _run_checked(self, event: RunChecked, now: float) -> None:
        """Learn from its gateway what became of a run."""
        self._asking.discard((event.subtask, event.attempt))
        target = self._current(event.subtask, event.attempt)
        if target is None or target.gateway != event.gateway:
            return
        status, lost = event.status, ""
        if status is None:
            if event.gateway not in self._context.plane.members():
                lost = f"{event.gateway} was lost"
        elif status.last is None:
            sent_at = self._sent_at.get(event.subtask, 0.0)
            if not status.running and now - sent_at > self._context.config.run_timeout_s:
                lost = f"{event.gateway} does not know the run"
        elif status.last.kind in _ENDS:
            self._run_event(status.last, now)
        elif not status.running:
            lost = f"{event.gateway} lost the run"
        elif status.last.kind is RunEventKind.STARTED:
            self._run_event(status.last, now)
        if lost:
            self._attempt_failed(target, Failure(code="unreachable", message=lost, retryable=True), now)
        if (target := self._current(event.subtask, event.attempt)) is not None:
            self._judge(target, status, now)

    def _judge(self, target: SubtaskRecord, status: RunStatus | None, now: float) -> None:
        """Judge a run that is under way, and do what follows."""
        if target.state is not SubtaskState.RUNNING:
            return
        run = (target.subtask.id, target.attempt)
        # Of a run that another coordinator heard begin nothing is known but that it runs now.
        began, alive = self._began.setdefault(run, now), self._alive.setdefault(run, now)
        manifest = self._context.catalogue.skills.get(target.subtask.skill)
        if manifest is None:
            return
        silent_s = now - alive
        if status is not None and status.running and status.silent_s is not None:
            silent_s = min(status.silent_s, silent_s)
        found = judge(
            manifest,
            running_s=now - began,
            silent_s=silent_s,
            known=Known(learned=self._context.durations(manifest.id), siblings=self._siblings(target)),
            asked_s=asked_s(target.subtask.params),
            config=self._context.config.detection,
        )
        if found is None or (found.condition is Condition.STRAGGLING and target.note.startswith(WAITS)):
            return
        if target.condition != found.condition and self._notice(target, found.note, condition=str(found.condition)):
            self._notify(str(found.condition), target, found.note)
        if found.condition is Condition.STUCK:
            self._out.append(CancelRun(target))
            failure = Failure(
                code=str(found.condition),
                message=f"{found.note} (on {target.gateway})",
                remedy="`swiftbot task watch` has its last lines; silent_s in its skill.toml bounds its silence",
                retryable=True,
            )
            self._attempt_failed(target, failure, now)
        elif manifest.speculate:
            self._speculate(target, found, now)

    def _siblings(self, target: SubtaskRecord) -> tuple[float, ...]:
        """How long other runs of the same skill took in this task, seconds."""
        return tuple(
            other.duration_ms / 1e3
            for other in self.record.subtasks
            if other.subtask.skill == target.subtask.skill
            and other.state is SubtaskState.SUCCEEDED
            and other.duration_ms is not None
        )

    def _notice(self, target: SubtaskRecord, note: str, **fields: Any) -> bool:
        return self._draft.offer(
            TransitionKind.NOTICED,
            subtask=target.subtask.id,
            attempt=target.attempt,
            note=clean(note, MAX_NOTE),
            **fields,
        )

    def _speculate(self, target: SubtaskRecord, found: Finding, now: float) -> None:
        """Leave a straggler for a new attempt, once, where there is a gateway for it."""
        if any(attempt.left.startswith(_LEFT) for attempt in target.attempts):
            return
        placement = self._context.scheduler.place(self.record, target, None)
        tried = {attempt.gateway for attempt in target.attempts}
        other = next((gateway for gateway in placement.order if gateway not in tried), None)
        if other is None:
            return
        why = f"{_LEFT} on {target.gateway}, goes on here: {found.note}"
        if self._move(target, target.attempt, other, why=why, placed=placement.why, now=now):
            self._notify("speculated", target, f"goes on on {other}")

    # --- replanning -----------------------------------------------------------------------------------------------

    def _replan(self, now: float) -> None:
        """Do what can be done now about subtasks that were given up."""
        if self.record.state is not TaskState.RUNNING:
            self._stop_planning()
            return
        if self.record.proposal is not None:
            self._pursue_proposal(now)
            return
        self._ending_since = None  # of the next proposal's runs nobody was asked to end yet
        self._end_at.clear()
        # Each decision changes the record; the bound of revisions is that of this loop.
        while not self._replanning and (stranded := machine.stranded(self.record)):
            self._revise(stranded[0])

    def _revise(self, target: SubtaskRecord) -> None:
        context = self._context
        decision = decide(
            self.record,
            target,
            manifests=context.catalogue.skills,
            robots=context.plans.robots(),
            config=context.config.replan,
            against=lambda plan, robot: context.plans.against(self.record, target, plan, robot),
        )
        match decision:
            case Rebinding():
                self._take_plan(TransitionKind.REBOUND, target, decision.plan, decision.note, robot=decision.robot)
            case Substitution():
                self._take_plan(TransitionKind.SUBSTITUTED, target, decision.plan, decision.note)
            case AskDecomposer():
                self._notice(target, f"asks the decomposer for a new plan: {decision.note}")
                self._replanning = True
                self._out.append(Replan(subtask=target.subtask.id, why=decision.note))
            case GiveUp():
                self._give_up(target, decision.note)

    def _robot_missing(self, target: SubtaskRecord, reason: str, now: float) -> str:
        """Decide about a subtask that waits for its robot: another takes over, or the reason to wait on."""
        context, config = self._context, self._context.config.replan
        waited_s = self._backoff.waited_s(target.subtask.id, now)
        if not robot_of(target) or waited_s < config.robot_wait_s or self.record.revised >= config.max_revisions:
            return reason
        found = allowed_robot(
            self.record,
            target,
            f"offline for {waited_s:.0f} s",
            manifests=context.catalogue.skills,
            robots=context.plans.robots(),
            config=config,
            against=lambda plan, robot: context.plans.against(self.record, target, plan, robot),
        )
        if isinstance(found, Rebinding):
            self._take_plan(TransitionKind.REBOUND, target, found.plan, found.note, robot=found.robot)
            return ""
        return f"{reason}; {found}"

    def _replanned(self, event: Replanned) -> None:
        """Take in what the decomposer answers."""
        self._replanning = False
        record, context = self.record, self._context
        target = self._find(event.subtask)
        if target is None:
            return
        if event.plan is None:
            self._give_up(target, event.why)
            return
        wrong = problems(record, event.plan, context.catalogue.skills)
        if wrong:
            self._give_up(target, f"the new plan does not fit any more: {'; '.join(wrong[:3])}")
            return
        # An operator who confirmed a plan before it ran is asked again, as is the rule for first plans.
        doubts = event.plan.provenance.confirm if event.plan.provenance is not None else ()
        rule = context.plans.approval(record, event.plan)
        waits = bool(doubts) or confirmed(record) or bool(rule)
        said = f"replanned by {event.plan.tier} ({event.plan.confidence:.2f} sure)"
        if rule:
            said = f"{said}, to be approved ({rule})"
        self._draft.offer(
            TransitionKind.PROPOSED,
            subtask=event.subtask,
            plan=event.plan,
            waits=waits,
            expires_s=context.config.replan.confirm_s if waits else 0.0,
            note=clean(f"{said}: {event.why}", MAX_NOTE),
        )

    def _take_plan(
        self, kind: TransitionKind, target: SubtaskRecord, plan: Plan, note: str, *, robot: str | None = None
    ) -> None:
        if not self._draft.offer(
            kind, subtask=target.subtask.id, attempt=target.attempt, plan=plan, robot=robot, note=clean(note, MAX_NOTE)
        ):
            # A defect of the decider in a case it did not foresee: the task ends as it would have without it.
            log.error("a revision does not fit", task=self.record.id, subtask=target.subtask.id, kind=str(kind))
            self._give_up(target, "the revised plan does not fit the record")
            return
        self._go_on()
        self._notify(str(kind), target, note)

    def _go_on(self) -> None:
        """Have ready subtasks that waited looked at at once."""
        for target in machine.ready(self.record):
            self._backoff.goes(target.subtask.id)
            self._backoff.not_before.pop(target.subtask.id, None)

    def _give_up(self, target: SubtaskRecord, why: str) -> None:
        kind = TransitionKind.REPLAN_FAILED
        if self._draft.offer(kind, subtask=target.subtask.id, attempt=target.attempt, note=clean(why, MAX_NOTE)):
            self._notify(str(kind), target, why)

    def _pursue_proposal(self, now: float) -> None:
        """Have a proposal take effect when no operator has to approve it (any more) and no run is in its way."""
        proposal, config = self.record.proposal, self._context.config
        if proposal is None:
            return
        target = self.record.of(proposal.subtask)
        if proposal.waits:
            # By the task's own age: whichever gateway coordinates it, the wait began when the plan was proposed.
            limit = proposal.expires_s or config.replan.confirm_s
            if self._draft.elapsed_s - proposal.since_s > limit:
                self._give_up(target, f"no operator agreed to the new plan within {limit:.0f} s")
            return
        spliced = splice(self.record, proposal.plan)
        if not spliced.ending:
            self._leaving.clear()
            self._take_plan(TransitionKind.REPLANNED, target, spliced.plan, proposal.note)
            return
        self._ending_since = self._ending_since or now
        for name in spliced.ending:
            run = self.record.of(name)
            if now - self._ending_since > config.grace_s:
                self._leaving.add(name)
                message = f"{run.gateway} did not confirm in time that it ended"
                self._attempt_failed(run, Failure(code="cancelled", message=message), now)
            elif self._end_at.get(name, 0.0) <= now:
                self._end_at[name] = now + config.check_s
                self._leaving.add(name)
                self._out.append(CancelRun(run))

    # --- operators, stops and leases ------------------------------------------------------------------------------

    def _operator_asked(self, event: OperatorAsked) -> None:
        """Carry out an order, or say why not."""
        if self.record.state is TaskState.ACCEPTED:
            self._deferred.append(event)
            return
        error = None
        try:
            match event.ask:
                case ApproveAsk():
                    self._approve(event.ask)
                case RejectAsk():
                    self._reject(event.ask)
                case PauseAsk():
                    self._pause(event.ask)
                case ResumeAsk():
                    if may_resume(self.record, event.ask):
                        self._draft.apply(TransitionKind.RESUMED, pause=_pause_of(event.ask))
                        self._go_on()
                case RetryAsk():
                    self._retry(event.ask)
                case FirstAsk():
                    self._move_first(event.ask)
        except SwiftbotError as refusal:
            error = refusal
        self._out.append(Answer(to=event, error=error))

    def _approve(self, ask: ApproveAsk) -> None:
        proposal = proposal_for(self.record, ask)
        if proposal is None:
            return
        # A plan that is sent back as it was is no other plan.
        edited = ask.plan if ask.plan is not None and plan_hash(ask.plan) != proposal.hash else None
        if ask.plan is not None and (wrong := self._context.plans.problems(self.record, ask.plan)):
            raise PlanError(
                f"the edited plan is not valid, and the task waits on: {'; '.join(wrong[:5])}",
                remedy="correct it",
                problems=wrong[:20],
            )
        self._draft.apply(
            TransitionKind.APPROVED,
            subtask=proposal.subtask,
            plan=edited,
            note=ask.by,
            decision=_decision(ask, proposal.hash, approved=True, edited=edited is not None),
        )

    def _reject(self, ask: RejectAsk) -> None:
        proposal = proposal_for(self.record, ask)
        if proposal is None:
            return
        who = ask.by or "the operator"
        self._draft.apply(
            TransitionKind.REJECTED,
            subtask=proposal.subtask,
            note=clean(f"{who} turned the new plan down{f': {ask.why}' if ask.why else ''}", MAX_NOTE),
            decision=_decision(ask, proposal.hash, approved=False),
            word=word_of(ask),
        )

    def _pause(self, ask: PauseAsk) -> None:
        if not may_pause(self.record, ask):
            return
        pause = _pause_of(ask)
        self._draft.apply(TransitionKind.PAUSED, pause=pause)
        for target in machine.active(self.record) if ask.hold else ():
            manifest = self._context.catalogue.skills.get(target.subtask.skill)
            if manifest is not None and manifest.checkpoints and manifest.mobility != "never":
                self._out.append(HoldRun(run=target, why=f"held at its checkpoint: {pause.text}"))

    def _run_held(self, event: RunHeld) -> None:
        """Leave a run that is ready for it, if its task is still paused."""
        target = self._current(event.subtask, event.attempt)
        if target is None:
            return
        if any(not pause.stop for pause in self.record.pauses):
            self._hold(target, event.note)
        else:
            self._out.append(ResumeRun(target))

    def _hold(self, target: SubtaskRecord, why: str) -> None:
        if self._held(target, why):
            self._out.append(EndRun(target))

    def _retry(self, ask: RetryAsk) -> None:
        if not may_retry(self.record, ask):
            return
        left = [target for target in machine.active(self.record) if target.subtask.id == ask.subtask]
        note = f"tried again by {ask.by or 'an operator'}"
        self._draft.apply(TransitionKind.RETRIED, subtask=ask.subtask, note=note, word=word_of(ask))
        self._out.extend(EndRun(target) for target in left)
        self._go_on()

    def _move_first(self, ask: FirstAsk) -> None:
        if not may_move(self.record, ask):
            return
        priority, place_ns = moved_before(self.record, tuple(self._context.scheduler.fleet_work()), ask.before)
        self._draft.apply(TransitionKind.RANKED, priority=priority, place_ns=place_ns, word=word_of(ask))
        self._go_on()

    def _follow_robots(self) -> None:
        """Pause and resume with soft stops; leave runs whose robot may not be commanded."""
        if self.record.state.final or self.record.state is TaskState.CANCELLING:
            return
        commands = self._context.commands
        needed = needed_robots(self.record)
        for stop in commands.active:
            hit = tuple(robot for robot in needed if commands.holds(stop, robot))
            if hit and not any(pause.stop == stop.id for pause in self.record.pauses):
                pause = Pause(by=stop.by, why=stop.why, stop=stop.id, robots=hit, at_ns=time.time_ns())
                self._draft.offer(TransitionKind.PAUSED, pause=pause)
        for pause in self.record.pauses:
            if pause.stop and commands.ended(pause.stop, pause.robots):
                self._draft.offer(TransitionKind.RESUMED, pause=pause)
                self._go_on()
        for target in machine.active(self.record):
            for robot in target.bound.values():
                if why := commands.hindrance(robot):
                    self._hold(target, f"waits for {robot}: {why}")
                    break

    def _expire(self) -> None:
        """End a task whose plan nobody has approved in time."""
        record, proposal = self.record, self.record.proposal
        if record.state is not TaskState.PROPOSED or proposal is None or proposal.expires_s <= 0:
            return
        if self._draft.elapsed_s - proposal.since_s > proposal.expires_s:
            failure = Failure(
                code=UnapprovedError.code,
                message=f"no operator approved its plan within {proposal.expires_s:.0f} s",
                remedy=f"submit it again, or `swiftbot task retry {record.id}`",
            )
            self._draft.offer(TransitionKind.PLAN_FAILED, failure=failure)


def _with_failure(target: SubtaskRecord, failure: Failure) -> SubtaskRecord:
    if not target.attempts or target.state is SubtaskState.READY:
        return target
    last = msgspec.structs.replace(target.attempts[-1], failure=failure)
    return msgspec.structs.replace(target, attempts=(*target.attempts[:-1], last))


def _pause_of(ask: PauseAsk | ResumeAsk) -> Pause:
    return Pause(by=ask.by, why=ask.why, act=ask.act, at_ns=time.time_ns())


def _decision(ask: ApproveAsk | RejectAsk, of: str, *, approved: bool, edited: bool = False) -> Decision:
    return Decision(
        approved=approved, by=ask.by, why=ask.why, hash=of, edited=edited, act=ask.act, at_ns=time.time_ns()
    )
