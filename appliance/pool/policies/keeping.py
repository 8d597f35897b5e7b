"""How long an idle container is kept when there is room enough and nobody has a forecast for it."""

from typing import Protocol

from appliance.pool.policies.facts import Idle
from appliance.pool.policies.forecaster import Level
from appliance.pool.policies.histogram import Histogram


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
