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
        return Robots(roster=self._plane.registry.robots, busy=self._busy())

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
        robots = tuple(sorted(self._plane.registry.robots.values(), key=lambda robot: robot.id))
        context = PlanContext(instruction=record.instruction, robots=robots, site=self._site)
        manifests = self._catalogue.skills
        outcome = await self._decomposer.replan(
            record,
            context,
            problems=lambda plan: problems(record, plan, manifests),
            rest=lambda plan: rest_of(record, plan),
        )
        return outcome.plan


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
        raise PlanError("the new plan has nothing left to do", problems=("plan what is to be done instead",))
    ids = {each.id for each in rest}
    return replace(
        proposed, subtasks=tuple(replace(each, after=tuple(one for one in each.after if one in ids)) for each in rest)
    )
