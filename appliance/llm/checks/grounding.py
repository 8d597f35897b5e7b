"""Whether a plan says anything that its instruction does not: invented, or slipped in from elsewhere. Pure.

A language model that read an order in the name of an object or in a robot's note may write a plan that is right in
form. But a correct plan points at words of its instruction: what a parameter says has to be found there, in the
names of the site or in what was planned before, and a robot has to be named or meant. Half of the words of a value are
enough, in any inflection, since names are put in a plain form.
"""

import re
from collections.abc import Iterable

from appliance.llm.checks.consistency import NUMBERS
from appliance.llm.checks.policy import robots_of
from appliance.llm.checks.schema import is_unnamed, shown
from appliance.llm.language.values import figures
from appliance.llm.settings import PlanContext
from appliance.model import Plan

_TOKEN = re.compile(r"[a-z]+|\d+")
_PLAIN = frozenset({
    "operator", "home", "base", "me", "us", "team", "all", "any", "here", "start", "area", "result", "results",
})  # fmt: skip
"""What a plan may say of its own accord: whoever gave the order, where a robot came from, what is reported."""
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
