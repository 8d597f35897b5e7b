"""Plans of the tasks that one gateway drives: made, checked, and whether a person has to agree to them first."""

from collections.abc import Awaitable, Callable

from appliance.errors import PlanError
from appliance.llm.cascade import Decomposer
from appliance.llm.checks.schema import validate
from appliance.llm.settings import PlanContext
from appliance.model import Plan, Site, TaskRecord, TaskRequest, TaskState
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue
from appliance.tasks.admission import checked
from appliance.tasks.api import ExperienceAsk, ExperienceList, PlanAnswer, PlanAsk, TaskAsk
from appliance.tasks.recovery import rest_of
from appliance.tasks.replan.splice import problems as unspliced
from appliance.tasks.settings import TasksConfig
from appliance.tasks.steering.api import PlanCheckAsk, PlanChecked
from appliance.tasks.steering.deciding import needs_approval
from appliance.tasks.steering.hashing import plan_hash


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
