"""How a plan is laid out as lines: below what each subtask comes after, and indented by the longest chain before it.

A record may come from a version or a robot that checks nothing, so cycles and unknown predecessors are laid out as
well, and no walk recurses.
"""

from collections.abc import Iterable

from appliance.model import Plan, Subtask

DEEPEST = 8
"""Levels that are indented further; deeper ones would leave no room at 80 columns."""


def depths(subtasks: Iterable[Subtask]) -> dict[str, int]:
    """Return the length of the longest chain before each subtask; one in a cycle counts what was settled before it."""
    after = _known(subtasks)
    found: dict[str, int] = {}
    waiting = dict(after)
    while waiting:
        free = [each for each, before in waiting.items() if all(other in found for other in before)]
        # None is free: a cycle, which the validator refuses. Its first one is laid out all the same.
        for each in free or [next(iter(waiting))]:
            found[each] = max((found[other] + 1 for other in waiting[each] if other in found), default=0)
            del waiting[each]
    return found


def ordered(subtasks: Iterable[Subtask]) -> list[str]:
    """Return ids so that each stands below all it comes after, and right below the last of them."""
    after = _known(subtasks)
    missing = {each: len(before) for each, before in after.items()}
    children: dict[str, list[str]] = {}
    for each, before in after.items():
        for other in before:
            children.setdefault(other, []).append(each)
    out: dict[str, None] = {}
    waiting = [each for each, count in missing.items() if not count][::-1]
    while waiting:
        node = waiting.pop()
        out[node] = None
        for child in children.get(node, ())[::-1]:
            missing[child] -= 1
            if not missing[child]:
                waiting.append(child)
    return [*out, *(each for each in after if each not in out)]


def _known(subtasks: Iterable[Subtask]) -> dict[str, set[str]]:
    """Return id -> ids before it that are in the plan; the first of several subtasks with one id counts."""
    found: dict[str, tuple[str, ...]] = {}
    for each in subtasks:
        found.setdefault(each.id, each.after)
    return {each: {other for other in after if other in found and other != each} for each, after in found.items()}


def branch(depth: int) -> str:
    """Return what stands before a subtask of that depth."""
    return f"{'   ' * (min(depth, DEEPEST) - 1)}└─▶ " if depth else ""


def cycle(subtasks: Iterable[Subtask]) -> tuple[str, ...]:
    """Return the ids that wait for each other in a circle, or for those; empty when there is none."""
    waiting = _known(subtasks)
    while free := {each for each, before in waiting.items() if not before}:
        waiting = {each: before - free for each, before in waiting.items() if each not in free}
    return tuple(waiting)


def at_once(plan: Plan) -> int:
    """Return how many subtasks may start at the beginning."""
    return sum(not depth for depth in depths(plan.subtasks).values())
