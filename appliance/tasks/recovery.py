"""What drivers need to find runs that go wrong and to revise plans: facts, counters, and the way to the decomposer."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence

import structlog
from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.llm.cascade import Decomposer
from appliance.llm.settings import PlanContext
from appliance.model import Plan, Site, SubtaskRecord, SubtaskState, TaskRecord
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue, SkillManifest
from appliance.tasks.durations import Durations
from appliance.tasks.replan.allowed import remainder
from appliance.tasks.replan.robots import Robots
from appliance.tasks.replan.splice import problems, splice
from appliance.tasks.revising import ACTIVE
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
