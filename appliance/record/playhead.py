"""Where a replay is in its log, as a pure function of the clock that is passed in: rate, pause, seek.

`position(now) = mark + (now - since) · rate`, where `mark` and `since` are set anew whenever the rate changes, the
replay is paused or goes on, or jumps. A rate of 0 means as fast as whoever listens takes it: then the position is
wherever the last message was. Logs that are played onto the plane and those on the screens go by the same.
"""

SLOWEST, FASTEST = 0.01, 1000.0


class Playhead:
    """Between the log's nanoseconds and the clock's seconds.

    Args:
        start_ns: time in the log to begin at; nothing is before it.
        end_ns: time at which it stands still; None: it goes on.
        rate: seconds of the log a second; 0: as fast as possible.
        now: the clock.
        paused: begin standing still.
    """

    def __init__(
        self, start_ns: int, end_ns: int | None = None, *, rate: float, now: float, paused: bool = False
    ) -> None:
        self.start_ns = start_ns
        self.end_ns = None if end_ns is None else max(start_ns, end_ns)
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
        at_ns = self._mark_ns + round((now - self._since) * self._rate * 1e9)
        if self.end_ns is None or at_ns < self.end_ns:
            return at_ns
        self._mark_ns, self._paused = self.end_ns, True
        return self.end_ns

    @property
    def length_s(self) -> float:
        """Seconds from the start to the end; 0 without one."""
        return 0.0 if self.end_ns is None else (self.end_ns - self.start_ns) / 1e9

    def position_s(self, now: float) -> float:
        """Return the position as seconds from the start."""
        return (self.position_ns(now) - self.start_ns) / 1e9

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

    def play(self, now: float) -> None:
        """Go on from there; at the end from the start."""
        if self.position_ns(now) == self.end_ns:
            self.seek(self.start_ns, now)
        self.pause(now, paused=False)

    def hold(self, at_ns: int, now: float) -> None:
        """Take it that messages could be read up to `at_ns` only: the clock waits for them."""
        if not self._paused and self.position_ns(now) > at_ns:
            self.seek(at_ns, now)

    def set_rate(self, rate: float, now: float) -> None:
        """Go on at another rate, kept within bounds; 0 is as fast as possible."""
        self._mark_ns, self._since = self.position_ns(now), now
        self._rate = min(FASTEST, max(SLOWEST, rate)) if rate else 0.0

    def seek(self, to_ns: int, now: float) -> None:
        """Jump, within the bounds; it goes on from there if it did before."""
        self.position_ns(now)
        latest_ns = to_ns if self.end_ns is None else min(to_ns, self.end_ns)
        self._mark_ns, self._since = max(self.start_ns, latest_ns), now
