"""Checks of things: what is picked up is known to the site, and the robot goes to where it is. Pure."""

from collections.abc import Iterable

from appliance.llm.checks.finding import Facts, Finding, Severity
from appliance.llm.checks.reading import stem
from appliance.model import Site, SiteObject, Subtask

REACH_M = 2.0
"""A robot this near to a thing can take it."""


def known_thing(name: str, site: Site) -> SiteObject | None:
    """Return the object of a site that a name means: all of its words, in the singular; None when none does."""
    words = {stem(each) for each in name.lower().split()}
    for each in site.objects:
        own = {stem(word) for word in each.name.lower().split()}
        if words == own or (
            words < own and sum(words < {stem(w) for w in o.name.lower().split()} for o in site.objects) == 1
        ):
            return each
    return None


def elsewhere(facts: Facts) -> Iterable[Finding]:
    """A robot that takes a thing is sent to where the site knows it to be, or stands there."""
    if facts.site is None:
        return
    for subtask in facts.plan.subtasks:
        if (where := away(facts, subtask)) is not None:
            thing = subtask.params.get("object")
            yield Finding(
                check="elsewhere", severity=Severity.HOLD,
                message=f"{subtask.id}: {thing} is at {where}, and {subtask.robot} is not sent there",
                hint=f"say where: go to {where}, then ...",
            )  # fmt: skip


def away(facts: Facts, subtask: Subtask) -> str | None:
    """Return where the thing is that a subtask takes, if its robot is neither sent there nor stands there."""
    site = facts.site
    manifest = facts.manifest(subtask)
    if site is None or manifest is None or "load" not in manifest.ties or subtask.robot is None:
        return None
    thing = known_thing(str(subtask.params.get("object", "")), site)
    place = site.find(thing.at) if thing is not None else None
    if thing is None or place is None:
        return None
    moved = [
        each for each in facts.plan.subtasks
        if each.robot == subtask.robot and each.id in facts.before[subtask.id]
        and (m := facts.manifest(each)) is not None and m.moves_robot
    ]  # fmt: skip
    if any(site.find(str(each.params.get("place", ""))) is place for each in moved if each.skill == "goto"):
        return None
    if moved:
        return None  # it was sent somewhere by name: that is where the words say the thing is
    robot = next((each for each in facts.robots or () if each.id == subtask.robot), None)
    pose = robot.pose if robot is not None else None
    if pose is not None and (pose.x - place.x) ** 2 + (pose.y - place.y) ** 2 <= REACH_M**2:
        return None
    return thing.at


def unknown_thing(facts: Facts) -> Iterable[Finding]:
    """What is taken, opened or switched is a thing of the site, where the site lists such things."""
    site = facts.site
    if site is None:
        return
    held = {each.holding for each in facts.robots or () if each.holding}
    taken: set[str] = set(held)
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        if manifest is None or not manifest.at_object:
            continue
        name = str(subtask.params.get("object", ""))
        if not name:
            continue
        listed: list[str] = []
        if "load" in manifest.ties or "load" in manifest.frees:
            listed = [each.name for each in site.objects]
            if listed and known_thing(name, site) is not None:
                taken.add(name)
                continue
        else:
            listed = [each.name for each in (*site.doors, *site.devices)]
        if listed and name not in taken and not any(_like(name, each) for each in listed):
            known = ", ".join(listed[:8])
            yield Finding(
                check="unknown_thing", severity=Severity.HOLD, words=(name,),
                message=f'{subtask.id}: the site knows no "{name}"', hint=f"it knows {known}",
            )  # fmt: skip


def _like(name: str, other: str) -> bool:
    one, two = ({stem(word) for word in each.lower().split()} for each in (name, other))
    return one == two or two <= one
