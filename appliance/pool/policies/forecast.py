"""Demand and its forecasts: what has been asked of each image here, and what will be wanted by when (prewarming).

Concurrency is seen as levels: the n-th container of an image is wanted while n runs are there at once. The idle
time of level n is from the moment the number of runs falls below n to the moment it rises to n again. So one
histogram of idle times a level says for the first, second, third … container of an image what the published
policies say for the only one. A `Forecaster` says whether the n-th container of an image is wanted by the time one
could be ready.

IdleTimes: a histogram of how long it takes until something is wanted again, from a quarter second to a day. As in
Shahrad et al., "Serverless in the Wild", USENIX ATC 2020, section 4.2, but with geometric buckets, each an eighth of an
octave (9 %) wide, where theirs are a minute wide: a fleet's work repeats by the second as well as by the hour. Old
counts fade: when there are 256 they are halved.

PlanHints: the plan says which image its next steps need and when, so the container is there by then.

Histogram, the idle-time histogram policy (the same paper): give up at once what returns late, start it shortly before
it does. Prewarm at the 5th percentile of the idle times, keep to the 99th. A timer of 60 s whose runs take 1 s so costs
a few seconds of idle memory a minute instead of 59. Where the histogram is not representative, others are asked.

Rate, arrival rate × service time: how many containers have to be there so that most runs find one. Little's law: an
image whose runs arrive at rate r and take s seconds has r * s of them there at a time. With Poisson arrivals and a
container for each, their number is Poisson distributed with that mean, whatever the distribution of s (M/G/infinity),
and a new run sees that distribution too (PASTA). So c containers give a hit rate of P(N < c). With r = 0.5/s and s =
4 s the mean is 2; 5 containers give 94.7 %, 6 give 98.3 %.
"""

import enum
import math
from collections.abc import Iterable, Mapping, Set
from typing import Protocol

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import PoolHint

FIRST_S = 0.25
PER_OCTAVE = 8
BUCKETS = 150
"""0.25 s * 2^(150/8) = 31 hours."""
DAY_S = 86_400.0
ENOUGH_IDLE_TIMES = 8
"""Idle times that must have been seen before the histogram says anything."""
FADE_AT = 256.0
HEAD = 0.05
TAIL = 0.99
LEAST_CV = 4.0
"""Coefficient of variation of the bucket counts from which the histogram is representative (ATC 2020, section 4.2).

A timer fills one to three buckets of 150 (CV 7 to 12), a Poisson process some 40 unevenly (CV 1.5). The published 2 is
for buckets of a minute and counts a thin histogram as sharp: here the counts' own scatter is taken off (Simpson's
unbiased index of concentration), without which eight idle times of a Poisson process have a CV of 4.7."""


def bucket(gap_s: float) -> int:
    """Return the bucket of an idle time."""
    if gap_s <= FIRST_S:
        return 0
    return min(BUCKETS - 1, 1 + int(PER_OCTAVE * math.log2(gap_s / FIRST_S)))


def lower_s(index: int) -> float:
    """Return where a bucket begins, seconds."""
    return 0.0 if index == 0 else FIRST_S * 2.0 ** ((index - 1) / PER_OCTAVE)


UPPER_S = tuple(lower_s(index + 1) for index in range(BUCKETS))
MIDDLE_S = tuple((lower_s(index) + lower_s(index + 1)) / 2 for index in range(BUCKETS))


class IdleTimes:
    """The idle times of one thing. Memory: 150 numbers."""

    __slots__ = ("_prices", "_window", "counts", "total")

    def __init__(self) -> None:
        self.counts: list[float] = [0.0] * BUCKETS
        self.total = 0.0
        self._window: tuple[float, float] | bool | None = False
        self._prices: dict[int, float] = {}

    def add(self, gap_s: float) -> None:
        """Note one idle time."""
        self.counts[bucket(gap_s)] += 1.0
        self.total += 1.0
        self._window = False
        self._prices.clear()
        if self.total >= FADE_AT:
            self.counts = [count / 2 for count in self.counts]
            self.total /= 2

    def state(self) -> dict[int, float]:
        """Return the counts by bucket, to be kept; empty buckets are left out."""
        return {index: count for index, count in enumerate(self.counts) if count}

    @classmethod
    def restored(cls, state: Mapping[int, float]) -> "IdleTimes":
        """Return the histogram of counts that were kept; buckets there are none of are left out."""
        made = cls()
        for index, count in state.items():
            if 0 <= index < BUCKETS and 0 < count <= FADE_AT:
                made.counts[index] = count
        made.total = sum(made.counts)
        return made

    def window(self) -> tuple[float, float] | None:
        """Return the 5th percentile, rounded down, and the 99th, rounded up, seconds; None: not representative."""
        if isinstance(self._window, bool):
            self._window = self._compute()
        return self._window

    def _compute(self) -> tuple[float, float] | None:
        if self.total < ENOUGH_IDLE_TIMES:
            return None
        pairs = sum(count * (count - 1) for count in self.counts if count > 1) / (self.total * (self.total - 1))
        if math.sqrt(max(0.0, BUCKETS * pairs - 1)) < LEAST_CV:
            return None
        return lower_s(self._at(HEAD)), lower_s(self._at(TAIL) + 1)

    def _at(self, part: float) -> int:
        left = part * self.total
        for index, count in enumerate(self.counts):
            left -= count
            if left <= 0 and count:
                return index
        return BUCKETS - 1

    def price_s(self, idle_s: float) -> float:
        """Return the seconds of being kept that a use costs at best from here on.

        That is the least over all h of E[min(T, h)] / P(T <= h), T being the time that is left until the next use:
        the reciprocal of Gittins' index. Of a Poisson process it is the mean gap, whenever asked; of a timer what
        is left of its period; after a burst it grows. One use that never comes is added to those seen.
        """
        first = bucket(idle_s)
        found = self._prices.get(first)
        if found is None:
            found = self._prices[first] = self._price_s(first)
        return found

    def _price_s(self, first: int) -> float:
        seen = [(index, count) for index, count in enumerate(self.counts[first:], first) if count]
        from_s = lower_s(first)
        left = sum(count for _, count in seen) + 1.0
        spent_s = uses = 0.0
        best_s = 10 * DAY_S
        for index, count in seen:
            end_s = UPPER_S[index] - from_s
            uses += count
            left -= count
            spent_s += count * (MIDDLE_S[index] - from_s if index > first else end_s / 2)
            price_s = (spent_s + left * end_s) / uses
            best_s = min(best_s, price_s)
        return best_s


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


class Level(Struct, frozen=True):
    """The n-th container of an image."""

    image: str
    number: int
    """1 is the first."""
    busy: int
    """Containers of the image that have a run: those are the levels 1 to `busy`."""
    ahead_s: float
    """How long a new one takes to be ready, with a margin, seconds."""


class Surety(enum.IntEnum):
    """How sure a forecast is, so what may be given up for it."""

    SPARE_ROOM = 0
    """Only started where there is room."""
    LESS_WORTH = 1
    """Takes the place of what is worth less."""
    CERTAIN = 2
    """Takes the place of whatever is not as certain; is spared by all but waiting runs."""


class Forecaster(Protocol):
    """Forecasters are asked in turn, the surest first; the first with an opinion counts."""

    surety: Surety
    """What a container it wants may do to those that are there."""

    def images(self, now: float) -> Iterable[str]:
        """Return the images it may want containers of."""
        ...

    def wants(self, level: Level, now: float) -> str | None:
        """Return why it is wanted, empty when it is not, None without an opinion."""
        ...


MAX_HINTS = 256
OPERATOR = "operator"
"""The `task` of an operator's wish: containers are to be ready, whatever runs come."""
EARLY_S = 10.0
"""A run of the image counts as the announced one when it comes at most so much before its time."""


class _Hint(Struct, frozen=True):
    count: int
    at: float
    until: float


class PlanHints:
    """What plans have announced. A hint of the same task and image replaces the earlier one."""

    surety = Surety.CERTAIN

    def __init__(self) -> None:
        self._hints: dict[tuple[str, str], _Hint] = {}

    def hinted(self, hint: PoolHint, now: float) -> None:
        """Note a hint; the oldest of too many is dropped."""
        key = (hint.image, hint.task)
        self._hints.pop(key, None)
        at = now + max(0.0, hint.in_s)
        if hint.count > 0 and hint.keep_s > 0:
            self._hints[key] = _Hint(hint.count, at, at + hint.keep_s)
        if len(self._hints) > MAX_HINTS:
            del self._hints[next(iter(self._hints))]

    def arrived(self, image: str, now: float) -> None:
        """Note a run: of a plan's announced needs that are due, the earliest is met."""
        due = [
            (hint.at, key)
            for key, hint in self._hints.items()
            if key[0] == image and key[1] != OPERATOR and hint.at - EARLY_S <= now
        ]
        if not due:
            return
        _, key = min(due)
        hint = self._hints[key]
        if hint.count > 1:
            self._hints[key] = replace(hint, count=hint.count - 1)
        else:
            del self._hints[key]

    def images(self, now: float) -> Iterable[str]:
        """Return the images that somebody has announced a need of."""
        for key in [key for key, hint in self._hints.items() if hint.until <= now]:
            del self._hints[key]
        return {image for image, _ in self._hints}

    def wants(self, level: Level, now: float) -> str | None:
        """Want as many idle ones as are announced for the time until a new one could be ready."""
        if not self._hints:
            return None
        due = sum(
            hint.count
            for key, hint in self._hints.items()
            if key[0] == level.image and hint.at - level.ahead_s <= now < hint.until
        )
        return "a plan or an operator will need it" if level.number <= level.busy + due else None

    def next_s(self, image: str, now: float) -> float | None:
        """Return in how many seconds the next announced need of this image is; None: none is."""
        if not self._hints:
            return None
        times = [max(0.0, hint.at - now) for key, hint in self._hints.items() if key[0] == image and hint.until > now]
        return min(times, default=None)


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


MOST_CONTAINERS = 256


def containers_for(load: float, hit_target: float) -> int:
    """Return the least c with P(Poisson(load) < c) >= hit_target, at most 256; `load` is rate × service time."""
    if load > 100.0:  # exp(-load) is about to vanish; the normal approximation is good to a container here
        return min(MOST_CONTAINERS, math.ceil(load + 2.33 * math.sqrt(load)))
    term = total = math.exp(-load)
    count = 1
    while total < hit_target and count < MOST_CONTAINERS:
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
