"""Which partial results of runs go into the record: the last of each subtask, cut to size, at most one a second.

A handler may tell partial results as often as it likes and each is an event for whoever listens; the record is for
whoever comes later and must stay small. The clock is passed in.
"""

from typing import Any

from appliance.model import RunEvent
from appliance.tasks.bounds import result_problem

EVERY_S = 1.0
MAX_PARTIAL_BYTES = 8 * 1024
"""Of one subtask, as JSON; 64 of them are half a megabyte of a record."""


class Partials:
    """The partial results of one task that are not in its record yet."""

    def __init__(self) -> None:
        self._waiting: dict[str, RunEvent] = {}
        self._not_before: dict[str, float] = {}

    def add(self, event: RunEvent) -> None:
        """Note a partial result; it replaces the one before."""
        self._waiting[event.subtask] = event

    def drop(self, subtask: str) -> None:
        """Forget a subtask whose attempt has ended."""
        self._waiting.pop(subtask, None)
        self._not_before.pop(subtask, None)

    def due(self, now: float) -> list[RunEvent]:
        """Return those that may go into the record now, each with its result cut to size."""
        found = [
            event for subtask, event in self._waiting.items() if self._not_before.get(subtask, 0.0) <= now
        ]  # fmt: skip
        for event in found:
            del self._waiting[event.subtask]
            self._not_before[event.subtask] = now + EVERY_S
        return found

    def next_at(self) -> float | None:
        """When the next one may go into the record; None when there is none."""
        return min((self._not_before.get(subtask, 0.0) for subtask in self._waiting), default=None)


def shown(result: dict[str, Any] | None) -> dict[str, Any]:
    """Return a partial result as the record keeps it: itself, or why it is not there."""
    problem = result_problem(result, max_bytes=MAX_PARTIAL_BYTES)
    return {"left_out": problem.message} if problem is not None else dict(result or {})
