"""Eviction: what an idle container is worth, which goes first when room is short, and how long one is kept otherwise.

A further policy is a class with the three methods of `Evictor`, a line in `EVICTION`, and its name in
`pool.settings.PoolConfig.eviction`.

The facts that policies see and the orders they answer, each with its reason, are here too (`Idle`, `View`; `Start`,
`Retire`), and what a cold start of an image costs on this gateway (`ColdCosts`).

LeastRecent: what has not been used for longest goes first.

GreedyDual, Greedy-Dual-Size-Frequency: what is used often, dear to start and small stays; what was once popular ages
away. Cherkasova 1998; for containers Fuerst and Sharma, "FaasCache", ASPLOS 2021, section 4. The priority of an idle
container is clock + frequency * cold cost / memory, where clock is the priority of the last one given up, read
when the container was last used. A container of 256 MB that takes 500 ms to start and has served 4 runs since the
clock stood at 3 is worth 3 + 5 * 500 / 256 = 12.8.

Learned: predicts when each idle container is used next, gives up what is worth least. A linear model of the logarithm
of the time to the next use, fitted online by recursive least squares with forgetting (Haykin, Adaptive Filter Theory,
ch. 9). What a container is worth is the cold start it saves, over the memory it holds times the time until then:
cold_ms / (memory_mb * predicted seconds). The features: how often and how lately its image was asked for, for how long
its level (`forecast`) was idle and usually is, its start cost and memory, the hour of the day, and what plans have
announced. It does not trust itself: until it has seen enough uses, and whenever it has lately lost more than it has won
against Greedy-Dual-Size-Frequency, the latter decides. Win and loss are counted over the evictions on which the two
differ: the policy that would have given up what was asked for first has lost.

Keeping: how long an idle container is kept when there is room enough and there is no forecast for it.
"""

import math
import operator
import random
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeAlias

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from appliance.pool.policies.forecast import LONGEST_S, Demand, Histogram, Level, until_level_s
from appliance.pool.settings import PoolConfig


class Idle(Struct, frozen=True, kw_only=True):
    """A ready container that nobody has. `since` is when it became so, seconds of the clock that is passed in."""

    id: str
    image: str
    memory_mb: int
    runs: int
    cold_ms: float
    since: float


class View(Struct, frozen=True, kw_only=True):
    """The containers of one gateway at one moment, and what they may take."""

    idle: tuple[Idle, ...] = ()
    busy: dict[str, int] = field(default_factory=dict[str, int])
    """Containers of each image that have a run or are reserved for one."""
    lasting: dict[str, int] = field(default_factory=dict[str, int])
    """Of these, how many have been so for longer than a start of their image takes."""
    starting: dict[str, int] = field(default_factory=dict[str, int])
    memory_mb: int = 0
    """Memory of all containers in whatever state."""
    containers: int = 0
    """All containers in whatever state."""
    budget_mb: int
    """What they may take together now: less than the setting while the machine is short of memory."""
    capacity: int
    blocked: frozenset[str] = frozenset()
    """Images that are not to be started now (quarantine)."""


class Start(Struct, frozen=True, kw_only=True):
    """Start a container of this image, because."""

    image: str
    why: str


class Retire(Struct, frozen=True, kw_only=True):
    """Give this container up, because."""

    id: str
    why: str


class ColdCosts:
    """ColdCost(T): the moving 75th percentile of this gateway's own cold starts of each image, milliseconds."""

    def __init__(self, initial_ms: float, *, window: int = 16) -> None:
        self._initial_ms = initial_ms
        self._window = window
        self._seen: dict[str, deque[float]] = {}
        self._costs: dict[str, float] = {}
        self._usual_ms = initial_ms

    def add(self, image: str, took_ms: float) -> None:
        """Note a cold start."""
        seen = self._seen.setdefault(image, deque(maxlen=self._window))
        seen.append(took_ms)
        self._costs[image] = sorted(seen)[(3 * len(seen)) // 4]
        self._usual_ms = sum(self._costs.values()) / len(self._costs)

    def of(self, image: str) -> float:
        """Return what a cold start of this image is expected to cost."""
        return self._costs.get(image, self._initial_ms)

    def usual_ms(self) -> float:
        """Return the mean over the images that were started here; the initial guess before any was."""
        return self._usual_ms

    def state(self) -> dict[str, tuple[float, ...]]:
        """Return what was measured, to be kept."""
        return {image: tuple(seen) for image, seen in self._seen.items()}

    def restore(self, state: Mapping[str, tuple[float, ...]]) -> None:
        """Go on from what was measured before."""
        for image, seen in state.items():
            for took_ms in seen:
                self.add(image, took_ms)


class Evictor(Protocol):
    """Says what idle containers are worth; the planner gives up the one worth least.

    Worths are compared with each other only, within one call; they have no unit in common between policies.
    """

    def arrived(self, image: str, now: float) -> None:
        """Note that a run asked for this image here."""
        ...

    def worths(self, idle: Sequence[Idle], now: float) -> list[float]:
        """Return what each of these containers is worth, in their order; one without id is yet to be started."""
        ...

    def evicted(self, idle: Idle, now: float) -> None:
        """Note that it was given up for want of room."""
        ...


class LeastRecent:
    """LRU, the baseline: looks neither at size nor at cost nor at how often."""

    def arrived(self, image: str, now: float) -> None:
        """Nothing: the time of the last use is in the container."""

    def worths(self, idle: Sequence[Idle], now: float) -> list[float]:
        """Return the times of last use, seconds."""
        del now
        return [each.since for each in idle]

    def evicted(self, idle: Idle, now: float) -> None:
        """Nothing to remember."""


class GreedyDual:
    """The floor that every other eviction policy has to beat. State: one number a container."""

    def __init__(self) -> None:
        self._clock = 0.0
        self._marks: dict[str, tuple[float, float]] = {}

    def arrived(self, image: str, now: float) -> None:
        """Nothing: each container counts its own runs."""

    def worths(self, idle: Sequence[Idle], now: float) -> list[float]:
        """Return the priorities, milliseconds a megabyte."""
        del now
        marks: dict[str, tuple[float, float]] = {}
        for each in idle:
            mark = self._marks.get(each.id)
            # Used since it was last seen: the clock of its last use is the clock now, for it only moves at evictions.
            marks[each.id] = mark if mark is not None and mark[0] == each.since else (each.since, self._clock)
        self._marks = marks
        return [marks[each.id][1] + (each.runs + 1) * each.cold_ms / each.memory_mb for each in idle]

    def evicted(self, idle: Idle, now: float) -> None:
        """Set the clock to the priority of the one given up."""
        del now
        mark = self._marks.pop(idle.id, None)
        if mark is not None:
            self._clock = max(self._clock, mark[1] + (idle.runs + 1) * idle.cold_ms / idle.memory_mb)


Vector: TypeAlias = NDArray[np.float64]

FEATURES = 11
FORGET = 0.9995
ENOUGH_USES = 64
"""Uses it must have seen before it decides."""
MAX_PENDING = 256
SAMPLES = 4
"""Predictions kept of one level: of all moments since its last use, each with the same chance (Vitter 1985, algorithm
R). The last four would all be of shortly before the next use, and everything would seem to return at once."""
HORIZON_S = 6 * 3600.0
"""A use that has not come by then counts as one then."""
TRUST = 0.05
"""Weight of the newest duel in the moving balance."""
LEAST_BALANCE = -0.1


class LearnedState(Struct, frozen=True, kw_only=True):
    """What it has learned, to survive a restart."""

    weights: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    seen: int
    balance: float


class _Sample(Struct, frozen=True):
    at: float
    features: tuple[float, ...]


class _Pending(Struct):
    """Predictions of one level that wait for its next use, and how many there were."""

    samples: list[_Sample]
    seen: int = 0


class _Duel(Struct, frozen=True):
    """An eviction on which the two policies differ: each one's choice as (image, level)."""

    learned: tuple[str, int]
    greedy: tuple[str, int]
    at: float


class Learned:
    """Learned eviction with Greedy-Dual-Size-Frequency as a floor.

    Args:
        demand: what was asked of each image.
        next_hint_s: in how many seconds a plan needs an image; None: none has announced one.
        hour: the hour of the day, 0 to 24, at a reading of the clock.
    """

    def __init__(
        self,
        demand: Demand,
        *,
        next_hint_s: Callable[[str, float], float | None],
        hour: Callable[[float], float],
    ) -> None:
        self._demand = demand
        self._next_hint_s = next_hint_s
        self._hour = hour
        self._greedy = GreedyDual()
        self._weights: Vector = np.zeros(FEATURES)
        # Before anything is known: as long again as the expected gap and as it was idle, evenly.
        self._weights[1] = self._weights[2] = self._weights[10] = 1 / 3
        self._model: list[float] = self._weights.tolist()
        self._covariance: Vector = np.eye(FEATURES) * 10.0
        self._seen = 0
        self._balance = 0.0
        self._pending: dict[tuple[str, int], _Pending] = {}
        self._dice = random.Random(0)  # noqa: S311 - which moments are kept, the same each time; no secret
        self._turn = 0
        self._duels: deque[_Duel] = deque(maxlen=MAX_PENDING)
        self._last: dict[str, tuple[float, float, tuple[str, int], tuple[float, ...]]] = {}

    @property
    def decides(self) -> bool:
        """Whether it decides itself; otherwise Greedy-Dual does."""
        return self._seen >= ENOUGH_USES and self._balance >= LEAST_BALANCE

    def state(self) -> LearnedState:
        """Return what it has learned."""
        return LearnedState(
            weights=tuple(self._weights.tolist()),
            covariance=tuple(tuple(row) for row in self._covariance.tolist()),
            seen=self._seen,
            balance=self._balance,
        )

    def restore(self, state: LearnedState) -> None:
        """Go on from there; a state of another shape is ignored."""
        weights, covariance = np.array(state.weights), np.array(state.covariance)
        if weights.shape == (FEATURES,) and covariance.shape == (FEATURES, FEATURES) and np.isfinite(covariance).all():
            self._weights, self._covariance = weights, covariance
            self._model = self._weights.tolist()
            self._seen, self._balance = state.seen, state.balance

    def arrived(self, image: str, now: float) -> None:
        """Learn from the predictions and duels that this run settles; to be told after the demand was."""
        demand = self._demand.images.get(image)
        level = demand.runs if demand is not None else 1
        pending = self._pending.pop((image, level), None)
        for sample in pending.samples if pending is not None else ():
            self._learn(np.array(sample.features), math.log(max(0.1, now - sample.at)))
        if self._duels:
            self._settle((image, level), now)

    def worths(self, idle: Sequence[Idle], now: float) -> list[float]:
        """Return cold start saved over memory times predicted time, ms/(MB s); or Greedy-Dual's priorities."""
        greedy = self._greedy.worths(idle, now)
        if not idle:
            return greedy
        levels = self._levels(idle)
        features = [self._features(each, level, now) for each, level in zip(idle, levels, strict=True)]
        own = [
            each.cold_ms / (each.memory_mb * self._predict(vector)) for each, vector in zip(idle, features, strict=True)
        ]
        self._last = {
            each.id: (mine, theirs, (each.image, level), vector)
            for each, mine, theirs, level, vector in zip(idle, own, greedy, levels, features, strict=True)
        }
        return own if self.decides else greedy

    def wait_s(self, idle: Idle, level: int, now: float) -> float | None:
        """Return in how many seconds it will be used; None while the predictions are not to be trusted."""
        if not self.decides:
            return None
        return self._predict(self._features(idle, level, now))

    def observed(self, idle: Sequence[Idle], now: float) -> None:
        """Take one of the idle containers, each in turn, as an example to learn from."""
        if idle:
            self._turn = (self._turn + 1) % len(idle)
            each, level = idle[self._turn], self._levels(idle)[self._turn]
            self._remember((each.image, level), self._features(each, level, now), now)

    def _predict(self, features: tuple[float, ...]) -> float:
        """Return the predicted seconds to the next use. Plain lists: for ten numbers quicker than an array."""
        exponent = sum(map(operator.mul, self._model, features))
        return math.exp(min(12.0, max(-3.0, exponent)))

    def evicted(self, idle: Idle, now: float) -> None:
        """Note the eviction: a sample to learn from, and a duel if the two policies would have differed."""
        self._greedy.evicted(idle, now)
        if idle.id not in self._last:
            return
        mine = min(self._last.values(), key=lambda one: one[0])
        theirs = min(self._last.values(), key=lambda one: one[1])
        if mine[2] != theirs[2]:
            self._duels.append(_Duel(learned=mine[2], greedy=theirs[2], at=now))
        _, _, key, features = self._last.pop(idle.id)
        self._remember(key, features, now)

    def _levels(self, idle: Sequence[Idle]) -> list[int]:
        """Return the level that each would serve: the one used last the lowest free, one yet to come the highest."""
        taken: dict[str, int] = {}
        levels = [0] * len(idle)
        for index in sorted(range(len(idle)), key=lambda index: (not idle[index].id, -idle[index].since)):
            image = idle[index].image
            demand = self._demand.images.get(image)
            before = taken.get(image, demand.runs if demand is not None else 0)
            levels[index] = taken[image] = before + 1
        return levels

    def _features(self, idle: Idle, level: int, now: float) -> tuple[float, ...]:
        demand = self._demand.images.get(idle.image)
        idle_s = now - idle.since
        lately_s = long_s = LONGEST_S
        usual_s = 0.0
        if demand is not None:
            lately_s = until_level_s(1.0 / max(1e-3, demand.gap_s(now)), demand.service_s, demand.runs, level)
            long_s = until_level_s(demand.slow_rate(now), demand.slow_service_s, demand.runs, level)
            idle_s = now - demand.idle_since(level, idle.since)
            times = demand.idle_times(level)
            usual_s = times.price_s(idle_s) if times is not None else 0.0
        hint_s = self._next_hint_s(idle.image, now)
        turn = self._hour(now) * math.pi / 12
        return (
            1.0,
            math.log(lately_s + 0.1),
            math.log(usual_s + 0.1) if usual_s else math.log(long_s + 0.1),
            math.log(max(0.0, idle_s) + 1.0),
            1.0 if usual_s else 0.0,
            math.log(idle.cold_ms / 500.0),
            math.log(idle.memory_mb / 256.0),
            math.sin(turn),
            math.cos(turn),
            0.0 if hint_s is None else 5.0 - math.log(hint_s + 1.0),
            math.log(long_s + 0.1),
        )

    def _remember(self, key: tuple[str, int], features: tuple[float, ...], now: float) -> None:
        """Keep a prediction's features until the use comes; one that takes too long counts as twice as long."""
        pending = self._pending.pop(key, None) or _Pending([])
        pending.seen += 1
        if len(pending.samples) < SAMPLES:
            pending.samples.append(_Sample(now, features))
        elif (at := self._dice.randrange(pending.seen)) < SAMPLES:
            pending.samples[at] = _Sample(now, features)
        self._pending[key] = pending  # the newest last
        if len(self._pending) > MAX_PENDING:
            for sample in self._pending.pop(next(iter(self._pending))).samples:
                self._learn(np.array(sample.features), math.log(max(0.1, 2 * (now - sample.at))))

    def _learn(self, x: Vector, y: float) -> None:
        """One step of recursive least squares with forgetting."""
        direction = self._covariance @ x
        gain = direction / (FORGET + float(x @ direction))
        self._weights = self._weights + gain * (y - float(x @ self._weights))
        self._model = self._weights.tolist()
        self._covariance = (self._covariance - np.outer(gain, direction)) / FORGET
        trace = float(np.trace(self._covariance))
        if trace > 1e4:  # nothing new in some direction for long: forgetting must not blow it up
            self._covariance *= 1e4 / trace
        self._seen += 1

    def _settle(self, wanted: tuple[str, int], now: float) -> None:
        kept: deque[_Duel] = deque(maxlen=MAX_PENDING)
        for duel in self._duels:
            if wanted in (duel.learned, duel.greedy):
                won = wanted == duel.greedy
                self._balance += TRUST * ((1.0 if won else -1.0) - self._balance)
            elif now - duel.at < HORIZON_S:
                kept.append(duel)
        self._duels = kept


EVICTION: dict[str, Callable[[Learned], Evictor]] = {
    "learned": lambda learned: learned,
    "greedy-dual": lambda _: GreedyDual(),
    "lru": lambda _: LeastRecent(),
}
"""The eviction policies by their names in `pool.eviction`, each made for one planner. What
demand teaches the learned one is known whichever decides: `pool.keep` may ask it."""


class Keeping(Protocol):
    """Says when an idle container has been kept for long enough."""

    def rests(self, idle: Idle, level: Level, now: float) -> str:
        """Return why it is kept no longer; empty while it is kept. `level` is the one it would serve."""
        ...


class KeepFixed:
    """Keep-alive of a fixed time, as OpenWhisk and the paper's local pool do (there 10 minutes)."""

    def __init__(self, idle_s: float) -> None:
        self._idle_s = idle_s

    def rests(self, idle: Idle, level: Level, now: float) -> str:
        """Give up what was idle for longer."""
        del level
        return "idle for long" if now - idle.since > self._idle_s else ""


class KeepHistogram:
    """As long as the idle times of its level say; the fixed time where they say nothing."""

    def __init__(self, histogram: Histogram, otherwise: Keeping) -> None:
        self._histogram = histogram
        self._otherwise = otherwise

    def rests(self, idle: Idle, level: Level, now: float) -> str:
        """Give up what is outside its window."""
        why = self._histogram.rests(level, idle.since, now)
        return self._otherwise.rests(idle, level, now) if why is None else why


class KeepWorth:
    """For as long as it is worth its memory: a small one that is dear to start waits longer than a large cheap one.

    One of usual size (pool.container_memory_mb) and usual start cost (the mean here) is kept while it is expected to be
    used within `idle_s`; one of twice the memory within half of it. Where the learned policy does not trust its
    predictions, the fixed time counts. A level whose idle times say that it is not due for a while rests.
    """

    def __init__(
        self,
        learned: Learned,
        histogram: Histogram | None,
        costs: ColdCosts,
        *,
        usual_mb: int,
        idle_s: float,
    ) -> None:
        self._learned = learned
        self._histogram = histogram
        self._costs = costs
        self._usual_mb_s = usual_mb * idle_s
        self._otherwise = KeepFixed(idle_s)

    def rests(self, idle: Idle, level: Level, now: float) -> str:
        """Give up what is worth less than its memory."""
        if self._histogram is not None and (why := self._histogram.rests(level, idle.since, now)):
            return why
        wait_s = self._learned.wait_s(idle, level.number, now)
        if wait_s is None:
            return self._otherwise.rests(idle, level, now)
        if idle.cold_ms * self._usual_mb_s >= self._costs.usual_ms() * idle.memory_mb * wait_s:
            return ""
        return f"not expected to be used for {wait_s:.0f} s"


def _keep_worth(config: PoolConfig, learned: Learned, histogram: Histogram, costs: ColdCosts) -> Keeping:
    sharp = histogram if "histogram" in config.prewarm else None
    return KeepWorth(learned, sharp, costs, usual_mb=config.container_memory_mb, idle_s=config.idle_s)


KEEPING: dict[str, Callable[[PoolConfig, Learned, Histogram, ColdCosts], Keeping]] = {
    "fixed": lambda config, _learned, _histogram, _costs: KeepFixed(config.idle_s),
    "histogram": lambda config, _learned, histogram, _costs: KeepHistogram(histogram, KeepFixed(config.idle_s)),
    "worth": _keep_worth,
}
"""How long idle containers are kept, by the names in `pool.keep`."""
