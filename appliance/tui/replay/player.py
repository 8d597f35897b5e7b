"""Which moment of a log is shown: play, pause, seek, rate. Pure; the clock is passed in, in monotonic seconds."""

from appliance.errors import PayloadError

RATES = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 100.0)
"""Log seconds a second."""


class Player:
    """The place in a log.

    Args:
        start_ns: time of its first message.
        end_ns: time of its last one.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self.start_ns = start_ns
        self.end_ns = max(start_ns, end_ns)
        self.rate = 1.0
        self.playing = False
        self._into_ns = 0.0
        """The place at `_since`, from the start: a float cannot tell a Unix nanosecond from the next hundred."""
        self._since = 0.0

    @property
    def length_s(self) -> float:
        """Seconds from the first message to the last."""
        return (self.end_ns - self.start_ns) / 1e9

    def at_ns(self, now: float) -> int:
        """Return the moment that is shown; at the end it pauses."""
        return self.start_ns + round(self._into(now))

    def _into(self, now: float) -> float:
        if not self.playing:
            return self._into_ns
        into = self._into_ns + max(0.0, now - self._since) * self.rate * 1e9
        if into >= self.end_ns - self.start_ns:
            self.playing = False
            self._into_ns = into = float(self.end_ns - self.start_ns)
        return into

    def at_s(self, now: float) -> float:
        """Return the same as seconds from the first message."""
        return (self.at_ns(now) - self.start_ns) / 1e9

    def play(self, now: float) -> None:
        """Go on from where it is; at the end from the beginning."""
        self._settle(now)
        if self._into_ns >= self.end_ns - self.start_ns:
            self._into_ns = 0.0
        self.playing = True

    def pause(self, now: float) -> None:
        """Stand still."""
        self._settle(now)
        self.playing = False

    def seek(self, seconds: float, now: float) -> None:
        """Go to so many seconds after the first message, at most the last one's."""
        if seconds != seconds:  # noqa: PLR0124 - not a number
            raise PayloadError("that is no time", remedy="give seconds from the start, such as 90, 1:30 or +10")
        self._settle(now)
        self._into_ns = min(max(0.0, seconds), self.length_s) * 1e9

    def step(self, seconds: float, now: float) -> None:
        """Go so many seconds on, or back."""
        self.seek(self.at_s(now) + seconds, now)

    def set_rate(self, rate: float, now: float) -> None:
        """Play so many log seconds a second.

        Raises:
            PayloadError: it is not within `RATES`.
        """
        if not RATES[0] <= rate <= RATES[-1]:
            raise PayloadError(f"a rate of {rate:g}", remedy=f"give {RATES[0]:g} to {RATES[-1]:g}")
        self._settle(now)
        self.rate = rate

    def faster(self, now: float) -> None:
        """Take the next rate above."""
        self.set_rate(next((each for each in RATES if each > self.rate), RATES[-1]), now)

    def slower(self, now: float) -> None:
        """Take the next rate below."""
        self.set_rate(next((each for each in RATES[::-1] if each < self.rate), RATES[0]), now)

    def hold(self, at_ns: int, now: float) -> None:
        """Take it that messages could be read up to `at_ns` only: the clock waits for them."""
        if self.playing and self.at_ns(now) > at_ns:
            self._into_ns = float(max(at_ns - self.start_ns, 0))
            self._since = now

    def _settle(self, now: float) -> None:
        self._into_ns = self._into(now)
        self._since = now


def seconds_of(text: str, *, at_s: float, length_s: float) -> float:
    """Read a time in a log: `90`, `1:30`, `1:02:03`, `50%`, or `+10` and `-10` from where it is.

    Raises:
        PayloadError: it is none.
    """
    plain = text.strip()
    sign = plain[:1] if plain[:1] in ("+", "-") else ""
    try:
        if plain.endswith("%") and not sign:
            found = float(plain[:-1]) / 100 * length_s
        else:
            found = 0.0
            parts = plain.removeprefix(sign).split(":")
            if len(parts) > 3:
                raise ValueError  # noqa: TRY301 - told below
            if any(not part[:1].isdecimal() for part in parts):
                raise ValueError  # noqa: TRY301 - told below
            for part in parts:
                found = found * 60 + float(part)
    except ValueError:
        found = float("nan")
    if not 0 <= found < 1e12:
        raise PayloadError(f"{text[:40]!r} is no time of a log", remedy="give 90, 1:30, 50 %, or +10 and -10 from here")
    return at_s + (found if sign == "+" else -found) if sign else found


def told(seconds: float) -> str:
    """Return a time of a log for people: minutes and seconds with tenths, hours where there are any."""
    tenths = round(max(0.0, seconds) * 10)
    minutes, rest = divmod(tenths, 600)
    hours, minutes = divmod(minutes, 60)
    clock = f"{minutes:02}:{rest // 10:02}.{rest % 10}"
    return f"{hours}:{clock}" if hours else clock
