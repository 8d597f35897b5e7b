"""A token bucket: how many things are let through."""


class Bucket:
    """Lets `rate` things a second through, and `burst` at once after a pause; it begins full."""

    def __init__(self, rate: float, *, burst: float) -> None:
        self._rate = rate
        self._burst = max(1.0, burst)
        self._tokens = self._burst
        self._at: float | None = None

    def limit(self, rate: float) -> None:
        """Let through at another rate from now on."""
        self._rate = rate

    def left(self, now: float) -> int:
        """How many may go through at once now."""
        if self._at is not None:
            self._tokens = min(self._burst, self._tokens + max(0.0, now - self._at) * self._rate)
        self._at = now
        return int(self._tokens + 1e-9)

    def take(self, now: float) -> bool:
        """Let one through, if it may."""
        if not self.left(now):
            return False
        self._tokens -= 1.0
        return True
