"""What could be reached by somebody who knew the future: a bound, and an eviction policy.

`least_cold` is a true lower bound on the cold starts of every policy that starts containers on demand only (as
keep-alive, LRU and Greedy-Dual do). Put each image's runs on levels (policies/demand.py): a run that raises their
number to n is warm only if an n-th container was kept through the whole idle time of level n, which costs memory *
idle time. Choosing idle times for the least memory-seconds is a knapsack with equal values, solved exactly by taking
the cheapest first. That the memory at each moment is bounded too is left out, so the bound may be out of reach. It
bounds no policy that starts ahead: with perfect foresight that needs neither cold starts nor idle memory.

`Belady` is no bound but a policy with a crystal ball: at each eviction it gives up the container whose next use is
latest, weighted by memory over cold cost (Bélády 1966 evicts the latest; exact optimality is lost with unequal sizes,
for which it is NP-hard).
"""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Sequence
from heapq import heappop, heappush

from appliance.pool.policies import Idle
from appliance.pool.simulator.traces import Trace


def least_cold(trace: Trace, wasted_mb_s: Sequence[float]) -> list[int]:
    """Return the least cold starts possible on demand with so many idle megabyte-seconds each, on one gateway."""
    costs: list[float] = []
    cold = 0
    runs: defaultdict[str, int] = defaultdict(int)
    fell: dict[tuple[str, int], float] = {}
    ends: list[tuple[float, str]] = []
    for arrival in trace.arrivals:
        while ends and ends[0][0] <= arrival.at_s:
            at, image = heappop(ends)
            fell[image, runs[image]] = at
            runs[image] -= 1
        runs[arrival.image] += 1
        since = fell.get((arrival.image, runs[arrival.image]))
        cold += 1
        if since is not None:
            costs.append((arrival.at_s - since) * trace.images[arrival.image].memory_mb)
        heappush(ends, (arrival.at_s + arrival.service_s, arrival.image))
    costs.sort()
    sums: list[float] = []
    total = 0.0
    for cost in costs:
        total += cost
        sums.append(total)
    return [cold - bisect_right(sums, most) for most in wasted_mb_s]


class Belady:
    """Eviction by the true time to the next use, over the value of a megabyte."""

    def __init__(self, trace: Trace, gateway: int = 0) -> None:
        self._times: defaultdict[str, list[float]] = defaultdict(list)
        for arrival in trace.arrivals:
            if arrival.gateway == gateway:
                self._times[arrival.image].append(arrival.at_s)
        self._never = 10 * trace.duration_s

    def arrived(self, image: str, now: float) -> None:
        """Nothing: it knows."""

    def worths(self, idle: Sequence[Idle], now: float) -> list[float]:
        """Return cold cost over memory times time to the next use: the k-th newest one's is the k-th next run."""
        rank: defaultdict[str, int] = defaultdict(int)
        worths = [0.0] * len(idle)
        for index in sorted(range(len(idle)), key=lambda index: -idle[index].since):
            each = idle[index]
            times = self._times[each.image]
            at = bisect_right(times, now) + rank[each.image]
            rank[each.image] += 1
            wait_s = (times[at] if at < len(times) else self._never) - now
            worths[index] = each.cold_ms / (each.memory_mb * max(wait_s, 1e-3))
        return worths

    def evicted(self, idle: Idle, now: float) -> None:
        """Nothing: it knows."""
