"""The last event of each run that a gateway has had, over a restart too: a coordinator that comes later can ask.

Each is kept in SQLite until the task's record has moved on, and of the many that nobody asks after the oldest go.
"""

from collections.abc import Collection, Coroutine
from typing import Any, Protocol

import msgspec
import structlog
from msgspec.structs import replace

from appliance.errors import SwiftbotError
from appliance.model import Failure, RunEvent, RunEventKind, encode

log = structlog.get_logger(__name__)

KEPT_RUNS = 2000
"""Last events kept of ended runs; a coordinator asks within seconds."""
_PREFIX = "run/"


class KeyValues(Protocol):
    """What is needed of the gateway's store."""

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Keep a value."""
        ...

    async def delete(self, key: str) -> object:
        """Forget a key."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return what is kept under keys of that prefix."""
        ...


class KeptRuns:
    """Events by run id, and the newest attempt of each subtask."""

    def __init__(self, store: KeyValues, gateway: str) -> None:
        self.last: dict[str, RunEvent] = {}
        """Run id -> its last event that counts for a coordinator."""
        self._store = store
        self._gateway = gateway
        self._newest: dict[tuple[str, str], int] = {}

    async def load(self) -> dict[str, str]:
        """Load what was kept; a run that was in progress when the gateway went down has failed.

        Returns:
            Run id -> gateway, of the runs that were passed on.
        """
        moved: dict[str, str] = {}
        for key, value in await self._store.scan(_PREFIX):
            run_id = key.removeprefix(_PREFIX)
            try:
                event = msgspec.json.decode(value, type=RunEvent)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                log.warning("a kept run event cannot be read and is dropped", run=run_id, reason=str(error))
                await self._store.delete(key)
                continue
            if event.gateway not in ("", self._gateway):
                moved[run_id] = event.gateway
            elif event.kind not in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
                message = f"{self._gateway} was restarted while it ran"
                failure = Failure(code="unreachable", message=message, retryable=True)
                event = replace(event, kind=RunEventKind.FAILED, failure=failure)
                await self._store.put(key, encode(event))
            self._note(run_id, event)
        return moved

    async def keep(self, run_id: str, event: RunEvent) -> None:
        """Keep an event over a restart; a store that cannot must not keep the outcome from being told."""
        try:
            await self._store.put(f"{_PREFIX}{run_id}", encode(event), durable=False)
        except SwiftbotError as error:
            log.warning("run event could not be kept", run=run_id, reason=str(error))

    def newest(self, task: str, subtask: str) -> int:
        """The newest attempt of a subtask that this gateway knows of; 0: none."""
        return self._newest.get((task, subtask), 0)

    def remember(self, run_id: str, event: RunEvent, *, busy: Collection[str]) -> list[str]:
        """Note an event; returns the runs that are too many now, oldest first, none of those in progress."""
        self._note(run_id, event)
        over = len(self.last) - KEPT_RUNS
        return [] if over <= 0 else [each for each in self.last if each not in busy][:over]

    def _note(self, run_id: str, event: RunEvent) -> None:
        self.last[run_id] = event
        subtask = event.task, event.subtask
        self._newest[subtask] = max(event.attempt, self._newest.get(subtask, 0))

    def forget(self, run_id: str) -> Coroutine[Any, Any, object]:
        """Forget a run, and which attempt of its subtask it was; what is returned takes it off the disk."""
        gone = self.last.pop(run_id, None)
        if gone is not None:
            self._newest.pop((gone.task, gone.subtask), None)
        return self._store.delete(f"{_PREFIX}{run_id}")
