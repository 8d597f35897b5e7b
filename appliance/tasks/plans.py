"""Plans of the tasks that one gateway drives: made by the decomposer, checked, approved by a person, and revised."""

from collections.abc import Awaitable, Callable, Collection, Sequence

from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.llm.cascade import Decomposer
from appliance.llm.checks.safety import involved, kept_from, out_of_use
from appliance.llm.checks.schema import validate
from appliance.llm.settings import OutOfUse, PlanContext
from appliance.model import (
    Plan,
    RobotInfo,
    Site,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
)
from appliance.model.task_api import (
    ExperienceAsk,
    ExperienceList,
    PlanAnswer,
    PlanAsk,
    PlanCheckAsk,
    PlanChecked,
    TaskAsk,
)
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue
from appliance.tasks.admission import checked
from appliance.tasks.allocation import cost
from appliance.tasks.machine import ACTIVE, plan_hash
from appliance.tasks.replan import Robots, problems, remainder, splice
from appliance.tasks.settings import TasksConfig
from appliance.tasks.steering import needs_approval


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
    """Makes, checks and revises plans by what is known of robots, skills and site just now.

    Args:
        config: whether plans have to be approved.
        plane: the fleet.
        catalogue: the skills known here.
        decomposer: makes and reviews plans.
        site: the map plans are checked against.
        task: finds a task's record.
        busy: robots with a run in progress.
        out_of_use: places that are closed, robots in maintenance, standing rules.
    """

    def __init__(
        self,
        config: TasksConfig,
        plane: Plane,
        *,
        catalogue: Catalogue,
        decomposer: Decomposer,
        site: Site,
        task: Callable[[TaskAsk], Awaitable[TaskRecord]],
        busy: Callable[[], Collection[str]],
        out_of_use: Callable[[], OutOfUse] = OutOfUse,
    ) -> None:
        self._config = config
        self._plane = plane
        self._catalogue = catalogue
        self._decomposer = decomposer
        self._site = site
        self._task = task
        self._busy = busy
        self._out_of_use = out_of_use

    def closed(self, subtask: Subtask) -> str:
        """Why a subtask may not begin just now: where it goes is closed; empty when it may."""
        context = PlanContext(instruction="", site=self._site, out_of_use=OutOfUse(places=self._out_of_use().places))
        return "; ".join(out_of_use(subtask, context, self._catalogue))

    def kept_from(self, subtask: Subtask, robot: str) -> str:
        """Which standing rule keeps a robot, or one that works beside it, from a subtask now; "" when none does."""
        context = self._context("")
        for each in dict.fromkeys((robot, *involved(subtask, context))) if context.out_of_use.rules else ():
            if why := kept_from(subtask, each, context, self._catalogue):
                return why if each == robot else f"held up: {each} is {why}"
        return ""

    def robots(self) -> Robots:
        """The roster as it is known now."""
        experience = self._decomposer.memory.experience
        return Robots(roster=self._plane.registry.robots, busy=self._busy(), shuns=experience.shuns, short=self._short)

    async def plan(self, record: TaskRecord) -> Plan:
        """Return the plan handed in with the task if it is valid, else a new one."""
        context = self._context(record.instruction, submitter=record.submitter)
        if record.plan is not None:
            if problems := self._decomposer.review(record.plan, context).problems:
                remedy = "correct what the message lists and submit the plan again"
                raise PlanError("the plan handed in is not valid", remedy=remedy, problems=problems)
            return record.plan
        return (await self._decomposer.plan(context)).plan

    async def replan(self, record: TaskRecord) -> Plan:
        """Have the decomposer replan what is left of a task.

        Raises:
            PlanError: it cannot; the message says why.
        """
        context = self._context(record.instruction, submitter=record.submitter)
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
        context = self._context(record.instruction, submitter=record.submitter)
        wrong = self._decomposer.review(remainder(record, target, plan, robot), context).problems
        if not wrong:
            return ()
        # A robot that has left meanwhile, say, is no reason against what is done about another's failure.
        before = remainder(record, target, record.plan, "") if record.plan is not None else plan
        known = frozenset(self._decomposer.review(before, context).problems)
        return tuple(each for each in wrong if each not in known)

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
            doubts = (*doubts, *self.below_reserve(plan))
        elif record.submitter in self._plane.registry.robots:
            context = self._context(record.instruction, submitter=record.submitter)
            doubts = (*self._decomposer.review(plan, context).holds, *self.below_reserve(plan))
        return "; ".join((*doubts, wanted) if wanted else doubts)

    def below_reserve(self, plan: Plan) -> tuple[str, ...]:
        """Which robots that a plan names would end below the reserve of their battery, in words."""
        roster = self._plane.registry.robots
        named = dict.fromkeys(name for each in plan.subtasks for name in each.robots if name in roster)
        short = [self._short(roster[name], [each for each in plan.subtasks if name in each.robots]) for name in named]
        return tuple(filter(None, short))

    def _short(self, robot: RobotInfo, subtasks: Sequence[Subtask]) -> str:
        """Why a robot would end below its reserve, in words; "" when it would not."""
        expected = self._decomposer.memory.experience.expected_s
        return cost(robot, subtasks, site=self._site, expected=expected, battery=self._config.battery).short

    def problems(self, record: TaskRecord | None, plan: Plan) -> tuple[str, ...]:
        """What is wrong with a plan just now; of a task that runs, with the continuation that it is."""
        if record is not None and record.state is TaskState.RUNNING:
            wrong = validate(plan, self._catalogue) or problems(record, plan, self._catalogue.skills)
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
            out_of_use=self._out_of_use(),
        )

    async def experience(self, ask: ExperienceAsk) -> ExperienceList:
        """Tell how skills have done on robots lately, by what this gateway has heard."""
        memory = self._decomposer.memory
        return ExperienceList(
            gateway=self._plane.gateway,
            rows=tuple(memory.experience.rows()[: max(0, ask.limit)]),
            thresholds=memory.thresholds.all,
        )
