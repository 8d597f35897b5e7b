"""When a robot is asked again for a command, and when it is given up: the retry policy of `send_command`. Pure.

A robot answers a command when it is done, and says at the latest after `LONG_POLL_S` that it is still under way; it is
then asked again with the same id. What departs from that is bounded:

- nobody takes the question, or it is taken and dropped: asked again after 0.2 s, 0.4 s, ... (at most 2 s), given up
  after `UNREACHABLE_S`;
- the question is taken and nothing comes back: asked again after `FIRST_SILENCE_S`, then after twice that; the earlier
  questions stay open, an answer to any of them counts. Given up after `SILENT_S` without a word;
- it says at once that it is under way: asked again after 0.2 s, 0.4 s, ... (at most 5 s), until the deadline;
- it answers an earlier question while a later one is open: a robot that keeps its replies by id answers that one too.
  Where the answer does not come within `CONFIRM_S` it is asked once more, and else it carries out the order again.
"""

from enum import Enum, auto

from msgspec import Struct

LONG_POLL_S = 10.0
"""Longest that a question is held before the asker is asked to repeat it."""
GRACE_S = 2.0
"""How much longer than that an answer is waited for."""
FIRST_SILENCE_S = LONG_POLL_S + GRACE_S
SILENT_S = 36.0
"""A robot that took a question and has not said a word for so long is given up."""
UNREACHABLE_S = 8.0
"""A robot that nobody has answered for so long is given up: a restarting gateway is back sooner."""
CONFIRM_S = 2.0
"""How soon a robot that keeps its replies gives one again."""
FIRST_S, MOST_GONE_S, MOST_QUICK_S = 0.2, 2.0, 5.0
HELD_S = 2.0
"""A question that was held so long was not turned away at the door."""
JITTER = 0.25
"""Share of a wait that chance takes off, so that many who lost one gateway do not ask the next one at once."""


class Ending(Enum):
    """Why a robot is not asked any more."""

    NOBODY = auto()
    """Nobody took the questions, or they were taken and dropped."""
    SILENT = auto()
    """The questions were taken, and not a word came."""
    LATE = auto()
    """The command's own time is over."""
    FORGETFUL = auto()
    """Asked again for what it has done, it does it again."""


class Ask(Struct, frozen=True):
    """Send the question now, and tell `asked`."""


class Wait(Struct, frozen=True):
    """Wait for a word on the open questions, at most until then."""

    until: float


class Done(Struct, frozen=True):
    """The first answer holds."""


class End(Struct, frozen=True):
    """Give up."""

    why: Ending


Step = Ask | Wait | Done | End


class CommandRetry:
    """Decides for one command; `next` says what to do, the other methods tell it what happened. Times in seconds.

    Args:
        now: when it begins.
        timeout_s: how long the command may take.
        live: whether each answer is made afresh, so that two differ without having been done twice (`state`).
        chance: 0 to 1, taken off each wait in proportion to `JITTER`.
    """

    def __init__(self, now: float, timeout_s: float, *, live: bool = False, chance: float = 0.0) -> None:
        self.deadline = now + timeout_s
        self.asks = 0
        """Questions sent so far."""
        self.said = 0
        """How often the robot said that it is under way."""
        self._began = self._heard = self._next = now
        self._live = live
        self._shorter = 1.0 - JITTER * chance
        self._open: dict[int, float] = {}
        """Questions that nothing has come of yet -> when they were sent."""
        self._unheard = self._gone = self._quick = 0
        """In a row: questions without a word, turned away, and answered at once with `under way`."""
        self._gone_since: float | None = None
        self._answered: int | None = None
        self._confirm_at = 0.0
        self._confirming: int | None = None
        """The question that was sent to see whether it remembers; 0: about to be."""
        self._differs = False

    def silence(self, now: float) -> float:
        """Seconds since its last word, or since the first question."""
        return now - self._heard

    def asked(self, now: float) -> int:
        """A question goes out; returns its number."""
        self.asks += 1
        self._unheard += 1
        self._open[self.asks] = now
        if self._confirming == 0:
            self._confirming = self.asks
        return self.asks

    def under_way(self, number: int, now: float) -> None:
        """It says that the command is under way."""
        sent = self._open.pop(number, now)
        if self._answered is not None:
            # After an answer: it is at it again, unless the two crossed on their way, which another question tells.
            self._differs = number == self._confirming
            self._open[number] = sent
            if self._confirming is None:
                self._confirm_at = now
            return
        self.said += 1
        self._heard, self._unheard, self._gone, self._gone_since = now, 0, 0, None
        if now - sent >= HELD_S:
            self._quick, self._next = 0, now
        else:
            self._next = now + min(FIRST_S * 2**self._quick, MOST_QUICK_S) * self._shorter
            self._quick = min(self._quick + 1, 16)

    def gone(self, number: int, now: float) -> None:
        """Nobody took a question, or it was taken and dropped."""
        sent = self._open.pop(number, now)
        if self._answered is not None:
            if number == self._confirming:  # it went away: what it remembers is not known, and its answer holds
                self._answered = number
            return
        self._unheard = max(0, self._unheard - 1)
        if self._gone_since is None or now - sent >= HELD_S:
            self._gone_since = now
        self._next = now + min(FIRST_S * 2**self._gone, MOST_GONE_S) * self._shorter
        self._gone = min(self._gone + 1, 16)

    def answered(self, number: int, now: float, *, same: bool = True, kept: bool = True) -> None:
        """What came of the command is there.

        Args:
            number: the question that is answered.
            now: when.
            same: whether it is what the first answer said, where this is not the first.
            kept: whether robots keep such an answer; one that was busy may do it when it is asked again.
        """
        self._open.pop(number, None)
        if self._answered is None and not kept:
            self._answered, self._live = number, True
        elif self._answered is None:
            self._answered, self._confirm_at = number, now + CONFIRM_S
        elif self._live or same:
            self._answered = max(self._answered, number)
        else:
            self._differs = True

    def next(self, now: float) -> Step:
        """Return what to do at a time; `Ask` is followed by `asked`."""
        if self._answered is not None:
            return self._confirm(now, self._answered)
        if now >= self.deadline:
            mute = not self.said and now - self._began >= UNREACHABLE_S
            return End(Ending.SILENT if mute else Ending.LATE)
        last = min(self.deadline, self._heard + SILENT_S)
        if now >= last:
            return End(Ending.SILENT)
        if self._open:
            due = max(self._open.values()) + FIRST_SILENCE_S * 2 ** max(0, self._unheard - 1)
            return Ask() if now >= due else Wait(min(due, last))
        if self._gone_since is not None:
            if now >= self._gone_since + UNREACHABLE_S:
                return End(Ending.NOBODY)
            last = min(last, self._gone_since + UNREACHABLE_S)
        return Ask() if now >= self._next else Wait(min(self._next, last))

    def _confirm(self, now: float, answered: int) -> Step:
        """After the first answer: whether questions that were sent later are answered from memory."""
        if self._differs:
            return End(Ending.FORGETFUL)
        if self._live or not any(number > answered for number in self._open):
            return Done()
        if now < self._confirm_at:
            return Wait(self._confirm_at)
        if self._confirming is not None:
            return End(Ending.FORGETFUL)
        self._confirming, self._confirm_at = 0, now + CONFIRM_S
        return Ask()
