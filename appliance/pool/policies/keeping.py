"""How long an idle container is kept when there is room enough and nobody has a forecast for it."""

from typing import Protocol

from appliance.pool.policies.costs import ColdCosts
from appliance.pool.policies.facts import Idle
from appliance.pool.policies.forecaster import Level
from appliance.pool.policies.histogram import Histogram
from appliance.pool.policies.learned import Learned


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
