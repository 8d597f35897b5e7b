"""Operators' orders on a driven task (approve, reject, pause, resume, retry), and soft stops and leases of its robots.

What becomes of an order is decided by the record alone: taken, done already, or why not. Two operators who act on one
task are decided between there and by the compare-and-set under which the record is written: whoever's order stands in
the record was first, and the other is told who that was.

`Steering` is the shell around these decisions: each order becomes a transition, whoever gave it hears of it when the
record with it is written, and runs that are left are ended only then.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

import structlog

from appliance.errors import (
    ConflictError,
    NotFoundError,
    PlanError,
    RefusedError,
    SwiftbotError,
    UnapprovedError,
    UnreachableError,
)
from appliance.llm.checks.schema import able, is_unnamed
from appliance.model import (
    Approval,
    Decision,
    Failure,
    Pause,
    Plan,
    Proposal,
    RobotInfo,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Word,
)
from appliance.skills.catalogue import SkillManifest
from appliance.tasks import machine
from appliance.tasks.api import ApproveAsk, PauseAsk, RejectAsk, ResumeAsk, RetryAsk
from appliance.tasks.context import Input, RunHeld, Steered, Surroundings
from appliance.tasks.machine import ACTIVE, SHORTEST, TransitionKind, matches, plan_hash
from appliance.tasks.orders import Orders
from appliance.tasks.record_writer import Keeper
from appliance.tasks.records import MAX_NOTE, clean
from appliance.tasks.retention import refuse_trimmed
from appliance.tasks.timing import Pace


def needs_approval(
    plan: Plan, wanted: Approval, *, manifests: Mapping[str, SkillManifest], robots: Mapping[str, RobotInfo]
) -> str:
    """Why a plan has to be approved before it takes effect; empty when it need not be.

    Args:
        plan: the plan.
        wanted: what configuration and request ask for.
        manifests: skills by name.
        robots: the roster: what flies is dangerous, whatever it does, and so is what one that flies may be chosen for.
    """
    if wanted is Approval.NEVER:
        return ""
    if wanted is Approval.ALWAYS:
        return "every plan is approved first"
    reasons: list[str] = []
    for each in plan.subtasks:
        manifest = manifests.get(each.skill)
        if manifest is not None and manifest.danger:
            reasons.append(f"{each.id} ({each.skill}): {manifest.danger}")
        elif manifest is not None and "base" in manifest.uses and (flying := _flying(each, manifest, robots)):
            reasons.append(f"{each.id} ({each.skill}): {flying}")
    more = f", and {len(reasons) - 5} more" if len(reasons) > 5 else ""
    return "; ".join(reasons[:5]) + more


def _flying(subtask: Subtask, manifest: SkillManifest, robots: Mapping[str, RobotInfo]) -> str:
    """Which robot that flies does a subtask, or may be chosen for it; offline ones too, since they may come back."""
    name = subtask.robot or ""
    if not is_unnamed(name):
        robot = robots.get(name)
        return f"{name} flies" if robot is not None and robot.flies else ""
    found = [each for each in sorted(robots) if robots[each].flies and not able(robots[each], manifest)]
    return f"{found[0]} may be chosen, which flies" if found else ""


def proposal_for(record: TaskRecord, ask: ApproveAsk | RejectAsk) -> Proposal | None:
    """The proposal that an operator's word is about; None when this very order has been carried out already.

    Raises:
        ConflictError: somebody else was faster, or another plan waits by now.
        RefusedError: nothing waits, or the hash is too short to mean one.
    """
    proposal, decision = record.proposal, record.decision
    if ask.act and decision is not None and decision.act == ask.act:
        return None
    waits = record.state in (TaskState.PROPOSED, TaskState.RUNNING) and proposal is not None and proposal.waits
    if not waits or proposal is None:
        if decision is not None:
            did = "approved" if decision.approved else "rejected"
            edited = " in an edited form" if decision.edited else ""
            said = f": {decision.why}" if decision.why else ""
            raise ConflictError(
                f"{decision.by or 'another operator'} has {did} the plan of task {record.id}{edited} already{said}",
                remedy=f"see `swiftbot task show {record.id}`",
            )
        raise RefusedError(
            f"nothing of task {record.id} waits for an operator's word: it is {record.state}",
            remedy=f"see `swiftbot task show {record.id}`",
        )
    if ask.hash and not matches(ask.hash, proposal.hash):
        if len(ask.hash) < SHORTEST:
            raise RefusedError(f"{ask.hash!r} is too short for a hash", remedy=f"give {SHORTEST} characters or more")
        raise ConflictError(
            f"the plan of task {record.id} that waits by now is another one: {proposal.hash[:12]}",
            remedy="look at it, then decide",
        )
    return proposal


def may_pause(record: TaskRecord, ask: PauseAsk) -> bool:
    """Whether a pause is to be written; False when this very order was.

    Raises:
        ConflictError: somebody else has paused it.
        RefusedError: it has ended, or is being ended.
    """
    for each in record.pauses:
        if not each.stop:
            if ask.act and each.act == ask.act:
                return False
            raise ConflictError(f"task {record.id} is {each.text} already")
    if record.state.final or record.state is TaskState.CANCELLING:
        raise RefusedError(f"task {record.id} is {record.state}: there is nothing to pause")
    return True


def may_resume(record: TaskRecord, ask: ResumeAsk) -> bool:
    """Whether a pause is to be taken back; False when there is none any more.

    Raises:
        RefusedError: it waits for a soft stop to be lifted, or has ended.
    """
    del ask
    if record.state.final:
        raise RefusedError(f"task {record.id} has {record.state}", remedy=f"`swiftbot task retry {record.id}`")
    if any(not each.stop for each in record.pauses):
        return True
    if record.pauses:
        raise RefusedError(
            f"task {record.id} goes on when the stop is lifted: {record.paused}", remedy="`swiftbot resume`"
        )
    return False


def may_retry(record: TaskRecord, ask: RetryAsk) -> bool:
    """Whether something is to be tried again; False when this very order was carried out.

    Raises:
        NotFoundError: the plan has no such subtask.
        RefusedError: there is nothing to try again, with the reason.
    """
    if ask.act and record.retried_by is not None and record.retried_by.act == ask.act:
        return False
    refuse_trimmed(record)
    target = None
    if ask.subtask:
        try:
            target = record.of(ask.subtask)
        except KeyError:
            known = ", ".join(each.subtask.id for each in record.subtasks) or "none"
            raise NotFoundError(
                f"task {record.id} has no subtask {ask.subtask[:60]!r}", remedy=f"it has: {known}"
            ) from None
        if target.state is SubtaskState.SUCCEEDED:
            raise RefusedError(f"{ask.subtask} has succeeded, and what has succeeded is kept")
    if record.state in (TaskState.FAILED, TaskState.CANCELLED):
        return True
    if record.state is TaskState.SUCCEEDED:
        raise RefusedError(f"task {record.id} has succeeded", remedy="submit it again")
    if record.state is not TaskState.RUNNING or target is None:
        who = f"; {record.retried_by.by} had it tried again" if record.retried_by is not None else ""
        raise RefusedError(
            f"task {record.id} is {record.state}{who}: there is nothing to try again",
            remedy="name one of its subtasks, or wait for its end",
        )
    if target.state not in (*ACTIVE, SubtaskState.FAILED):
        raise RefusedError(f"{ask.subtask} is {target.state}: it has not been tried yet, or will be by itself")
    return True


def needed_robots(record: TaskRecord) -> tuple[str, ...]:
    """The robots that a task still needs, by name, or by label (`any1`) where none is chosen yet."""
    names = {
        each.bound_robot or each.subtask.robot
        for each in record.subtasks
        if not each.state.final and (each.bound_robot or each.subtask.robot)
    }
    if record.state is TaskState.PROPOSED and record.proposal is not None:
        names |= {each.robot for each in record.proposal.plan.subtasks if each.robot}
    return tuple(sorted(name for name in names if name))


log = structlog.get_logger(__name__)

END_TRIES = 5
"""How often a run that is left is told to end, `tasks.check_s` apart; then its attempt number alone fences it off."""


class Steering:
    """The orders of one task. `tell` gets what its own work finds out."""

    def __init__(
        self, around: Surroundings, keeper: Keeper, orders: Orders, pace: Pace, tell: Callable[[Input], None]
    ) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._pace = pace
        self._tell = tell
        self._taken: list[Steered] = []
        """Orders whose transitions are not written yet."""
        self._leaving: list[SubtaskRecord] = []
        """Runs to be ended when that is written."""
        self._tasks: set[asyncio.Task[None]] = set()

    def take(self, news: Steered) -> None:
        """Carry out an order, or say why not."""
        keeper = self._keeper
        before = keeper.record.sequence
        try:
            match news.ask:
                case ApproveAsk():
                    self._approve(news.ask)
                case RejectAsk():
                    self._reject(news.ask)
                case PauseAsk():
                    self._pause(news.ask)
                case ResumeAsk():
                    self._resume(news.ask)
                case RetryAsk():
                    self._retry(news.ask)
        except SwiftbotError as error:
            news.refuse(error)
            return
        if keeper.record.sequence == before:
            news.done(keeper.told)
        else:
            self._taken.append(news)

    def run_held(self, news: RunHeld) -> None:
        """Leave a run that is ready for it, if its task is still paused."""
        record = self._keeper.record
        target = next((each for each in machine.active(record) if each.subtask.id == news.subtask), None)
        if target is None or target.attempt != news.attempt:
            return
        if any(not each.stop for each in record.pauses):
            self._hold(target, news.note)
        else:
            self._start(self._let_go_on(target))

    def advance(self) -> None:
        """Do what follows from soft stops, leases and time."""
        record = self._keeper.record
        if record.state.final or record.state is TaskState.CANCELLING:
            return
        self._follow_stops()
        for each in machine.active(self._keeper.record):
            if each.bound_robot and (why := self._around.commands.hindrance(each.bound_robot)):
                self._hold(each, f"waits for {each.bound_robot}: {why}")
        proposal = record.proposal
        if record.state is TaskState.PROPOSED and proposal is not None and proposal.expires_s > 0:
            waited_s = self._keeper.elapsed_s - proposal.since_s
            if waited_s > proposal.expires_s:
                failure = Failure(
                    code=UnapprovedError.code,
                    message=f"no operator approved its plan within {proposal.expires_s:.0f} s",
                    remedy=f"hand it in again, or `swiftbot task retry {record.id}`",
                )
                self._keeper.take(self._keeper.transition(TransitionKind.PLAN_FAILED, failure=failure))

    def written(self) -> None:
        """The record is written: say so, and end the runs that were left."""
        taken, self._taken = self._taken, []
        for each in taken:
            each.done(self._keeper.record)
        leaving, self._leaving = self._leaving, []
        for target in leaving:
            self._start(self._end(target))

    def close(self) -> None:
        """Carry out nothing more; whoever waits asks again, and finds it done or not."""
        for each in self._taken:
            each.refuse(UnreachableError("the task's coordination moved on before it was written", remedy="ask again"))
        for task in self._tasks:
            task.cancel()

    # --- orders -------------------------------------------------------------------------------------------------

    def _approve(self, ask: ApproveAsk) -> None:
        keeper = self._keeper
        proposal = proposal_for(keeper.record, ask)
        if proposal is None:
            return
        # A plan that is sent back as it was is no other plan.
        edited = ask.plan if ask.plan is not None and plan_hash(ask.plan) != proposal.hash else None
        if ask.plan is not None and (problems := self._around.plan_problems(keeper.record, ask.plan)):
            raise PlanError(
                f"the edited plan is not valid, and the task waits on: {'; '.join(problems[:5])}",
                remedy="mend it",
                problems=problems[:20],
            )
        keeper.apply(
            keeper.transition(
                TransitionKind.APPROVED,
                subtask=proposal.subtask,
                plan=edited,
                note=ask.by,
                decision=_decision(ask, proposal.hash, approved=True, edited=edited is not None),
            )
        )

    def _reject(self, ask: RejectAsk) -> None:
        keeper = self._keeper
        proposal = proposal_for(keeper.record, ask)
        if proposal is None:
            return
        who = ask.by or "the operator"
        keeper.apply(
            keeper.transition(
                TransitionKind.REJECTED,
                subtask=proposal.subtask,
                note=clean(f"{who} turned the new plan down{f': {ask.why}' if ask.why else ''}", MAX_NOTE),
                decision=_decision(ask, proposal.hash, approved=False),
                word=_word(ask),
            )
        )

    def _pause(self, ask: PauseAsk) -> None:
        keeper = self._keeper
        if not may_pause(keeper.record, ask):
            return
        pause = Pause(by=ask.by, why=ask.why, act=ask.act, at_ns=time.time_ns())
        keeper.apply(keeper.transition(TransitionKind.PAUSED, pause=pause))
        if ask.hold:
            for each in machine.active(keeper.record):
                self._start(self._make_ready_to_leave(each, pause.text))

    def _resume(self, ask: ResumeAsk) -> None:
        keeper = self._keeper
        if may_resume(keeper.record, ask):
            pause = Pause(by=ask.by, why=ask.why, act=ask.act, at_ns=time.time_ns())
            keeper.apply(keeper.transition(TransitionKind.RESUMED, pause=pause))
            self._go_on()

    def _retry(self, ask: RetryAsk) -> None:
        keeper = self._keeper
        if not may_retry(keeper.record, ask):
            return
        left = [each for each in machine.active(keeper.record) if each.subtask.id == ask.subtask]
        note = f"tried again by {ask.by or 'an operator'}"
        keeper.apply(keeper.transition(TransitionKind.RETRIED, subtask=ask.subtask, note=note, word=_word(ask)))
        self._leaving.extend(left)
        self._go_on()

    # --- robots -------------------------------------------------------------------------------------------------

    def _follow_stops(self) -> None:
        keeper, commands = self._keeper, self._around.commands
        needed = needed_robots(keeper.record)
        for stop in commands.active:
            hit = tuple(each for each in needed if commands.holds(stop, each))
            if hit and not any(each.stop == stop.id for each in keeper.record.pauses):
                pause = Pause(by=stop.by, why=stop.why, stop=stop.id, robots=hit, at_ns=time.time_ns())
                keeper.take(keeper.transition(TransitionKind.PAUSED, pause=pause))
        for pause in keeper.record.pauses:
            if pause.stop and commands.ended(pause.stop, pause.robots):
                keeper.take(keeper.transition(TransitionKind.RESUMED, pause=pause))
                self._go_on()

    def _hold(self, target: SubtaskRecord, why: str) -> None:
        keeper = self._keeper
        held = keeper.transition(
            TransitionKind.HELD, subtask=target.subtask.id, attempt=target.attempt, note=clean(why, MAX_NOTE)
        )
        if keeper.take(held):
            self._leaving.append(target)

    def _go_on(self) -> None:
        """Let subtasks that waited be looked at at once."""
        for each in machine.ready(self._keeper.record):
            self._pace.goes(each.subtask.id)
            self._pace.not_before.pop(each.subtask.id, None)

    # --- runs ---------------------------------------------------------------------------------------------------

    async def _end(self, target: SubtaskRecord) -> None:
        """Have a run end that the record has left, until its gateway says that it has."""
        for _ in range(END_TRIES):
            status = await self._orders.ask(target, self._keeper.record.id, "run_cancel")
            if status is not None and not status.running:
                return
            await asyncio.sleep(self._around.config.check_s)

    async def _make_ready_to_leave(self, target: SubtaskRecord, why: str) -> None:
        """Have a run save a checkpoint, where its skill can; then it may be left."""
        try:
            manifest = self._around.manifest(target.subtask.skill)
        except NotFoundError:
            return
        if not manifest.checkpoints or manifest.mobility == "never":
            return  # it goes on to its end
        if await self._orders.hold(target, self._keeper.record.id):
            note = f"held at its checkpoint: {why}"
            self._tell(RunHeld(subtask=target.subtask.id, attempt=target.attempt, note=note))

    async def _let_go_on(self, target: SubtaskRecord) -> None:
        await self._orders.ask(target, self._keeper.record.id, "run_resume")

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work, name=f"steer {self._keeper.record.id}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def revived(record: TaskRecord, ask: RetryAsk, *, elapsed_s: float) -> dict[str, Any] | None:
    """Return the fields of the transition that begins a task again that has ended; None when that was done.

    A deadline that has passed is dropped: with it the task would end at once.
    """
    if not may_retry(record, ask):
        return None
    return {
        "subtask": ask.subtask,
        "note": f"tried again by {ask.by or 'an operator'}",
        "word": _word(ask),
        "deadline_s": record.deadline_s if record.deadline_s > elapsed_s else 0.0,
    }


def _word(ask: RejectAsk | RetryAsk) -> Word:
    return Word(by=ask.by, why=ask.why, act=ask.act, at_ns=time.time_ns())


def _decision(ask: ApproveAsk | RejectAsk, of: str, *, approved: bool, edited: bool = False) -> Decision:
    return Decision(
        approved=approved, by=ask.by, why=ask.why, hash=of, edited=edited, act=ask.act, at_ns=time.time_ns()
    )
