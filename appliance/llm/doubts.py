"""What makes it doubtful that a plan is what an instruction means, though it may be: what is said and not planned.

A model that is short of words leaves a robot idle, or the third of three docks out, plans one by one what is to run
side by side, or says the same thing twice, and is sure of it. Unlike the rules of `sense` these have exceptions ("leave
Robot_4 where it is", "it is 22:00"): of the hand-written pairs with a plan one in 250 leaves a robot out that it names,
one in 35 a figure, one in 250 plans nothing side by side where it says "while", and one in 60 says a thing twice. So
such a plan is not refused; but one without doubts is better, and where there is none an operator is to look at it.
"""

import itertools
import re
from collections.abc import Iterable

from appliance.llm.checks.consistency import NUMBERS, Meaning, before

_KIND = r"(robot|drone|rover|ugv|uav|auv|bot|arm|cart|unit)"
_NUMBERED = re.compile(rf"\b{_KIND}[ _]?(\d+|{'|'.join(list(NUMBERS)[1:10])})\b")
"""What is a robot's name whoever is there."""
_PARTS = re.compile(r"[_.-]")
_FIGURE = re.compile(r"(?<![\w.:])\d+(?:\.\d+)?(?![\d.:]*\w)")
_DEADLINE = re.compile(r"\b(by|before|within|until|till|at most|no later than|in less than) (the )?$")
"""Before a figure: a deadline, which plans do not have."""
_SIDE_BY_SIDE = re.compile(r"\b(while|whilst|meanwhile|meantime|at the same time|simultaneously|in parallel|during)\b")
"""Fewer words than in `sense`, which may say so: these hardly ever stand where nothing does."""
_AGAIN = re.compile(r"\b(twice|thrice|again|times|each|every|once more|both)\b")
_OFTEN_TWICE = frozenset(
    ("wait_for", "hold", "takeoff", "land", "return_home", "dock", "goto", "evaluate", "aggregate", "train_local")
) | {"notify", "report", "patrol", "say"}
"""Skills that plans often have twice."""
_UNITS = (1.0, 60.0, 3600.0, 0.001, 0.01, 100.0, 1000.0, 0.3048, 1 / 3.6, 0.514444, 0.44704)
"""What a figure may be multiplied with on its way into a parameter: minutes, hours, feet, km/h, knots, ..."""


def doubts(meaning: Meaning) -> tuple[str, ...]:
    """Return what makes it doubtful that the plan is what is meant, each as a sentence; its order must be possible."""
    text = re.sub(r"\s+", " ", meaning.instruction.lower())
    said = list(_values(meaning))
    return (*_robots(text, meaning, said), *_figures(text, said), *_together(text, meaning), *_twice(text, meaning))


def _values(meaning: Meaning) -> Iterable[str]:
    """Robots and values of parameters, as they may stand in a text."""
    for subtask in meaning.subtasks:
        if subtask.robot:
            yield _PARTS.sub(" ", subtask.robot)
        for value in subtask.params.values():
            listed: list[object] = value if isinstance(value, list) else [value]  # pyright: ignore[reportUnknownVariableType]
            for each in listed:
                yield f"{each:g}" if isinstance(each, int | float) else str(each).lower().replace("_", " ")


def _robots(text: str, meaning: Meaning, said: list[str]) -> Iterable[str]:
    if meaning.robots:
        words = [_in_figures(word) for word in re.findall(r"[a-z0-9]+", text)]
        line = f" {' '.join(words)} "
        named = {
            robot
            for robot in meaning.robots
            if f" {_PARTS.sub(' ', robot)} " in line or f" {_PARTS.sub('', robot)} " in line
        }
    else:
        named = {f"{kind}_{_in_figures(number)}" for kind, number in _NUMBERED.findall(text)}
    for robot in sorted(named):
        if not any(f" {_PARTS.sub(' ', robot)} " in f" {_PARTS.sub(' ', each)} " for each in said):
            yield f"{robot} is named and has nothing to do"


def _in_figures(word: str) -> str:
    return NUMBERS.get(word, word)


def _figures(text: str, said: list[str]) -> Iterable[str]:
    has = {part for each in said for part in re.findall(r"\d+(?:\.\d+)?", each)}
    numbers = [float(each) for each in has]
    for found in _FIGURE.finditer(text):
        figure = found.group()
        if figure in has or _DEADLINE.search(text[: found.start()]):
            continue
        if not any(
            abs(float(figure) * unit - number) <= 1e-3 * max(1.0, number) for unit in _UNITS for number in numbers
        ):
            yield f"{figure} is said and stands nowhere"


def _together(text: str, meaning: Meaning) -> Iterable[str]:
    reach = before(meaning.subtasks)
    pairs = itertools.combinations(meaning.subtasks, 2)
    if (found := _SIDE_BY_SIDE.search(text)) and all(one.id in reach[two.id] for one, two in pairs):
        yield f'"{found.group()}" is said and nothing runs side by side'


def _twice(text: str, meaning: Meaning) -> Iterable[str]:
    if _AGAIN.search(text):
        return
    seen: list[tuple[object, ...]] = []
    for subtask in meaning.subtasks:
        what = (subtask.skill, subtask.robot, subtask.params)
        if subtask.skill not in _OFTEN_TWICE and what in seen:
            yield f"{subtask.id} ({subtask.skill}) is planned twice"
        seen.append(what)
