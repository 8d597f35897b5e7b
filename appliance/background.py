"""Tasks that an object starts and leaves running until it closes: kept, named, their defects logged, ended with it.

asyncio itself keeps tasks weakly, and says nothing of one that broke until it is collected. Root tasks of a daemon,
whose end is its end, are `process.Supervisor`'s.
"""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

import structlog

from appliance.errors import SwiftbotError

T = TypeVar("T")

log = structlog.get_logger(__name__)


class Background:
    """The tasks of one object."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    def start(self, work: Coroutine[Any, Any, T], name: str) -> asyncio.Task[T]:
        """Run something on the event loop's thread; what it raises is logged."""
        task = asyncio.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if task.cancelled() or (error := task.exception()) is None:
            return
        if isinstance(error, SwiftbotError):
            log.warning("a background task failed", task=task.get_name(), reason=str(error))
        else:
            log.error("a background task broke", task=task.get_name(), exc_info=error)

    @property
    def tasks(self) -> tuple[asyncio.Task[Any], ...]:
        """Those in progress."""
        return tuple(self._tasks)

    @property
    def count(self) -> int:
        """How many are in progress."""
        return len(self._tasks)

    def cancel(self) -> None:
        """Have all end, without waiting for it."""
        for task in self.tasks:
            task.cancel()

    async def finish(self, within_s: float) -> None:
        """Wait until all have ended, or for so long."""
        if self._tasks:
            await asyncio.wait(self.tasks, timeout=within_s)

    async def close(self) -> None:
        """Cancel all, and wait until they have ended."""
        self.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)
