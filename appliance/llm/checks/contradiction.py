"""Orders of one plan that cannot both be carried out. Pure.

Only what is certain counts: two subtasks that nothing orders, of which one undoes the other, or that send the same
robot to two places at once.
"""

from collections.abc import Iterable
from itertools import combinations

from appliance.model import Plan, Subtask
from appliance.skills.catalogue import Catalogue


def contradictions(plan: Plan, catalogue: Catalogue) -> Iterable[str]:
    """Return the pairs that contradict each other, each with a remedy."""
    before = precedes(plan)
    for one, other in combinations(plan.subtasks, 2):
        if one.id in before[other.id] or other.id in before[one.id]:
            continue
        if _opposite(one, other, catalogue) and _same_thing(one, other, plan, before, catalogue):
            thing = one.params.get("object") or one.robot
            yield (
                f"{one.id} and {other.id}: {one.skill} and {other.skill} of {str(thing)[:60]} at the same time "
                "contradict each other: say which comes first"
            )
        elif (
            one.robot
            and one.robot == other.robot != "all"
            and _holds_base(one, catalogue)
            and _holds_base(other, catalogue)
            and _differ(one, other)
        ):
            yield (
                f"{one.id} and {other.id}: {one.robot} cannot do {one.skill} and {other.skill} at the same time: "
                "say which comes first, or name another robot"
            )


def precedes(plan: Plan) -> dict[str, set[str]]:
    """Return for each subtask all that come before it, directly or not; a circle's members precede each other."""
    direct = {each.id: list(each.after) for each in plan.subtasks}
    found: dict[str, set[str]] = {}
    for name, first in direct.items():
        seen: set[str] = set()
        waiting = list(first)
        while waiting:
            each = waiting.pop()
            if each not in seen:
                seen.add(each)
                waiting += direct.get(each, ())
        found[name] = seen
    return found


def _holds_base(subtask: Subtask, catalogue: Catalogue) -> bool:
    """Whether a subtask takes a robot's whole body somewhere, or keeps it there."""
    manifest = catalogue.skills.get(subtask.skill)
    return manifest is not None and "base" in manifest.uses and not manifest.joint


def _opposite(one: Subtask, other: Subtask, catalogue: Catalogue) -> bool:
    manifest = catalogue.skills.get(one.skill)
    if manifest is None or other.skill not in manifest.opposite_of or "load" in (*manifest.ties, *manifest.frees):
        return False  # what one robot puts down another may take
    if manifest.flying:
        return one.robot == other.robot
    return one.params.get("object") == other.params.get("object")


def _same_thing(one: Subtask, other: Subtask, plan: Plan, before: dict[str, set[str]], catalogue: Catalogue) -> bool:
    """Whether two robots mean one thing by a name: not at different places, and not where each does both in order."""
    if one.robot == other.robot:
        return True
    if _went(one, plan, before) != _went(other, plan, before):
        return False
    thing = one.params.get("object")
    own = [
        (first, then)
        for first, then in combinations(plan.subtasks, 2)
        if first.robot == then.robot and _opposite(first, then, catalogue) and first.params.get("object") == thing
    ]
    return not any(first.id in before[then.id] or then.id in before[first.id] for first, then in own)


def _went(subtask: Subtask, plan: Plan, before: dict[str, set[str]]) -> frozenset[str]:
    """Where its robot was sent before."""
    return frozenset(
        str(each.params.get("place"))
        for each in plan.subtasks
        if each.skill == "goto" and each.robot == subtask.robot and each.id in before[subtask.id]
    )


def _differ(one: Subtask, other: Subtask) -> bool:
    """Whether two moves are not the same said twice."""
    return (one.skill, one.params) != (other.skill, other.params)
