"""The safety policy as a function of a plan: what of it is not allowed, and what of it nobody said. Pure.

`unsafe` names subtask and remedy. What a plan does not say counts as far as it is known: the skill's usual value
(`Param.usual` of its manifest), the home that a robot has told. Speeds and take-off heights that a skill chooses are
lowered when they are sent (`appliance.limits`); for how long it does something has to be said where its usual time is
above a limit, or not known.

`ungrounded` finds what is invented, or slipped in from elsewhere. A language model that read an order in the name of an
object or in a robot's note may write a plan that is right in form. But a correct plan points at words of its
instruction: what a parameter says has to be found there, in the names of the site or in what was planned before, and a
robot has to be named or meant. Half of the words of a value are enough, in any inflection, since names are put in a
plain form.
"""

import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

from appliance.llm.checks.consistency import NUMBERS, precedes, stem
from appliance.llm.checks.facts import Facts
from appliance.llm.checks.places import known_as, parts_of, shown, spot_of
from appliance.llm.checks.schema import MAX_PROBLEMS, able, is_unnamed
from appliance.llm.settings import PlanContext, RobotLimits, SafetyConfig
from appliance.llm.values import figures
from appliance.model import Finding, Plan, RobotInfo, Severity, Site, Subtask
from appliance.model.closures import ANYTHING
from appliance.skills.catalogue import Catalogue

PLACES = ("place", "area", "station", "path", "at", "to", "into", "asset", "target", "object")
"""Parameters that may name where a robot goes, or what it goes to."""
_LOWERED = frozenset({"altitude_m", "speed_mps"})
"""What a skill chooses of these is lowered to the limit when it is sent."""
_LIMITS = (("altitude_m", "m", "altitude"), ("speed_mps", "m/s", "speed"), ("duration_s", "s", "duration"))


class _Goal(NamedTuple):
    """Where a subtask goes: as names are compared, and as messages name it."""

    name: str
    said: str


def unsafe(plan: Plan, context: PlanContext, catalogue: Catalogue, config: SafetyConfig) -> tuple[str, ...]:
    """Return what of a plan the policy does not allow; none means that it may run, as far as this is concerned.

    Args:
        plan: one that `validate` has passed.
        context: roster, site, and who asks.
        catalogue: the skills there are.
        config: the policy.
    """
    problems: list[str] = []
    for subtask in plan.subtasks:
        where = f"{shown(subtask.id)} ({shown(subtask.skill)})"
        problems += [f"{where}: {text}" for text in _subtask(subtask, context, catalogue, config)]
    problems += _exclusive(plan, context, catalogue, config)
    return tuple(problems[:MAX_PROBLEMS])


def _subtask(subtask: Subtask, context: PlanContext, catalogue: Catalogue, config: SafetyConfig) -> Iterable[str]:
    if pattern := matched(subtask.skill, config.skills_never):
        yield f"the policy forbids the skill (safety.skills_never: {pattern}): leave it out"
    yield from (f"{text}: choose another, or wait" for text in out_of_use(subtask, context, catalogue))
    yield from (f"{text}: choose another robot or place, or wait" for text in _ruled_out(subtask, context, catalogue))
    goals = _goals(subtask, catalogue)
    homes = _homes(subtask, context, catalogue)
    for goal in (*goals, *homes.values()):
        if pattern := matched_any(known_as(goal.name, context.site), config.places_never):
            yield f"the policy forbids {goal.said} (safety.places_never: {pattern}): choose another"
        if context.site is not None and (area := _forbidden(goal.name, context.site)):
            yield f"{goal.said} lies in the forbidden area {area}: choose another"
    if subtask.robot is None:
        return
    if context.from_robot and config.robot_tasks != "any":
        if config.robot_tasks == "never":
            yield "tasks of robots may command no robot (safety.robot_tasks)"
        elif robots_of(subtask) != {context.submitter}:
            yield f"a task of {shown(context.submitter)} may command no other robot (safety.robot_tasks)"
    for robot in _candidates(subtask, context.robots, catalogue):
        own = [homes[robot]] if robot in homes else []
        yield from _limited(subtask, robot, [*goals, *own], context.site, catalogue, config.limits)


def _limited(
    subtask: Subtask,
    robot: str,
    goals: Sequence[_Goal],
    site: Site | None,
    catalogue: Catalogue,
    limits: Sequence[RobotLimits],
) -> Iterable[str]:
    holding = [each for each in limits if matched(robot, each.robots)]
    if any(matched(subtask.skill, each.skills_never) for each in holding):
        yield f"{robot} may not do this (safety.limits): name another robot"
    highest = strictest(limits, robot, "altitude_m")
    for goal in goals:
        if any(matched_any(known_as(goal.name, site), each.places_never) for each in holding):
            yield f"{robot} may not go to {goal.said} (safety.limits): name another robot or place"
        spot = spot_of(goal.name, site)
        if spot is not None and highest is not None and spot.z > highest:
            yield f"{goal.said} is {spot.z:g} m up, above the limit of {robot}, {highest:g} m: choose a lower place"
    for key, unit, word in _LIMITS:
        bound = strictest(limits, robot, key)
        if bound is None:
            continue
        value = subtask.params.get(key)
        if isinstance(value, int | float):
            if value > bound:
                yield f"{word} {value:g} {unit} is above the limit of {robot}, {bound:g} {unit}: ask for less"
        elif key not in _LOWERED and (why := _too_long(subtask, key, bound, catalogue)):
            yield f"{why} the limit of {robot} is {bound:g} {unit}: say a {word} of at most that"


def _too_long(subtask: Subtask, key: str, bound: float, catalogue: Catalogue) -> str:
    """Why what a skill does by itself where its plan says nothing may be more than a bound; empty when it is not."""
    manifest = catalogue.skills.get(subtask.skill)
    param = manifest.params.get(key) if manifest is not None else None
    if param is None or (isinstance(param.usual, int | float) and param.usual <= bound):
        return ""
    usual = f"is usually {param.usual:g}" if isinstance(param.usual, int | float) else "is not known beforehand"
    return f"{key} {usual} and"


def strictest(limits: Sequence[RobotLimits], robot: str, key: str) -> float | None:
    """Return the least bound of that kind (`altitude_m`, `speed_mps`, `duration_s`) that holds for a robot, or None."""
    found: list[float] = [
        bound for each in limits if matched(robot, each.robots) and (bound := getattr(each, key)) is not None
    ]
    return min(found, default=None)


def _candidates(subtask: Subtask, robots: Sequence[RobotInfo] | None, catalogue: Catalogue) -> list[str]:
    """The robots that may come to do a subtask: those it names, or all that could be chosen."""
    names = robots_of(subtask)
    unnamed = any(is_unnamed(each) or each == "all" for each in names)
    found = [each for each in names if not is_unnamed(each) and each != "all"]
    if unnamed:
        found += _able(subtask, robots, catalogue)
    return sorted(set(found))


def _able(subtask: Subtask, robots: Sequence[RobotInfo] | None, catalogue: Catalogue) -> list[str]:
    """The robots of the roster that have what a subtask's skill needs."""
    manifest = catalogue.skills.get(subtask.skill)
    return [each.id for each in robots or () if manifest is None or not able(each, manifest)]


def out_of_use(subtask: Subtask, context: PlanContext, catalogue: Catalogue) -> Iterable[str]:
    """Yield the closed places that a robot goes to for a subtask, and those of its robots that are in maintenance."""
    closed = context.out_of_use
    for robot in sorted(robots_of(subtask) & set(closed.robots)):
        yield f"{robot} is {closed.robots[robot]}"
    if subtask.robot is None or not closed.places:
        return
    for goal in dict.fromkeys((*_goals(subtask, catalogue), *_homes(subtask, context, catalogue).values())):
        if (place := next((each for each in known_as(goal.name, context.site) if each in closed.places), "")) != "":
            yield f"{goal.said} is {closed.places[place]}"


def _ruled_out(subtask: Subtask, context: PlanContext, catalogue: Catalogue) -> Iterable[str]:
    """Yield each robot of a subtask that a standing rule keeps from it; of one that is still to be chosen, all."""
    if subtask.robot is None or not context.out_of_use.rules:
        return
    named = robots_of(subtask)
    for robot in involved(subtask, context):
        if why := kept_from(subtask, robot, context, catalogue):
            yield f"{robot} is {why}"
    found = [(each, kept_from(subtask, each, context, catalogue)) for each in _able(subtask, context.robots, catalogue)]
    kept = [f"{robot} is {why}" for robot, why in found if why]
    if kept and ("all" in named or (any(is_unnamed(each) for each in named) and len(kept) == len(found))):
        yield "; ".join(kept[:MAX_PROBLEMS])


def involved(subtask: Subtask, context: PlanContext) -> list[str]:
    """Return the robots that a subtask names: those that do it, and the one of the roster that is given something."""
    found = {each for each in robots_of(subtask) if not is_unnamed(each) and each != "all"}
    return sorted(found | {each.id for each in context.robots or () if each.id == subtask.params.get("to")})


ALWAYS = frozenset({"land", "return_home", "hold"})
"""Skills that a rule of hours alone keeps no robot from: one that is in the air when they begin has to come down."""


def kept_from(subtask: Subtask, robot: str, context: PlanContext, catalogue: Catalogue) -> str:
    """Return the standing rule that keeps a robot from a subtask, in words; empty when none does.

    Args:
        subtask: any.
        robot: of the roster; what group one of another name belongs to is not known, so that rules of both count.
        context: roster, site, and the rules that hold now.
        catalogue: the skills there are.
    """
    info = next((each for each in context.robots or () if each.id == robot), None)
    for closure in context.out_of_use.rules:
        rule = closure.rule
        if rule is None or (rule.robots and robot not in rule.robots):
            continue
        if info is not None and rule.group != "all" and info.flies != (rule.group == "flying"):
            continue
        if rule.places:
            homes = _homes(subtask, context, catalogue)
            goals = [*_goals(subtask, catalogue), *([homes[robot]] if robot in homes else [])]
            hit = any(set(known_as(goal.name, context.site)) & set(rule.places) for goal in goals)
        elif rule.things:
            taken = _taken(subtask, robot, catalogue)
            hit = taken != "" and any(each == ANYTHING or _is(taken, each) for each in rule.things)
        else:
            hit = subtask.skill not in ALWAYS
        if hit:
            return f"kept from it by standing rule {closure.name} ({closure.text})"
    return ""


def _taken(subtask: Subtask, robot: str, catalogue: Catalogue) -> str:
    """What a robot takes up in a subtask, alone, with others or from another; empty when it takes up nothing."""
    manifest = catalogue.skills.get(subtask.skill)
    if manifest is None:
        return ""
    given = "load" in manifest.frees and subtask.params.get("to") == robot
    takes = given or "load" in manifest.ties or {"robots", "object"} <= set(manifest.params)
    return (str(subtask.params.get("object", "")) or ANYTHING) if takes else ""


def _is(thing: str, said: str) -> bool:
    """Whether a thing may be what is said: one name has all words of the other, in singular or plural."""
    one, other = ({stem(word) for word in re.findall(r"\w+", each.casefold())} for each in (thing, said))
    return thing == ANYTHING or one <= other or other <= one


def _exclusive(plan: Plan, context: PlanContext, catalogue: Catalogue, config: SafetyConfig) -> Iterable[str]:
    """Visits of different robots to a place for one, that may fall together."""
    if not config.exclusive_places:
        return
    before = precedes(plan)
    visits = [
        (each, place, robots)
        for each in plan.subtasks
        if _leaves(each, catalogue)
        for place, robots in _visits(each, context, catalogue, config).items()
    ]
    for number, (one, place, robots) in enumerate(visits):
        for other, same, others in visits[number + 1 :]:
            if same != place or robots & others:
                continue
            if not (_gone(plan, one, other, before, catalogue) or _gone(plan, other, one, before, catalogue)):
                yield (
                    f"{one.id} and {other.id}: {place} is for one robot at a time (safety.exclusive_places): "
                    "have one leave before the other comes"
                )
    for each, place, robots in visits:
        if len(robots) > 1:
            yield f"{each.id}: {place} is for one robot at a time (safety.exclusive_places): choose another place"


def _visits(subtask: Subtask, context: PlanContext, catalogue: Catalogue, config: SafetyConfig) -> dict[str, set[str]]:
    """The places for one that a subtask visits, each by the one name that it has on the site, and with which robots."""
    named = robots_of(subtask)
    doing = set(_candidates(subtask, context.robots, catalogue)) if "all" in named else named
    found: dict[str, set[str]] = {}
    goals = [(goal, doing) for goal in _goals(subtask, catalogue)]
    for robot, goal in _homes(subtask, context, catalogue).items():
        goals.append((goal, {robot} if robot in doing else doing))
    for goal, robots in goals:
        names = known_as(goal.name, context.site)
        if matched_any(names, config.exclusive_places):
            found.setdefault(names[0], set()).update(robots)
    return found


def _gone(plan: Plan, first: Subtask, then: Subtask, before: dict[str, set[str]], catalogue: Catalogue) -> bool:
    """Whether the first robot has left for elsewhere before the other comes."""
    return any(
        each.id != first.id
        and _leaves(each, catalogue)
        and robots_of(each) == robots_of(first)
        and first.id in before[each.id]
        and each.id in before[then.id]
        for each in plan.subtasks
    )


def _leaves(subtask: Subtask, catalogue: Catalogue) -> bool:
    """Whether a robot is no longer where it was after a subtask."""
    manifest = catalogue.skills.get(subtask.skill)
    return manifest is not None and manifest.moves_robot and not manifest.flying


def places_of(subtask: Subtask) -> list[str]:
    """Return what a subtask names of places and things, in the form in which names are compared; a route in parts."""
    found = [subtask.params.get(key) for key in PLACES]
    return list(dict.fromkeys(name for each in found if isinstance(each, str) for name in parts_of(each)))


def _goals(subtask: Subtask, catalogue: Catalogue) -> list[_Goal]:
    """Where a subtask goes: what it names, and what its skill takes where it names nothing."""
    found = [_Goal(name, shown(name)) for name in places_of(subtask)]
    manifest = catalogue.skills.get(subtask.skill)
    for key, param in manifest.params.items() if manifest is not None else ():
        if key in PLACES and isinstance(param.usual, str) and not isinstance(subtask.params.get(key), str):
            found += [_Goal(name, f"{shown(name)}, its usual {key},") for name in parts_of(param.usual)]
    return found


def _homes(subtask: Subtask, context: PlanContext, catalogue: Catalogue) -> dict[str, _Goal]:
    """Where a subtask that has its robot return goes to, by robot: the home it has told, else the site's `home`."""
    manifest = catalogue.skills.get(subtask.skill)
    if manifest is None or "return_home" not in manifest.verbs:
        return {}
    told = {each.id: each.home for each in context.robots or () if each.home is not None}
    return {
        robot: _Goal(f"{told[robot].x:.2f}, {told[robot].y:.2f}" if robot in told else "home", f"the home of {robot}")
        for robot in _candidates(subtask, context.robots, catalogue)
    }


def robots_of(subtask: Subtask) -> set[str]:
    """Return the robots of a subtask, labels such as `any1` included."""
    listed: object = subtask.params.get("robots")
    names = [each for each in listed if isinstance(each, str)] if isinstance(listed, list | tuple) else []  # pyright: ignore[reportUnknownVariableType]
    return {*names, *([subtask.robot] if subtask.robot else [])}


def matched(name: str, patterns: Iterable[str]) -> str:
    """Return the first pattern that a name matches, or ""."""
    return next((each for each in patterns if fnmatchcase(name, each)), "")


def matched_any(names: Iterable[str], patterns: Sequence[str]) -> str:
    """Return the first pattern that one of several names matches, or ""."""
    return next((found for each in names if (found := matched(each, patterns))), "")


def _forbidden(name: str, site: Site) -> str:
    found = spot_of(name, site)
    if found is None:
        return ""
    inside = (box for box in site.forbidden if box.x[0] <= found.x <= box.x[1] and box.y[0] <= found.y <= box.y[1])
    return next((box.name for box in inside), "")


def policy_holds(facts: Facts) -> Iterable[Finding]:
    """Skills that the policy has approved each time (`safety.confirm_skills`)."""
    skills = sorted({each.skill for each in facts.plan.subtasks if matched(each.skill, facts.safety.confirm_skills)})
    if skills:
        yield Finding(
            check="approval",
            severity=Severity.HOLD,
            message=f"{', '.join(skills)} needs approval (safety.confirm_skills)",
        )


_TOKEN = re.compile(r"[a-z]+|\d+")
_PLAIN = frozenset({
    "operator", "home", "base", "me", "us", "team", "all", "any", "here", "start", "area", "result", "results",
})  # fmt: skip
"""What a plan may say of its own accord: who gave the order, where a robot came from, what is reported."""
_GROUP = frozenset({
    "all", "both", "every", "everyone", "everybody", "each", "any", "robots", "robot", "team", "fleet", "they", "them",
    "you", "others", "other", "rest", "two", "three", "four", "five", "six", "pair", "units", "unit", "crew", "drones",
    "together", "everything",
})  # fmt: skip
"""Words that may mean robots that are not named."""
_RANGE = frozenset({"to", "through", "till", "until", "thru", "between"})
_STEM = 4
"""Letters that two words must share to be inflections of one."""


def ungrounded(plan: Plan, context: PlanContext, added: frozenset[str] = frozenset()) -> tuple[str, ...]:
    """Return what a plan says and its instruction does not, each with subtask and remedy.

    Args:
        plan: any.
        context: the words; of a roster that is known, robots are checked by `robots.unnamed_robot`.
        added: subtasks that no words ask for.
    """
    said = _said(context)
    problems: list[str] = []
    group = bool(said & _GROUP) or context.so_far is not None or context.robots is not None
    for subtask in plan.subtasks:
        if subtask.id in added:
            continue
        where = f"{shown(subtask.id)} ({shown(subtask.skill)})"
        problems += [
            f"{where}: {name} {shown(each)} is not in the instruction: take it out"
            for name, value in subtask.params.items()
            if name != "robots"
            for each in (value if isinstance(value, list | tuple) else (value,))  # pyright: ignore[reportUnknownVariableType]
            if isinstance(each, str) and not _grounded(each, said)
        ]
        if not group:
            problems += [
                f"{where}: the instruction does not name {shown(robot)}: use any"
                for robot in sorted(robots_of(subtask))
                if not is_unnamed(robot) and robot != "all" and not _named(robot, said)
            ]
    return tuple(problems)


def _said(context: PlanContext) -> set[str]:
    """All words of the instruction and of the site's names, numbers in figures too."""
    texts = [context.instruction, figures(context.instruction.casefold())]
    if context.site is not None:
        # Two names of one place: the instruction may say the other.
        text = f" {' '.join(_words(context.instruction))} "
        for name, place in context.site.places.items():
            if any(f" {' '.join(_words(each))} " in text for each in (name, *place.aliases)):
                texts += [name, *place.aliases]
    if context.so_far is not None:
        for step in context.so_far.steps:
            texts += [str(each) for each in step.params.values()]
    words = {word for text in texts for word in _words(text)}
    # Word by word too: "gauges two four and six" are no 24, and "glass one," is glass 1.
    return words | {NUMBERS[word] for word in words & NUMBERS.keys()}


def _words(text: str) -> Iterable[str]:
    return _TOKEN.findall(text.casefold())


def _grounded(value: str, said: set[str]) -> bool:
    words = list(_words(value))
    if not words:
        return not value.strip()
    if not all(_counted(word, said) for word in words if word.isdigit()):
        return False  # dock 2 is not dock 1, however much of its name is right
    found = sum(word in said or word in _PLAIN or _inflected(word, said) for word in words)
    return 2 * found >= len(words)


def _counted(number: str, said: set[str]) -> bool:
    """Whether a number was said, or lies in a range that was: "tanks 4 to 6"."""
    if number in said:
        return True
    numbers = [int(each) for each in said if each.isdigit() and len(each) < 10]
    return bool(said & _RANGE) and len(numbers) > 1 and len(number) < 10 and min(numbers) < int(number) < max(numbers)


def _inflected(word: str, said: set[str]) -> bool:
    """Whether a word was said in another form: "batteries" for `battery`, "photographed" for `photograph`."""
    if len(word) < 3:
        return False
    stem = word[: max(3, min(len(word) - 1, max(_STEM, len(word) - 3)))]
    return any(each.startswith(stem) and abs(len(each) - len(word)) <= 4 for each in said)


def _named(robot: str, said: set[str]) -> bool:
    words = [word for word in _words(robot) if not word.isdigit()] or list(_words(robot))
    return any(word in said or any(each.startswith(word) for each in said) for word in words if word)
