"""What a plan leaves to the site and the roster: the way to a thing, and the one robot that can do it. Pure.

An order such as "fetch the red box" names no place; the site knows where the box is, so its robot is sent there first.
An order that names no robot is given to the one robot that can do it, where there is only one; one to "a drone" to a
drone, since the scheduler would choose among all robots that can do it.
"""

import re

from msgspec.structs import replace

from appliance.llm.checks.facts import Facts, text_said
from appliance.llm.checks.places import locate
from appliance.llm.checks.robots import candidates
from appliance.llm.checks.safety import robots_of
from appliance.llm.checks.schema import is_unnamed
from appliance.llm.checks.things import away, sent_elsewhere
from appliance.llm.settings import PlanContext, SafetyConfig
from appliance.llm.shortlist import NOT_DOING, natural
from appliance.model import Plan, Subtask
from appliance.skills.catalogue import Catalogue

_POLICY = SafetyConfig()
WAY = "goto"
"""The skill that takes a robot to a place."""


def completed(plan: Plan, context: PlanContext, catalogue: Catalogue) -> tuple[Plan, frozenset[str]]:
    """Return a plan with what the site and the roster leave no choice of, and the ids of the ways that were added.

    One that is not valid is returned as it is.

    Args:
        plan: as a planner proposed it.
        context: roster and site; what is unknown adds nothing.
        catalogue: the skills there are.
    """
    if len({each.id for each in plan.subtasks}) != len(plan.subtasks) or len(plan.subtasks) > 63:
        return plan, frozenset()
    facts = Facts(plan, context, catalogue, _POLICY)
    for step in (_bound, _sent, _met):
        facts = Facts(step(facts), context, catalogue, _POLICY)
    return _with_ways(facts)


def _bound(facts: Facts) -> Plan:
    """Give what is asked of an unnamed robot to the only one that can do it, and of "a drone" to a drone."""
    if not facts.robots:
        return facts.plan
    labels = sorted({name for each in facts.plan.subtasks for name in robots_of(each) if is_unnamed(name)})
    used = {name for each in facts.plan.subtasks for name in robots_of(each)}
    # "A drone follows drone_1": a robot that has a name in the words is not the one without.
    used |= {name for each in facts.reading.tokens if each.group == "one" or each.listed for name in each.robots}
    there = {each.id: each.online for each in facts.robots}
    only: dict[str, str] = {}
    for label in labels:
        able = candidates(facts, label)
        meant = _one_of(facts, label)
        within = [each for each in able if each in meant]
        free = [each for each in within if each not in used and each not in only.values()]
        if free and len(within) < len(able):
            # Any robot could be chosen otherwise, and the words say which kind.
            only[label] = min(free, key=lambda each: (not there[each], natural(each)))
        elif len(able) == 1 and len(labels) == 1:
            only[label] = able[0]
    if not only:
        return facts.plan
    subtasks = tuple(
        replace(each, robot=only.get(each.robot, each.robot)) if each.robot else each for each in facts.plan.subtasks
    )
    return replace(facts.plan, subtasks=subtasks)


def _one_of(facts: Facts, label: str) -> frozenset[str]:
    """The robots one of which the words have do what a plan gives to an unnamed one; none where that is not clear."""
    tokens, sentence = facts.reading.tokens, facts.reading.sentence
    values = set[int]().union(*facts.account.values.values())
    doing = [
        number
        for number, each in enumerate(tokens)
        if each.kind == "robot"
        and each.robots
        and number not in values
        and not (number and tokens[number - 1].text in NOT_DOING)
    ]
    said: set[tuple[str, frozenset[str]]] = set()
    for each in facts.plan.subtasks:
        if label in robots_of(each):
            for index in facts.account.values[each.id] or facts.account.called[each.id]:
                earlier = [number for number in doing if number <= index]
                there = [number for number in doing if sentence[number] == sentence[index]]
                # "Photograph the gate with a drone": behind what it does, and nobody else is there.
                who = earlier[-1] if earlier else there[0] if len(there) == 1 else None
                said.add(("", frozenset()) if who is None else (tokens[who].group, frozenset(tokens[who].robots)))
    group, robots = next(iter(said)) if len(said) == 1 else ("", frozenset[str]())
    return robots if group == "any" else frozenset()


def _sent(facts: Facts) -> Plan:
    """Send a robot to a place of the site that is all that the words say: no words ask for more than the way there."""
    subtasks = tuple(_way_only(facts, each) for each in facts.plan.subtasks)
    return replace(facts.plan, subtasks=subtasks) if subtasks != facts.plan.subtasks else facts.plan


_TO = re.compile(r"^(?:(?:over|on|back|up|down) )?(?:to|towards|at) (?:the )?", re.IGNORECASE)


def _spot(path: str, facts: Facts) -> str:
    """The one place or coordinate that a path is, without brackets; empty where it is more."""
    place = _TO.sub("", path.strip())
    place = place.strip("() ") if place.startswith("(") and place.endswith(")") else place
    known = facts.site is not None and locate(place, facts.site) is not None
    return place if known else ""


def _way_only(facts: Facts, subtask: Subtask) -> Subtask:
    manifest, values = facts.manifest(subtask), list(subtask.params.values())
    if manifest is None or facts.site is None or subtask.skill == WAY or WAY not in facts.catalogue.skills:
        return subtask
    stays = manifest.moves_robot and set(manifest.uses) == {"base"} and not facts.account.called[subtask.id]
    path = subtask.params.get("path")
    if isinstance(path, str) and len(values) == 1 and (spot := _spot(path, facts)):
        return replace(subtask, skill=WAY, params={"place": spot})  # one place is no path
    usual = [str(each.usual) for each in manifest.params.values() if isinstance(each.usual, str)]
    place = values[0] if len(values) == 1 and isinstance(values[0], str) else ""
    if not values and usual and text_said(facts.reading, usual[0], facts.site):
        place = usual[0]  # "rover_2 is needed at the charger"
    elif not facts.account.values[subtask.id]:
        return subtask
    if not stays or not place or facts.site.find(place) is None:
        return subtask
    return replace(subtask, skill=WAY, params={"place": place})


_WHERE = re.compile(r"(.+?) (?:at|in|by|near) (?:the )?(.+)")


def _met(facts: Facts) -> Plan:
    """Send a robot to where somebody is to whom it gives something: "hands it to Ana at the office"."""
    plan = facts.plan
    for subtask in plan.subtasks:
        to = subtask.params.get("to")
        manifest = facts.manifest(subtask)
        match = _WHERE.fullmatch(to) if isinstance(to, str) else None
        if match is None or facts.site is None or manifest is None or "load" not in manifest.frees:
            continue
        if facts.site.find(match[2]) is None or WAY not in facts.catalogue.skills or len(plan.subtasks) > 62:
            continue
        named = {each.id for each in plan.subtasks}
        way = Subtask(
            id=next(f"w{n}" for n in range(1, 99) if f"w{n}" not in named), skill=WAY, robot=subtask.robot,
            params={"place": match[2]}, after=subtask.after,
        )  # fmt: skip
        moved = replace(subtask, params={**subtask.params, "to": match[1]}, after=(way.id,))
        plan = replace(
            plan,
            subtasks=tuple(new for each in plan.subtasks for new in ((way, moved) if each is subtask else (each,))),
        )
    return plan if plan is facts.plan else _renumbered(plan)[0]


def _renumbered(plan: Plan) -> tuple[Plan, dict[str, str]]:
    """A plan with the ids s1, s2, ... in the order of its subtasks, and the new id of each old one."""
    names = {each.id: f"s{number}" for number, each in enumerate(plan.subtasks, start=1)}
    renamed = tuple(
        replace(each, id=names[each.id], after=tuple(names.get(other, other) for other in each.after))
        for each in plan.subtasks
    )
    return replace(plan, subtasks=renamed), names


def _with_ways(facts: Facts) -> tuple[Plan, frozenset[str]]:
    """Send a robot to where it takes or puts down a thing, where the plan sends it nowhere for that."""
    none = facts.plan, frozenset[str]()
    if facts.site is None or WAY not in facts.catalogue.skills:
        return none
    ways: dict[str, Subtask] = {}
    while len(ways) < 16:
        missing = next((each for each in facts.plan.subtasks if _needs_way(facts, each)), None)
        if missing is None:
            break
        way = Subtask(
            id=f"way{len(ways) + 1}", skill=WAY, robot=missing.robot, params={"place": away(facts, missing)},
            after=missing.after,
        )  # fmt: skip
        ways[way.id] = way
        subtasks = [
            new
            for each in facts.plan.subtasks
            for new in ((way, replace(each, after=(way.id,))) if each is missing else (each,))
        ]
        facts = Facts(replace(facts.plan, subtasks=tuple(subtasks)), facts.context, facts.catalogue, _POLICY)
    if not ways:
        return none
    plan, names = _renumbered(facts.plan)
    return plan, frozenset(names[each] for each in ways)


def _needs_way(facts: Facts, subtask: Subtask) -> bool:
    """Whether a way has to be added before a subtask: a thing is taken where it is known to be, or put down elsewhere.

    A robot that the words send somewhere and that is then to take a thing from another place is left to a person.
    """
    if away(facts, subtask) is None:
        return False
    manifest = facts.manifest(subtask)
    return manifest is not None and ("load" in manifest.frees or not sent_elsewhere(facts, subtask))
