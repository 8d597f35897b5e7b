"""Who has taken which robot over, and until when: one gateway's view, by its own clock. Pure, the clock is passed in.

That there is one winner is decided where the lease's record is written, under compare-and-set; here it is kept how
long each holds. A lease that is heard of counts from then, whatever its giver's clock says; so it may hold a little
longer than its operator thinks, never shorter than its renewals allow.
"""

from collections.abc import Iterable

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import Lease

MOST = 1024
"""Robots taken over at once, and leases remembered that have ended."""
GIVEN_BACK = "given back"
EXPIRED = "expired"


class _Held(Struct):
    lease: Lease
    until: float
    over: bool = False
    """Found due: no command under it counts any more."""
    ending: bool = False
    """Its end is on its way from here: a renewal that is heard now comes too late."""


class Leases:
    """The leases as one gateway knows them; `now` is monotonic seconds."""

    def __init__(self) -> None:
        self._held: dict[str, _Held] = {}
        self._ended: dict[str, None] = {}
        """Ids of leases that have ended: a late renewal must not bring one back."""

    @property
    def all(self) -> tuple[Lease, ...]:
        """Those in force, by robot."""
        return tuple(self._held[each].lease for each in sorted(self._held))

    def of(self, robot: str) -> Lease | None:
        """The lease of a robot, or None."""
        held = self._held.get(robot)
        return held.lease if held is not None else None

    def left_s(self, robot: str, now: float) -> float:
        """For how long it holds yet if it is not renewed."""
        held = self._held.get(robot)
        return max(0.0, held.until - now) if held is not None else 0.0

    def over(self, robot: str) -> bool:
        """Whether the lease of a robot was found due; the robot is nobody's until its end is told."""
        held = self._held.get(robot)
        return held is not None and held.over

    def due(self, now: float) -> tuple[Lease, ...]:
        """Those that were not renewed in time, and whose end is not on its way."""
        found: list[Lease] = []
        for each in self._held.values():
            each.over = now >= each.until
            if each.over and not each.ending:
                found.append(each.lease)
        return tuple(found)

    def end(self, lease: Lease) -> Lease:
        """Its end is on its way: no renewal keeps it; returns how it will be told when the robot holds."""
        held = self._held.get(lease.robot)
        if held is not None and held.lease.id == lease.id:
            held.over = held.ending = True
        return replace(lease, ended=EXPIRED)

    def hear(self, lease: Lease, now: float) -> bool:
        """Take in a lease, a renewal or an end; returns whether who has the robot has changed.

        Of two leases of one robot (two sides of a partition) the lower id stands, everywhere.
        """
        held = self._held.get(lease.robot)
        if lease.ended:
            self._end(lease.id)
            if held is not None and held.lease.id == lease.id:
                del self._held[lease.robot]
                return True
            return False
        if lease.id in self._ended:
            return False
        if held is not None and held.lease.id == lease.id:
            if lease.renewal <= held.lease.renewal or held.ending:
                return False
            held.lease, held.until, held.over = lease, now + lease.lease_s, False
            return False
        if held is not None and held.lease.id < lease.id:
            return False
        if held is None and len(self._held) >= MOST:
            return False
        self._held[lease.robot] = _Held(lease, now + lease.lease_s)
        return True

    def merge(self, leases: Iterable[Lease], now: float) -> bool:
        """Take in what another knows; returns whether anything has changed."""
        return sum(self.hear(each, now) for each in leases) > 0

    def expire(self, now: float, grace_s: float = 0.0) -> tuple[Lease, ...]:
        """End those that were not renewed in time, nor told to have ended in a grace after it, and return them."""
        over = [each.lease for each in self._held.values() if now >= each.until + grace_s]
        for each in over:
            del self._held[each.robot]
            self._end(each.id)
        return tuple(replace(each, ended=EXPIRED) for each in over)

    def next_s(self, now: float) -> float | None:
        """Seconds until one may be over; None when there is none."""
        return min((max(0.0, each.until - now) for each in self._held.values()), default=None)

    def _end(self, lease: str) -> None:
        self._ended[lease] = None
        while len(self._ended) > MOST:
            del self._ended[next(iter(self._ended))]
