"""Checks of things: what is picked up is known to the site, and the robot goes to where it is. Pure."""

import math
import re
from collections.abc import Iterable, Sequence

from appliance.llm.checks import lexicon as lx
from appliance.llm.checks.facts import Facts, text_said
from appliance.llm.checks.places import bare, locate, nearest, parts_of
from appliance.llm.checks.reading import Token, stem
from appliance.model import Finding, Severity, Site, SiteObject, Subtask
from appliance.skills.catalogue import SkillManifest

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
    """A robot that takes or puts down a thing is sent to where that is, or stands there."""
    if facts.site is None:
        return
    for subtask in facts.plan.subtasks:
        if (where := away(facts, subtask)) is not None:
            thing = subtask.params.get("object")
            yield Finding(
                check="elsewhere", severity=Severity.HOLD,
                message=f"{subtask.id} ({subtask.skill} {thing}): {subtask.robot} is not sent to {where}",
                hint=f"say where: go to {where}, then ...",
            )  # fmt: skip


def away(facts: Facts, subtask: Subtask) -> str | None:
    """Return the place of a subtask's thing, if its robot is neither sent there nor stands there.

    A thing that is taken is where an earlier subtask put it down, else where the site has it; one that is put down goes
    to the place that is named.
    """
    site = facts.site
    manifest = facts.manifest(subtask)
    if site is None or manifest is None or subtask.robot is None:
        return None
    where = _taken_at(facts, subtask) if "load" in manifest.ties else _put_at(manifest, subtask)
    place = site.find(where) if where else None
    if place is None:
        return None
    last = _last_way(facts, subtask)
    if last is not None:
        return None if site.find(str(last.params.get("place", ""))) is place or last.skill != "goto" else where
    robot = next((each for each in facts.robots or () if each.id == subtask.robot), None)
    pose = robot.pose if robot is not None else None
    if pose is not None and (pose.x - place.x) ** 2 + (pose.y - place.y) ** 2 <= REACH_M**2:
        return None
    return where


def sent_elsewhere(facts: Facts, subtask: Subtask) -> bool:
    """Whether the words send a subtask's robot somewhere for it: the last way before it has served nothing else yet."""
    way = _last_way(facts, subtask)
    return way is not None and not any(
        each.robot == subtask.robot and way.id in facts.before[each.id] and each.id in facts.before[subtask.id]
        for each in facts.plan.subtasks
    )


def _taken_at(facts: Facts, subtask: Subtask) -> str:
    """Where the thing is that a subtask takes; empty when that is not known."""
    name = str(subtask.params.get("object", ""))
    put = [
        str(each.params["at"]) for each in facts.plan.subtasks
        if each.id in facts.before[subtask.id] and each.params.get("object") == name and each.params.get("at")
    ]  # fmt: skip
    if put:
        return put[-1]
    thing = known_thing(name, facts.site) if facts.site is not None else None
    return thing.at if thing is not None else ""


def _put_at(manifest: SkillManifest, subtask: Subtask) -> str:
    """Where a subtask puts down what its robot holds; empty where it does not, or does not say."""
    puts = "load" in manifest.frees and manifest.at_object == "at"
    return str(subtask.params.get("at", "")) if puts else ""


def _last_way(facts: Facts, subtask: Subtask) -> Subtask | None:
    """The last subtask before one that takes its robot somewhere."""
    found = [
        each for each in facts.plan.subtasks
        if each.robot == subtask.robot and each.id in facts.before[subtask.id]
        and (m := facts.manifest(each)) is not None and m.moves_robot
    ]  # fmt: skip
    return max(found, key=lambda each: len(facts.before[each.id])) if found else None


def not_held(facts: Facts) -> Iterable[Finding]:
    """A robot puts down or gives what it holds, or has picked up before."""
    if facts.robots is None or facts.continued or _HOLDS & {each.text for each in facts.reading.tokens}:
        return
    holding = {each.id: each.holding for each in facts.robots}
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        if manifest is None or "load" not in manifest.frees or subtask.robot is None:
            continue
        thing = subtask.params.get("object")
        taken = any(
            each.params.get("object") == thing and each.id in facts.before[subtask.id]
            and (m := facts.manifest(each)) is not None and "load" in m.ties
            for each in facts.plan.subtasks
        )  # fmt: skip
        if not taken and not holding.get(subtask.robot):
            yield Finding(
                check="not_held", severity=Severity.HOLD,
                message=f"{subtask.id} ({subtask.skill}): {subtask.robot} neither holds {thing} nor picks it up",
                hint="say where it is to be picked up",
            )  # fmt: skip


_HOLDS = frozenset(("holds", "holding", "held", "carries", "carrying", "has", "hand"))
"""Words that say that a robot has something already."""


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
        fixture = not ("load" in manifest.ties or "load" in manifest.frees) and set(name.lower().split()) & lx.FIXTURES
        if fixture:
            continue
        if "load" in manifest.ties or "load" in manifest.frees:
            listed = [each.name for each in site.objects]
            if listed and known_thing(name, site) is not None:
                taken.add(name)
                continue
        else:
            listed = [each.name for each in (*site.doors, *site.devices, *site.objects)]
            listed += [name for key, place in site.places.items() for name in (key, *place.aliases)]
        if listed and name not in taken and not any(_like(name, each) for each in listed):
            known = ", ".join(listed[:8])
            yield Finding(
                check="unknown_thing", severity=Severity.HOLD, words=(name,),
                message=f'{subtask.id}: the site knows no "{name}"', hint=f"it knows {known}",
            )  # fmt: skip


def _like(name: str, other: str) -> bool:
    one, two = ({stem(word) for word in each.lower().split()} for each in (name, other))
    return one == two or two <= one


def odd_names(facts: Facts) -> Iterable[Finding]:
    """What a plan names has a name: of the site, in quotation marks, or of words that can be one."""
    spoken = {each.text.lower() for each in facts.reading.tokens if each.kind == "quote"}
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        if manifest is None or subtask.id in facts.added:
            continue
        for key, value in subtask.params.items():
            if key in _SPOKEN or not isinstance(value, str) or value.lower() in spoken or _site_has(facts.site, value):
                continue
            words = value.lower().split() or [""]
            one = key == "object" and ("load" in manifest.ties or "load" in manifest.frees)
            if any(word in lx.NO_NAME or _adverb(word) for word in words) or (
                one and (words[0] in lx.ORDINALS or _many(words[0]))
            ):
                yield Finding(
                    check="names", severity=Severity.HOLD, words=(value,),
                    message=f'{subtask.id}: "{value}" is no name of a {key}', hint="name it as the site does",
                )  # fmt: skip


def counted(facts: Facts) -> Iterable[Finding]:
    """A robot takes, puts down or gives one thing: the words say of no object that there are several."""
    tokens = facts.reading.tokens
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        value = subtask.params.get("object")
        load = manifest is not None and ("load" in manifest.ties or "load" in manifest.frees)
        if not load or not isinstance(value, str) or subtask.id in facts.added:
            continue
        said = text_said(facts.reading, value, None) or set()
        for first in sorted(index for index in said if index - 1 not in said):
            before = first - 1
            while before > 0 and tokens[before].text in _DETERMINERS:
                before -= 1
            last = first
            while last + 1 in said:
                last += 1
            listed = last + 1 < len(tokens) and tokens[last + 1].text in ("and", "&")
            several = next((at for at in (before, first) if _several(tokens, at, listed=listed)), None)
            if several is not None:
                word = tokens[several].text
                yield Finding(
                    check="quantity", severity=Severity.HOLD, words=(word,),
                    message=f'{subtask.id} ({subtask.skill} {value}): the words say "{word}", and it handles one thing',
                    hint="give each thing an order of its own",
                )  # fmt: skip
                break


_DETERMINERS = frozenset(("of", "the", "our", "my", "your", "those", "these", "them"))


def _several(tokens: Sequence[Token], at: int, *, listed: bool) -> bool:
    """Whether a token says that what follows it is more than one thing; `listed`: "and" and another follow."""
    if at < 0 or (at and tokens[at - 1].text in lx.NUMBERED):
        return False
    token = tokens[at]
    if token.text in ("all", "every", "each"):
        return True
    if token.text == "both":
        return not listed
    return token.kind in ("word", "number") and (
        token.text in lx.COUNTS or (token.value is not None and token.value > 1)
    )


def unknown_place(facts: Facts) -> Iterable[Finding]:
    """Where something is done is a place, a thing or a coordinate of the site."""
    site = facts.site
    if site is None:
        return
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        for key, value in subtask.params.items():
            param = manifest.params.get(key) if manifest is not None else None
            if param is None or (param.names != "place" and key != "path") or not isinstance(value, str):
                continue
            parts = [each for part in parts_of(value) if (each := _ROUTE.sub("", part)) or key != "path"]
            there = [locate(each, site) is not None or _site_has(site, each) for each in parts]
            # Of a route each stop is a place; the route's own name is none of them.
            if not (all(there[1:]) if key == "path" and len(parts) > 2 else any(there)):
                like = nearest(value, site)
                yield Finding(
                    check="unknown_place", severity=Severity.HOLD, words=(value,),
                    message=f'{subtask.id}: the site knows no place "{value}"',
                    hint=f"nearest name: {like}" if like else f"it knows {', '.join(sorted(site.places)[:8])}",
                )  # fmt: skip


_ROUTE = re.compile(r"^(?:the )?(?:path|route|way)\b ?")
"""What stands before the first place of a route."""
_POINT = re.compile(
    r"([\w .-]{1,60}?)\s*\(\s*(-?\d{1,6}(?:\.\d+)?)\s*[,;]\s*(-?\d{1,6}(?:\.\d+)?)\s*(?:m|metres|meters)?\s*\)"
)


def other_point(facts: Facts) -> Iterable[Finding]:
    """A coordinate in brackets behind a place is that place: "goal 1 (28, 5)"."""
    site = facts.site
    if site is None:
        return
    for found in _POINT.finditer(facts.reading.text.lower()):
        words = found.group(1).split()
        place = next((known for size in (3, 2, 1) if (known := site.find(" ".join(words[-size:]))) is not None), None)
        if place is None:
            continue
        away = math.hypot(place.x - float(found.group(2)), place.y - float(found.group(3)))
        if away > REACH_M:
            said = found.group().strip()
            yield Finding(
                check="names", severity=Severity.HOLD, words=(said,),
                message=f'"{said}": the place is at ({place.x:g}, {place.y:g})', hint="name the place, or the point",
            )  # fmt: skip


def _adverb(word: str) -> bool:
    """Whether a word says how something is done: "sideways", "diagonally"."""
    return word in lx.MANNER or word.endswith(("wise", "ways")) or (word.endswith("ly") and word not in lx.NOUNS_IN_LY)


_SPOKEN = frozenset(("text", "question", "event", "instruction", "prompt"))
"""Parameters that are said, not names."""


def _many(word: str) -> bool:
    return word in lx.COUNTS or (word.isdigit() and int(word) > 1)


def _names(site: Site) -> list[str]:
    names = [each.name for each in (*site.doors, *site.devices, *site.objects)]
    names += [site.fence.name] if site.fence is not None else []
    return names + [name for key, place in site.places.items() for name in (key, *place.aliases)]


def _site_has(site: Site | None, name: str) -> bool:
    return site is not None and (
        locate(name, site) is not None
        or known_thing(name, site) is not None
        or bare(name) in {each.lower() for each in _names(site)}
    )
