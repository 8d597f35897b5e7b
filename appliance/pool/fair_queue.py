"""Fair queueing: who is next among those who wait, by priority, then the earliest deadline, then fairly by submitter.

It exists apart from what is waited for (a container, or room in a fleet) and from the waiting itself, as plain code
with the clock passed in (but for `turn_of`), so that its promises can be property-tested:

    - A higher priority goes first; within one priority the earlier deadline, those without one last.
    - Among those left, submitters take turns by start-time fair queueing (Goyal, Vin and Cheng, 1996): each has a
      virtual time that grows by the cost of what it was served, and the one furthest behind is next. So a flood
      from one submitter delays another by no more than what is being served, however long the flood is. A new
      submitter begins at the present virtual time: not having asked before earns nothing.
    - Waiting raises the priority by one every `aging_s`, without a limit: whatever waits is passed by only finitely
      many that come after it, so nothing starves.
"""

import heapq
import math
import time
from collections.abc import Iterable

from msgspec import Struct

from appliance.model import PLAIN_PRIORITY, RunRequest

AGING_S = 15.0
"""Waiting so long counts as one priority more: a plain run passes those of the highest priority after a minute."""


class Turn(Struct, frozen=True, kw_only=True):
    """One who waits. Times are of the machine's monotonic clock."""

    id: str
    number: int = 0
    """Grows with each that comes: settles what nothing else does."""
    submitter: str = ""
    priority: int = PLAIN_PRIORITY
    due_at: float = math.inf
    since: float = 0.0
    cost: float = 1.0
    """What serving it takes, in whatever unit all of one line are counted."""

    def level(self, now: float, aging_s: float = AGING_S) -> int:
        """The priority with what waiting has added to it."""
        return self.priority + int(max(0.0, now - self.since) / aging_s)


def turn_of(request: RunRequest, since: float | None = None) -> Turn:
    """Return the place of a run that waits since then, by default since now."""
    now = time.monotonic()
    return Turn(
        id=request.run_id,
        submitter=request.submitter,
        priority=request.priority,
        due_at=now + request.due_s if request.due_s else math.inf,
        since=now if since is None else since,
    )


class Turns:
    """The order of those who wait in one line; remembers only how much each submitter has been served."""

    def __init__(self, *, aging_s: float = AGING_S) -> None:
        self._aging_s = aging_s
        self._served: dict[str, float] = {}
        """Submitter -> virtual time at which its next begins; those not ahead of the present one are left out."""
        self._now = 0.0
        """Virtual time: when the one served last began."""

    def order(self, waiting: Iterable[Turn], now: float) -> list[Turn]:
        """Return all who wait in the order in which they would be served if nobody else came."""
        classes: dict[tuple[int, float], dict[str, list[Turn]]] = {}
        for turn in waiting:
            by_submitter = classes.setdefault((-turn.level(now, self._aging_s), turn.due_at), {})
            by_submitter.setdefault(turn.submitter, []).append(turn)
        served, present = dict(self._served), self._now
        found: list[Turn] = []
        for key in sorted(classes):
            heads: list[tuple[float, float, int, list[Turn]]] = []
            for turns in classes[key].values():
                turns.sort(key=lambda each: (each.since, each.number), reverse=True)
                heads.append(self._head(turns, served, present))
            heapq.heapify(heads)
            while heads:
                start, _, _, turns = heapq.heappop(heads)
                turn = turns.pop()
                present = start  # the least of those left, and none of them begins before the present
                served[turn.submitter] = start + turn.cost
                found.append(turn)
                if turns:
                    heapq.heappush(heads, self._head(turns, served, present))
        return found

    @staticmethod
    def _head(turns: list[Turn], served: dict[str, float], present: float) -> tuple[float, float, int, list[Turn]]:
        first = turns[-1]
        return max(served.get(first.submitter, 0.0), present), first.since, first.number, turns

    def served(self, turn: Turn) -> None:
        """Note that one of those who wait was served."""
        start = max(self._served.get(turn.submitter, 0.0), self._now)
        self._now = start
        self._served[turn.submitter] = start + turn.cost
        # A submitter that is not ahead of the present begins there anyway: the table holds only those served of late.
        self._served = {name: at for name, at in self._served.items() if at > start}


class Completions:
    """How fast what is served ends: the mean time that the last ones took, for saying when a wait may be over."""

    def __init__(self) -> None:
        self._mean_s: float | None = None

    @property
    def mean_s(self) -> float | None:
        """Mean seconds of the last ones; None before the first."""
        return self._mean_s

    def ended(self, took_s: float) -> None:
        """Note how long one took."""
        if took_s >= 0:
            self._mean_s = took_s if self._mean_s is None else 0.9 * self._mean_s + 0.1 * took_s

    def expected_s(self, position: int, at_once: int) -> float | None:
        """Return in how many seconds the one at `position` (from 1) may be served; None when nothing was measured."""
        return None if self._mean_s is None else self._mean_s * position / max(1, at_once)
