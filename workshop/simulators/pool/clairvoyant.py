"""What could be reached by somebody who knew the future: two bounds, a plan, and an eviction policy.

`least_cold` is a true lower bound on the cold starts of every policy that starts containers on demand only (as
keep-alive, LRU and Greedy-Dual do). Put each image's runs on levels (policies/demand.py): a run that raises their
number to n is warm only if an n-th container was kept through the whole idle time of level n, which costs memory *
idle time. Choosing idle times for the least memory-seconds is a knapsack with equal values, solved exactly by taking
the cheapest first. That the memory at each moment is bounded too is left out, so the bound may be out of reach. It
bounds no policy that starts ahead: with perfect foresight that needs neither cold starts nor idle memory.

`least_cold_within` has that bound on the memory at each moment: what the runs leave of the budget. Which idle times
fit is then a packing, too hard to solve exactly; its Lagrangian dual bounds it from the safe side, whatever the prices
are (Fisher 1981): with a price for a megabyte at each moment, every idle time is kept that costs less than the cold
start it saves, and what was not sold of the memory is paid for. The prices are moved until that bound is low. Both
bounds hold where runs do not wait: those that have to, because those before them fill the budget, are taken as if they
did not, though a run that waited may begin warm in what the one before it has left.

`cold_with_foresight` is no bound but a plan that somebody who knew all arrivals could have made: idle times are kept,
those first that are cheapest at the prices of that bound, as long as there is room at each moment. What is best lies
between the two.

`Belady` is a policy with a crystal ball: at each eviction it gives up the container whose next use is latest, weighted
by memory over what a cold start counts (Bélády 1966 evicts the latest; exact optimality is lost with unequal sizes, for
which it is NP-hard).
"""

import math
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Sequence
from heapq import heappop, heappush
from typing import TypeAlias

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from appliance.pool.policies import Idle
from workshop.simulators.pool.traces import Trace

Vector: TypeAlias = NDArray[np.float64]

MOMENTS = 720
"""Pieces of a trace, each with a price of its own; what is used of a piece is summed over it, which keeps the bound."""
ROUNDS = 300
"""Steps of the prices: further ones change the bound by less than a percent of it."""


class _Levels(Struct, frozen=True):
    """The runs of a trace on one gateway on their levels."""

    unavoidable: int
    """Runs that are the first on their level."""
    begins: Vector
    """Of each idle time between two runs on a level: since when, seconds."""
    ends: Vector
    memory_mb: Vector
    busy: tuple[Vector, Vector, Vector]
    """Of each run: from when, until when, with how much memory."""


def _levels(trace: Trace) -> _Levels:
    unavoidable = 0
    runs: defaultdict[str, int] = defaultdict(int)
    fell: dict[tuple[str, int], float] = {}
    going: list[tuple[float, str]] = []
    idle: list[tuple[float, float, float]] = []
    busy: list[tuple[float, float, float]] = []
    for arrival in trace.arrivals:
        while going and going[0][0] <= arrival.at_s:
            at, image = heappop(going)
            fell[image, runs[image]] = at
            runs[image] -= 1
        runs[arrival.image] += 1
        memory_mb = float(trace.images[arrival.image].memory_mb)
        since = fell.get((arrival.image, runs[arrival.image]))
        if since is None:
            unavoidable += 1
        else:
            idle.append((since, arrival.at_s, memory_mb))
        busy.append((arrival.at_s, arrival.at_s + arrival.service_s, memory_mb))
        heappush(going, (arrival.at_s + arrival.service_s, arrival.image))
    begins, ends, sizes = np.array(idle).reshape(-1, 3).T
    at, until, held = np.array(busy).reshape(-1, 3).T
    return _Levels(unavoidable, begins, ends, sizes, (at, until, held))


def least_cold(trace: Trace, wasted_mb_s: Sequence[float]) -> list[int]:
    """Return the least cold starts possible on demand with so many idle megabyte-seconds each, on one gateway."""
    levels = _levels(trace)
    sums = np.cumsum(np.sort((levels.ends - levels.begins) * levels.memory_mb))
    cold = levels.unavoidable + len(sums)
    return [cold - int(np.searchsorted(sums, most, side="right")) for most in wasted_mb_s]


def least_cold_within(trace: Trace, budgets_mb: Sequence[float], *, rounds: int = ROUNDS) -> list[int]:
    """Return a bound on the cold starts of every policy on demand with such memory for all containers, on one gateway.

    It holds where no run has to wait for another.
    """
    levels = _levels(trace)
    bounds: list[int] = []
    for budget_mb in budgets_mb:
        warm, _ = _most_warm(levels, budget_mb, rounds)
        bounds.append(levels.unavoidable + len(levels.begins) - math.floor(warm + 1e-6))
    return bounds


def cold_with_foresight(trace: Trace, budgets_mb: Sequence[float], *, rounds: int = ROUNDS) -> list[int]:
    """Return the cold starts of a plan made with all arrivals known, with such memory, on one gateway."""
    levels = _levels(trace)
    times, busy_mb = _busy(levels)
    moments = np.unique(np.concatenate((times, levels.begins, levels.ends)))
    held_mb = np.concatenate(([0.0], busy_mb))[np.searchsorted(times, moments, side="right")]
    since, until = np.searchsorted(moments, levels.begins), np.searchsorted(moments, levels.ends)
    found: list[int] = []
    for budget_mb in budgets_mb:
        _, bills = _most_warm(levels, budget_mb, rounds)
        free_mb = budget_mb - held_mb
        cold = levels.unavoidable
        for index in np.argsort(bills, kind="stable"):
            span = free_mb[since[index] : until[index]]
            if len(span) and float(span.min()) < levels.memory_mb[index]:
                cold += 1
            else:
                span -= levels.memory_mb[index]
        found.append(cold)
    return found


def _busy(levels: _Levels) -> tuple[Vector, Vector]:
    """Return the moments at which runs begin or end, and the memory they hold from each of them on."""
    at, until, held = levels.busy
    times = np.concatenate((at, until))
    order = np.argsort(times, kind="stable")
    return times[order], np.cumsum(np.concatenate((held, -held))[order])


def _integral(edges: Vector, steps: Vector, values: Vector, *, before: float) -> Vector:
    """Return the integral from 0 to each edge of what is `before` at first and changes to `values` at `steps`."""
    whole = np.concatenate(([0.0], steps, edges[-1:]))
    levels = np.concatenate(([before], values))
    sums = np.concatenate(([0.0], np.cumsum(levels * np.diff(whole))))
    return np.interp(edges, whole, sums)


def _most_warm(levels: _Levels, budget_mb: float, rounds: int) -> tuple[float, Vector]:
    """Return a bound above which no choice of idle times gets that fits into what runs leave of a budget.

    Beside it what each idle time costs at the prices that gave it; it is worth keeping below 1.
    """
    begins, ends, memory_mb = levels.begins, levels.ends, levels.memory_mb
    if not len(begins):
        return 0.0, begins
    steps, busy_mb = _busy(levels)
    edges = np.linspace(0.0, float(steps[-1]) + 1.0, MOMENTS + 1)
    room = np.diff(_integral(edges, steps, np.maximum(0.0, budget_mb - busy_mb), before=float(budget_mb)))
    lengths = np.diff(edges)
    costs = np.sort((ends - begins) * memory_mb)
    # As if the memory could be used at any moment: the price at which it is just sold out.
    last = min(len(costs) - 1, int(np.searchsorted(np.cumsum(costs), float(room.sum()))))
    prices = np.full(len(room), 1.0 / max(1e-9, float(costs[last])))
    best, cheapest = float(len(begins)), np.zeros(len(begins))
    for step in range(rounds):
        sums = np.concatenate(([0.0], np.cumsum(prices * lengths)))
        bills = memory_mb * (np.interp(ends, edges, sums) - np.interp(begins, edges, sums))
        bound = float(prices @ room) + float(np.maximum(0.0, 1.0 - bills).sum())
        if bound < best:
            best, cheapest = bound, bills
        kept = bills < 1.0
        used = np.diff(_held(edges, begins[kept], ends[kept], memory_mb[kept]))
        # Multiplied, since prices differ by orders of magnitude between busy and quiet moments.
        short = np.clip((used - room) / np.maximum(room, 0.05 * float(room.mean()) + 1e-9), -1.0, 3.0)
        prices = prices * np.exp(0.5 / math.sqrt(1.0 + step) * short)
    return best, cheapest


def _held(edges: Vector, begins: Vector, ends: Vector, memory_mb: Vector) -> Vector:
    """Return the MB s held from 0 to each edge by what is kept between these times."""

    def since(times: Vector) -> Vector:
        order = np.argsort(times)
        count = np.searchsorted(times[order], edges)
        sizes = np.concatenate(([0.0], np.cumsum(memory_mb[order])))[count]
        weighted = np.concatenate(([0.0], np.cumsum((memory_mb * times)[order])))[count]
        return sizes * edges - weighted

    return since(begins) - since(ends)


class Belady:
    """Eviction by the true time to the next use, over the value of a megabyte.

    Args:
        trace: what will arrive.
        gateway: where.
        by_number: all cold starts count alike, instead of by what each takes.
    """

    def __init__(self, trace: Trace, gateway: int = 0, *, by_number: bool = False) -> None:
        self._by_number = by_number
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
            saved = 1.0 if self._by_number else each.cold_ms
            worths[index] = saved / (each.memory_mb * max(wait_s, 1e-3))
        return worths

    def evicted(self, idle: Idle, now: float) -> None:
        """Nothing: it knows."""
