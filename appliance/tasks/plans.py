"""Plans of the tasks that one gateway drives: made by the decomposer, checked, approved by a person, and revised.

`Plans` makes and checks plans by what is known of robots, skills and site just now, and says whether a person has to
agree first. `Recovery` has what coordinators need to find runs that go wrong and to revise plans: facts, counters, and
the way to the decomposer.
"""

from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence

import structlog
from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.llm.cascade import Decomposer
from appliance.llm.checks.schema import validate
from appliance.llm.settings import PlanContext
from appliance.model import Plan, Site, SubtaskRecord, SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue, SkillManifest
from appliance.tasks.admission import checked
from appliance.tasks.api import ExperienceAsk, ExperienceList, PlanAnswer, PlanAsk, PlanCheckAsk, PlanChecked, TaskAsk
from appliance.tasks.durations import Durations
from appliance.tasks.machine import ACTIVE, plan_hash
from appliance.tasks.replan import Robots, problems, remainder, splice
from appliance.tasks.replan import problems as unspliced
from appliance.tasks.settings import TasksConfig
from appliance.tasks.steering import needs_approval
from appliance.tasks.transition import Transition

log = structlog.get_logger(__name__)


class Recovery:
    """One per gateway, shared by its drivers.

    Args:
        plane: the fleet.
        catalogue: the skills known here.
        decomposer: who plans anew.
        site: the map plans are checked against.
        durations: how long runs took.
        busy: robots with a run in progress.
    """

    def __init__(
        self,
        plane: Plane,
        *,
        catalogue: Catalogue,
        decomposer: Decomposer,
        site: Site,
        durations: Durations,
        busy: Callable[[], Collection[str]],
    ) -> None:
        self._plane = plane
        self._catalogue = catalogue
        self._decomposer = decomposer
        self._site = site
        self._durations = durations
        self._busy = busy
        self.counts: Counter[str] = Counter()
        """What was found and done, by kind, since start."""
        self.on_published: Callable[[Transition], None] = lambda _: None
        """Hears of each transition that is published here."""

    @property
    def manifests(self) -> Mapping[str, SkillManifest]:
        """Manifests by skill, of those known here."""
        return self._catalogue.skills

    def robots(self) -> Robots:
        """The roster as it is known now."""
        experience = self._decomposer.memory.experience
        return Robots(roster=self._plane.registry.robots, busy=self._busy(), shuns=experience.shuns)

    def experience(self, skill: str) -> Sequence[float]:
        """How long the last runs of a skill took, seconds."""
        return self._durations.seen(skill)

    def published(self, transition: Transition) -> None:
        """Hear of a transition that was published."""
        self.on_published(transition)

    def note(self, what: str, record: TaskRecord, target: SubtaskRecord, why: str) -> None:
        """Count what was found or done, and say it in the log."""
        self.counts[what] += 1
        log.info(
            f"monitor: {what}",
            task=record.id,
            subtask=target.subtask.id,
            attempt=target.attempt,
            skill=target.subtask.skill,
            why=why,
        )

    async def replan(self, record: TaskRecord) -> Plan:
        """Have the decomposer plan anew what is left of a task.

        Raises:
            PlanError: it cannot; the message says why.
        """
        context = self._context(record)
        manifests = self._catalogue.skills
        outcome = await self._decomposer.replan(
            record,
            context,
            problems=lambda plan: problems(record, plan, manifests),
            rest=lambda plan: rest_of(record, plan),
        )
        return outcome.plan

    def against(self, record: TaskRecord, target: SubtaskRecord, plan: Plan, robot: str = "") -> tuple[str, ...]:
        """Say what a revised plan makes wrong that was not wrong before, by the checks that every plan has to pass.

        Args:
            record: the task as it stands.
            target: the subtask that was given up.
            plan: the task's plan from then on.
            robot: who takes over from the robot of `target`; "" when nobody does.
        """
        context = self._context(record)
        wrong = self._decomposer.review(remainder(record, target, plan, robot), context).problems
        if not wrong:
            return ()
        # A robot that has left meanwhile, say, is no reason against what is done about another's failure.
        before = remainder(record, target, record.plan, "") if record.plan is not None else plan
        known = frozenset(self._decomposer.review(before, context).problems)
        return tuple(each for each in wrong if each not in known)

    def _context(self, record: TaskRecord) -> PlanContext:
        """What is known now that bears on a task, and whose it is: a robot's task stays a robot's."""
        roster = self._plane.registry.robots
        return PlanContext(
            instruction=record.instruction,
            robots=tuple(sorted(roster.values(), key=lambda robot: robot.id)),
            site=self._site,
            submitter=record.submitter,
            from_robot=record.submitter in roster,
        )


def rest_of(record: TaskRecord, proposed: Plan) -> Plan:
    """Return what of a new plan is still to be begun, as a plan of its own: only that must hold today.

    A robot that has finished its part may have left the fleet since.
    """
    spliced = splice(record, proposed)
    begun = {
        each.subtask.id for each in record.subtasks if each.state is SubtaskState.SUCCEEDED or each.state in ACTIVE
    }
    rest = [each for each in spliced.plan.subtasks if each.id not in begun]
    if not rest:
        problems = ("plan what is to be done instead",)
        raise PlanError("the new plan has nothing left to do", remedy="submit it as a new task", problems=problems)
    ids = {each.id for each in rest}
    return replace(
        proposed, subtasks=tuple(replace(each, after=tuple(one for one in each.after if one in ids)) for each in rest)
    )


class Plans:
    """Makes and checks plans by what is known of robots, skills and site just now; `task` finds a task's record."""

    def __init__(
        self,
        config: TasksConfig,
        plane: Plane,
        *,
        catalogue: Catalogue,
        decomposer: Decomposer,
        site: Site,
        task: Callable[[TaskAsk], Awaitable[TaskRecord]],
    ) -> None:
        self._config = config
        self._plane = plane
        self._catalogue = catalogue
        self._decomposer = decomposer
        self._site = site
        self._task = task

    async def plan(self, record: TaskRecord) -> Plan:
        """Return the plan handed in with the task if it is valid, else a new one."""
        context = self._context(record.instruction, submitter=record.submitter)
        if record.plan is not None:
            if problems := self._decomposer.review(record.plan, context).problems:
                remedy = "correct what the message lists and submit the plan again"
                raise PlanError("the plan handed in is not valid", remedy=remedy, problems=problems)
            return record.plan
        return (await self._decomposer.plan(context)).plan

    def approval(self, record: TaskRecord, plan: Plan) -> str:
        """Why a plan has to be approved before it takes effect; "" when it need not be."""
        wanted = needs_approval(
            plan,
            record.approval.stricter(self._config.approval),
            manifests=self._catalogue.skills,
            robots=self._plane.registry.robots,
        )
        # A person who hands in a plan has seen it; a robot's, or one that was made here, nobody has.
        doubts: tuple[str, ...] = ()
        if not record.handed_in:
            doubts = plan.provenance.confirm if plan.provenance is not None else ()
        elif record.submitter in self._plane.registry.robots:
            context = self._context(record.instruction, submitter=record.submitter)
            doubts = self._decomposer.review(plan, context).holds
        return "; ".join((*doubts, wanted) if wanted else doubts)

    def problems(self, record: TaskRecord | None, plan: Plan) -> tuple[str, ...]:
        """What is wrong with a plan just now; of a task that runs, with the continuation that it is."""
        if record is not None and record.state is TaskState.RUNNING:
            wrong = validate(plan, self._catalogue) or unspliced(record, plan, self._catalogue.skills)
            if wrong:
                return tuple(wrong)
            try:
                plan = rest_of(record, plan)
            except PlanError as error:
                return (error.message, *error.problems)
        submitter, instruction = (record.submitter, record.instruction) if record is not None else ("", "")
        return self._decomposer.review(plan, self._context(instruction, submitter=submitter)).problems

    async def check(self, ask: PlanCheckAsk) -> PlanChecked:
        """Answer `plan_check`."""
        record = await self._task(TaskAsk(id=ask.task)) if ask.task else None
        wrong = self.problems(record, ask.plan)
        wanted = self._config.approval.stricter(record.approval) if record is not None else self._config.approval
        skills, robots = self._catalogue.skills, self._plane.registry.robots
        approval = "" if wrong else needs_approval(ask.plan, wanted, manifests=skills, robots=robots)
        return PlanChecked(problems=wrong, hash=plan_hash(ask.plan), approval=approval)

    async def propose(self, ask: PlanAsk) -> PlanAnswer:
        """Decompose an instruction against the present roster and site; run nothing."""
        instruction = checked(TaskRequest(instruction=ask.instruction), self._config).instruction
        context = self._context(instruction, private=ask.private)
        outcome = await self._decomposer.plan(context)
        analysis = self._decomposer.analyse(context, outcome.plan)
        return PlanAnswer(plan=outcome.plan, attempts=outcome.attempts, analysis=analysis)

    def _context(self, instruction: str, *, submitter: str = "", private: bool = False) -> PlanContext:
        """What is known now that bears on an instruction."""
        roster = self._plane.registry.robots
        return PlanContext(
            instruction=instruction,
            robots=tuple(sorted(roster.values(), key=lambda robot: robot.id)),
            site=self._site,
            private=private,
            submitter=submitter,
            from_robot=submitter in roster,
        )

    async def experience(self, ask: ExperienceAsk) -> ExperienceList:
        """Tell how skills have done on robots lately, by what this gateway has heard."""
        memory = self._decomposer.memory
        return ExperienceList(
            gateway=self._plane.gateway,
            rows=tuple(memory.experience.rows()[: max(0, ask.limit)]),
            thresholds=memory.thresholds.all,
        )
