"""Deadlines of tasks and backoff of their subtasks. Times are seconds; the clock is passed in.

**Deadlines**: how much time is left, and how a task ends that is not done in time. A deadline counts from acceptance.
The record carries the seconds that had passed at its last transition, each measured by the coordinator of that time on
its own monotonic clock, so no clocks are compared. What passes between the last transition and a takeover is known to
those who heard that record: they count on from when they heard it (`Ages`).

**Backoff** (`Backoff`): when each subtask of a task may be tried next, and what the waiting ones wait for.
"""

import math
import time
from collections import OrderedDict
from collections.abc import Callable

import msgspec
from msgspec import Struct

from appliance.model import Failure, SubtaskState, TaskRecord
from appliance.plane.session import Message

MOST_HEARD = 10_000
"""Tasks with deadlines whose age is remembered; beyond it the one heard of longest ago is forgotten."""


def left_s(record: TaskRecord, elapsed_s: float) -> float:
    """Return the seconds until a task's deadline; infinite without one."""
    return record.deadline_s - elapsed_s if record.deadline_s else math.inf


def passed(record: TaskRecord) -> Failure:
    """Return how a task ends whose deadline has passed."""
    done = sum(each.state is SubtaskState.SUCCEEDED for each in record.subtasks)
    how_far = f"{done} of {len(record.subtasks)} subtasks were" if record.subtasks else "it was not planned yet"
    return Failure(
        code="deadline",
        message=f"not done within {record.deadline_s:g} s of its acceptance: {how_far}",
        remedy="give it more time, or a higher priority",
    )


class _Age(Struct):
    """The part of a record that tells its age."""

    id: str
    elapsed_s: float = 0.0
    deadline_s: float = 0.0


class Ages:
    """How old the tasks with deadlines are that were heard of, by this machine's monotonic clock."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since: OrderedDict[str, float] = OrderedDict()

    def hear(self, message: Message) -> None:
        """Take in the news of a record; those without a deadline are not looked at further."""
        if message.deleted or b'"deadline_s":' not in message.payload:
            return
        try:
            age = msgspec.json.decode(message.payload, type=_Age)
        except (msgspec.DecodeError, UnicodeDecodeError):
            return  # the gateway that keeps the record counts it
        if not message.key.endswith(f"/task/{age.id}/record"):
            return
        since = self._clock() - age.elapsed_s
        # What was heard before of the same task may be older than this record says: time does not go back.
        self._since[age.id] = min(since, self._since.get(age.id, since))
        self._since.move_to_end(age.id)
        while len(self._since) > MOST_HEARD:
            self._since.popitem(last=False)

    def elapsed_s(self, record: TaskRecord) -> float:
        """Return the seconds since a task was accepted, as far as is known here."""
        since = self._since.get(record.id)
        return record.elapsed_s if since is None else max(record.elapsed_s, self._clock() - since)


LOOK_AGAIN_S = 0.5
"""How soon after it could not be placed a subtask is tried again."""


class Backoff:
    """The waits of one task's subtasks; times in seconds on this machine's monotonic clock."""

    def __init__(self) -> None:
        self.not_before: dict[str, float] = {}
        self._reasons: dict[str, str] = {}
        self._since: dict[str, float] = {}

    @property
    def waiting(self) -> bool:
        """Whether a subtask waits for a robot or a gateway."""
        return bool(self._reasons)

    def may_go(self, subtask: str, now: float) -> bool:
        """Whether a ready subtask may be tried now."""
        if self.not_before.get(subtask, 0.0) > now:
            return False
        self.not_before.pop(subtask, None)
        return True

    def goes(self, subtask: str) -> None:
        """It waits no more."""
        self._reasons.pop(subtask, None)
        self._since.pop(subtask, None)

    def waited_s(self, subtask: str, now: float) -> float:
        """Seconds since a subtask began to wait for what it still waits for."""
        return now - self._since.get(subtask, now)

    def waits(self, subtask: str, reason: str, now: float) -> bool:
        """Note why it waits, and look again soon; returns whether the reason is a new one."""
        self.not_before[subtask] = now + LOOK_AGAIN_S
        new = self._reasons.get(subtask) != reason
        self._reasons[subtask] = reason
        self._since.setdefault(subtask, now)
        return new

    def repeats(self, subtask: str, at: float) -> None:
        """Its next attempt may begin then."""
        self.not_before[subtask] = at

    def look_again(self) -> None:
        """What the waiting ones wait for may have come: they may be tried at once."""
        for subtask in self._reasons:
            self.not_before.pop(subtask, None)
