"""Where a key belongs: consistent hashing on a 160-bit ring (design/algorithms, DHT; Chord). Pure.

Every gateway computes the same answer from the same membership, so finding a key's owner asks nobody: one hop
while the membership is known whole.
"""

import hashlib
from bisect import bisect_right
from collections.abc import Iterable

from appliance.errors import UnreachableError

RING_BITS = 160


def position(text: str) -> int:
    """Where a text lies on the ring: its SHA-1 as a number in [0, 2**160)."""
    return int.from_bytes(hashlib.sha1(text.encode(), usedforsecurity=False).digest(), "big")


class Ring:
    """The ring of a set of gateways, each at `virtual_nodes` points. Immutable."""

    def __init__(self, members: Iterable[str], *, virtual_nodes: int) -> None:
        self.members: frozenset[str] = frozenset(members)
        self.virtual_nodes = virtual_nodes
        points = sorted((position(f"{name}#{n}"), name) for name in self.members for n in range(virtual_nodes))
        self._points = [point for point, _ in points]
        self._names = [name for _, name in points]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Ring) and self.members == other.members and self.virtual_nodes == other.virtual_nodes

    def __hash__(self) -> int:
        return hash((self.members, self.virtual_nodes))

    def position(self, text: str) -> int:
        """Where a text lies on the ring."""
        return position(text)

    def owner(self, key: str) -> str:
        """The gateway a key belongs to: the first point at or after the key's; UnreachableError on an empty ring."""
        return self.successors(key, 1)[0]

    def successors(self, key: str, n: int) -> tuple[str, ...]:
        """The first `n` different gateways from the key's position on, its owner first; fewer on a smaller ring."""
        if not self._points:
            raise UnreachableError("the ring has no gateway", remedy="start one: `swiftbot up` or `swiftbot gateway`")
        # A point equal to the key's position owns it: bisect_right of the position just before.
        start = bisect_right(self._points, position(key) - 1)
        wanted = min(n, len(self.members))
        found: dict[str, None] = {}
        for step in range(len(self._points)):
            found[self._names[(start + step) % len(self._points)]] = None
            if len(found) == wanted:
                break
        return tuple(found)

    def with_member(self, name: str) -> "Ring":
        """The ring once that gateway has joined."""
        return self if name in self.members else Ring(self.members | {name}, virtual_nodes=self.virtual_nodes)
