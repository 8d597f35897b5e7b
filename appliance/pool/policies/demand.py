"""What has been asked of each image here: how often, for how long, and how many at a time.

Concurrency is seen as levels: the n-th container of an image is wanted while n runs are there at once. The idle
time of level n is from the moment the number of runs falls below n to the moment it rises to n again. So one
histogram of idle times a level says for the first, second, third … container of an image what the published
policies say for the only one.
"""

import math
from collections.abc import Mapping, Set

from msgspec import Struct

from appliance.pool.policies.idle_times import IdleTimes

MAX_IMAGES = 256
MAX_LEVELS = 16
"""Levels beyond share no histogram: they are left to the rate."""
FADE = 0.2
"""Weight of the newest in moving averages: about the last nine count."""


SLOW_S = 3600.0
"""The slow rate is a mean over about so long: what comes by chance at a steady rate is known by its long mean."""
FIRST_GAP_S = 60.0
"""What the time between two runs of a new image is taken for; it counts as much as one run that was seen."""
SLOWEST_FADE = 0.02
"""Weight of the newest in the slow mean of service times, once there are many."""
LONGEST_S = 10 * 86_400.0
LOST_S = 60.0
"""A run that arrived so long ago and has no container waits no longer."""


class DemandState(Struct, frozen=True, kw_only=True):
    """What is known of the demand for one image, without the moments: those are of one process's clock."""

    arrivals: int
    service_s: float
    gap_s: float
    levels: tuple[dict[int, float], ...] = ()
    slow: float = 0.0
    watched_s: float = 0.0
    slow_service_s: float = 0.0
    """Of the slow rate and the slow mean of service times; 0 where an older version kept none."""


class ImageDemand:
    """The demand for one image."""

    __slots__ = ("_counted", "_gap_s", "_served", "_slow", "_watched_s", "arrivals", "fell", "last", "levels", "runs",
                 "service_s", "slow_service_s")  # fmt: skip

    def __init__(self) -> None:
        self.arrivals = 0
        self.runs = 0
        """Runs that are here now."""
        self.last = 0.0
        """When the last one arrived."""
        self.service_s = 1.0
        self.fell: list[float | None] = [None] * MAX_LEVELS
        """When the number of runs last fell below each level."""
        self.levels: list[IdleTimes] = []
        self._gap_s = 0.0
        self._slow = 0.0
        """Arrivals but the first, each fading by exp(-age / SLOW_S), as of `_counted`."""
        self._watched_s = 0.0
        """The time since the first, fading like them."""
        self._counted: float | None = None
        self.slow_service_s = 1.0
        self._served = 0

    def arrived(self, now: float) -> None:
        """Note a run that begins or wants to."""
        if self.arrivals:
            gap_s = max(0.0, now - self.last)
            self._gap_s = gap_s if self.arrivals == 1 else self._gap_s + FADE * (gap_s - self._gap_s)
        if self._counted is None:
            self._counted = now
        else:
            self._slow, self._watched_s = self._faded(now)
            self._slow, self._counted = self._slow + 1.0, now
        self.arrivals += 1
        self.last = now
        self.runs += 1
        if self.runs <= MAX_LEVELS:
            fell = self.fell[self.runs - 1]
            if fell is not None:
                while len(self.levels) < self.runs:
                    self.levels.append(IdleTimes())
                self.levels[self.runs - 1].add(now - fell)

    def ended(self, service_s: float, now: float) -> None:
        """Note the end of a run."""
        if service_s > 0:
            self.service_s += FADE * (service_s - self.service_s)
            self._served += 1
            self.slow_service_s += max(1.0 / self._served, SLOWEST_FADE) * (service_s - self.slow_service_s)
        if 0 < self.runs <= MAX_LEVELS:
            self.fell[self.runs - 1] = now
        self.runs = max(0, self.runs - 1)

    def gap_s(self, now: float) -> float:
        """Return the expected time between two arrivals; a silence longer than that counts as one gap more."""
        if self.arrivals < 2:
            return max(86_400.0, now - self.last)
        silence_s = now - self.last
        return self._gap_s + FADE * (silence_s - self._gap_s) if silence_s > self._gap_s else self._gap_s

    def _faded(self, now: float) -> tuple[float, float]:
        """Return arrivals and time watched as they count now."""
        age_s = max(0.0, now - (self._counted if self._counted is not None else now))
        part = math.exp(-age_s / SLOW_S)
        return self._slow * part, self._watched_s * part + SLOW_S * (1.0 - part)

    def slow_rate(self, now: float) -> float:
        """Return the arrivals a second over the last hour or so."""
        count, watched_s = self._faded(now)
        return (count + 1.0) / (watched_s + FIRST_GAP_S)

    def state(self) -> DemandState:
        """Return what is known, to be kept."""
        levels = tuple(each.state() for each in self.levels)
        return DemandState(
            arrivals=self.arrivals,
            service_s=self.service_s,
            gap_s=self._gap_s,
            levels=levels,
            slow=self._slow,
            watched_s=self._watched_s,
            slow_service_s=self.slow_service_s,
        )

    @classmethod
    def restored(cls, state: DemandState, now: float) -> "ImageDemand":
        """Return the demand that was kept; the time until `now` is taken for none."""
        made = cls()
        made.arrivals = max(0, state.arrivals)
        made.last = now
        made.service_s = max(0.0, state.service_s)
        made._gap_s = max(0.0, state.gap_s)
        made._slow, made._watched_s = max(0.0, state.slow), max(0.0, state.watched_s)
        made._counted = now
        made.slow_service_s = max(0.0, state.slow_service_s) or made.service_s
        made._served = made.arrivals
        made.levels = [IdleTimes.restored(each) for each in state.levels[:MAX_LEVELS]]
        return made

    def idle_times(self, level: int) -> IdleTimes | None:
        """Return the histogram of a level (1 is the first), if there is one."""
        return self.levels[level - 1] if 0 < level <= len(self.levels) else None

    def idle_since(self, level: int, otherwise: float) -> float:
        """Return when a level was last wanted."""
        fell = self.fell[level - 1] if 0 < level <= MAX_LEVELS else None
        return otherwise if fell is None else fell


def until_level_s(rate: float, service_s: float, runs: int, level: int) -> float:
    """Return the mean time until `level` runs are there at once, with `runs` there now (fewer than `level`).

    Of a queue with a server for each (M/M/infinity): the time from k to k + 1 runs is h_k = 1/r + k / (r s) h_(k-1), r
    being the rate and s the service time (Keilson 1964). With one run each 10 s that takes 1 s, the second container is
    wanted, from none in use, after 10 + (10 + 10 * 10) = 120 s, where the first is after 10 s.
    """
    step_s = total_s = 0.0
    for count in range(level):
        step_s = 1.0 / rate + count / (rate * max(service_s, 1e-3)) * step_s
        if count >= runs:
            total_s += step_s
        if total_s > LONGEST_S:
            return LONGEST_S
    return total_s


class Demand:
    """The demand for all images, of which the 256 asked for last are kept."""

    def __init__(self) -> None:
        self.images: dict[str, ImageDemand] = {}

    def arrived(self, image: str, now: float) -> ImageDemand:
        """Note a run that begins or wants to."""
        found = self.images.pop(image, None) or ImageDemand()
        self.images[image] = found  # the newest last
        if len(self.images) > MAX_IMAGES:
            del self.images[next(iter(self.images))]
        found.arrived(now)
        return found

    def ended(self, image: str, service_s: float, now: float) -> None:
        """Note the end of a run."""
        found = self.images.get(image)
        if found is not None:
            found.ended(service_s, now)

    def settle(self, present: Set[str], now: float) -> None:
        """Set right what an end that was never told has left behind: `present` are the images that have runs."""
        for image, demand in self.images.items():
            if demand.runs and image not in present and now - demand.last > LOST_S:
                while demand.runs:
                    demand.ended(0.0, now)

    def state(self) -> dict[str, DemandState]:
        """Return what is known of all images, to be kept."""
        return {image: each.state() for image, each in self.images.items()}

    def restore(self, state: Mapping[str, DemandState], now: float) -> None:
        """Go on from what was known; an image that was asked for since is left as it is."""
        for image, each in list(state.items())[-MAX_IMAGES:]:
            if image not in self.images:
                self.images[image] = ImageDemand.restored(each, now)
