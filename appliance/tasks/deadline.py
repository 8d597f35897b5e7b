"""Deadlines of tasks: how much time is left, and how a task ends that is not done in time.

A deadline counts from acceptance. The record carries the seconds that had passed at its last transition, each measured
by the coordinator of that time on its own monotonic clock, so no clocks are compared. What passes between the last
transition and a takeover is known to those who heard that record: they count on from when they heard it.
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
            return  # whoever keeps the record counts it
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
