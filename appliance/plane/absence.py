"""Whether a record that is not here is nowhere: what an owner must know before it says that there is none. Pure.

A copy that is here answers a read; none is no answer until all are heard that may hold one. Two kinds are not:

- *silent* members, which are seen and with which the shard was to be compared, and which did not answer,
- members that are *gone*, where all holders of a key were lost together: copies are for r-1 of them. They may be on the
  other side of a cut, or late for their leases on a machine that starves, and have the record all the same.

What is gone counts for `GONE_S`; by then it is taken for lost, with what only it had. Until then whoever asks for such
a key is told that nobody knows.
"""

from collections.abc import Iterable

from appliance.plane.ring import Ring

GONE_S = 600.0
"""For so long members that were lost may come back with what only they have: as long as they are asked whether they are
there after all (`reconcile`)."""
_MOST_RINGS = 8


class Absence:
    """What one gateway has not heard of others' copies.

    Args:
        replicas: copies of a record.
    """

    def __init__(self, *, replicas: int) -> None:
        self._replicas = replicas
        self.silent: frozenset[str] = frozenset()
        """Members that are seen and have not answered yet when they were to be compared with."""
        self._gone: dict[str, float] = {}
        """Member that was lost -> until when it counts, on the caller's monotonic clock."""
        self._rings: tuple[Ring, ...] = ()
        """Rings on which copies were where they belong; the last one, and those before it whose keys are in doubt."""

    def lost(self, name: str, now: float) -> None:
        """A member is not seen any more."""
        self.silent -= {name}
        self._gone[name] = now + GONE_S

    def asked(self, members: Iterable[str], silent: frozenset[str]) -> None:
        """These were to be compared with, and of these some did not answer."""
        self.silent = (self.silent - frozenset(members)) | silent

    def heard(self, members: Iterable[str]) -> None:
        """These have answered."""
        self.silent -= frozenset(members)

    def settled(self, ring: Ring) -> None:
        """The shard is reconciled for a ring: with all who came, but for the silent."""
        for name in ring.members:
            self._gone.pop(name, None)
        if not self._rings or self._rings[-1].members <= ring.members:
            self._rings = (*self._rings[:-1], ring)

    def calm(self, ring: Ring, now: float) -> None:
        """All have answered a while after the last change: copies are where they belong on this ring."""
        self._gone = {name: until for name, until in self._gone.items() if until > now}
        if not self.silent:
            doubtful = (each for each in self._rings if each != ring and len(self._missing(each)) >= self._replicas)
            self._rings = (*doubtful, ring)[-_MOST_RINGS:]

    def doubt(self, key: str, now: float) -> tuple[str, ...]:
        """Gateways that may have a record of a key and were not heard; none: whoever may have it has told."""
        if self.silent:
            return tuple(sorted(self.silent))
        gone = {name for name, until in self._gone.items() if until > now}
        if len(gone) < self._replicas:
            return ()
        for ring in self._rings:
            holders = ring.successors(key, self._replicas)
            if gone.issuperset(holders):
                return holders
        return ()

    def _missing(self, ring: Ring) -> frozenset[str]:
        return ring.members & self._gone.keys()
