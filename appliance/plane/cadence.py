"""How often a thing is told of, by how volatile it is and how much it is asked for. Pure.

The paper pushes every 500 ms: a container that was taken in between is missed, and one that never changes is told for
nothing. Here every change is told, and the interval between two messages about one thing weighs what a message costs
against what it saves. With messages T apart a change is known T/2 late on average, so of `demand` decisions a second
about demand · volatility · T / 2 rest on a state that has passed, while listeners / T messages a second are delivered.
The sum, with PRICE such decisions worth a delivery, is least at

    T = sqrt(2 · PRICE · listeners / (volatility · demand))

the square-root law of keeping copies fresh (Cho and Garcia-Molina, "Synchronizing a database to improve freshness",
SIGMOD 2000). A thing that has been quiet for T is told of at once.
"""

import math

PRICE = 0.005
"""Decisions on a passed state that the delivery of one message is worth. With three listeners, a container that changes
twice a second and is asked for once a second is told of at most every 120 ms; at ten times of both, every 20 ms."""
MEMORY_S = 10.0
"""Rates are averages over about so long."""
QUIET = 0.02
"""Decisions a second that a thing nobody asked for counts with: somebody may."""
_MOST_HEARD = 1000.0
"""Messages a second that a listener hears at most when everybody has news all the time."""
_MUCH_HEARD = 100.0
"""The same when everybody has news all the time and nobody asks for it."""
_HEARTBEATS = 10.0
"""Messages a second that a listener hears when nothing changes."""


class Rate:
    """Events a second, of late: each counts less and less, by exp(−age / MEMORY_S)."""

    def __init__(self) -> None:
        self._value = 0.0
        self._at = 0.0

    def add(self, now: float) -> None:
        """An event; `now` in seconds of a clock that never goes back."""
        self._value, self._at = self.read(now) + 1 / MEMORY_S, now

    def read(self, now: float) -> float:
        """Events a second."""
        return self._value * math.exp(-max(0.0, now - self._at) / MEMORY_S)


def interval_s(*, volatility: float, demand: float, listeners: int, least_s: float, most_s: float) -> float:
    """Seconds between two messages about a thing, within `bounds`.

    Args:
        volatility: changes a second.
        demand: decisions a second that rest on it.
        listeners: who is told.
        least_s: never less; what changes within this time is told together.
        most_s: never more.
    """
    least_s, most_s = bounds(listeners, least_s=least_s, most_s=most_s)
    weight = volatility * max(QUIET, demand)
    wanted = math.sqrt(2 * PRICE * max(1, listeners) / weight) if weight > 0 else most_s
    return min(most_s, max(least_s, wanted))


def bounds(listeners: int, *, least_s: float, most_s: float) -> tuple[float, float]:
    """The shortest and the longest interval in a fleet of that size: each listener hears so many others."""
    least_s = max(least_s, listeners / _MOST_HEARD)
    return least_s, max(most_s, least_s, listeners / _MUCH_HEARD)


def heartbeat_s(listeners: int, least_s: float) -> float:
    """Seconds after which what has not changed is said again, so that silence means something."""
    return max(least_s, listeners / _HEARTBEATS)


class Cadence:
    """When one thing is told of next."""

    def __init__(self, *, least_s: float, most_s: float) -> None:
        self._least_s, self._most_s = least_s, most_s
        self._changes = Rate()
        self._asked = Rate()
        self._told_at = -math.inf
        self._since: float | None = None

    @property
    def since(self) -> float | None:
        """Since when something is untold; None: nothing is."""
        return self._since

    def changed(self, now: float) -> None:
        """It has changed."""
        self._changes.add(now)
        if self._since is None:
            self._since = now

    def asked(self, now: float) -> None:
        """A decision rested on it."""
        self._asked.add(now)

    def demand(self, now: float) -> float:
        """Decisions a second."""
        return self._asked.read(now)

    def due(self, now: float, *, listeners: int, elsewhere: float = 0.0) -> float | None:
        """When it is to be told; None: there is nothing to tell. `elsewhere`: decisions a second on other gateways."""
        if self._since is None:
            return None
        least_s, most_s = bounds(listeners, least_s=self._least_s, most_s=self._most_s)
        apart_s = interval_s(
            volatility=self._changes.read(now),
            demand=self._asked.read(now) + elsewhere,
            listeners=listeners,
            least_s=self._least_s,
            most_s=self._most_s,
        )
        return min(max(self._since + least_s, self._told_at + apart_s), self._since + most_s)

    def told(self, now: float) -> None:
        """It has been told as it is."""
        self._told_at, self._since = now, None
