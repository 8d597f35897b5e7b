"""The idle-time histogram policy: give up at once what returns late, start it shortly before it does.

Shahrad et al., "Serverless in the Wild", USENIX ATC 2020: prewarm at the 5th percentile of the idle times, keep to
the 99th. A timer of 60 s whose runs take 1 s so costs a few seconds of idle memory a minute instead of 59. Where the
histogram is not representative, others are asked.
"""

from collections.abc import Iterable

from appliance.pool.policies.demand import Demand
from appliance.pool.policies.forecaster import Level, Surety

LEAST_REST_S = 5.0
"""A container is not given up to be started again sooner than this, nor than ten cold starts.

Nor is it given up for not having been used for less than that: idle times seen under load may all be milliseconds,
where the published policy counts them by the minute."""
MARGIN = 0.1
"""The window is widened by this part of its ends (ATC 2020 uses 10 %)."""


class Histogram:
    """Prewarming and keeping by the idle times of each level of each image."""

    surety = Surety.LESS_WORTH

    def __init__(self, demand: Demand) -> None:
        self._demand = demand

    def images(self, now: float) -> Iterable[str]:
        """Return the images with any idle times."""
        del now
        return [image for image, demand in self._demand.images.items() if demand.levels]

    def wants(self, level: Level, now: float) -> str | None:
        """Want a level from the 5th to the 99th percentile of its idle times."""
        window = self.window(level)
        if window is None:
            return None
        idle_s = now - self._demand.images[level.image].idle_since(level.number, now)
        return "its idle times say it is due" if window[0] <= idle_s < window[1] else ""

    def rests(self, level: Level, since: float, now: float) -> str | None:
        """Return why a container that is idle since then is not wanted now; empty when it is; None: no telling."""
        window = self.window(level)
        if window is None:
            return None
        idle_s = now - self._demand.images[level.image].idle_since(level.number, since)
        if idle_s < window[0]:
            return "not due for a while"
        missed = idle_s >= window[1] and min(idle_s, now - since) >= _least_s(level)
        return "it was due and nobody came" if missed else ""

    def window(self, level: Level) -> tuple[float, float] | None:
        """Return from when to when after its last use a level is kept, seconds; None: not representative."""
        demand = self._demand.images.get(level.image)
        times = demand.idle_times(level.number) if demand is not None else None
        found = times.window() if times is not None else None
        if found is None:
            return None
        begin_s = found[0] * (1 - MARGIN) - level.ahead_s
        return (begin_s if begin_s > _least_s(level) else 0.0), found[1] * (1 + MARGIN)


def _least_s(level: Level) -> float:
    """Return for how long at least a container rests, or is kept."""
    return max(LEAST_REST_S, 10 * level.ahead_s)
