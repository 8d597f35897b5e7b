"""What decides whether a tier is asked: queue, privacy, budget, circuit breaker, thresholds of confidence.

All but the queue is pure, with clock and day passed in; the cascade asks and tells.

- `Gate`: the planner's queue. So many instructions at once, so many that wait, and a clear refusal for the rest.
- `Privacy`: what is never sent upstream, instructions by tag or pattern and robots by the pattern of their ids.
- `Budget`: what upstream may cost a day, in requests and money by the configured prices. A day is the calendar day of
  this gateway's own clock, as it is on the bill; nothing between gateways rests on it.
- `Breaker`: what failed several times in a row is left alone for a while, longer each time. Without it every
  instruction on an offline site would wait for the deadline of a server that cannot be reached.
- `Thresholds`: how sure a tier must be is learned from what became of its plans. A tier's threshold is the lowest
  confidence, at least the configured one, from which its plans turned out well often enough. It rises when plans that
  were sure enough fail as plans, and comes back down as good ones follow and the bad ones are forgotten. It is never
  below what is configured: experience can only tighten.
"""

import asyncio
import contextlib
import re
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from fnmatch import fnmatchcase

from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import ConfigError, RefusedError
from appliance.llm.settings import PlanContext

LONGEST_RETRY_S = 60.0
_WEIGHT = 0.2
"""Of the latest instruction in the mean time that one takes."""


class Gate:
    """Lets instructions in by turns.

    Args:
        at_once: planned at the same time.
        waiting: that may wait.
        clock: seconds.
    """

    def __init__(self, *, at_once: int, waiting: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._turns = asyncio.Semaphore(at_once)
        self._at_once = at_once
        self._most = waiting
        self._clock = clock
        self._mean_s = 0.0
        self.waiting = 0
        self.inside = 0
        self.refused = 0

    @contextlib.asynccontextmanager
    async def turn(self) -> AsyncGenerator[None]:
        """Wait for a turn and hold it.

        Raises:
            RefusedError: too many wait already; `retry_after_s` says when to ask again.
        """
        if self.inside >= self._at_once and self.waiting >= self._most:
            self.refused += 1
            raise RefusedError(
                f"{self.waiting} instructions wait to be planned already",
                remedy="ask again a little later",
                retry_after_s=self.retry_after_s,
            )
        self.waiting += 1
        try:
            await self._turns.acquire()
        finally:
            self.waiting -= 1
        self.inside += 1
        began = self._clock()
        try:
            yield
        finally:
            self.inside -= 1
            took = self._clock() - began
            self._mean_s = took if not self._mean_s else self._mean_s + _WEIGHT * (took - self._mean_s)
            self._turns.release()

    @property
    def retry_after_s(self) -> float:
        """Seconds until one that comes now would have its turn, by how long they took lately."""
        ahead = (self.waiting + 1) / self._at_once
        return min(LONGEST_RETRY_S, max(0.1, round(ahead * self._mean_s, 1)))


_NAME = re.compile(r"[a-z0-9]+")


class Privacy:
    """Says what may leave this machine.

    Args:
        never: regular expressions; an instruction in which one is found stays here. Case does not matter.
        robots: shell patterns of robot ids: an instruction that names such a robot stays on this machine,
            and none elsewhere sees its name.
        tag: a word that keeps an instruction here; it is taken out before planning.

    Raises:
        ConfigError: an expression is none.
    """

    def __init__(self, *, never: Sequence[str], robots: Sequence[str], tag: str) -> None:
        try:
            self._never = [re.compile(each, re.IGNORECASE) for each in never]
        except re.error as error:
            raise ConfigError(
                f"llm.upstream_never: no regular expression: {error}", remedy="see Python's `re` for the form"
            ) from error
        self._robots = tuple(robots)
        self._tag = re.compile(rf"(?<!\S){re.escape(tag)}(?!\S)", re.IGNORECASE) if tag else None

    def marked(self, context: PlanContext) -> PlanContext:
        """Return the context with the tag taken out of its instruction, and private where it was there."""
        if self._tag is None or not self._tag.search(context.instruction):
            return context
        text = " ".join(self._tag.sub(" ", context.instruction).split())
        return replace(context, instruction=text, private=True)

    def withholds(self, context: PlanContext) -> str:
        """Return why an instruction must stay here, or ""."""
        if context.private:
            return "the instruction is private"
        for pattern in self._never:
            if pattern.search(context.instruction):
                return f"the instruction matches {pattern.pattern!r} (llm.upstream_never)"
        said = " ".join(_NAME.findall(context.instruction.casefold()))
        for robot in context.robots or ():
            if self._private(robot.id) and f" {' '.join(_NAME.findall(robot.id))} " in f" {said} ":
                return f"the instruction names {robot.id} (llm.upstream_never_robots)"
        return ""

    def trimmed(self, context: PlanContext) -> PlanContext:
        """Return the context without the robots whose names stay on this machine."""
        if not self._robots or context.robots is None:
            return context
        return replace(context, robots=tuple(each for each in context.robots if not self._private(each.id)))

    def _private(self, robot: str) -> bool:
        return any(fnmatchcase(robot, pattern) for pattern in self._robots)


MILLION = 1_000_000


class Spent(Struct, frozen=True, kw_only=True):
    """On one day."""

    day: str = ""
    requests: int = 0
    cost: float = 0.0


class Budget:
    """Counts what is spent and says when it is enough.

    Args:
        cost: a day, in the currency of the prices; 0: no bound.
        requests: a day; 0: no bound.
        price_in: of a million prompt tokens.
        price_out: of a million answer tokens.
    """

    def __init__(self, *, cost: float, requests: int, price_in: float, price_out: float) -> None:
        self._cost = cost
        self._requests = requests
        self._price_in = price_in
        self._price_out = price_out
        self._spent = Spent()

    def on(self, day: str) -> Spent:
        """Return what was spent on a day."""
        return self._spent if self._spent.day == day else Spent(day=day)

    def refuses(self, day: str) -> str:
        """Return why nothing may be asked any more on a day, or ""."""
        spent = self.on(day)
        if self._requests and spent.requests >= self._requests:
            return f"{spent.requests} requests today, and no more than {self._requests} are allowed"
        if self._cost and spent.cost >= self._cost:
            return f"{spent.cost:.2f} spent today of {self._cost:.2f}"
        return ""

    def spend(self, day: str, *, tokens_in: int = 0, tokens_out: int = 0, requests: int = 1) -> Spent:
        """Note a request and what it took; returns what the day has cost by then."""
        spent = self.on(day)
        cost = (max(0, tokens_in) * self._price_in + max(0, tokens_out) * self._price_out) / MILLION
        self._spent = replace(spent, requests=spent.requests + requests, cost=round(spent.cost + cost, 6))
        return self._spent

    @property
    def last(self) -> Spent:
        """What was spent on the latest day."""
        return self._spent

    def load(self, spent: Spent) -> None:
        """Take in what was spent before a restart."""
        self._spent = spent


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
        """The asker did not wait for the answer: nothing is learned."""
        self._trying = False


TARGET_SHARE = 0.8
"""Share of a tier's plans that are to turn out well."""
LEAST_OUTCOMES = 2.5
"""Observations, weighed by age, below which nothing is concluded."""
MOST_OUTCOMES = 64
OUTCOME_HALF_LIFE_S = 6 * 3600.0
"""After so long an outcome counts half: within a shift what was mended is believed again."""
HIGHEST_THRESHOLD = 0.95
THRESHOLD_STEP = 0.05


class Thresholds:
    """The confidence from which each tier's plans run unasked.

    Args:
        base: what is configured, by tier.
        clock: seconds.
    """

    def __init__(self, base: Mapping[str, float], *, clock: Callable[[], float]) -> None:
        self._base = dict(base)
        self._clock = clock
        self._seen: dict[str, deque[tuple[float, bool, float]]] = {}
        """Tier -> (confidence, whether it turned out well, when)."""

    def add(self, tier: str, confidence: float, *, good: bool, age_s: float = 0.0) -> None:
        """Note what became of a plan of a tier."""
        seen = self._seen.setdefault(tier, deque(maxlen=MOST_OUTCOMES))
        seen.append((confidence, good, self._clock() - age_s))

    def of(self, tier: str) -> float:
        """Return the confidence from which a plan of a tier is taken; 0 for one that has none."""
        base = self._base.get(tier, 0.0)
        return self._moved(base, list(self._seen.get(tier, ())))

    @property
    def all(self) -> dict[str, float]:
        """By tier."""
        return {tier: self.of(tier) for tier in self._base}

    def rows(self) -> dict[str, list[tuple[float, bool, float]]]:
        """What is remembered, with ages in place of times, to be kept over a restart."""
        now = self._clock()
        return {tier: [(sure, good, now - at) for sure, good, at in seen] for tier, seen in self._seen.items()}

    def load(self, rows: Mapping[str, list[tuple[float, bool, float]]]) -> None:
        """Take in what was remembered."""
        for tier, seen in rows.items():
            for sure, good, age_s in seen[-MOST_OUTCOMES:]:
                self.add(tier, sure, good=good, age_s=age_s)

    def _moved(self, base: float, seen: list[tuple[float, bool, float]]) -> float:
        if base >= HIGHEST_THRESHOLD:
            return base
        now = self._clock()
        weighed = [(sure, good, 0.5 ** (max(0.0, now - at) / OUTCOME_HALF_LIFE_S)) for sure, good, at in seen]
        threshold = base
        while threshold < HIGHEST_THRESHOLD:
            above = [(good, weight) for sure, good, weight in weighed if sure >= threshold]
            total = sum(weight for _, weight in above)
            if total < LEAST_OUTCOMES or sum(weight for good, weight in above if good) >= TARGET_SHARE * total:
                return round(threshold, 4)
            threshold = round(threshold + THRESHOLD_STEP, 4)
        return HIGHEST_THRESHOLD
