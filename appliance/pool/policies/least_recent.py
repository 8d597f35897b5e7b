"""Least recently used: what nobody has used for longest goes first."""

from collections.abc import Sequence

from appliance.pool.policies.facts import Idle


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
