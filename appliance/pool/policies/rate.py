"""Arrival rate × service time: how many containers have to be there so that most runs find one.

Little's law: an image whose runs arrive at rate r and take s seconds has r * s of them there at a time. With Poisson
arrivals and a container for each, their number is Poisson distributed with that mean, whatever the distribution of
s (M/G/infinity), and a new run sees that distribution too (PASTA). So c containers give a hit rate of P(N < c). With
r = 0.5/s and s = 4 s the mean is 2; 5 containers give 94.7 %, 6 give 98.3 %.
"""

import math
from collections.abc import Iterable

from appliance.pool.policies.demand import Demand
from appliance.pool.policies.forecaster import Level, Surety

MOST = 256


def containers_for(load: float, hit_target: float) -> int:
    """Return the least c with P(Poisson(load) < c) >= hit_target, at most 256; `load` is rate × service time."""
    if load > 100.0:  # exp(-load) is about to vanish; the normal approximation is good to a container here
        return min(MOST, math.ceil(load + 2.33 * math.sqrt(load)))
    term = total = math.exp(-load)
    count = 1
    while total < hit_target and count < MOST:
        term *= load / count
        total += term
        count += 1
    return count


class Rate:
    """Prewarming by the rate of arrivals of an image, as a moving average.

    Args:
        demand: what was asked.
        hit_target: part of the runs that shall find a warm container.
        horizon_s: an image that is asked for less often than this is none of its business.
    """

    surety = Surety.SPARE_ROOM

    def __init__(self, demand: Demand, *, hit_target: float, horizon_s: float) -> None:
        self._demand = demand
        self._hit_target = hit_target
        self._horizon_s = horizon_s
        self._wanted: dict[str, tuple[float, int]] = {}

    def images(self, now: float) -> Iterable[str]:
        """Return the images that are asked for often enough."""
        self._wanted.clear()
        return [
            image
            for image, demand in self._demand.images.items()
            if demand.arrivals > 2 and demand.gap_s(now) < self._horizon_s
        ]

    def wants(self, level: Level, now: float) -> str | None:
        """Want as many as the target takes; no opinion on an image that is seldom asked for."""
        demand = self._demand.images.get(level.image)
        if demand is None or demand.arrivals < 3:
            return None
        gap_s = demand.gap_s(now)
        if gap_s >= self._horizon_s:
            return None
        at, count = self._wanted.get(level.image, (-1.0, 0))
        if at != now:
            count = containers_for((demand.service_s + level.ahead_s) / gap_s, self._hit_target)
            self._wanted[level.image] = (now, count)
        return f"one is wanted every {gap_s:.1f} s for {demand.service_s:.1f} s" if level.number <= count else ""
