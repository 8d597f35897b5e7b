"""What a gateway still knows of what was said of tasks: the last lines of each, its own only, within one bound.

Whoever watches a task later asks every gateway for them (verb `task_lines`); nothing is written to disk, since the logs
have all of it.
"""

import threading
import time
from collections import OrderedDict, deque

from appliance.model import LogLine, RunEvent
from appliance.tasks.api import TaskLines, TaskLinesAsk
from appliance.tasks.transition import Transition
from appliance.tasks.watch import lines
from appliance.tasks.watch.lines import Line

PER_TASK = 1000
"""Lines kept of one task."""
ALTOGETHER = 10_000
"""Of all tasks: about 6 MB. The task that was last heard of longest ago is forgotten first."""


class Kept:
    """The last lines that one gateway has said, by task."""

    def __init__(self, gateway: str, *, per_task: int = PER_TASK, altogether: int = ALTOGETHER) -> None:
        self._gateway = gateway
        self._per_task = per_task
        self._altogether = altogether
        self._lines: OrderedDict[str, deque[Line]] = OrderedDict()
        self._dropped: dict[str, int] = {}
        self._count = 0
        self._lock = threading.Lock()
        """Log lines come from worker threads too."""

    def hear_event(self, event: RunEvent) -> None:
        """Keep what a run here has told."""
        self._add(lines.of_event(event))

    def hear_log(self, line: LogLine) -> None:
        """Keep a log line of this gateway, if it is about a task."""
        self._add(lines.of_log(self._gateway, line))

    def hear_transition(self, event: Transition) -> None:
        """Keep a transition that was applied here."""
        self._add(lines.of_transition(event))

    def _add(self, line: Line | None) -> None:
        if line is not None:
            with self._lock:
                self._keep(line)

    def _keep(self, line: Line) -> None:
        kept = self._lines.get(line.task)
        if kept is None:
            kept = self._lines[line.task] = deque()
        self._lines.move_to_end(line.task)
        kept.append(line)
        self._count += 1
        if len(kept) > self._per_task:
            kept.popleft()
            self._count -= 1
            self._dropped[line.task] = self._dropped.get(line.task, 0) + 1
        while self._count > self._altogether and len(self._lines) > 1:
            task, gone = self._lines.popitem(last=False)
            self._count -= len(gone)
            self._dropped.pop(task, None)

    async def answer(self, ask: TaskLinesAsk) -> TaskLines:
        """Return the last lines of a task, oldest first, with this gateway's time of now."""
        with self._lock:
            kept = tuple(self._lines.get(ask.task, ()))
            dropped = self._dropped.get(ask.task, 0)
        skipped = max(0, len(kept) - max(0, ask.limit))
        return TaskLines(
            gateway=self._gateway,
            now_ns=time.time_ns(),
            lines=kept[skipped:],
            dropped=dropped + skipped,
        )
