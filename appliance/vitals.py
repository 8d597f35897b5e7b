"""What the machine and this process use just now, read no more often than it changes anything.

Reading /proc costs more than all else in a gateway's account of itself, and a share of CPU time over a twentieth of a
second says little: what is read counts for half a second, and its age goes with it.
"""

import time
from collections.abc import Callable

import psutil
from msgspec import Struct

KEPT_S = 0.5


class Reading(Struct, frozen=True, kw_only=True):
    """CPU of the whole machine since the reading before, percent; resident memory of this process, MB; when."""

    cpu_percent: float
    memory_mb: float
    at: float


class Vitals:
    """The last reading, renewed when it is older than `KEPT_S` seconds."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._process = psutil.Process()
        self._last: Reading | None = None

    def read(self) -> Reading:
        """The reading that counts now."""
        now = self._clock()
        if self._last is None or now - self._last.at >= KEPT_S:
            memory_mb = round(self._process.memory_info().rss / 2**20, 1)
            self._last = Reading(cpu_percent=psutil.cpu_percent(interval=None), memory_mb=memory_mb, at=now)
        return self._last
