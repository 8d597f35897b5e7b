"""Whom a gateway compares its records with when the ring changes: those who held what it must hold now. Pure.

A change of membership concerns only the stretches of the ring next to the points that came or went. Elsewhere the
same gateways hold the same keys in the same order, and comparing would cost a large fleet N questions of every member
for each gateway that comes or goes.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator

from appliance.plane.ring import Ring, point


def partners(before: Ring, now: Ring, me: str, replicas: int) -> frozenset[str]:
    """The gateways to compare with before `me` answers for keys on the ring `now`.

    For every stretch that `me` has come to hold a copy of, or to own, since `before`: those that held or hold it, and
    the one after them, which held it when somebody has come since. They must be on the ring `now`.

    Args:
        before: the ring of the last comparison; an empty one: nothing is known, everything is compared.
        now: the ring as it is.
        me: this gateway.
        replicas: copies of a record.
    """
    if before.points and me in before.members and not _may_gain(before, now, me, replicas):
        return frozenset()
    found = set[str]()
    for places in _stretches(before, now, me, replicas):
        end = places[-1]
        holding = now.holders(end, replicas + 1)
        for place in places:
            held = before.holders(place, replicas + 1) if before.points else ()
            if me not in held[:replicas] or (holding[:1] == (me,) != held[:1]):
                found.update(holding, held)
    return frozenset((found & now.members) - {me})


def _may_gain(before: Ring, now: Ring, me: str, replicas: int) -> bool:
    """Whether `me`, which was there, can hold more than before: only if somebody went who stood just before it."""
    went = before.members - now.members
    reach = replicas + len(went)
    return any(
        me in before.holders(point(name, number), reach) for name in went for number in range(before.virtual_nodes)
    )


def sharing(ring: Ring, me: str, replicas: int) -> frozenset[str]:
    """The gateways that hold a copy of anything that `me` holds a copy of."""
    return partners(Ring((), virtual_nodes=ring.virtual_nodes), ring, me, replicas)


def _stretches(before: Ring, now: Ring, me: str, replicas: int) -> Iterator[list[int]]:
    """Stretches of `now` that `me` holds a copy of, each by the ends of the stretches of `before` in it, its own last.

    The end of a stretch is the point that owns it.
    """
    points, names = now.points, now.names
    size, seen = len(points), set[int]()
    for number in range(now.virtual_nodes if me in now.members else 0):
        at = names.index(me, bisect_left(points, point(me, number)))
        passed = set[str]()
        for step in range(size):
            index = (at - step) % size
            if names[index] != me:
                passed.add(names[index])
                if len(passed) >= replicas:
                    break
            if index not in seen:
                seen.add(index)
                yield [*_within(before, points[index - 1], points[index]), points[index]]


def _within(ring: Ring, start: int, end: int) -> tuple[int, ...]:
    """Points of a ring after `start` and before `end`, going clockwise."""
    points = ring.points
    if start < end:
        return points[bisect_right(points, start) : bisect_left(points, end)]
    return (*points[bisect_right(points, start) :], *points[: bisect_left(points, end)])
