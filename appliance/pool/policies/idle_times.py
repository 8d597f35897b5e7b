"""A histogram of idle times: how long it takes until something is wanted again, from a quarter second to a day.

As in Shahrad et al., "Serverless in the Wild", USENIX ATC 2020, section 4.2, but with geometric buckets, each a
eighth of an octave (9 %) wide, where theirs are a minute wide: a fleet's work repeats by the second as well as by
the hour. Old counts fade: when there are 256 they are halved.
"""

import math
from collections.abc import Mapping

FIRST_S = 0.25
PER_OCTAVE = 8
BUCKETS = 150
"""0.25 s * 2^(150/8) = 31 hours."""
DAY_S = 86_400.0
ENOUGH = 8
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
        if self.total < ENOUGH:
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
