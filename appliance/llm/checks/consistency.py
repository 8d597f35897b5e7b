"""Whether a plan agrees with itself and with the annotation rules, as far as a program can tell. Pure.

Everything that can be decided without understanding the sentence is decided here: names, types, ids, order, actuators
used twice at once, ways to where a robot already is, things put down that were never picked up, names that the
instruction does not contain. The corpus is held to it, since a wrong pair teaches a wrong habit; and of a model's
answers the likeliest one that breaks no rule is taken. Unlike `validate` it says nothing of safety or of what can run.

`contradictions` finds orders of one plan that cannot both be carried out. Only what is certain counts: two subtasks
that nothing orders, of which one undoes the other, or that send the same robot to two places at once.
"""

import re
from collections.abc import Iterable, Sequence
from itertools import combinations

from msgspec import Struct

from appliance.llm.words import singular
from appliance.model import Plan, Subtask
from appliance.skills.catalogue import Catalogue, SkillManifest

NUMBERS = {
    word: str(number)
    for number, word in enumerate(
        (
            *("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven"),
            *("twelve", "thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty"),
        )
    )
}
"""Number words, in figures."""
_TENS = {
    word: tens
    for tens, word in enumerate(("twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety"), start=2)
}
_TOGETHER = re.compile(
    r"\b(while|whilst|meanwhile|meantime|as (you|he|she|it|they|we)|as \w+ (is|goes|does|drives|flies)|same time|"
    r"simultaneous\w*|parallel|during|at once|along the way|on (the|your) way|all the while|throughout)\b"
)
_PLACE = re.compile(r"(.*\D) (\d+|[a-z])")
"""A place of a kind of which there are several."""
_HELD = re.compile(r"\b(hold|holding|held|holds|carrying|carries|you have|you've got|has got|in (its|your) gripper)\b")
_ANY = re.compile(r"any\d*|all")


class Meaning(Struct, frozen=True, kw_only=True):
    """An instruction, and the plan that it is taken to mean."""

    instruction: str
    robots: tuple[str, ...] = ()
    """The roster; empty when unknown."""
    domain: str
    subtasks: tuple[Subtask, ...]


def problems(meaning: Meaning, catalogue: Catalogue, *, style: bool = True) -> tuple[str, ...]:
    """Return what speaks against a plan for an instruction, each as a sentence; nothing where it may be meant.

    Args:
        meaning: the instruction and the plan.
        catalogue: the skills there are.
        style: also the rules of how values are written and that they stand in the words, which a corpus keeps.
    """
    found: list[str] = []
    if meaning.domain not in {
        catalogue.skills[each.skill].domain for each in meaning.subtasks if each.skill in catalogue.skills
    }:
        found.append(f"domain {meaning.domain} is not that of any of its subtasks")
    words = stems(meaning.instruction)
    for index, subtask in enumerate(meaning.subtasks):
        where = f"{subtask.id} ({subtask.skill})"
        if subtask.id != f"s{index + 1}":
            found.append(f"{where}: ids are s1, s2, ... in the order of the lines")
        manifest = catalogue.skills.get(subtask.skill)
        if manifest is None:
            found.append(f"{where}: there is no such skill")
            continue
        found += [f"{where}: {text}" for text in (_params(subtask, manifest) if style else ())]
        found += [f"{where}: {text}" for text in _robot(subtask, manifest, meaning, words)]
        found += [f"{where}: {text}" for text in (_words(subtask, words) if style else ())]
    return (*found, *(_order(meaning, catalogue) if not found else ()))


def stems(text: str) -> frozenset[str]:
    """Return the words of a text without endings of the plural, number words also in figures."""
    words = re.findall(r"[a-z0-9]+", re.sub(r"['’]s\b", "", text.lower()))
    found = {stem(word) for word in words} | {NUMBERS[word] for word in words if word in NUMBERS}
    for first, second in zip(words, (*words, "")[1:], strict=True):
        found.add(stem(first + second))
        if first in _TENS:
            found.add(str(_TENS[first] * 10 + (int(NUMBERS.get(second, "0")) % 10)))
        if first in NUMBERS and second in NUMBERS:  # room two one four
            found.add(NUMBERS[first] + NUMBERS[second])
    for first, last in re.findall(r"\b(\d{1,4})\s*(?:to|through|thru|till|-|–)\s*(\d{1,4})\b", text.lower()):
        found |= {str(number) for number in range(int(first), min(int(last), int(first) + 50))}
    found |= {part for word in words for part in re.findall(r"[a-z]+|[0-9]+", word)}
    return frozenset(found)


def stem(word: str) -> str:
    """Return a word without an ending of the plural, to compare with others so treated."""
    return singular(word) if len(word) > 3 else word


def before(subtasks: Sequence[Subtask]) -> dict[str, frozenset[str]]:
    """Return for each subtask all that come before it, directly or not; lines must stand in a possible order."""
    reach: dict[str, frozenset[str]] = {}
    for subtask in subtasks:
        reach[subtask.id] = frozenset(subtask.after).union(*(reach[other] for other in subtask.after))
    return reach


def _params(subtask: Subtask, manifest: SkillManifest) -> Iterable[str]:
    for name, param in manifest.params.items():
        if param.required and name not in subtask.params:
            yield f"parameter {name} is missing"
    for name, value in subtask.params.items():
        kind = manifest.params[name].type if name in manifest.params else None
        if kind is None:
            yield f"there is no parameter {name}"
        elif kind in ("number", "integer"):
            whole = isinstance(value, int) or (kind == "number" and isinstance(value, float))
            if not whole or isinstance(value, bool) or value <= 0:
                yield f"{name} must be a {kind} above 0"
        elif kind == "array":
            if not isinstance(value, list) or not value or not all(_clean(item) for item in value):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
                yield f"{name} must be a list of lower-case texts"
        elif not _clean(value):
            yield f"{name} must be lower-case text without an article in front, blanks or a full stop at its ends"
        elif name not in ("text", "question", "event") and value.startswith(
            ("the ", "a ", "an ", "my ", "our ", "your ")
        ):
            yield f"{name} must be without article or possessive"


def _clean(value: object) -> bool:
    return isinstance(value, str) and value != "" and value == value.strip(" .\"'").lower()


def _robot(subtask: Subtask, manifest: SkillManifest, meaning: Meaning, words: frozenset[str]) -> Iterable[str]:
    listed: list[str] = subtask.params.get("robots") or []
    if (subtask.robot is None) != (manifest.runs == "compute"):
        yield "a skill that runs as compute has robot -, any other has a robot"
    if manifest.joint and subtask.robot is not None and listed[:1] != [subtask.robot]:
        yield "a joint skill's robot is the first of its robots"
    if len(set(listed)) != len(listed):
        yield "a robot is listed twice"
    for robot in {*listed, *([subtask.robot] if subtask.robot else [])}:
        if _ANY.fullmatch(robot):
            if robot == "all" and meaning.robots:
                yield "the roster is known: one copy for each robot in place of all"
        elif meaning.robots and robot not in meaning.robots:
            yield f"robot {robot} is not in the roster"
        elif not meaning.robots and (lost := [part for part in re.split(r"[_.-]", robot) if stem(part) not in words]):
            yield f"robot {robot}: the instruction does not say {', '.join(lost)}"


def _words(subtask: Subtask, words: frozenset[str]) -> Iterable[str]:
    params: dict[str, str | list[str] | float] = subtask.params
    for name, value in params.items():
        if name == "robots" or value == "operator":
            continue
        texts = value if isinstance(value, list) else [value] if isinstance(value, str) else []
        said = {word for text in texts for word in re.findall(r"[a-z0-9]+", re.sub(r"['’]s\b", "", text))}
        if lost := sorted(word for word in said if stem(word) not in words and word not in words):
            yield f"{name}: the instruction does not say {', '.join(lost)}"


def _order(meaning: Meaning, catalogue: Catalogue) -> Iterable[str]:
    known: set[str] = set()
    for subtask in meaning.subtasks:
        if unknown := [other for other in subtask.after if other not in known]:
            yield f"{subtask.id}: {', '.join(unknown)} must stand before it"
            return
        if list(subtask.after) != sorted(set(subtask.after), key=lambda each: int(each[1:])):
            yield f"{subtask.id}: predecessors must stand once each, in order"
        known.add(subtask.id)
    reach = before(meaning.subtasks)
    for subtask in meaning.subtasks:
        for other in subtask.after:
            if any(other in reach[third] for third in subtask.after):
                yield f"{subtask.id}: < {other} follows from its other predecessors"
        yield from _feeds(subtask, meaning, reach, catalogue)
    together = bool(_TOGETHER.search(meaning.instruction.lower()))
    for index, one in enumerate(meaning.subtasks):
        for two in meaning.subtasks[index + 1 :]:
            if one.id in reach[two.id] or not _crew(one) & _crew(two):
                continue
            shared = set(catalogue.skills[one.skill].uses) & set(catalogue.skills[two.skill].uses)
            if shared:
                yield f"{one.id} and {two.id} use the {' and '.join(sorted(shared))} of one robot at once"
            elif not together:
                yield f"{one.id} and {two.id} run together on one robot, which the instruction does not say"
    yield from _moves(meaning, catalogue)


def _feeds(subtask: Subtask, meaning: Meaning, reach: dict[str, frozenset[str]], catalogue: Catalogue) -> Iterable[str]:
    feeds = catalogue.skills[subtask.skill].feeds_on
    producers = {each.id for each in meaning.subtasks if each.skill in feeds}
    aside = {each for each in producers if subtask.id not in reach[each]}
    if aside and not producers & reach[subtask.id]:
        yield f"{subtask.id} ({subtask.skill}): it must come after what it uses, one of {', '.join(sorted(aside))}"


def _moves(meaning: Meaning, catalogue: Catalogue) -> Iterable[str]:
    """A way to where the robot already is, up or down too; a thing put down that was never picked up, or too far away.

    A robot that was sent to dock 3 puts nothing down at dock 2: what is at hand is not of the kind of place it is at.
    """
    where: dict[str, object] = {}
    height: dict[str, str] = {}
    held: set[tuple[str, object]] = set()
    holding = bool(_HELD.search(meaning.instruction.lower()))
    for subtask in meaning.subtasks:
        robot = subtask.robot or ""
        if subtask.skill == "goto":
            if where.get(robot) == subtask.params.get("place"):
                yield f"{subtask.id}: {robot} was sent there before, and nowhere since"
            where[robot] = subtask.params.get("place")
        elif subtask.skill in ("takeoff", "land"):
            if height.get(robot) == subtask.skill and subtask.skill == "land":
                yield f"{subtask.id}: {robot} has landed already"
            height[robot] = subtask.skill
        elif subtask.skill in ("return_home", "dock"):
            there = (subtask.skill, *sorted(map(str, subtask.params.items())))
            if where.get(robot) == there:
                yield f"{subtask.id}: {robot} is there already"
            where[robot] = there
        elif catalogue.skills[subtask.skill].moves_robot:
            where.pop(robot, None)
        elif subtask.skill == "pick":
            held.add((robot, subtask.params.get("object")))
        elif subtask.skill == "handover":
            held.add((str(subtask.params.get("to")), subtask.params.get("object")))
        elif subtask.skill == "place":
            if (robot, subtask.params.get("object")) not in held and not holding:
                yield f"{subtask.id}: {robot} puts down what it has not picked up"
            at, last = (_PLACE.fullmatch(str(each)) for each in (subtask.params.get("at"), where.get(robot)))
            if at and last and at[1] == last[1] and at[2] != last[2]:
                yield f"{subtask.id}: {robot} was sent to {last[0]}, and {at[0]} is another"


def _crew(subtask: Subtask) -> set[str]:
    return (
        {*(subtask.params.get("robots") or ()), *((subtask.robot,) if subtask.robot else ())}
        if subtask.robot
        else set()
    )


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
