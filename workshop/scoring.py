"""How near a plan is to the right one: the figures that plans are judged by wherever they are trained or measured.

The definitions are those of the reference scorer (`workshop/bench/plan/cases/score.py`), and the tests hold
the two to the same figures. Subtasks are matched by skill, so that most of their parameters
agree (the robot is one). From that follow: `subtask_f1`; `decomposition`, F1 of the pairs "this before that", direct or
not; `parallel_recall`, the share of independent pairs that were left independent; `param_f1`; `exact`, all of it right;
`domain`; `valid`, whether it is a plan at all.
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any, cast

from msgspec import Struct

_SMALL_WORDS = re.compile(r"\b(the|a|an|its|his|her|their|your|my|our)\b")
_SEPARATORS = re.compile(r"[^a-z0-9.]+")
_FEW = 6
"""Up to so many subtasks of one skill on either side every way to match them is tried."""
_SHIFT = 1e-3
"""What a place further away in the list counts against a match."""

Subtask = Mapping[str, Any]


class Score(Struct, frozen=True, kw_only=True):
    """Figures of one plan, 0 to 1; `parallel_recall` is None where the right plan has nothing independent."""

    subtask_f1: float = 0.0
    decomposition: float = 0.0
    parallel_recall: float | None = None
    param_f1: float = 0.0
    exact: float = 0.0
    domain: float = 0.0
    valid: float = 0.0


def score(said: Mapping[str, Any], gold: Mapping[str, Any]) -> Score:
    """Return the figures of a plan.

    Args:
        said: `domain` and `subtasks`, each with `id`, `skill`, `robot`, `params` and `after`; what is no plan (a cycle,
            an unknown or repeated id) has no figure but 0.
        gold: the right one.
    """
    right: Sequence[Subtask] = gold["subtasks"]
    before = _order(right)
    ids = [each["id"] for each in right]
    free = {
        (one, two)
        for one, two in itertools.combinations(ids, 2)
        if (one, two) not in before and (two, one) not in before
    }
    try:
        subtasks: Sequence[Subtask] = said["subtasks"]
        order = _order(subtasks)
    except (KeyError, TypeError, ValueError):
        return Score(parallel_recall=0.0 if free else None)
    pairs = _matched(subtasks, right)
    name = {subtasks[one]["id"]: right[two]["id"] for one, two in pairs.items()}
    known = {(name.get(one, f"?{one}"), name.get(two, f"?{two}")) for one, two in order}
    found = _f1(len(pairs), len(subtasks), len(right))
    there = set(name.values())
    apart = sum({one, two} <= there and not {(one, two), (two, one)} & known for one, two in free)
    given = [_features(each) for each in subtasks]
    asked = [_features(each) for each in right]
    hits = sum(
        key in asked[two] and _agree(value, asked[two][key])
        for one, two in pairs.items()
        for key, value in given[one].items()
    )
    parameters = _f1(hits, sum(len(given[one]) for one in pairs), sum(map(len, asked)))
    return Score(
        subtask_f1=found,
        decomposition=_f1(len(known & before), len(known), len(before)) if order or before else found,
        parallel_recall=apart / len(free) if free else None,
        param_f1=parameters,
        exact=float(found == 1 and known == before and parameters == 1),
        domain=float(said.get("domain") == gold.get("domain")),
        valid=1.0,
    )


def mean_figures(scores: Sequence[Score]) -> dict[str, Any]:
    """Return `cases`, and the mean of each figure in percent; None where no case has it."""
    figures: dict[str, Any] = {"cases": len(scores)}
    for name in Score.__struct_fields__:
        values = [float(value) for each in scores if (value := getattr(each, name)) is not None]
        figures[name] = round(100 * sum(values) / len(values), 1) if values else None
    return figures


def _order(subtasks: Sequence[Subtask]) -> set[tuple[str, str]]:
    """Return the pairs (earlier, later), direct or not; ValueError for a cycle, an unknown or a repeated id."""
    after = {each["id"]: tuple(each.get("after") or ()) for each in subtasks}
    if len(after) != len(subtasks):
        raise ValueError("ids repeat")
    behind: dict[str, set[str]] = {}
    left = dict(after)
    while left:
        ready = [one for one, parents in left.items() if all(parent in behind for parent in parents)]
        if not ready:
            raise ValueError("a cycle, or an unknown id")
        for one in ready:
            behind[one] = set(after[one]).union(*(behind[parent] for parent in left.pop(one)))
    return {(earlier, one) for one, parents in behind.items() for earlier in parents}


def _matched(said: Sequence[Subtask], right: Sequence[Subtask]) -> dict[int, int]:
    """Return which subtask stands for which, as their places in the lists."""

    def alike(one: int, two: int) -> float:
        return _similarity(said[one], right[two]) - _SHIFT * abs(one - two)

    pairs: dict[int, int] = {}
    for skill in {each["skill"] for each in right}:
        ours = [place for place, each in enumerate(said) if each.get("skill") == skill]
        theirs = [place for place, each in enumerate(right) if each["skill"] == skill]
        likeness = {(one, two): alike(one, two) for one in ours for two in theirs}
        if len(ours) <= _FEW and len(theirs) <= _FEW:
            swapped = len(ours) > len(theirs)
            few, many = (theirs, ours) if swapped else (ours, theirs)
            ways = [
                [(b, a) if swapped else (a, b) for a, b in zip(few, way, strict=True)]
                for way in itertools.permutations(many, len(few))
            ]
            pairs |= dict(max(ways, key=lambda way: sum(likeness[pair] for pair in way)))
        else:
            taken: set[int] = set()
            for _, one, two in sorted(((value, *pair) for pair, value in likeness.items()), reverse=True):
                if one not in pairs and two not in taken:
                    pairs[one] = two
                    taken.add(two)
    return pairs


def _similarity(one: Subtask, two: Subtask) -> float:
    first, second = _features(one), _features(two)
    keys = set(first) | set(second)
    return (
        sum(key in first and key in second and _agree(first[key], second[key]) for key in keys) / len(keys)
        if keys
        else 1.0
    )


def _features(subtask: Subtask) -> dict[str, Any]:
    """Return the parameters that say something, the robot among them."""
    parameters: Mapping[str, Any] = subtask.get("params") or {}
    found = {key: value for key, value in parameters.items() if value is not None and value not in ("", [])}
    return {**found, "robot": subtask["robot"]} if subtask.get("robot") else found


def _agree(one: object, two: object) -> bool:
    """Whether two values are the same once normal, or texts that share more than half of their words."""
    first, second = _normal(one), _normal(two)
    if first == second:
        return True
    if isinstance(first, str) and isinstance(second, str):
        a, b = set(first.split()), set(second.split())
        return bool(a and b) and len(a & b) / len(a | b) > 0.5
    return False


def _normal(value: object) -> float | str | tuple[str, ...]:
    """Return a value as a number, as words without articles and marks, or as the sorted list of such."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return round(float(value), 3)
    if isinstance(value, list | tuple):
        items = cast("Sequence[object]", value)
        return tuple(sorted(str(_normal(each)) for each in items))
    text = _SEPARATORS.sub(" ", _SMALL_WORDS.sub(" ", str(value).lower())).strip(" .")
    try:
        return round(float(text), 3)
    except ValueError:
        return " ".join(text.split())


def _f1(hits: int, said: int, right: int) -> float:
    return 1.0 if said == right == 0 else 2 * hits / (said + right)
