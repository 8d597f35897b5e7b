"""A histogram of idle times: how long it takes until something is wanted again, from a quarter second to a day.

As in Shahrad et al., "Serverless in the Wild", USENIX ATC 2020, section 4.2, but with geometric buckets, each a
eighth of an octave (9 %) wide, where theirs are a minute wide: a fleet's work repeats by the second as well as by
the hour. Old counts fade: when there are 256 they are halved.
"""

import math

FIRST_S = 0.25
PER_OCTAVE = 8
BUCKETS = 150
"""0.25 s * 2^(150/8) = 31 hours."""
ENOUGH = 8
"""Idle times that must have been seen before the histogram says anything."""
FADE_AT = 256.0
HEAD = 0.05
TAIL = 0.99
LEAST_CV = 2.0
"""Coefficient of variation of the bucket counts from which the histogram is representative (ATC 2020, section 4.2).

A timer fills one or two buckets of 150 (CV 8 to 12), a Poisson process some 40 unevenly (CV 2), noise over all
scales every bucket alike (CV 0)."""


def bucket(gap_s: float) -> int:
    """Return the bucket of an idle time."""
    if gap_s <= FIRST_S:
        return 0
    return min(BUCKETS - 1, 1 + int(PER_OCTAVE * math.log2(gap_s / FIRST_S)))


def lower_s(index: int) -> float:
    """Return where a bucket begins, seconds."""
    return 0.0 if index == 0 else FIRST_S * 2.0 ** ((index - 1) / PER_OCTAVE)


class IdleTimes:
    """The idle times of one thing. Memory: 150 numbers."""

    __slots__ = ("_window", "counts", "total")

    def __init__(self) -> None:
        self.counts: list[float] = [0.0] * BUCKETS
        self.total = 0.0
        self._window: tuple[float, float] | bool | None = False

    def add(self, gap_s: float) -> None:
        """Note one idle time."""
        self.counts[bucket(gap_s)] += 1.0
        self.total += 1.0
        self._window = False
        if self.total >= FADE_AT:
            self.counts = [count / 2 for count in self.counts]
            self.total /= 2

    def window(self) -> tuple[float, float] | None:
        """Return the 5th percentile, rounded down, and the 99th, rounded up, seconds; None: not representative."""
        if isinstance(self._window, bool):
            self._window = self._compute()
        return self._window

    def _compute(self) -> tuple[float, float] | None:
        if self.total < ENOUGH:
            return None
        mean = self.total / BUCKETS
        variance = sum(count * count for count in self.counts) / BUCKETS - mean * mean
        if math.sqrt(max(0.0, variance)) / mean < LEAST_CV:
            return None
        return lower_s(self._at(HEAD)), lower_s(self._at(TAIL) + 1)

    def _at(self, part: float) -> int:
        left = part * self.total
        for index, count in enumerate(self.counts):
            left -= count
            if left <= 0 and count:
                return index
        return BUCKETS - 1

    def rest_s(self, idle_s: float) -> float:
        """Return how much longer it usually takes (the median) once it has been idle for so long, seconds."""
        first = bucket(idle_s)
        ahead = sum(self.counts[first:])
        if not ahead:
            return max(idle_s, FIRST_S)  # longer than ever seen: as long again
        half = ahead / 2
        for index in range(first, BUCKETS):
            half -= self.counts[index]
            if half <= 0:
                return max(FIRST_S / 2, math.sqrt(max(lower_s(index), FIRST_S / 2) * lower_s(index + 1)) - idle_s)
        return max(idle_s, FIRST_S)
