"""The planner's queue: so many instructions at once, so many that wait, and a clear refusal for the rest."""

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, Callable

from appliance.errors import RefusedError

LONGEST_RETRY_S = 60.0
_WEIGHT = 0.2
"""Of the latest instruction in the mean time that one takes."""


class Gate:
    """Lets instructions in by turns.

    Args:
        at_once: planned at the same time.
        waiting: that may wait.
        clock: seconds.
    """

    def __init__(self, *, at_once: int, waiting: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._turns = asyncio.Semaphore(at_once)
        self._at_once = at_once
        self._most = waiting
        self._clock = clock
        self._mean_s = 0.0
        self.waiting = 0
        self.inside = 0
        self.refused = 0

    @contextlib.asynccontextmanager
    async def turn(self) -> AsyncGenerator[None]:
        """Wait for a turn and hold it.

        Raises:
            RefusedError: too many wait already; `retry_after_s` says when to ask again.
        """
        if self.inside >= self._at_once and self.waiting >= self._most:
            self.refused += 1
            raise RefusedError(
                f"{self.waiting} instructions wait to be planned already",
                remedy="ask again a little later",
                retry_after_s=self.retry_after_s,
            )
        self.waiting += 1
        try:
            await self._turns.acquire()
        finally:
            self.waiting -= 1
        self.inside += 1
        began = self._clock()
        try:
            yield
        finally:
            self.inside -= 1
            took = self._clock() - began
            self._mean_s = took if not self._mean_s else self._mean_s + _WEIGHT * (took - self._mean_s)
            self._turns.release()

    @property
    def retry_after_s(self) -> float:
        """Seconds until one that comes now would have its turn, by how long they took lately."""
        ahead = (self.waiting + 1) / self._at_once
        return min(LONGEST_RETRY_S, max(0.1, round(ahead * self._mean_s, 1)))
