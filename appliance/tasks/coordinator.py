"""The coordinator of one task, from acceptance to its end: the thin shell around `machine`.

`Driver` is one asyncio task with an inbox: run events, lost gateways, cancels and timers come in one at a time; each
becomes a transition, the record is written to the DHT under compare-and-set *before* anything follows from it, then
the orders go out. If the write finds that the record has moved on, another gateway coordinates the task: this driver
reads again and, unless the key is its own, stops. So two coordinators never start the same attempt.

Its parts, around the `Keeper` of the record (`record_writer`):

- `Pace` (`timing`): backoff, when each subtask may be tried next.
- `plan_it`: the first plan, unless a cancel comes first.
- `Dispatching`: sends the ready subtasks to gateways, says what those that stay wait for, and ends runs. What it
  decides becomes transitions; the orders go out when the record with them is written.
- `Hearing`: makes transitions of the news of runs; what does not fit the record is dropped. Of partial results the
  record gets the last of each subtask, cut to size, at most one a second (`Partials`): each is an event for whoever
  listens, while the record is for whoever comes later and must stay small.
- `Replanning`: revises the plan when a subtask was given up, as `replan.decide` says. Each step is a transition of its
  own. What the decomposer proposes is in the record before it takes effect, so that a coordinator that takes over does
  not ask again; runs that the new plan leaves out are ended first, while what finishes meanwhile is finished.
- `Monitor`: the watchdog of runs; the judgement is that of `durations`. A **stuck** run is ended and its attempt has
  failed, so that the next is made elsewhere. A **straggler** is left for a new attempt on another gateway, with its
  last checkpoint, where its manifest allows it (`speculate`: it commands no robot and writes no volume). MapReduce lets
  both copies run and takes the first; here one attempt at a subtask is current, that is what keeps effects from
  doubling, and two that are current would not be. So speculation is moving on, once for a subtask, and only to a
  gateway that can have it.
- `Checking`: asks the gateways after the runs, in case an event was lost or a gateway went deaf.
- `Steering` (`steering`): operators' orders.

Clocks are passed in; times are seconds of this machine's monotonic clock.
"""

import asyncio
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import structlog

from appliance.errors import NotFoundError, PlanError, SwiftbotError, TakenError, UnreachableError
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
from appliance.tasks.conflicts import OVERTAKEN, foreign, heal
from appliance.tasks.context import (
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
    deadline_s,
    figures,
)
from appliance.tasks.durations import Condition, Finding, Known, asked_s, judge
from appliance.tasks.machine import TransitionKind
from appliance.tasks.orders import Orders, request_for
from appliance.tasks.record_writer import Keeper, SupersededError
from appliance.tasks.records import MAX_NOTE, MAX_RUN_S, Unknown, clean, result_problem, tidy
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
from appliance.tasks.steering import Steering
from appliance.tasks.timing import Pace, left_s, passed

EVERY_S = 1.0
MAX_PARTIAL_BYTES = 8 * 1024
"""Of one subtask, as JSON; 64 of them are half a megabyte of a record."""


class Partials:
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
        """Return those that may go into the record now, each with its result cut to size."""
        found = [
            event for subtask, event in self._waiting.items() if self._not_before.get(subtask, 0.0) <= now
        ]  # fmt: skip
        for event in found:
            del self._waiting[event.subtask]
            self._not_before[event.subtask] = now + EVERY_S
        return found

    def next_at(self) -> float | None:
        """When the next one may go into the record; None when there is none."""
        return min((self._not_before.get(subtask, 0.0) for subtask in self._waiting), default=None)


def shown(result: dict[str, Any] | None) -> dict[str, Any]:
    """Return a partial result as the record keeps it: itself, or why it is not there."""
    problem = result_problem(result, max_bytes=MAX_PARTIAL_BYTES)
    return {"left_out": problem.message} if problem is not None else dict(result or {})


TAKEN_PAUSE_S = 2.0
"""Before the next attempt with a robot that was taken over at the vehicle."""


class Hearing:
    """Hears of the runs of one task."""

    def __init__(self, around: Surroundings, keeper: Keeper, orders: Orders, pace: Pace) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._pace = pace
        self._partials = Partials()
        self.gives_way: set[str] = set()
        """Subtasks whose runs are being ended because a new plan leaves them out."""

    def useful(self, event: RunEvent) -> bool:
        """Whether an event is of a current attempt and tells something that the record keeps."""
        if event.kind in (RunEventKind.LOG, RunEventKind.ALIVE):
            return False
        current = next((each for each in self._keeper.record.subtasks if each.subtask.id == event.subtask), None)
        return (
            current is not None
            and event.attempt == current.attempt
            and not current.state.final
            and not foreign(self._keeper.record, event)
        )

    @property
    def next_partial_at(self) -> float | None:
        """When a partial result may go into the record next; None when there is none."""
        return self._partials.next_at()

    def tell_partials(self, now: float) -> None:
        """Have the partial results that are due in the record."""
        keeper = self._keeper
        for event in self._partials.due(now):
            partial = keeper.transition(
                TransitionKind.PARTIAL, subtask=event.subtask, attempt=event.attempt, result=shown(event.result)
            )
            keeper.take(partial, durable=False)

    async def hear(self, event: RunEvent) -> None:
        """Take in an event; before an end, wait a moment for the answer to the order."""
        if event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            await self._orders.answered(event.subtask, event.attempt)
        self.take_in(event)

    def take_in(self, event: RunEvent) -> None:
        """Make a transition of an event."""
        keeper = self._keeper
        try:
            target = keeper.record.of(event.subtask)
        except KeyError:
            return
        if event.attempt != target.attempt or target.state.final or foreign(keeper.record, event):
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
                ready_ns = keeper.ready_ns.get(event.subtask)
                startup_ms = (time.monotonic_ns() - ready_ns) / 1e6 if ready_ns else event.startup_ms
                keeper.take(keeper.transition(TransitionKind.STARTED, startup_ms=startup_ms, choice=choice, **common))
            case RunEventKind.PROGRESS:
                if event.choice is not None:
                    self._orders.passed_on(event.subtask, event.attempt, event.choice)
                keeper.take(
                    keeper.transition(TransitionKind.PROGRESS, progress=event.progress, note=event.note, **common),
                    durable=False,
                )
            case RunEventKind.SUCCEEDED:
                self._partials.drop(event.subtask)
                succeeded = keeper.transition(
                    TransitionKind.SUCCEEDED,
                    result=event.result,
                    duration_ms=event.duration_ms,
                    cpu_ms=event.cpu_ms,
                    peak_mb=event.peak_mb,
                    choice=choice,
                    **common,
                )
                if keeper.take(succeeded) and event.duration_ms is not None:
                    self._around.took(target.subtask.skill, event.duration_ms)
            case RunEventKind.FAILED:
                failure = event.failure or Failure(code="internal", message="the run failed without a reason")
                if failure.code == "cancelled" and keeper.record.state is TaskState.RUNNING:
                    # By its gateway, which drains or heard an outdated record: nothing is wrong with the subtask.
                    failure = msgspec.structs.replace(
                        failure, code="orphaned", message=f"ended there, though its task goes on: {failure.message}",
                        retryable=True,
                    )  # fmt: skip
                if failure.code == TakenError.code and self._wait_for_robot(target, failure):
                    return
                self.attempt_failed(target, failure, event.duration_ms, event=event)
            case RunEventKind.PARTIAL:
                self._partials.add(event)
            case RunEventKind.CHECKPOINT:
                # The first one is written at once: whoever comes later must know that there is something to remove.
                keeper.take(keeper.transition(TransitionKind.CHECKPOINT, **common), durable=not target.checkpoint_ns)
            case RunEventKind.LOG | RunEventKind.ALIVE:
                pass

    def _wait_for_robot(self, target: SubtaskRecord, failure: Failure) -> bool:
        """Let a subtask wait whose robot a pilot or a failsafe has taken: nothing is wrong with it or its attempt.

        It goes on with the next attempt when the robot is given back; until then nobody commands it.
        """
        keeper = self._keeper
        note = clean(f"waits for {target.bound_robot or 'its robot'}: {failure.message}", MAX_NOTE)
        held = keeper.transition(TransitionKind.HELD, subtask=target.subtask.id, attempt=target.attempt, note=note)
        if not keeper.take(held):
            return False
        # The roster hears of it with the next heartbeat; a new attempt before that would meet the same refusal.
        self._pace.repeats(target.subtask.id, time.monotonic() + TAKEN_PAUSE_S)
        return True

    def gateway_lost(self, gateway: str) -> None:
        """End the attempts on a gateway that is gone."""
        for each in machine.active(self._keeper.record):
            if each.gateway == gateway:
                failure = Failure(code="unreachable", message=f"{gateway} was lost", retryable=True)
                self.attempt_failed(each, failure, None)

    def give_way(self, target: SubtaskRecord, why: str) -> None:
        """Give up a run that a new plan leaves out and that does not end when told to."""
        self.gives_way.add(target.subtask.id)
        self.attempt_failed(target, Failure(code="cancelled", message=why), None)

    def attempt_failed(
        self, target: SubtaskRecord, failure: Failure, duration_ms: float | None, *, event: RunEvent | None = None
    ) -> None:
        """Note that an attempt has failed, and whether another will be made; `event`: what its gateway told of it."""
        keeper = self._keeper
        judged = _with_failure(target, failure)
        leaves = target.subtask.id in self.gives_way
        retries = self._retries(target)
        give_up = leaves or machine.gives_up(judged, failure, retries=retries + 1)
        replan = leaves or worth_replanning(failure.code)
        taken = keeper.take(
            keeper.transition(
                TransitionKind.ATTEMPT_FAILED,
                subtask=target.subtask.id,
                attempt=target.attempt,
                gateway=target.gateway,
                failure=failure,
                give_up=give_up,
                retries=None if leaves else retries,
                replan=give_up and replan and keeper.record.state is TaskState.RUNNING,
                duration_ms=duration_ms,
                cpu_ms=event.cpu_ms if event else None,
                peak_mb=event.peak_mb if event else None,
                choice=self._orders.choice(target.subtask.id, target.attempt),
            )
        )
        self._partials.drop(target.subtask.id)
        if taken and not give_up:
            keeper.ready_ns[target.subtask.id] = time.monotonic_ns()
            self._pace.repeats(target.subtask.id, time.monotonic() + machine.retry_delay_s(target.attempt))

    def _retries(self, target: SubtaskRecord) -> int:
        try:
            return self._around.manifest(target.subtask.skill).retries
        except NotFoundError:
            return 0


def _with_failure(target: SubtaskRecord, failure: Failure) -> SubtaskRecord:
    if not target.attempts or target.state is SubtaskState.READY:
        return target
    last = msgspec.structs.replace(target.attempts[-1], failure=failure)
    return msgspec.structs.replace(target, attempts=(*target.attempts[:-1], last))


log = structlog.get_logger(__name__)


class Replanning:
    """Revises the plan of one task. `tell` gets what the decomposer answers."""

    def __init__(
        self,
        around: Surroundings,
        keeper: Keeper,
        orders: Orders,
        hearing: Hearing,
        pace: Pace,
        tell: Callable[[Input], None],
    ) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._hearing = hearing
        self._pace = pace
        self._tell = tell
        self._asking: asyncio.Task[None] | None = None
        self._asked_for = ""
        self._ending_since: float | None = None
        self._end_at: dict[str, float] = {}

    def advance(self, now: float) -> None:
        """Do what can be done now about subtasks that were given up."""
        record = self._keeper.record
        if record.state is not TaskState.RUNNING:
            self.close()
            return
        if record.proposal is not None:
            self._pursue(now)
            return
        self._ending_since = None  # of the next proposal's runs nobody was asked to end yet
        self._end_at.clear()
        if self._asking is None:
            # Each decision changes the record; the bound of revisions is that of this loop.
            while self._asking is None and (stranded := machine.stranded(self._keeper.record)):
                self._decide(stranded[0])

    def robot_missing(self, target: SubtaskRecord, reason: str, now: float) -> str:
        """Say what is done about a subtask that waits for its robot: another takes over, or the reason to wait on."""
        config = self._around.config.replan
        robot = robot_of(target)
        waited_s = self._pace.waited_s(target.subtask.id, now)
        if not robot or waited_s < config.robot_wait_s or self._keeper.record.revised >= config.max_revisions:
            return reason
        recovery = self._around.recovery
        found = allowed_robot(
            self._keeper.record,
            target,
            f"offline for {waited_s:.0f} s",
            manifests=recovery.manifests,
            robots=recovery.robots(),
            config=config,
            against=lambda plan, robot: recovery.against(self._keeper.record, target, plan, robot),
        )
        if isinstance(found, Rebinding):
            self._rebind(target, found)
            return ""
        return f"{reason}; {found}"

    def take_up(self, news: PlanMade) -> None:
        """Take what the decomposer answers."""
        self._asking = None
        keeper = self._keeper
        try:
            target = keeper.record.of(news.subtask)
        except KeyError:
            return
        if news.plan is None:
            self._give_up(target, news.why)
            return
        wrong = problems(keeper.record, news.plan, self._around.recovery.manifests)
        if wrong:
            self._give_up(target, f"the new plan does not fit any more: {'; '.join(wrong[:3])}")
            return
        # Whoever confirmed a plan before it ran is asked again, as is the rule for first plans: this is another one.
        doubts = news.plan.provenance.confirm if news.plan.provenance is not None else ()
        rule = self._around.approval(keeper.record, news.plan)
        waits = bool(doubts) or confirmed(keeper.record) or bool(rule)
        said = f"planned anew by {news.plan.tier} ({news.plan.confidence:.2f} sure)"
        if rule:
            said = f"{said}, to be approved ({rule})"
        keeper.take(
            keeper.transition(
                TransitionKind.PROPOSED,
                subtask=news.subtask,
                plan=news.plan,
                waits=waits,
                expires_s=self._around.config.replan.confirm_s if waits else 0.0,
                note=clean(f"{said}: {news.why}", MAX_NOTE),
            )
        )

    def close(self) -> None:
        """Ask no more."""
        if self._asking is not None:
            self._asking.cancel()
            self._asking = None

    # --- steps ------------------------------------------------------------------------------------------------

    def _decide(self, target: SubtaskRecord) -> None:
        keeper, recovery = self._keeper, self._around.recovery
        decision = decide(
            keeper.record,
            target,
            manifests=recovery.manifests,
            robots=recovery.robots(),
            config=self._around.config.replan,
            against=lambda plan, robot: recovery.against(keeper.record, target, plan, robot),
        )
        match decision:
            case Rebinding():
                self._rebind(target, decision)
            case Substitution():
                self._revise(TransitionKind.SUBSTITUTED, target, decision.plan, decision.note)
            case AskDecomposer():
                self._ask(target, decision.note)
            case GiveUp():
                self._give_up(target, decision.note)

    def _rebind(self, target: SubtaskRecord, found: Rebinding) -> None:
        self._revise(TransitionKind.REBOUND, target, found.plan, found.note, robot=found.robot)

    def _revise(
        self, kind: TransitionKind, target: SubtaskRecord, plan: Plan, note: str, *, robot: str | None = None
    ) -> None:
        keeper = self._keeper
        revised = keeper.transition(
            kind, subtask=target.subtask.id, attempt=target.attempt, plan=plan, robot=robot, note=clean(note, MAX_NOTE)
        )  # fmt: skip
        if not keeper.take(revised):
            # A defect of the decider, met in whatever it did not foresee: the task ends as it would have without it.
            log.error("a revision does not fit", task=keeper.record.id, subtask=target.subtask.id, kind=str(kind))
            self._give_up(target, "the revised plan does not fit the record")
            return
        for each in machine.ready(keeper.record):
            self._pace.goes(each.subtask.id)
            self._pace.not_before.pop(each.subtask.id, None)
        self._around.recovery.note(str(kind), keeper.record, target, note)

    def _give_up(self, target: SubtaskRecord, why: str) -> None:
        keeper = self._keeper
        given_up = keeper.transition(
            TransitionKind.REPLAN_FAILED, subtask=target.subtask.id, attempt=target.attempt, note=clean(why, MAX_NOTE)
        )  # fmt: skip
        if keeper.take(given_up):
            self._around.recovery.note(str(TransitionKind.REPLAN_FAILED), keeper.record, target, why)

    # --- the decomposer ---------------------------------------------------------------------------------------

    def _ask(self, target: SubtaskRecord, note: str) -> None:
        self._say(target, f"asks the decomposer for a new plan: {note}")
        self._asking = asyncio.create_task(self._plan(target.subtask.id, note), name=f"replan {self._keeper.record.id}")

    async def _plan(self, subtask: str, note: str) -> None:
        """Have the rest planned anew; whatever comes of it is told."""
        try:
            async with asyncio.timeout(self._around.config.replan.ask_s):
                plan = await self._around.recovery.replan(self._keeper.record)
            self._tell(PlanMade(subtask=subtask, plan=plan, why=note))
        except PlanError as error:
            said = f": {'; '.join(error.problems[:3])}" if error.problems else ""
            self._tell(PlanMade(subtask=subtask, plan=None, why=f"{note}; the decomposer: {error.message}{said}"))
        except SwiftbotError as error:
            self._tell(PlanMade(subtask=subtask, plan=None, why=f"{note}; the decomposer: {error}"))
        except TimeoutError:
            limit = self._around.config.replan.ask_s
            self._tell(PlanMade(subtask=subtask, plan=None, why=f"{note}; the decomposer took over {limit:g} s"))
        except Exception as error:  # the boundary to the planner: whatever breaks in it, the task ends with a reason
            log.exception("replanning broke", task=self._keeper.record.id)
            why = f"{note}; replanning broke: {type(error).__name__}: {error}"
            self._tell(PlanMade(subtask=subtask, plan=None, why=why))

    def _pursue(self, now: float) -> None:
        """Have a proposal take effect, when an operator need not agree (any more) and no run stands against it."""
        keeper = self._keeper
        proposal = keeper.record.proposal
        if proposal is None:
            return
        target = keeper.record.of(proposal.subtask)
        if proposal.waits:
            # By the task's own age: whoever coordinates it now, the wait began when the plan was proposed.
            limit = proposal.expires_s or self._around.config.replan.confirm_s
            if keeper.elapsed_s - proposal.since_s > limit:
                self._give_up(target, f"no operator agreed to the new plan within {limit:.0f} s")
            return
        spliced = splice(keeper.record, proposal.plan)
        if spliced.ending:
            self._end(spliced.ending, now)
            return
        self._hearing.gives_way.clear()
        self._revise(TransitionKind.REPLANNED, target, spliced.plan, proposal.note)

    def _end(self, subtasks: tuple[str, ...], now: float) -> None:
        """End the runs that the new plan leaves out; one that does not confirm is given up after the grace."""
        self._ending_since = self._ending_since or now
        config, keeper = self._around.config, self._keeper
        for name in subtasks:
            target = keeper.record.of(name)
            if now - self._ending_since > config.grace_s:
                self._hearing.give_way(target, f"{target.gateway} did not confirm in time that it ended")
            elif self._end_at.get(name, 0.0) <= now:
                self._end_at[name] = now + config.check_s
                self._hearing.gives_way.add(name)
                self._orders.cancel(target, keeper.record.id)

    def _say(self, target: SubtaskRecord, note: str) -> None:
        keeper = self._keeper
        keeper.take(
            keeper.transition(
                TransitionKind.NOTICED, subtask=target.subtask.id, attempt=target.attempt, note=clean(note, MAX_NOTE)
            )
        )


class Dispatching:
    """Dispatches one task's subtasks; on the way to its end, cancels what still runs."""

    def __init__(
        self,
        around: Surroundings,
        keeper: Keeper,
        orders: Orders,
        hearing: Hearing,
        pace: Pace,
        replanning: Replanning,
    ) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._hearing = hearing
        self._pace = pace
        self._replanning = replanning
        self._cancelled_at: float | None = None
        self._cancel_at: dict[str, float] = {}

    def advance(self, now: float) -> None:
        """Dispatch what can be dispatched now, or end what runs if the task is being ended."""
        keeper = self._keeper
        if keeper.record.state is TaskState.CANCELLING:
            self._end_runs(now)
            return
        ready = machine.ready(keeper.record)
        if any(self._pace.not_before.get(each.subtask.id, 0.0) <= now for each in ready):
            group = self._around.regroup(keeper.record)
            if group is not None:
                keeper.apply(keeper.transition(TransitionKind.GROUPED, group=group))
        for each in machine.ready(keeper.record):
            keeper.ready_ns.setdefault(each.subtask.id, time.monotonic_ns())
            if keeper.record.state is TaskState.RUNNING and self._pace.may_go(each.subtask.id, now):
                self._dispatch(each, now)

    def _dispatch(self, target: SubtaskRecord, now: float) -> None:
        keeper, subtask = self._keeper, target.subtask
        try:
            manifest = self._around.manifest(subtask.skill)
        except NotFoundError as error:
            # Planned on a gateway that knows more skills than this one, or before this one forgot it.
            failure = Failure(code=error.code, message=error.message, remedy=error.remedy)
            keeper.apply(
                keeper.transition(
                    TransitionKind.ATTEMPT_FAILED,
                    subtask=subtask.id,
                    attempt=target.next_attempt,
                    failure=failure,
                    give_up=True,
                    replan=True,
                )
            )
            return
        robot = None
        if subtask.robot is not None:
            robot, reason = self._around.bind(keeper.record, target)
            if robot is None:
                reason = self._replanning.robot_missing(target, reason, now)
                if reason:
                    self._wait(target, reason, now)
                return
        placement = self._around.place(keeper.record, target, robot)
        if not placement.order:
            self._wait(target, f"waits for a gateway: {placement.why}", now)
            return
        left = left_s(keeper.record, keeper.elapsed_s)
        turn = self._around.turn(keeper.record, target, placement, left)
        if not turn.gateway:
            self._wait(target, f"waits for room: {', '.join(placement.order)} have enough to do", now)
            return
        self._pace.goes(subtask.id)
        request = request_for(
            keeper.record,
            target,
            manifest,
            robot=robot,
            coordinator=self._around.plane.gateway,
            elapsed_s=keeper.elapsed_s,
        )
        gateway = turn.gateway
        keeper.apply(
            keeper.transition(
                TransitionKind.DISPATCHED,
                subtask=subtask.id,
                attempt=request.attempt,
                gateway=gateway,
                robot=robot,
                placed=clean(placement.why, MAX_NOTE),
                **figures(self._around.plane, gateway),
            )
        )
        self._around.sent(keeper.record, target, placement)
        self._orders.add(gateway, request)

    def move(self, news: MoveReady) -> None:
        """Leave a run for a new attempt on the gateway that was made ready for it, unless it has ended meanwhile."""
        keeper = self._keeper
        try:
            target = keeper.record.of(news.subtask)
            manifest = self._around.manifest(target.subtask.skill)
        except (KeyError, NotFoundError):
            news.give_up("the task has no such subtask, or its coordinator no such skill")
            return
        if news.outcome.done():
            return
        request = request_for(
            keeper.record,
            target,
            manifest,
            robot=target.bound_robot,
            coordinator=self._around.plane.gateway,
            elapsed_s=keeper.elapsed_s,
        )
        moved = keeper.transition(
            TransitionKind.MOVED,
            subtask=news.subtask,
            attempt=news.attempt,
            gateway=news.gateway,
            note=clean(news.why, MAX_NOTE),
            placed=clean(news.placed, MAX_NOTE),
            choice=self._orders.choice(news.subtask, news.attempt),
            **figures(self._around.plane, news.gateway),
        )
        if request.attempt != news.next_attempt or not keeper.take(moved):
            news.give_up(f"attempt {news.attempt} has ended meanwhile")
            return
        keeper.ready_ns[news.subtask] = time.monotonic_ns()
        self._orders.move(news, request, left=target)

    def _wait(self, target: SubtaskRecord, reason: str, now: float) -> None:
        """Tell people why it waits, once per reason, and look again soon.

        Written to the record, since every gateway must be able to say why nothing goes on.
        """
        if self._pace.waits(target.subtask.id, reason, now):
            keeper = self._keeper
            keeper.apply(
                keeper.transition(
                    TransitionKind.PROGRESS, subtask=target.subtask.id, attempt=target.attempt, note=clean(reason, 500)
                )
            )

    def _end_runs(self, now: float) -> None:
        if self._cancelled_at is None:
            self._cancelled_at = now
        for each in machine.active(self._keeper.record):
            if now - self._cancelled_at > self._around.config.grace_s:
                failure = Failure(code="cancelled", message=f"{each.gateway} did not confirm the cancel in time")
                self._hearing.attempt_failed(each, failure, None)
            elif self._cancel_at.get(each.subtask.id, 0.0) <= now:
                # Again and again: the first may overtake the order to run, or be lost.
                self._cancel_at[each.subtask.id] = now + self._around.config.check_s
                self._orders.cancel(each, self._keeper.record.id)


_LEFT = "straggling"
"""How the reason of an attempt that was left for speculation begins."""


class Monitor:
    """Watches the runs of one task."""

    def __init__(
        self, around: Surroundings, keeper: Keeper, orders: Orders, hearing: Hearing, dispatching: Dispatching
    ) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._hearing = hearing
        self._dispatching = dispatching
        self._heard: dict[tuple[str, int], float] = {}
        self._began: dict[tuple[str, int], float] = {}

    def seen(self, event: RunEvent) -> None:
        """Note a sign of life of a run; whatever it tells is one. Of attempts that nobody ordered nothing is kept."""
        run = (event.subtask, event.attempt)
        now = time.monotonic()
        target = next((each for each in self._keeper.record.subtasks if each.subtask.id == event.subtask), None)
        if target is None or target.attempt != event.attempt:
            return
        if event.kind is RunEventKind.STARTED:
            self._began.setdefault(run, now)
        self._heard[run] = now

    def look(self, target: SubtaskRecord, silent_s: float | None) -> None:
        """Judge a run that is under way, and do what follows.

        Args:
            target: the subtask as it stands.
            silent_s: since its last sign of life by its own gateway's account; None when that did not tell.
        """
        if target.state is not SubtaskState.RUNNING:
            return
        now = time.monotonic()
        run = (target.subtask.id, target.attempt)
        # Of a run that another coordinator heard begin nothing is known but that it runs now.
        began, heard = self._began.setdefault(run, now), self._heard.setdefault(run, now)
        manifest = self._around.recovery.manifests.get(target.subtask.skill)
        if manifest is None:
            return
        silent = now - heard if silent_s is None else min(silent_s, now - heard)
        found = judge(
            manifest,
            running_s=now - began,
            silent_s=silent,
            known=Known(learned=self._around.recovery.experience(manifest.id), siblings=self._siblings(target)),
            asked_s=asked_s(target.subtask.params),
            config=self._around.config.detection,
        )
        if found is None:
            return
        if target.condition != found.condition:
            self._note(target, found)
        if found.condition is Condition.STUCK:
            self._end(target, found)
        elif manifest.speculate:
            self._move_on(target, found)

    def _siblings(self, target: SubtaskRecord) -> tuple[float, ...]:
        return tuple(
            each.duration_ms / 1e3
            for each in self._keeper.record.subtasks
            if each.subtask.skill == target.subtask.skill
            and each.state is SubtaskState.SUCCEEDED
            and each.duration_ms is not None
        )

    def _note(self, target: SubtaskRecord, found: Finding) -> None:
        keeper = self._keeper
        noticed = keeper.transition(
            TransitionKind.NOTICED,
            subtask=target.subtask.id,
            attempt=target.attempt,
            condition=str(found.condition),
            note=clean(found.note, MAX_NOTE),
        )
        if keeper.take(noticed):
            self._around.recovery.note(str(found.condition), keeper.record, target, found.note)

    def _end(self, target: SubtaskRecord, found: Finding) -> None:
        self._orders.cancel(target, self._keeper.record.id)
        failure = Failure(
            code=str(found.condition),
            message=f"{found.note} (on {target.gateway})",
            remedy="`swiftbot task watch` has its last lines; silent_s in its skill.toml bounds its silence",
            retryable=True,
        )
        self._hearing.attempt_failed(target, failure, None)

    def _move_on(self, target: SubtaskRecord, found: Finding) -> None:
        """Leave a straggler for a new attempt, once, where there is a gateway for it."""
        if any(each.left.startswith(_LEFT) for each in target.attempts):
            return
        placement = self._around.place(self._keeper.record, target, None)
        tried = {each.gateway for each in target.attempts}
        other = next((each for each in placement.order if each not in tried), None)
        if other is None:
            return
        outcome: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        outcome.add_done_callback(lambda done: done.cancelled() or done.exception())
        self._dispatching.move(
            MoveReady(
                subtask=target.subtask.id,
                attempt=target.attempt,
                next_attempt=target.next_attempt,
                gateway=other,
                why=f"{_LEFT} on {target.gateway}, goes on here: {found.note}",
                placed=placement.why,
                outcome=outcome,
            )
        )
        self._around.recovery.note("speculated", self._keeper.record, target, f"goes on on {other}")


class Checking:
    """Asks after the runs of one task now and then."""

    def __init__(
        self, around: Surroundings, keeper: Keeper, orders: Orders, hearing: Hearing, monitor: Monitor
    ) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._hearing = hearing
        self._monitor = monitor
        self.next_at = time.monotonic() + around.config.check_s

    async def check(self) -> None:
        """When it is time: ask after runs, in case an event was lost, and give up the silent past their deadline."""
        now = time.monotonic()
        if now < self.next_at:
            return
        members = self._around.plane.members()
        asked: list[SubtaskRecord] = []
        for each in machine.active(self._keeper.record):
            limit = self._limit_s(each)
            silent_s = now - self._orders.silent_since(each.subtask.id, now)
            if each.gateway not in members:
                self._hearing.gateway_lost(each.gateway)
            elif silent_s > limit + self._around.config.grace_s:
                failure = Failure(code="deadline", message=f"nothing came of it within {limit:.0f} s")
                self._hearing.attempt_failed(each, failure, None)
            elif silent_s > self._around.config.check_s:
                asked.append(each)
        await self.ask_after(asked)
        # Answers may have taken a while; the next look is a whole interval away from them.
        self.next_at = time.monotonic() + self._around.config.check_s

    async def ask_after(self, targets: Sequence[SubtaskRecord]) -> None:
        """Learn from their gateways what became of runs."""
        task = self._keeper.record.id
        answers = await asyncio.gather(*(self._orders.ask(each, task, "run_status") for each in targets))
        for target, status in zip(targets, answers, strict=True):
            self._learn(target, status)
        for target, status in zip(targets, answers, strict=True):
            self._judge(target, status)

    def _learn(self, target: SubtaskRecord, status: RunStatus | None) -> None:
        lost = ""
        if status is None:
            if target.gateway not in self._around.plane.members():
                lost = f"{target.gateway} was lost"
        elif status.last is None:
            sent = self._orders.sent_at(target.subtask.id)
            if not status.running and time.monotonic() - sent > self._around.config.run_timeout_s:
                lost = f"{target.gateway} does not know the run"
        elif status.last.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            self._hearing.take_in(status.last)
        elif not status.running:
            lost = f"{target.gateway} lost the run"
        elif status.last.kind is RunEventKind.STARTED:
            self._hearing.take_in(status.last)
        if lost:
            failure = Failure(code="unreachable", message=lost, retryable=True)
            self._hearing.attempt_failed(target, failure, None)

    def _judge(self, target: SubtaskRecord, status: RunStatus | None) -> None:
        """Have a run looked at as it stands now that its gateway was asked."""
        current = next((each for each in machine.active(self._keeper.record) if each.subtask == target.subtask), None)
        if current is not None and current.attempt == target.attempt:
            self._monitor.look(current, status.silent_s if status is not None and status.running else None)

    def _limit_s(self, target: SubtaskRecord) -> float:
        """How long a run may take; for a skill that only its gateway knows, as long as any."""
        try:
            return deadline_s(self._around.manifest(target.subtask.skill), target.subtask.params)
        except NotFoundError:
            return MAX_RUN_S


async def plan_it(around: Surroundings, keeper: Keeper, inbox: "asyncio.Queue[Input]") -> None:
    """Plan the task; whatever comes of it is a transition.

    Operators' orders that come meanwhile are looked at afterwards; other news are of no use and dropped.
    """
    planning = asyncio.ensure_future(around.plan(keeper.record))
    later: list[Input] = []
    try:
        record = keeper.record
        until = time.monotonic() + left_s(record, keeper.elapsed_s)
        if (cancel := await _cancelled_before(planning, inbox, until, later)) is not None:
            keeper.apply(keeper.transition(TransitionKind.CANCEL, word=cancel.word))
            return
        if not planning.done():
            keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=passed(record)))
            return
        plan = planning.result()
        note = around.expect(plan, deadline_s=record.deadline_s, elapsed_s=keeper.elapsed_s)
        if why := around.approval(record, plan):
            waits = keeper.transition(
                TransitionKind.PROPOSED, plan=plan, note=clean(why, 500), waits=True,
                expires_s=around.config.approval_s,
            )  # fmt: skip
            keeper.apply(waits)
            return
        keeper.apply(keeper.transition(TransitionKind.PLANNED, plan=plan, note=note))
    except SwiftbotError as error:
        keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=_plan_failure(error)))
    except Exception as error:  # the boundary to the planner: whatever breaks in it, the submitter is told
        log.exception("planning broke", task=keeper.record.id)
        failure = Failure(code="internal", message=clean(f"planning broke: {type(error).__name__}: {error}", 500))
        keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=failure))
    finally:
        planning.cancel()
        for news in later:
            inbox.put_nowait(news)


async def _cancelled_before(
    planning: "asyncio.Future[Plan]", inbox: "asyncio.Queue[Input]", deadline: float, later: list[Input]
) -> CancelAsked | None:
    """Wait for the plan, until the deadline at most; a cancel that came first. `later` gets operators' other orders."""
    while not planning.done() and (left := deadline - time.monotonic()) > 0:
        asking = asyncio.ensure_future(inbox.get())
        try:
            await asyncio.wait(
                {planning, asking},
                return_when=asyncio.FIRST_COMPLETED,
                timeout=None if math.isinf(left) else left,
            )
            if asking.done():
                news = asking.result()
                if isinstance(news, CancelAsked):
                    return news
                if isinstance(news, Steered):
                    later.append(news)
        finally:
            asking.cancel()
    return None


def _plan_failure(error: SwiftbotError) -> Failure:
    problems = error.problems if isinstance(error, PlanError) else ()
    message = error.message if not problems else f"{error.message}: {'; '.join(problems[:5])}"
    return Failure(code=error.code, message=message, remedy=error.remedy)


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
    def overtaken(self) -> bool:
        """Whether the record has moved on under this driver: it stops, and its copy is no answer to anybody."""
        return self._keeper.overtaken

    def heard(self, version: VersionVector) -> bool:
        """Hear that this gateway's copy of the record has changed; returns whether that was somebody else's doing.

        While a write of the driver's own is under way it is not told apart: the driver looks when that returns.
        """
        return self._keeper.heard(version)

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
