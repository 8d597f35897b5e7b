"""The ready subtasks that one gateway coordinates and that wait for room, in their turns, without I/O.

Without it every task would push its subtasks at gateways as soon as they are ready: whoever asks most often gets most,
priorities count only where a queue happens to be, and what a full gateway refuses uses up attempts. Here a subtask is
sent only when a gateway that can serve it has room, and when several could be, `pool.turns` says whose turn it is.

Room is what a gateway may hold, containers and some who wait for one (so that none stands idle until its coordinator
hears of it), less what runs there: by its own word, or by what was sent there and has not ended, whichever is more.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from msgspec import Struct

from appliance.model import GatewayStatus, SubtaskRecord, TaskRecord
from appliance.pool.turns import Completions, Turn, Turns
from appliance.tasks import machine

Key = tuple[str, str]
"""Task and subtask."""


class Place(Struct, frozen=True, kw_only=True):
    """Where a subtask may go now, or its place among those that wait."""

    gateway: str = ""
    """Empty: it waits."""
    position: int = 0
    """From 1; 0: it does not wait."""
    waiting: int = 0
    expected_s: float | None = None
    """In how many seconds it may go; None: nothing was measured yet."""


class _Waiting(Struct):
    turn: Turn
    candidates: tuple[str, ...]


class Line:
    """Whose turn it is.

    Args:
        gateways: what gateways tell of themselves, those that are there.
        backlog: runs that may be at a gateway beyond its containers, as a part of these.
        wake: told the task whose subtask may go now.
    """

    def __init__(
        self, gateways: Callable[[], Mapping[str, GatewayStatus]], *, backlog: float, wake: Callable[[str], None]
    ) -> None:
        self._gateways = gateways
        self._backlog = backlog
        self._wake = wake
        self._turns = Turns()
        self._numbers = 0
        self._waiting: dict[Key, _Waiting] = {}
        self._granted: dict[Key, str] = {}
        """Places given to subtasks that have not been sent there yet."""
        self._active: dict[str, dict[str, str]] = {}
        """Task -> subtask -> the gateway where it is."""
        self._at: Counter[str] = Counter()
        """Gateway -> subtasks of this coordinator there."""
        self.completions = Completions()

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._waiting)

    def ask(
        self, record: TaskRecord, target: SubtaskRecord, candidates: Sequence[str], now: float, *, left_s: float
    ) -> Place:
        """Return where a ready subtask may go, or its place in the line.

        Args:
            record: its task.
            target: the subtask.
            candidates: the gateways that can serve it, the best first.
            now: by the monotonic clock.
            left_s: seconds until its task's deadline; infinite without one.
        """
        key = (record.id, target.subtask.id)
        granted = self._granted.pop(key, None)
        if granted is not None:
            self._at[granted] -= 1
            if granted in candidates:
                return self._go(key, granted)
        waiting = self._waiting.get(key)
        if waiting is None:
            if not self._waiting and (free := next((each for each in candidates if self._room(each) > 0), "")):
                return self._go(key, free)
            self._numbers += 1
            waiting = _Waiting(
                Turn(
                    id="/".join(key),
                    number=self._numbers,
                    submitter=record.submitter,
                    priority=record.priority,
                    due_at=now + left_s,
                    since=now,
                ),
                (),
            )
            self._waiting[key] = waiting
        waiting.candidates = tuple(candidates)
        self.serve(now, but=key)
        if (granted := self._granted.pop(key, None)) is not None:
            self._at[granted] -= 1
            return self._go(key, granted)
        return self.place_of(key, now)

    def _go(self, key: Key, gateway: str) -> Place:
        """It is sent now: counted at once, and put right when its task's record says where it is."""
        self._active.setdefault(key[0], {})[key[1]] = gateway
        self._at[gateway] += 1
        return Place(gateway=gateway)

    def place_of(self, key: Key, now: float) -> Place:
        """Return the place of a subtask in the line."""
        if key not in self._waiting:
            return Place()
        name = "/".join(key)
        order = [each.id for each in self._turns.order((each.turn for each in self._waiting.values()), now)]
        position = order.index(name) + 1
        return Place(position=position, waiting=len(order), expected_s=self.expected_s(position))

    def expected_s(self, position: int) -> float | None:
        """In how many seconds one at this place may go; None: nothing was measured yet."""
        at_once = sum(status.capacity for status in self._gateways().values() if not status.draining)
        return self.completions.expected_s(position, at_once)

    def _room(self, gateway: str) -> float:
        status = self._gateways().get(gateway)
        if status is None:
            return 0.0
        if not status.capacity:
            return math.inf  # it does not tell; its own queue is bounded
        return status.capacity * (1 + self._backlog) - max(status.running, self._at[gateway])

    def serve(self, now: float, *, but: Key | None = None) -> None:
        """Give the room that there is to those who wait, in their turns; all but one are woken."""
        if not self._waiting:
            return
        by_id = {each.turn.id: key for key, each in self._waiting.items()}
        wanted = {each for waiting in self._waiting.values() for each in waiting.candidates}
        room = {each: left for each in wanted if (left := self._room(each)) > 0}
        if not room:
            return
        for turn in self._turns.order((each.turn for each in self._waiting.values()), now):
            key = by_id[turn.id]
            gateway = next((each for each in self._waiting[key].candidates if room.get(each, 0) > 0), "")
            if not gateway:
                continue
            del self._waiting[key]
            self._turns.served(turn)
            self._granted[key] = gateway
            self._at[gateway] += 1
            room[gateway] -= 1
            if key != but:
                self._wake(key[0])
            if not any(left > 0 for left in room.values()):
                return

    def moved(self, record: TaskRecord, now: float) -> None:
        """Note where the subtasks of a task are now."""
        active = {each.subtask.id: each.gateway for each in machine.active(record)}
        before = self._active.get(record.id, {})
        if active == before:
            return
        self._at.subtract(before.values())
        self._at.update(active.values())
        self._active[record.id] = active
        if before.keys() - active.keys():
            self.serve(now)

    def forget(self, task: str, now: float) -> None:
        """Note that a task is not driven here any more."""
        self._at.subtract(self._active.pop(task, {}).values())
        for key in [each for each in self._granted if each[0] == task]:
            self._at[self._granted.pop(key)] -= 1
        for key in [each for each in self._waiting if each[0] == task]:
            del self._waiting[key]
        self._at = Counter({gateway: count for gateway, count in self._at.items() if count > 0})
        self.serve(now)

    def left(self, task: str, subtask: str) -> None:
        """Note that a subtask does not wait for room any more: it waits for something else, or has ended."""
        self._waiting.pop((task, subtask), None)
        if (granted := self._granted.pop((task, subtask), None)) is not None:
            self._at[granted] -= 1
