"""The ring when not every gateway knows every other: bounded views, lookups hop by hop, upkeep. Pure.

To about a thousand gateways everybody knows everybody (`membership`), and a lookup is one hop. Beyond that each keeps a
bounded view. Clock and randomness are passed in: the same code runs under property tests and in the simulation of
10,000 gateways (`swiftbot bench dht`). No gateway runs it: members beyond `membership.MOST_MEMBERS` are refused.

**View**: what one gateway knows of the ring, and what it can say of a key from that. Three kinds of members are worth
remembering. Those next to it on the ring, both ways, make lookups correct: within its *closed* stretch a gateway
knows every member, so there, and only there, it can name a key's owner. Fingers, at distances that grow by a constant
factor, make lookups short. A few at random keep parts of the ring that lost each other from staying apart. While the
ring is no larger than the bound the closed stretch is all of it, and every lookup is one hop. Each member has one
point on the ring here: further virtual nodes would each need neighbours of their own.

**Lookup**: greedy, iterative, and finite whatever is answered. The gateway that looks up asks, itself, one member after
the other (Chord's iterative style), so that a dead or confused one costs a question and not the lookup. Towards the
position it always goes to the nearest member before it that it has heard of; once somebody names the owners, those are
asked in ring order, and the first that answers is the owner: everything between the position and it is gone. Nobody is
asked twice, so a lookup never runs in a circle.

**Upkeep**: joining, meeting neighbours, mending after failures, gossip. A round is one errand: meet a member (swap
neighbours and a few others, and see that it is there) or look up a finger's position. Neighbours matter most, so
every other round goes to them; fingers are looked up in turn, and the rest met in turn, those not heard of for
longest first. When a round finds something changed the next comes sooner, when not, later: at rest a gateway sends a
few bytes a second, and under churn as much as it takes (`Pace`). Rounds come from `due`, what came of them goes back
in.

Sources: Stoica et al., "Chord", SIGCOMM 2001 and IEEE/ACM ToN 11(1), 2003 (ring, successor list, greedy lookup,
stabilisation); Manku et al., "Symphony", USITS 2003 (distances of the long links); Gupta et al., "One hop lookups for
peer-to-peer overlays", HotOS 2003 (the view known whole).
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

    def step(self, target: int, *, named: bool = False) -> Step:
        """What `me` can say of a position: that it is its own, whose it is, or who is closer to it.

        `named`: others take `me` for its owner. Then those before `me` hear of it if they lie after the position: so
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


MOST_ASKED = 128
"""Questions of one lookup, dead members included: twenty times what a ring of a million members needs."""


class NextAsk(Struct, frozen=True, omit_defaults=True):
    """`ring_next`: what do you know of this position?"""

    position: str
    """In hex: JSON numbers end at 64 bits."""
    named: bool = False
    """You were named as its owner."""


class Owners(Struct, frozen=True, kw_only=True):
    """A lookup's end: the owner, and the next members after it as far as the owner named them."""

    owner: str
    replicas: tuple[str, ...]


class Lookup:
    """One lookup: ask `next()`, tell `answered` or `failed`, until `result` is there or `next()` has nobody more."""

    def __init__(self, target: int, view: View) -> None:
        self.target = target
        self.result: Owners | None = None
        self.hops = 0
        """Members that answered, the owner among them: 0 when the position is one's own, 1 when the owner is known."""
        self.gone: dict[str, None] = {}
        """Members asked in vain, in that order."""
        self._asked: set[str] = {view.me}
        self._before: dict[str, int] = {}
        """Not yet asked: name -> distance from it on to the position."""
        self._owners: dict[str, int] = {}
        """Named as owners: name -> distance from the position on to it."""
        self._steps: dict[str, Step] = {}
        here = view.step(target)
        for name in view.nearest(target, MOST_ASKED):
            self._before[name] = (target - point(name)) % RING_SIZE
        self._take(view.me, here)

    def next(self) -> str | None:
        """Whom to ask now; None when the lookup is over, with or without a result."""
        if self.result is not None or len(self._asked) > MOST_ASKED:
            return None
        name = self._nearest_owner() or min(self._before, key=self._before.__getitem__, default=None)
        if name is not None:
            self._asked.add(name)
            self._before.pop(name, None)
        return name

    def named(self, name: str) -> bool:
        """Whether a member was named as the owner: the question says so."""
        return name in self._owners

    def answered(self, name: str, step: Step) -> None:
        """A member that was asked has answered."""
        self.hops += 1
        self._take(name, step)

    def failed(self, name: str) -> None:
        """A member that was asked is not there."""
        self.gone[name] = None
        self._owners.pop(name, None)
        self._end()

    def _take(self, name: str, step: Step) -> None:
        if step.mine:
            # A member says so only if it knows of nobody between the position and itself.
            self._owners[name] = (point(name) - self.target) % RING_SIZE
        self._steps[name] = step
        for each in step.owners:
            if each not in self.gone:
                self._owners[each] = (point(each) - self.target) % RING_SIZE
        for each in step.closer:
            if each not in self._asked:
                self._before[each] = (self.target - point(each)) % RING_SIZE
        self._end()

    def _nearest_owner(self) -> str | None:
        unasked = [name for name in self._owners if name not in self._asked]
        return min(unasked, key=self._owners.__getitem__, default=None)

    def _end(self) -> None:
        """The nearest owner named is the owner once it has answered: all that were named before it are gone."""
        if not self._owners:
            return
        nearest = min(self._owners, key=self._owners.__getitem__)
        step = self._steps.get(nearest)
        if step is None:
            return
        known = sorted((each for each in self._owners if each != nearest), key=self._owners.__getitem__)
        self.result = Owners(owner=nearest, replicas=tuple(known))


_OTHERS = 4
"""Members named beside the neighbours whenever two meet: half of them the newest heard of, so that joins spread."""
_GONE_S = 120.0
"""How long hearsay does not bring back a member that was found gone; it can itself, at once."""
_LOST_S = 600.0
"""How long a member that was found gone is tried again now and then: what was cut off may be linked again, and two
parts of a ring that forgot each other would stay two rings."""
_LOST_TURN = 16
"""Every so many rounds."""
_MOST_GONE = 1024
_MOST_FIRST = 32
_TRUST_S = 5.0
"""How long a member that was heard from is not suspected."""
_PATIENCE = 3
"""Questions in a row that a member whose token is seen may leave without an answer before it counts as gone."""
_BREATH = 4.0
"""The next round comes no sooner than after so many times what the last one took: where all are slow because there is
more to do than they can, they do less."""


class MeetAsk(Struct, frozen=True, omit_defaults=True):
    """`ring_meet`: here am I; who is around you?"""

    asker: str
    all: bool = False
    """A joiner's: everybody you know."""


class LeaveAsk(Struct, frozen=True):
    """`ring_leave`: I go, and `around` me are these."""

    leaver: str
    around: Around


class Pace(Struct, frozen=True, kw_only=True):
    """How often a round comes, seconds."""

    least_s: float = 0.2
    most_s: float = 10.0
    faster: float = 0.6
    """Factor after a round that found a member gone, or a neighbour unknown."""
    slower: float = 1.06
    """Factor after one that did not: while members come and go about one round in ten finds something."""


class Meet(Struct, frozen=True):
    """A round: meet this member."""

    member: str


class Seek(Struct, frozen=True):
    """A round: look up whose this position is, for a finger."""

    target: int


class Upkeep:
    """The upkeep of one gateway's view."""

    def __init__(self, view: View, *, rng: random.Random, now: float, pace: Pace | None = None) -> None:
        self.view = view
        self._rng = rng
        self._pace = pace or Pace()
        self.interval_s = self._pace.least_s
        self.next_at = now + rng.uniform(0, self.interval_s)
        self._seen: dict[str, float] = dict.fromkeys(view.names, now)
        self._gone: dict[str, float] = {}
        self._late: dict[str, int] = {}
        """Member -> questions in a row that it has not answered in time."""
        self._newest: list[str] = []
        self._turn = 0
        self._finger = view.origin % view.bound
        """Number of the finger looked up last; not all members begin with the same one."""
        self._first: list[str] = []
        """To be met before all others, the last first: a joiner's neighbours; members that their neighbour left out, or
        that show no token."""

    def settle(self, now: float) -> None:
        """Begin as if nothing had changed for long: rounds spread over the longest interval."""
        self.interval_s = self._pace.most_s
        self.next_at = now + self._rng.uniform(0, self.interval_s)

    def joined(self, successor: str, told: Around, now: float) -> None:
        """The member at whose stretch this one joins has told everybody it knows; its neighbours are met first."""
        self.met(successor, told, now)
        view = self.view
        near = [*view.after()[: view.before_count], *reversed(view.before()[-view.before_count :])]
        self._first = [name for name in dict.fromkeys(reversed(near)) if name != successor]
        self.interval_s = self._pace.least_s
        self.next_at = now

    # --- rounds -----------------------------------------------------------------------------------------------

    def due(self, now: float) -> Meet | Seek | None:
        """The next round; None when there is nobody to meet."""
        view = self.view
        while self._first:
            name = self._first.pop()
            if name in view:
                self.next_at = now + self._pace.least_s
                return Meet(name)
        self.next_at = now + self.interval_s * self._rng.uniform(0.75, 1.25)
        self._turn += 1
        lost = self._lost(now) if self._turn % _LOST_TURN == 0 or not len(view) else ""
        if lost:
            return Meet(lost)
        if not len(view):
            return None
        after, before = view.after(), view.before()
        # Too short a list of neighbours: the one that is last in it knows those beyond.
        if self._turn % 4 == 1:
            short = not view.whole and len(after) < view.after_count
            return Meet(after[-1] if short and after else view.names[0])
        if self._turn % 4 == 3:
            short = not view.whole and len(before) < view.before_count
            return Meet(before[0] if short and before else view.names[-1])
        targets = view.targets() if self._turn % 4 == 2 and not view.whole else []
        if targets:
            # One after the other: drawn by lot, one of twenty would wait for three times as many rounds, now and then.
            self._finger = (self._finger + 1) % len(targets)
            return Seek(targets[self._finger])
        return Meet(min(view.names, key=lambda name: self._seen.get(name, 0.0)))

    def met(self, member: str, told: Around, now: float) -> None:
        """The member met has answered."""
        self._seen[member] = now
        self._late.pop(member, None)
        self._gone.pop(member, None)
        # One that was heard from a moment ago is there, only its neighbour does not know it yet.
        suspects = [name for name in self.view.unlisted(member, told) if now - self._seen.get(name, 0.0) > _TRUST_S]
        self._first = [*suspects, *self._first][-_MOST_FIRST:]
        usable = self._usable(told, now)
        new = self.view.merge(member, usable)
        self.view.hear(usable.others)
        self._changed(self._news(new) or bool(suspects))

    def took(self, seconds: float, now: float) -> None:
        """So long a round has taken."""
        self.next_at = max(self.next_at, now + min(self._pace.most_s, seconds * _BREATH))

    def late(self, member: str, now: float, *, in_round: bool = True) -> None:
        """A member has not answered in time, in a round or a lookup; that it is gone its token would tell."""
        count = self._late.get(member, 0) + 1
        if count >= _PATIENCE or member not in self.view:
            self.unreachable(member, now, in_round=in_round)
            return
        self._late[member] = count
        # Not the one to be met next again.
        self._seen[member] = now

    def doubt(self, member: str, now: float) -> None:
        """A member that was heard of shows no token: it is met next, since it may be gone."""
        if member in self.view and member not in self._first:
            self._first = [*self._first, member][-_MOST_FIRST:]
            self.next_at = min(self.next_at, now + self._pace.least_s)

    def unreachable(self, member: str, now: float, *, in_round: bool = True) -> None:
        """A member is not there: found so in a round, by a lookup, or told by the one that watches for it."""
        known = self.view.lose(member)
        self._seen.pop(member, None)
        self._late.pop(member, None)
        if len(self._gone) >= _MOST_GONE:
            del self._gone[next(iter(self._gone))]
        self._gone.setdefault(member, now)
        if in_round:
            self._changed(known)

    def found(self, names: Iterable[str], now: float) -> None:
        """A lookup of a finger's position has ended with these members, or others were heard of."""
        self.view.hear(self._fresh(names, now))
        self.view.trim(self._rng)
        self._changed(False)

    # --- being met --------------------------------------------------------------------------------------------

    def asked(self, ask: MeetAsk, now: float) -> Around:
        """Answer a member that meets this one; it is heard of by that."""
        answer = self.view.around(self._others(ask))
        self._seen[ask.asker] = now
        self._gone.pop(ask.asker, None)
        if self._news(self.view.hear((ask.asker,))):
            self._changed(True)
            self.next_at = min(self.next_at, now + self.interval_s)
        return answer

    def left(self, ask: LeaveAsk, now: float) -> None:
        """A member says that it goes, and who its neighbours are."""
        self.view.merge(ask.leaver, self._usable(ask.around, now))
        self.unreachable(ask.leaver, now, in_round=False)
        self.view.trim(self._rng)

    def leaving(self) -> tuple[LeaveAsk, tuple[str, ...]]:
        """What to say on leaving, and to whom: those whose neighbour this gateway is."""
        view = self.view
        return LeaveAsk(view.me, view.around()), (*view.before()[-view.replicas :], *view.after()[: view.replicas])

    # --- within -----------------------------------------------------------------------------------------------

    def _others(self, ask: MeetAsk) -> tuple[str, ...]:
        names = self.view.names
        if ask.all:
            return tuple(name for name in names if name != ask.asker)
        newest = [name for name in self._newest if name in self.view][: _OTHERS // 2]
        drawn = self._rng.sample(names, min(len(names), _OTHERS - len(newest)))
        return tuple(name for name in dict.fromkeys((*newest, *drawn)) if name != ask.asker)

    def _lost(self, now: float) -> str:
        """A member found gone that may be back; empty: none."""
        self._gone = {name: at for name, at in self._gone.items() if now - at < _LOST_S}
        return self._rng.choice(list(self._gone)) if self._gone else ""

    def _usable(self, told: Around, now: float) -> Around:
        return Around(
            before=self._fresh(told.before, now),
            after=self._fresh(told.after, now),
            others=self._fresh(told.others, now),
            whole=told.whole,
        )

    def _fresh(self, names: Iterable[str], now: float) -> tuple[str, ...]:
        """Those not found gone a short while ago."""
        return tuple(name for name in names if now - self._gone.get(name, -_GONE_S) >= _GONE_S)

    def _news(self, new: list[str]) -> bool:
        """Trim the view, and return whether neighbours are among those heard of: those are passed on."""
        view = self.view
        view.trim(self._rng)
        if len(self._seen) > 2 * view.bound:
            self._seen = {name: at for name, at in self._seen.items() if name in view}
            self._late = {name: count for name, count in self._late.items() if name in view}
        most = view.before_count
        near = set(view.names) if view.whole else {*view.after()[:most], *view.before()[-most:]}
        news = [name for name in new if name in near]
        self._newest = [*news[:_OTHERS], *self._newest][:_OTHERS]
        return bool(news)

    def _changed(self, changed: bool) -> None:
        pace = self._pace
        factor = pace.faster if changed else pace.slower
        self.interval_s = min(pace.most_s, max(pace.least_s, self.interval_s * factor))
