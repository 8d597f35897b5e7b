"""A radio link that loses, doubles, delays and mixes up frames, by chance but the same each time (a seed).

Pure: frames in with the time, frames out that are due.
"""

import heapq
import math
import random
from typing import Generic, TypeVar

from msgspec import Struct

from appliance.errors import ConfigError

T = TypeVar("T")
MAX_QUEUED = 4096
"""Frames on their way at once; beyond it they are lost, as in a full radio buffer."""


class Air(Struct, frozen=True, kw_only=True):
    """How bad it is, the same each way."""

    drop: float = 0.0
    """Share of frames lost."""
    double: float = 0.0
    """Share of frames that arrive twice."""
    mix: float = 0.0
    """Share of frames that are held back and arrive after later ones."""
    delay_s: float = 0.0
    """Time on the way; frames held back take up to three times as long, and 50 ms more."""
    seed: int = 1

    def check(self) -> None:
        """Raise ConfigError for what cannot be simulated."""
        for name, share in (("drop", self.drop), ("double", self.double), ("mix", self.mix)):
            if not 0.0 <= share < 1.0:
                raise ConfigError(f"{name} {share:g}", remedy="use a share from 0 to below 1")
        if not (math.isfinite(self.delay_s) and 0.0 <= self.delay_s <= 10.0):
            raise ConfigError(f"delay_s {self.delay_s:g}", remedy="use 0 to 10 seconds")


class Channel(Generic[T]):
    """One direction of a link."""

    def __init__(self, air: Air, *, direction: int) -> None:
        self._air = air
        self._chance = random.Random(f"{air.seed}/{direction}")  # noqa: S311 - a lossy link, no secret
        self._number = 0
        self._way: list[tuple[float, int, T]] = []
        self.lost = 0

    def send(self, frame: T, now: float) -> None:
        """Put a frame on its way, unless it is lost."""
        air, chance = self._air, self._chance
        # Always the same draws for a frame, so that one share does not change what the others do.
        lost, doubled, held = (chance.random() for _ in range(3))
        back = chance.random()
        if lost < air.drop or len(self._way) >= MAX_QUEUED:
            self.lost += 1
            return
        late = (2.0 * air.delay_s + 0.05) * back if held < air.mix else 0.0
        for copy in range(2 if doubled < air.double else 1):
            self._number += 1
            heapq.heappush(self._way, (now + air.delay_s + late + 0.01 * copy, self._number, frame))

    def due(self, now: float) -> list[T]:
        """Return what has arrived, in the order of arrival."""
        found: list[T] = []
        while self._way and self._way[0][0] <= now:
            found.append(heapq.heappop(self._way)[2])
        return found
