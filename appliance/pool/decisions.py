"""What the pool decided lately and why: a bounded list that people can ask for, and counters since the start."""

import time
from collections import Counter, deque

import structlog

from appliance.pool.api import DecisionList, PoolDecision

log = structlog.get_logger(__name__)

KEPT = 500
"""Decisions kept: some hours of a quiet gateway, a minute of the busiest."""


class Decisions:
    """Notes, logs and tells the starts and ends of containers."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._kept: deque[PoolDecision] = deque(maxlen=KEPT)

    def note(self, what: str, *, image: str, container: str, why: str) -> None:
        """Note a decision: `what` is start, adopt, retire or fail."""
        self.counts[what] += 1
        self._kept.append(
            PoolDecision(at_ns=time.time_ns(), what=what, image=image, container=container, why=why[:600])
        )
        log.info(f"container {what}", container=container, image=image, reason=why)

    def recent(self, limit: int) -> DecisionList:
        """Return the newest decisions first."""
        newest = tuple(reversed(self._kept))[: max(0, limit)]
        return DecisionList(decisions=newest, counts=dict(self.counts))
