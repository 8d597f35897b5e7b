"""The learned eviction policy: predicts when each idle container is used next, gives up what is worth least.

A linear model of the logarithm of the time to the next use, fitted online by recursive least squares with forgetting
(Haykin, Adaptive Filter Theory, ch. 9). What a container is worth is the cold start it saves, over the memory it
holds times the time until then: cold_ms / (memory_mb * predicted seconds). The features: how often and how lately
its image was asked for, for how long its level (demand.py) was idle and usually is, its start cost and memory, the
hour of the day, and what plans have announced.

It does not trust itself: until it has seen enough uses, and whenever it has lately lost more than it has won
against Greedy-Dual-Size-Frequency, the latter decides. Win and loss are counted over the evictions on which the two
differ: whoever would have given up what was asked for first has lost.
"""

import math
import operator
import random
from collections import deque
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from appliance.pool.policies.demand import LONGEST_S, Demand, until_level_s
from appliance.pool.policies.facts import Idle
from appliance.pool.policies.greedy_dual import GreedyDual

Vector: TypeAlias = NDArray[np.float64]

FEATURES = 11
FORGET = 0.9995
ENOUGH = 64
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
        return self._seen >= ENOUGH and self._balance >= LEAST_BALANCE

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
