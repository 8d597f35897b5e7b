"""Which keys go where when the ring changes: exactly the stretches whose replica set is another, and no more.

Consistent hashing promises that a join takes keys only from its neighbours (Karger et al., STOC 1997; Chord, theorem
IV.1: about K/N of K keys move); this says which. The stretches between the points of both rings are gone through
once; each belongs to one replica set before and one after, and only what differs is moved.
"""

from collections.abc import Iterator

from msgspec import Struct

from appliance.plane.ring import RING_SIZE, Ring


class Stretch(Struct, frozen=True, order=True):
    """Positions in (`after`, `upto`], clockwise; the whole ring when both are the same."""

    after: int
    upto: int

    def __contains__(self, place: int) -> bool:
        return self.after == self.upto or 0 < (place - self.after) % RING_SIZE <= self.size

    @property
    def size(self) -> int:
        """How many positions it has."""
        return (self.upto - self.after) % RING_SIZE or RING_SIZE


class Move(Struct, frozen=True, kw_only=True):
    """The keys of a stretch are copied to a member that did not hold them."""

    stretch: Stretch
    to: str
    sources: tuple[str, ...]
    """Members that held them and are still there, the owner before first; empty: all that held them are gone."""
    owner: bool
    """Whether it is their owner now, not only a replica."""


class Drop(Struct, frozen=True, kw_only=True):
    """The keys of a stretch need not be held by a member any more, once those in `after` hold them."""

    stretch: Stretch
    by: str
    held: tuple[str, ...]


def moves(before: Ring, after: Ring, *, replicas: int) -> tuple[list[Move], list[Drop]]:
    """Return what is to be copied and what can be dropped when one ring becomes another."""
    copied: list[Move] = []
    dropped: list[Drop] = []
    if not before.members or not after.members:
        return copied, dropped
    for stretch in stretches(before, after):
        old = before.holders(stretch.upto, replicas)
        new = after.holders(stretch.upto, replicas)
        if old == new:
            continue
        sources = tuple(name for name in old if name in after.members)
        copied += [
            Move(stretch=stretch, to=name, sources=sources, owner=name == new[0]) for name in new if name not in old
        ]
        dropped += [Drop(stretch=stretch, by=name, held=new) for name in sources if name not in new]
    return copied, dropped


def stretches(*rings: Ring) -> Iterator[Stretch]:
    """The stretches between neighbouring points of all these rings: within one, all keys have the same holders."""
    points = sorted({each for ring in rings for each in ring.points})
    for number, upto in enumerate(points):
        yield Stretch(points[number - 1], upto)


def partners(ring: Ring, name: str, *, replicas: int) -> frozenset[str]:
    """The members that hold a key together with this one: whom anti-entropy has to compare with."""
    found: set[str] = set()
    for stretch in stretches(ring):
        holders = ring.holders(stretch.upto, replicas)
        if name in holders:
            found.update(holders)
    return frozenset(found - {name})
