"""Revises a task's plan when a subtask was given up: the thin shell around `replan.decide`.

Each step is a transition of its own, written before anything follows from it. What the decomposer proposes is in the
record before it takes effect, so that a coordinator that takes over does not ask again; runs that the new plan leaves
out are ended first, while what finishes meanwhile is finished.
"""

import asyncio
from collections.abc import Callable

import structlog

from appliance.errors import PlanError, SwiftbotError
from appliance.model import Plan, SubtaskRecord, TaskState
from appliance.tasks import machine, revising
from appliance.tasks.bounds import MAX_NOTE, clean
from appliance.tasks.hearing import Hearing
from appliance.tasks.keeper import Keeper
from appliance.tasks.machine import TransitionKind
from appliance.tasks.orders import Orders
from appliance.tasks.pace import Pace
from appliance.tasks.replan.allowed import allowed_robot
from appliance.tasks.replan.decide import AskDecomposer, GiveUp, confirmed, decide
from appliance.tasks.replan.robots import Rebinding, robot_of
from appliance.tasks.replan.skills import Substitution
from appliance.tasks.replan.splice import problems, splice
from appliance.tasks.surroundings import Input, PlanMade, Surroundings

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
            while self._asking is None and (stranded := revising.stranded(self._keeper.record)):
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
