"""What a plan leaves to the site and the roster: the way to a thing, and the one robot that can do it. Pure.

An order such as "fetch the red box" names no place; the site knows where the box is, so its robot is sent there first.
An order that names no robot is given to the one robot that can do it, where there is only one.
"""

from msgspec.structs import replace

from appliance.llm.checks.finding import Facts
from appliance.llm.checks.policy import robots_of
from appliance.llm.checks.robots import candidates
from appliance.llm.checks.schema import is_unnamed
from appliance.llm.checks.things import away
from appliance.llm.safety.settings import SafetyConfig
from appliance.llm.settings import PlanContext
from appliance.model import Plan, Subtask
from appliance.skills.catalogue import Catalogue

_POLICY = SafetyConfig()


def completed(plan: Plan, context: PlanContext, catalogue: Catalogue) -> Plan:
    """Return a plan with what the site and the roster leave no choice of; one that is not valid is returned as it is.

    Args:
        plan: as a planner proposed it.
        context: roster and site; what is unknown adds nothing.
        catalogue: the skills there are.
    """
    if len({each.id for each in plan.subtasks}) != len(plan.subtasks) or len(plan.subtasks) > 63:
        return plan
    facts = Facts(plan, context, catalogue, _POLICY)
    bound = _bound(facts)
    if bound is not plan:
        facts = Facts(bound, context, catalogue, _POLICY)
    return _with_ways(facts)


def _bound(facts: Facts) -> Plan:
    """Give what is asked of an unnamed robot to the only one that can do it."""
    if not facts.robots:
        return facts.plan
    only: dict[str, str] = {}
    labels = {name for each in facts.plan.subtasks for name in robots_of(each) if is_unnamed(name)}
    for label in labels:
        able = candidates(facts, label)
        if len(able) == 1 and len(labels) == 1:
            only[label] = able[0]
    if not only:
        return facts.plan
    subtasks = tuple(
        replace(each, robot=only.get(each.robot, each.robot)) if each.robot else each for each in facts.plan.subtasks
    )
    return replace(facts.plan, subtasks=subtasks)


def _with_ways(facts: Facts) -> Plan:
    """Send a robot to a thing that it takes, where the site knows the thing to be elsewhere."""
    if facts.site is None or "goto" not in facts.catalogue.skills:
        return facts.plan
    subtasks: list[Subtask] = []
    added = False
    taken = {each.id for each in facts.plan.subtasks}
    for subtask in facts.plan.subtasks:
        where = away(facts, subtask)
        if where is None:
            subtasks.append(subtask)
            continue
        number = next(n for n in range(1, 200) if f"way{n}" not in taken)
        taken.add(f"way{number}")
        way = Subtask(
            id=f"way{number}", skill="goto", robot=subtask.robot, params={"place": where}, after=subtask.after
        )
        subtasks += [way, replace(subtask, after=(way.id,))]
        added = True
    if not added:
        return facts.plan
    names = {each.id: f"s{number}" for number, each in enumerate(subtasks, start=1)}
    renamed = tuple(
        replace(each, id=names[each.id], after=tuple(names.get(other, other) for other in each.after))
        for each in subtasks
    )
    return replace(facts.plan, subtasks=renamed)
