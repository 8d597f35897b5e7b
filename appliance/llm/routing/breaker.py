"""A circuit breaker: what failed several times in a row is left alone for a while, longer each time. Pure.

Without it every instruction on an offline site would wait for the deadline of a server that cannot be reached.
"""

FAILURES = 3
OPEN_S = 15.0
MOST_OPEN_S = 600.0


class Breaker:
    """Of one server.

    Args:
        failures: in a row, after which it opens.
        open_s: for how long at first; doubled each time that the one try after it fails too.
        most_s: for how long at most.
    """

    def __init__(self, *, failures: int = FAILURES, open_s: float = OPEN_S, most_s: float = MOST_OPEN_S) -> None:
        self._failures = failures
        self._open_s = open_s
        self._most_s = most_s
        self._row = 0
        self._opened = 0
        self._until = 0.0
        self._trying = False

    def state(self, now: float) -> str:
        """Return `closed`, `open` or `half-open`."""
        if self._row < self._failures:
            return "closed"
        return "open" if now < self._until or self._trying else "half-open"

    def retry_after_s(self, now: float) -> float:
        """Seconds until it may be tried again; 0: now."""
        return max(0.0, round(self._until - now, 1)) if self.state(now) == "open" else 0.0

    def take(self, now: float) -> bool:
        """Whether it may be asked; half open, only one at a time may."""
        state = self.state(now)
        if state == "half-open":
            self._trying = True
        return state != "open"

    def succeeded(self) -> None:
        """It has answered."""
        self._row, self._opened, self._trying = 0, 0, False

    def failed(self, now: float) -> None:
        """It has not."""
        self._row += 1
        self._trying = False
        if self._row >= self._failures:
            self._until = now + min(self._most_s, self._open_s * 2**self._opened)
            self._opened = min(self._opened + 1, 16)

    def gave_up(self) -> None:
        """Whoever asked did not wait for the answer: nothing is learned."""
        self._trying = False
