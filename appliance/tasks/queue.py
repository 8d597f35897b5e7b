"""Tasks that are accepted and not taken up yet: whose turn it is. Pure; the clock is passed in.

A coordinator works on `tasks.max_tasks` tasks at once. The records of the others wait, as durable as any: here stands
of each only what its turn depends on, and the record is read when its turn comes. So ten thousand take a few MB, and a
gateway that takes them over finds them in its shard like all tasks that have not ended.

- **Senders take turns**, however many tasks each has waiting. The one whose next task has the higher priority goes
  first; being passed over for `AGING_S` counts as one priority more, so none starves. Among equals it is the one that
  was served least, by start-time fair queueing as in `pool.fair_queue`.
- **Of one sender** the higher priority goes first, then the earlier deadline, then the task accepted first. There is no
  aging here: what a sender puts before its own tasks is its own affair, and an order given among ten thousand of lower
  priority must not wait for those that are older.
- **Taking tasks up makes way for accepting them**: while acceptances are slow, one sender has one turn every so often.
- **Nobody is held up by the tasks of others that are being worked on**: a sender that has fewer than `RESERVED` of this
  or a higher priority among them goes at once, up to twice `tasks.max_tasks`.
"""

import heapq
import math
from collections.abc import Callable, Iterator

from msgspec import Struct

from appliance.pool.fair_queue import AGING_S

JUST_NOW_S = 1.0
"""For so long it is remembered when a sender was served of which none waits: longer than turns are kept apart."""
RESERVED = 2
"""Tasks of one sender that are taken up although others fill the places: one that runs, and one that ends just now."""


class Waiting(Struct, frozen=True, kw_only=True, order=False):
    """A task that waits for its turn."""

    id: str
    submitter: str
    priority: int
    accepted_ns: int
    """By its record; of one sender the first goes first."""
    due_at: float = math.inf
    """When its deadline passes, on this machine's monotonic clock."""


class _Sender(Struct):
    heap: list[tuple[int, float, int, str]]
    """Its tasks in their order; those taken out meanwhile are passed over."""
    since: float
    """When it was served last, or began to wait."""
    served: float
    """When it was served last; minus infinity: not since it began to wait."""
    start: float
    """Virtual time at which its next one begins."""
    count: int = 0


class TaskQueue:
    """The tasks of one coordinator that wait."""

    def __init__(self) -> None:
        self._waiting: dict[str, Waiting] = {}
        self._senders: dict[str, _Sender] = {}
        self._present = 0.0
        """Virtual time: when the one served last began."""
        self._gone: dict[str, tuple[float, float]] = {}
        """Sender of which none waits -> virtual time at which its next begins, and when it was served last; those that
        are neither ahead of the present nor were served just now are left out."""
        self._due: list[tuple[float, str]] = []

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._waiting)

    def __contains__(self, task: str) -> bool:
        """Whether a task waits here."""
        return task in self._waiting

    def __iter__(self) -> Iterator[str]:
        """Iterate over the ids of those that wait."""
        return iter(tuple(self._waiting))

    def add(self, task: Waiting, now: float) -> None:
        """Have a task wait; one that does already keeps its place."""
        if task.id in self._waiting:
            return
        self._waiting[task.id] = task
        sender = self._senders.get(task.submitter)
        if sender is None:
            start, served = self._gone.pop(task.submitter, (self._present, -math.inf))
            sender = self._senders[task.submitter] = _Sender([], now, served, start)
        heapq.heappush(sender.heap, (-task.priority, task.due_at, task.accepted_ns, task.id))
        sender.count += 1
        if task.due_at < math.inf:
            heapq.heappush(self._due, (task.due_at, task.id))

    def remove(self, task: str) -> Waiting | None:
        """Take a task out whose turn has not come; returns it, None where it does not wait."""
        found = self._waiting.pop(task, None)
        if found is not None:
            sender = self._senders[found.submitter]
            sender.count -= 1
            if not sender.count:
                del self._senders[found.submitter]
                self._gone[found.submitter] = sender.start, sender.served
        return found

    def next(self, now: float, *, room: bool, busy: Callable[[str, int], int], apart_s: float = 0.0) -> Waiting | None:
        """Take out the task whose turn it is; None: none may go now.

        Args:
            now: on the monotonic clock.
            room: whether there is a place; without, only senders go that have too few at work.
            busy: how many tasks of a sender, of this or a higher priority, are being worked on.
            apart_s: between two turns of one sender, at least.
        """
        best: tuple[int, float, int, str] | None = None
        for name, sender in self._senders.items():
            if now - sender.served < apart_s:
                continue
            first = self._first(sender)
            if not room and busy(name, first.priority) >= RESERVED:
                continue
            level = first.priority + int(max(0.0, now - sender.since) / AGING_S)
            turn = (-level, max(sender.start, self._present), first.accepted_ns, first.id)
            if best is None or turn < best:
                best = turn
        if best is None:
            return None
        _, start, _, task = best
        self._present = start
        sender = self._senders[self._waiting[task].submitter]
        sender.since, sender.served, sender.start = now, now, start + 1.0
        found = self.remove(task)
        self._gone = {
            name: (at, served) for name, (at, served) in self._gone.items() if at > start or now - served < JUST_NOW_S
        }
        return found

    def _first(self, sender: _Sender) -> Waiting:
        while (task := self._waiting.get(sender.heap[0][3])) is None:
            heapq.heappop(sender.heap)
        return task

    def overdue(self, now: float) -> list[Waiting]:
        """Take out the tasks whose deadline has passed."""
        found: list[Waiting] = []
        while self._due and self._due[0][0] <= now:
            _, task = heapq.heappop(self._due)
            if (waiting := self.remove(task)) is not None:
                found.append(waiting)
        return found

    def ahead(self, task: str) -> int:
        """Return how many tasks of the same sender go before one that waits."""
        mine = self._waiting[task]
        place = (-mine.priority, mine.due_at, mine.accepted_ns, mine.id)
        return sum(
            each.submitter == mine.submitter and (-each.priority, each.due_at, each.accepted_ns, each.id) < place
            for each in self._waiting.values()
        )
