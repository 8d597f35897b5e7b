"""Where a key belongs: consistent hashing on a 160-bit ring (design/algorithms, DHT; Chord). Pure.

Every gateway computes the same answer from the same membership, so finding a key's owner asks nobody: one hop
while the membership is known whole.
"""

import hashlib
import threading
from bisect import bisect_left
from collections.abc import Iterable
from functools import lru_cache

from appliance.errors import UnreachableError

RING_BITS = 160
RING_SIZE = 2**RING_BITS
_FEW = 8
"""Members that come or go at once; beyond so many a ring built again is as cheap as one changed."""

_MOST_RECENT = 8
_LOCK = threading.Lock()


@lru_cache(maxsize=4096)
def position(text: str) -> int:
    """Where a text lies on the ring: its SHA-1 as a number in [0, 2**160)."""
    return int.from_bytes(hashlib.sha1(text.encode(), usedforsecurity=False).digest(), "big")


@lru_cache(maxsize=32_768)
def point(name: str, number: int = 0) -> int:
    """Where a gateway's virtual node of that number lies on the ring."""
    return position(f"{name}#{number}")


class Ring:
    """The ring of a set of gateways, each at `virtual_nodes` points. Immutable."""

    def __init__(self, members: Iterable[str], *, virtual_nodes: int) -> None:
        self.members: frozenset[str] = frozenset(members)
        self.virtual_nodes = virtual_nodes
        points = sorted((point(name, n), name) for name in self.members for n in range(virtual_nodes))
        self.points: tuple[int, ...] = tuple(each for each, _ in points)
        """Positions of all virtual nodes, ascending."""
        self.names: tuple[str, ...] = tuple(name for _, name in points)
        """Whose they are, in the same order."""

    @classmethod
    def _made(cls, members: frozenset[str], virtual_nodes: int, points: list[int], names: list[str]) -> "Ring":
        ring = cls((), virtual_nodes=virtual_nodes)
        ring.members, ring.points, ring.names = members, tuple(points), tuple(names)
        return ring

    def changed_to(self, members: frozenset[str]) -> "Ring":
        """The ring of other members; one that differs in a few is made from this one, which is cheaper."""
        if members == self.members:
            return self
        with _LOCK:
            known = _recent.get((members, self.virtual_nodes))
        if known is not None:
            return known
        made = self._changed_to(members)
        with _LOCK:
            _recent[members, self.virtual_nodes] = made
            while len(_recent) > _MOST_RECENT:
                del _recent[next(iter(_recent))]
        return made

    def _changed_to(self, members: frozenset[str]) -> "Ring":
        came, went = members - self.members, self.members - members
        if len(came) + len(went) > _FEW:
            return Ring(members, virtual_nodes=self.virtual_nodes)
        points, names = list(self.points), list(self.names)
        for name in went:
            for number in range(self.virtual_nodes):
                at = names.index(name, bisect_left(points, point(name, number)))
                del points[at], names[at]
        for name in came:
            for number in range(self.virtual_nodes):
                place = point(name, number)
                at = bisect_left(points, place)
                while at < len(points) and points[at] == place and names[at] < name:
                    at += 1
                points.insert(at, place)
                names.insert(at, name)
        return Ring._made(members, self.virtual_nodes, points, names)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Ring) and self.members == other.members and self.virtual_nodes == other.virtual_nodes

    def __hash__(self) -> int:
        return hash((self.members, self.virtual_nodes))

    def position(self, text: str) -> int:
        """Where a text lies on the ring."""
        return position(text)

    def owner(self, key: str) -> str:
        """The gateway a key belongs to: the first point at or after the key's; UnreachableError on an empty ring."""
        if not self.points:
            return self.successors(key, 1)[0]
        at = bisect_left(self.points, position(key))
        return self.names[at if at < len(self.names) else 0]

    def successors(self, key: str, n: int) -> tuple[str, ...]:
        """The first `n` different gateways from the key's position on, its owner first; fewer on a smaller ring."""
        return self.holders(position(key), n)

    def holders(self, place: int, n: int) -> tuple[str, ...]:
        """The same for a position."""
        if not self.points:
            raise UnreachableError("the ring has no gateway", remedy="start one with `swiftbot gateway`")
        # A point equal to the position owns it.
        start = bisect_left(self.points, place)
        wanted = min(n, len(self.members))
        found: dict[str, None] = {}
        for step in range(len(self.points)):
            found[self.names[(start + step) % len(self.points)]] = None
            if len(found) == wanted:
                break
        return tuple(found)

    def shares(self) -> dict[str, float]:
        """Return the share of all positions that each gateway owns, 0 to 1; they add up to 1."""
        found = dict.fromkeys(self.members, 0)
        for index, name in enumerate(self.names):
            # A virtual node owns what lies after the one before it; a single one owns all.
            alone = len(self.points) == 1
            found[name] += RING_SIZE if alone else (self.points[index] - self.points[index - 1]) % RING_SIZE
        return {name: length / RING_SIZE for name, length in found.items()}

    def with_member(self, name: str) -> "Ring":
        """The ring once that gateway has joined."""
        return self.changed_to(self.members | {name})

    def without_member(self, name: str) -> "Ring":
        """The ring once that gateway has left."""
        return self.changed_to(self.members - {name})


_recent: dict[tuple[frozenset[str], int], Ring] = {}
"""Rings made last: the same one is wanted by everybody in this process that hears of a change."""
