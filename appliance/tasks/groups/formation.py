"""Forms a task's group from what is known of the gateways, as plain functions (paper, Dynamic Groups).

A group is a set of gateways that can serve the task, at most `limit` of them. Its root is the gateway that owns the
task's key on the ring, so every gateway with the same view of the ring names the same one, without asking anybody, and
when it goes the next one on the ring is the root. The root is a member whatever it can serve itself: it coordinates.

    score(member) = w_l * (1 - load) + w_d * proximity + w_w * warm

A group is formed once and then kept. It is formed anew when a member can serve nothing any more, when the root has
changed, or when nobody in it can serve a subtask that somebody else can; what can be kept is kept. Now and then it is
looked at as a whole: it takes in others while it has room, and exchanges a member for another gateway that is better by
more than `HYSTERESIS`, so that gateways whose loads go up and down together do not take turns in it.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import Group

HYSTERESIS = 0.15
"""How much better another gateway must be to take a member's place, of at most 1. With the weight of load at 0.4 two
gateways may change by 0.18 in opposite directions before that is so."""


class Standing(Struct, frozen=True, kw_only=True):
    """What is known of a gateway with regard to one task. The figures are 0 to 1."""

    gateway: str
    load: float = 0.0
    near: float = 0.0
    """Share of the data, or the robot's link."""
    warm: float = 0.0
    """Whether containers for what is ready now are ready there."""
    serves: frozenset[str] = frozenset()
    """The unfinished subtasks that it can serve."""
    why_not: str = ""
    """Why it can serve none."""


class Weights(Struct, frozen=True, kw_only=True):
    """Weights of the score."""

    load: float = 0.4
    data: float = 0.3
    warm: float = 0.3


def score(standing: Standing, weights: Weights) -> float:
    """Return how well a gateway suits a task."""
    return (
        weights.load * (1.0 - min(1.0, max(0.0, standing.load)))
        + weights.data * standing.near
        + weights.warm * standing.warm
    )


def root_of(members: Collection[str], order: Sequence[str]) -> str:
    """Return the root: the member that comes first on the ring from the task's key on; "" when none does."""
    return next((each for each in order if each in members), "")


def must_form(group: Group | None, standings: Mapping[str, Standing], *, root: str, ready: Iterable[str]) -> str:
    """Return why a group must be formed (anew) at once, in words; empty when it may stay as it is.

    Args:
        group: the present one; None: there is none yet.
        standings: the gateways that are there.
        root: the gateway that owns the task's key.
        ready: the subtasks that could start now.
    """
    if group is None:
        return "formed"
    if group.root != root:
        return f"{root} took over from {group.root}"
    for member in group.members:
        standing = standings.get(member)
        if standing is None and member != root:
            return f"{member} is gone"
        if standing is not None and not standing.serves and member != root:
            return f"{member} {standing.why_not or 'can serve nothing any more'}"
    for subtask in ready:
        if any(subtask in standings[each].serves for each in group.members if each in standings):
            continue
        able = sorted(each.gateway for each in standings.values() if subtask in each.serves)
        if able:
            return f"nobody in it could serve {subtask}, {able[0]} can"
    return ""


def form(
    standings: Iterable[Standing],
    *,
    root: str,
    previous: Group | None,
    limit: int,
    weights: Weights,
    why: str,
) -> Group:
    """Form a group, keeping of the previous one what can be kept.

    Args:
        standings: the gateways that are there.
        root: the gateway that owns the task's key: a member in any case.
        previous: the group so far.
        limit: members at most, at least 1.
        weights: of the score.
        why: what it is formed for, in words.

    Returns:
        A group whose members but the root can all serve something, and which together can serve all that any `limit`
        gateways chosen greedily can. The previous one itself, if nothing about it changes.
    """
    known = {each.gateway: each for each in standings}
    scores = {name: score(each, weights) for name, each in known.items()}
    able = {name: each.serves for name, each in known.items() if each.serves}
    members = [root]
    if previous is not None:
        members += [each for each in previous.members if each in able and each != root]
    members = members[: max(1, limit)]
    _cover(members, able, scores, root=root, limit=limit)
    outside = sorted((each for each in able if each not in members), key=lambda each: (-scores[each], each))
    while outside and len(members) < limit:
        members.append(outside.pop(0))
    _exchange(members, outside, able, scores, root=root)
    members.sort(key=lambda each: (-scores.get(each, 0.0), each))
    if previous is not None and set(previous.members) == set(members) and previous.root == root:
        return previous
    told = ", ".join(f"{each} {scores[each]:.2f}" if each in scores else each for each in members)
    if root not in able:
        told += f"; {root} coordinates only: {known[root].why_not if root in known else 'nothing is known of it'}"
    return Group(
        members=tuple(members),
        root=root,
        number=previous.number + 1 if previous is not None else 1,
        why=f"{why}: {told}",
    )


def _cover(
    members: list[str], able: Mapping[str, frozenset[str]], scores: Mapping[str, float], *, root: str, limit: int
) -> None:
    """Add those who can serve what no member can; one that others can do without makes room for them."""
    every = frozenset[str]().union(*able.values())
    while True:
        covered = _served(members, able)
        missing = every - covered
        others = [each for each in able if each not in members]
        best = max(others, key=lambda each: (len(able[each] & missing), scores[each], each), default="")
        if not best or not able[best] & missing:
            return
        if len(members) >= limit:
            spare = [
                each for each in members if each != root and _served([m for m in members if m != each], able) == covered
            ]
            if not spare:
                return
            members.remove(min(spare, key=lambda each: (scores[each], each)))
        members.append(best)


def _exchange(
    members: list[str],
    outside: list[str],
    able: Mapping[str, frozenset[str]],
    scores: Mapping[str, float],
    *,
    root: str,
) -> None:
    """Exchange members for clearly better ones, as long as nothing is lost that the group can serve."""
    for best in outside:
        covered = _served(members, able)
        spare = [
            each
            for each in members
            if each != root
            and scores[best] > scores[each] + HYSTERESIS
            and _served([*(m for m in members if m != each), best], able) >= covered
        ]
        if not spare:
            return
        members.remove(min(spare, key=lambda each: (scores[each], each)))
        members.append(best)


def _served(members: Iterable[str], able: Mapping[str, frozenset[str]]) -> frozenset[str]:
    return frozenset[str]().union(*(able[each] for each in members if each in able))


def without(group: Group, gateway: str, order: Sequence[str]) -> Group:
    """Return the group as it is once a member is gone, with the root that follows; the same if it was none."""
    members = tuple(each for each in group.members if each != gateway)
    if len(members) == len(group.members) or not members:
        return group
    root = group.root if group.root in members else root_of(members, order) or members[0]
    return replace(group, members=members, root=root, number=group.number + 1, why=f"{gateway} is gone")
