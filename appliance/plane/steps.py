"""What a gateway compares next: for which ring, with whom, and what must not wait for it. Pure.

A change of membership is taken in steps, losses before arrivals. What somebody who is gone has left is waited for, by
tasks that nobody drives; what somebody brings who has come back is not, since keys only move to him. One that has just
started may be slow to answer, and must not hold up the takeover from one that died meanwhile.
"""

from collections.abc import Set
from enum import StrEnum

from msgspec import Struct

from appliance.plane.partners import partners, sharing
from appliance.plane.ring import Ring

AT_REST = 8
"""Members compared with in a round while nothing changes: all of a small fleet, some of a large one in turn."""
FEW = 32
"""A fleet of so many is small: whoever comes asks all it shares records with before it shows itself, and is asked."""
_MOST_MET = 4096


class Kind(StrEnum):
    """Why something is compared."""

    FIRST = "first"
    """Nothing is known of the others' copies: at first, and after this process stood still."""
    LOSS = "loss"
    """Somebody has gone."""
    ARRIVAL = "arrival"
    """Somebody has come."""
    REST = "rest"
    """Nothing has changed."""


class Settled(Struct, frozen=True):
    """The ring, and the count of stalls, that the shard was last reconciled for."""

    ring: Ring
    stalls: int


class Step(Struct, frozen=True, kw_only=True):
    """One comparison; once it is done the shard is reconciled for `ring`."""

    kind: Kind
    ring: Ring
    stalls: int
    asked: tuple[str, ...] = ()


class Steps:
    """Decides on the steps of one gateway. `me`: its id; `replicas`: copies of a record."""

    def __init__(self, me: str, *, replicas: int) -> None:
        self._me = me
        self._replicas = replicas
        self._near: tuple[Ring, frozenset[str]] | None = None
        self._turn = 0
        self._met: frozenset[str] = frozenset()
        """Gateways that this one has ever been on a ring with, since it started."""

    def settled(self, step: Step) -> Settled:
        """Note that a step is done."""
        members = step.ring.members
        self._met = members if len(self._met) > _MOST_MET else self._met | members
        return Settled(step.ring, step.stalls)

    def met(self, name: str) -> bool:
        """Whether a gateway was ever on a ring that was settled here: one that comes again was away."""
        return name in self._met

    def next(self, settled: Settled | None, ring: Ring, stalls: int) -> Step:
        """The next step towards a ring.

        One that was away may have ordered writes on the other side of a cut: whoever shares records with it asks. Of
        one never seen before that is assumed in a small fleet only: a large one would ask it a hundred times.
        At rest some are asked at a time, in turn: half of those that share records, half of all, since two that lost
        sight of each other learn of it by asking.
        """
        if settled is None or settled.stalls != stalls:
            return Step(kind=Kind.FIRST, ring=ring, stalls=stalls, asked=tuple(sorted(self.sharing(ring))))
        before = settled.ring
        if before == ring:
            return Step(kind=Kind.REST, ring=ring, stalls=stalls, asked=self._some_of(ring))
        stayed = before.members & ring.members
        if stayed != before.members:
            target = before.changed_to(stayed) if stayed else ring
            asked = partners(before, target, self._me, self._replicas)
            return Step(kind=Kind.LOSS, ring=target, stalls=stalls, asked=tuple(sorted(asked)))
        came = ring.members - before.members
        back = came if len(ring.members) <= FEW else came & self._met
        sharers = self.sharing(ring) & back if back else frozenset[str]()
        asked = partners(before, ring, self._me, self._replicas) | sharers
        return Step(kind=Kind.ARRIVAL, ring=ring, stalls=stalls, asked=tuple(sorted(asked)))

    def urgent(self, step: Step, members: Set[str], stalls: int) -> bool:
        """Whether a step that is under way is to be given up for what has happened since."""
        lost = step.ring.members - members
        if stalls != step.stalls:
            return True
        return bool(lost) if step.kind in (Kind.ARRIVAL, Kind.REST) else not lost.isdisjoint(step.asked)

    def sharing(self, ring: Ring) -> frozenset[str]:
        """The members that hold copies of the same records; found once for each ring."""
        if self._near is None or self._near[0] is not ring:
            self._near = ring, sharing(ring, self._me, self._replicas)
        return self._near[1]

    def _some_of(self, ring: Ring) -> tuple[str, ...]:
        others = sorted(ring.members - {self._me})
        if len(others) <= AT_REST:
            return tuple(others)
        self._turn += 1
        near = sorted(self.sharing(ring))
        return tuple(sorted({*_some(near, self._turn), *_some(others, self._turn)}))


def _some(names: list[str], turn: int) -> list[str]:
    """Half of `AT_REST` names, others each turn until all have had theirs."""
    most = AT_REST // 2
    start = turn * most % max(1, len(names))
    return (names[start:] + names[:start])[:most]
