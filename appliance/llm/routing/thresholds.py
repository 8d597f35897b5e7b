"""Thresholds that move with experience: how sure a tier must be is learned from what became of its plans. Pure.

A tier's threshold is the lowest confidence, at least the configured one, from which its plans turned out well often
enough. It rises when plans that were sure enough fail as plans, and comes back down as good ones follow and the bad
ones are forgotten. It is never below what is configured: experience can only tighten.
"""

from collections import deque
from collections.abc import Callable, Mapping

TARGET = 0.8
"""Share of a tier's plans that are to turn out well."""
LEAST = 2.5
"""Observations, weighed by age, below which nothing is concluded."""
MOST = 64
HALF_LIFE_S = 6 * 3600.0
"""After so long an outcome counts half: within a shift what was mended is believed again."""
HIGHEST = 0.95
STEP = 0.05


class Thresholds:
    """The confidence from which each tier's plans run unasked.

    Args:
        base: what is configured, by tier.
        clock: seconds.
    """

    def __init__(self, base: Mapping[str, float], *, clock: Callable[[], float]) -> None:
        self._base = dict(base)
        self._clock = clock
        self._seen: dict[str, deque[tuple[float, bool, float]]] = {}
        """Tier -> (confidence, whether it turned out well, when)."""

    def add(self, tier: str, confidence: float, *, good: bool, age_s: float = 0.0) -> None:
        """Note what became of a plan of a tier."""
        seen = self._seen.setdefault(tier, deque(maxlen=MOST))
        seen.append((confidence, good, self._clock() - age_s))

    def of(self, tier: str) -> float:
        """Return the confidence from which a plan of a tier is taken; 0 for one that has none."""
        base = self._base.get(tier, 0.0)
        return self._moved(base, list(self._seen.get(tier, ())))

    @property
    def all(self) -> dict[str, float]:
        """By tier."""
        return {tier: self.of(tier) for tier in self._base}

    def rows(self) -> dict[str, list[tuple[float, bool, float]]]:
        """What is remembered, with ages in place of times, to be kept over a restart."""
        now = self._clock()
        return {tier: [(sure, good, now - at) for sure, good, at in seen] for tier, seen in self._seen.items()}

    def load(self, rows: Mapping[str, list[tuple[float, bool, float]]]) -> None:
        """Take in what was remembered."""
        for tier, seen in rows.items():
            for sure, good, age_s in seen[-MOST:]:
                self.add(tier, sure, good=good, age_s=age_s)

    def _moved(self, base: float, seen: list[tuple[float, bool, float]]) -> float:
        if base >= HIGHEST:
            return base
        now = self._clock()
        weighed = [(sure, good, 0.5 ** (max(0.0, now - at) / HALF_LIFE_S)) for sure, good, at in seen]
        threshold = base
        while threshold < HIGHEST:
            above = [(good, weight) for sure, good, weight in weighed if sure >= threshold]
            total = sum(weight for _, weight in above)
            if total < LEAST or sum(weight for good, weight in above if good) >= TARGET * total:
                return round(threshold, 4)
            threshold = round(threshold + STEP, 4)
        return HIGHEST
