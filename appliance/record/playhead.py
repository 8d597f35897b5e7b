"""Where a replay is in its log, as a pure function of the clock that is passed in: rate, pause, seek.

`position(now) = mark + (now - since) · rate`, where `mark` and `since` are set anew whenever the rate changes, the
replay is paused or goes on, or jumps. A rate of 0 means as fast as whoever listens takes it: then the position is
wherever the last message was.
"""

SLOWEST, FASTEST = 0.01, 1000.0


class Playhead:
    """Between the log's nanoseconds and the clock's seconds.

    Args:
        start_ns: time in the log to begin at.
        rate: seconds of the log a second; 0: as fast as possible.
        now: the clock.
        paused: begin standing still.
    """

    def __init__(self, start_ns: int, *, rate: float, now: float, paused: bool = False) -> None:
        self._mark_ns = start_ns
        self._since = now
        self._rate = rate
        self._paused = paused

    @property
    def paused(self) -> bool:
        """Whether it stands still."""
        return self._paused

    @property
    def rate(self) -> float:
        """Seconds of the log a second; 0: as fast as possible."""
        return self._rate

    def position_ns(self, now: float) -> int:
        """Return the time in the log at a reading of the clock."""
        if self._paused or not self._rate:
            return self._mark_ns
        return self._mark_ns + round((now - self._since) * self._rate * 1e9)

    def delay_s(self, at_ns: int, now: float) -> float | None:
        """Return how long until a message of the log is due, 0 when it is; None while paused."""
        if self._paused:
            return None
        if not self._rate:
            return 0.0
        return max(0.0, (at_ns - self.position_ns(now)) / 1e9 / self._rate)

    def reached(self, at_ns: int) -> None:
        """Note that a message was played: without a rate that is where it is."""
        if not self._rate:
            self._mark_ns = max(self._mark_ns, at_ns)

    def pause(self, now: float, *, paused: bool) -> None:
        """Stand still, or go on from there."""
        self._mark_ns, self._since = self.position_ns(now), now
        self._paused = paused

    def set_rate(self, rate: float, now: float) -> None:
        """Go on at another rate, kept within bounds; 0 is as fast as possible."""
        self._mark_ns, self._since = self.position_ns(now), now
        self._rate = min(FASTEST, max(SLOWEST, rate)) if rate else 0.0

    def seek(self, to_ns: int, now: float) -> None:
        """Jump."""
        self._mark_ns, self._since = to_ns, now
