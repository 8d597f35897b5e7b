"""What one gateway knows of a ring too large to be known whole, and what it can say of a key from that.

Three kinds of members are worth remembering. Those next to it on the ring, both ways, make lookups correct: within
its *closed* stretch a gateway knows every member, so there, and only there, it can name a key's owner. Fingers, at
distances that grow by a constant factor, make lookups short. A few at random keep parts of the ring that lost each
other from staying apart. While the ring is no larger than the bound the closed stretch is all of it, and every lookup
is one hop. Each member has one point on the ring here: further virtual nodes would each need neighbours of their own.
"""

import math
import random
from bisect import bisect_left, bisect_right
from collections.abc import Iterable

from msgspec import Struct

from appliance.plane.ring import RING_SIZE, Ring, point

_CLOSER = 3
"""How many ways on an answer names, so that a lookup survives dead fingers without asking again."""


def bound_for(members: int) -> int:
    """How many members a view of a ring of that size needs: 4·log2 N, at least 16."""
    return max(16, math.ceil(4 * math.log2(max(2, members))))


def successor_count(members: float, bound: int) -> int:
    """Length of the successor list: 2·log2 N, at least 5, at most half the view.

    With half of all members failing at once, no successor is left of a fraction 2**-(2·log2 N) = N**-2 of members
    (SIGCOMM 2001, theorem 7, asks for a multiple of log N).
    """
    return max(1, min(bound // 2, max(5, math.ceil(2 * math.log2(max(2.0, members))))))


class Step(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a gateway says of a position: `ring_next`."""

    mine: bool = False
    """The position belongs to the gateway that was asked."""
    owners: tuple[str, ...] = ()
    """The members from the position on, the owner first, where they are known without a gap."""
    closer: tuple[str, ...] = ()
    """Members before the position, the nearest to it first."""


class Around(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A gateway's neighbours on the ring, without a gap, in ring order; and others that it knows."""

    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    whole: bool = False
    """`before`, `after` and the gateway itself are the whole ring."""


class View:
    """The members that `me` knows, at most `bound`; distances are clockwise from `me`, in (0, 2**160).

    `successors` fixes the length of the successor list; 0: it grows with the ring (`successor_count`).
    """

    def __init__(self, me: str, *, bound: int, replicas: int = 3, successors: int = 0) -> None:
        self.me = me
        self.origin = point(me)
        self.bound = bound
        self.replicas = replicas
        self._successors = successors
        self._distances: list[int] = []
        self._names: list[str] = []
        self._known: set[str] = set()
        self._new: set[str] = set()
        """Those heard of since the view was last trimmed."""
        # All members at distances in (0, _reach] and in [_back, RING_SIZE) are known.
        self._reach = 0
        self._back = RING_SIZE

    @classmethod
    def alone(cls, me: str, *, bound: int, replicas: int = 3) -> "View":
        """The view of the first gateway of a fleet: the whole ring is known, and empty."""
        view = cls(me, bound=bound, replicas=replicas)
        view._reach, view._back = RING_SIZE, 0
        return view

    @classmethod
    def settled(
        cls, me: str, ring: Ring, *, bound: int, replicas: int, rng: random.Random, successors: int = 0
    ) -> "View":
        """The view that upkeep arrives at while nothing changes. `ring`: all members, one virtual node each."""
        view = cls(me, bound=bound, replicas=replicas, successors=successors)
        names, size, place = ring.names, len(ring.names), bisect_left(ring.points, view.origin)
        if size - 1 <= bound:
            view.merge(me, Around(after=(*names[place + 1 :], *names[:place]), whole=True))
            return view
        after = successors or successor_count(size, bound)
        near = [names[(place + step) % size] for step in range(-view.before_count, after + 1)]
        view.merge(me, Around(before=tuple(near[: view.before_count]), after=tuple(near[view.before_count + 1 :])))
        view.hear(names[bisect_left(ring.points, target) % size] for target in view.targets())
        view.hear(rng.sample(names, min(size, bound - len(view) + 1)))
        view.trim(rng)
        return view

    # --- what is known ----------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, name: str) -> bool:
        return name in self._known

    @property
    def names(self) -> tuple[str, ...]:
        """The members known, in ring order from `me` on, without `me`."""
        return tuple(self._names)

    @property
    def whole(self) -> bool:
        """Whether every member of the ring is known."""
        return self._reach >= self._back - 1

    @property
    def before_count(self) -> int:
        """How many members before it a gateway keeps: those whose keys it replicates, and one more."""
        return max(1, min(self.bound // 4, self.replicas + 1))

    @property
    def after_count(self) -> int:
        """How many members after it a gateway keeps, for the ring as large as it looks."""
        return self._successors or successor_count(self.estimate(), self.bound)

    def after(self) -> list[str]:
        """The members known without a gap from `me` on: the successor list."""
        return self._names if self.whole else self._names[: self._within()]

    def before(self) -> list[str]:
        """The members known without a gap up to `me`, in ring order: the last is the predecessor."""
        return self._names if self.whole else self._names[self._from() :]

    def estimate(self) -> float:
        """How many members the ring has, from how densely they lie where all are known."""
        if self.whole:
            return len(self._names) + 1.0
        stretch = self._reach + RING_SIZE - self._back
        near = self._within() + len(self._names) - self._from()
        return 1.0 + (near * (RING_SIZE / stretch) if stretch else len(self._names))

    def replica_range(self) -> int | None:
        """The position after which this gateway holds copies, as owner or replica; None: of all keys, or unknown."""
        before = self.before()
        return point(before[-self.replicas]) if len(before) >= self.replicas else None

    def step(self, target: int, *, named: bool = False) -> Step:
        """What `me` can say of a position: that it is its own, whose it is, or who is closer to it.

        `named`: others take `me` for its owner. Then those before `me` are told if they lie after the position: so
        many may have joined there that who named it, and even `me`, does not know them all.
        """
        names, delta = self._names, (target - self.origin) % RING_SIZE
        here = bisect_left(self._distances, delta) if delta else len(names)
        most = self.after_count
        if delta == 0 or delta >= self._back or self.whole:
            if here == len(names):
                return Step(mine=True, owners=(self.me, *self.after()[: most - 1]))
            line = (*names[here:], self.me, *(names[:here] if self.whole else names[: self._within()]))
            return Step(owners=line[:most], closer=self._closer(here))
        if here < len(names) and self._distances[here] <= self._reach:
            return Step(owners=tuple(names[here : min(here + most, self._within())]), closer=self._closer(here))
        return Step(owners=tuple(self.before()) if named else (), closer=self._closer(here))

    def nearest(self, target: int, most: int) -> list[str]:
        """The members known that come before a position or are at it, the nearest first, at most so many."""
        here = bisect_right(self._distances, (target - self.origin) % RING_SIZE)
        found = self._names[max(0, here - most) : here]
        rest = most - len(found)
        if rest > 0:
            found = self._names[max(here, len(self._names) - rest) :] + found
        found.reverse()
        return found

    def around(self, others: tuple[str, ...] = ()) -> Around:
        """What `me` tells a member that it meets."""
        if self.whole and len(self._names) <= self.bound // 2:
            return Around(after=tuple(self._names), whole=True)
        after = self.after()[: self.after_count]
        before = [each for each in self.before()[-self.before_count :] if each not in after]
        told = {*after, *before}
        return Around(
            before=tuple(before), after=tuple(after), others=tuple(each for each in others if each not in told)
        )

    def unlisted(self, other: str, told: Around) -> list[str]:
        """Members known here that a member leaves out of its neighbours although they lie between them: gone?"""
        line = (*told.before, other, *told.after)
        listed, first = set(line), point(line[0])
        size = RING_SIZE if told.whole else (point(line[-1]) - first) % RING_SIZE
        index = bisect_left(self._distances, (first - self.origin) % RING_SIZE)
        found: list[str] = []
        for step in range(len(self._names)):
            name = self._names[(index + step) % len(self._names)]
            if (point(name) - first) % RING_SIZE >= size:
                break
            if name not in listed:
                found.append(name)
        return found

    # --- learning ---------------------------------------------------------------------------------------------

    def hear(self, names: Iterable[str]) -> list[str]:
        """Learn of members, from wherever; returns those that were not known."""
        return [name for name in names if self._insert(name)]

    def lose(self, name: str) -> bool:
        """Forget a member that is gone; returns whether it was known. That all others there are known stays true."""
        index = self._find(name)
        if index is None:
            return False
        del self._distances[index]
        del self._names[index]
        self._known.discard(name)
        return True

    def merge(self, other: str, told: Around) -> list[str]:
        """Learn what a member says of its neighbours: where its stretch meets ours, ours grows.

        Returns:
            The names that were not known, `told.others` left out.
        """
        line = (*told.before, other, *told.after)
        new = self.hear(line)
        if told.whole:
            self._reach, self._back = RING_SIZE, 0
            return new
        distances = [(point(name) - self.origin) % RING_SIZE for name in line]
        # Where the stretch passes `me`, who may be in it or not: distances start again there.
        turn = next((n for n in range(1, len(line)) if distances[n] < distances[n - 1]), 0)
        if distances[0] == 0:
            self._reach = max(self._reach, distances[-1])
        elif turn:
            self._back = min(self._back, distances[0])
            self._reach = max(self._reach, distances[-1])
        else:
            first, last = distances[0], distances[-1]
            if first <= self._reach:
                self._reach = max(self._reach, last)
            if last >= self._back:
                self._back = min(self._back, first)
        return new

    def trim(self, rng: random.Random) -> None:
        """Keep `bound` members: the nearest both ways, the best fingers, and others at random.

        Of these others who is known already stays: each that comes or goes is news for the rest of the plane, which
        watches its token and asks for its facts.
        """
        size, new = len(self._names), self._new
        self._new = set()
        if size <= self.bound:
            return
        after, before = self._kept()
        kept = {*range(after), *range(size - before, size)}
        for target in self.targets():
            index = bisect_left(self._distances, (target - self.origin) % RING_SIZE)
            if index < size:
                kept.add(index)
        rest = [index for index in range(size) if index not in kept]
        for heard_now in (False, True):
            some = [index for index in rest if (self._names[index] in new) is heard_now]
            kept.update(rng.sample(some, min(len(some), max(0, self.bound - len(kept)))))
        # Beyond what is kept on purpose there may now be gaps.
        self._reach = self._distances[after - 1] if after else 0
        self._back = self._distances[size - before] if before else RING_SIZE
        order = sorted(kept)
        self._distances = [self._distances[index] for index in order]
        self._names = [self._names[index] for index in order]
        self._known = set(self._names)

    def targets(self) -> list[int]:
        """The positions whose owners are worth knowing: at distances that grow by a constant factor.

        From the end of the successor list once round the ring, as many as there is room for. Chord's fingers are
        those with the factor 2; with f of them over a span S the factor is S**(1/f), and a hop leaves at most
        1 - 1/factor of the distance.
        """
        after, before = self._kept()
        count = self.bound - after - before - max(2, self.bound // 16)
        if count <= 0 or not after:
            return []
        start = self._distances[after - 1] / RING_SIZE
        span = -math.log(start)
        return [
            (self.origin + int(RING_SIZE * start * math.exp(span * number / (count + 1)))) % RING_SIZE
            for number in range(1, count + 1)
        ]

    # --- within -----------------------------------------------------------------------------------------------

    def _kept(self) -> tuple[int, int]:
        """How many of the members known without a gap are kept as neighbours, after and before."""
        size = len(self._names)
        if self.whole:
            return min(self.after_count, size), min(self.before_count, size)
        return min(self.after_count, self._within()), min(self.before_count, size - self._from())

    def _within(self) -> int:
        return bisect_left(self._distances, self._reach + 1)

    def _from(self) -> int:
        return bisect_left(self._distances, self._back)

    def _closer(self, here: int) -> tuple[str, ...]:
        return tuple(reversed(self._names[max(0, here - _CLOSER) : here]))

    def _find(self, name: str) -> int | None:
        distance = (point(name) - self.origin) % RING_SIZE
        index = bisect_left(self._distances, distance)
        return index if index < len(self._names) and self._names[index] == name else None

    def _insert(self, name: str) -> bool:
        if name in self._known:  # most of what is heard
            return False
        distance = (point(name) - self.origin) % RING_SIZE
        index = bisect_left(self._distances, distance)
        if distance == 0 or (index < len(self._names) and self._distances[index] == distance):
            return False
        self._distances.insert(index, distance)
        self._names.insert(index, name)
        self._known.add(name)
        self._new.add(name)
        return True
