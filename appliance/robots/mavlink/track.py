"""The positions that a vehicle has told of late, each with the time at which it says that it was there.

A gateway may look seldom and a radio may hold reports back, so neither the time of looking nor that of hearing tells
how far a vehicle went between two positions. Pure.
"""

from collections import deque
from dataclasses import dataclass

from appliance.model import Pose

_KEPT = 64
"""Reports: six seconds at 10 Hz, far more than passes between two looks."""
_CLOCK_MS = 2**32
"""`time_boot_ms` has 32 bits and begins anew after 49.7 days."""


@dataclass(frozen=True, slots=True)
class Report:
    """A position, in site metres, as the vehicle told it."""

    pose: Pose
    boot_ms: int
    """Milliseconds of the vehicle's own clock, which begins when it starts."""
    heard_at: float
    """Monotonic seconds."""


def apart_s(one: Report, other: Report) -> float:
    """Return the seconds from one report to a later one by the vehicle's clock; by ours where its clock stands.

    A clock that went back (a restart, or a report that was overtaken) gives weeks: what was between is not known.
    """
    passed_ms = (other.boot_ms - one.boot_ms) % _CLOCK_MS
    return passed_ms / 1000.0 if passed_ms else other.heard_at - one.heard_at


class Track:
    """The last reports of one vehicle, in the order in which they came."""

    def __init__(self) -> None:
        self.count = 0
        """Reports so far, those that are no longer kept too."""
        self._reports: deque[Report] = deque(maxlen=_KEPT)

    def take(self, report: Report) -> None:
        """Add a report."""
        self._reports.append(report)
        self.count += 1

    def since(self, count: int) -> list[Report]:
        """Return the reports that came after so many, behind the last one before them."""
        return list(self._reports)[-(self.count - count + 1) :]
