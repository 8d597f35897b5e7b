"""Checkpoints of runs: what a handler saves on its way, so that the next attempt goes on from there, anywhere.

They lie beside the task's record in the DHT, `checkpoint/{task}/{subtask}`, written by the gateway that executes the
run: so they outlive it, and the coordinator too. Only the last one counts. A handler may save as often as it likes:
what comes within a second of the last write waits for the next, and the newest wins. The coordinator hands the last
one to the next attempt and removes it when the task has ended; `retention` removes what is left over.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import ConflictError, SwiftbotError
from appliance.model import RunEvent, RunEventKind, VersionVector, encode, keyspace
from appliance.plane.dht import Dht
from appliance.pool.selection import size_text
from appliance.tasks.records import result_problem

log = structlog.get_logger(__name__)

EVERY_S = 1.0
"""Least time between two writes of one run; each is a replicated write."""
LAST_S = 2.0
"""How long the end of a run waits for its last checkpoint to be written."""


class Checkpoint(Struct, frozen=True, kw_only=True):
    """What is kept of a subtask under way. `attempt` fences: an outdated run does not replace a newer one's."""

    attempt: int
    gateway: str
    at_ns: int
    data: dict[str, Any]
    calls: int = 0
    """Calls of the handler until then: the next one's number, and so the id of its effect, follows from it."""


def checkpoint_key(task: str, subtask: str) -> str:
    """Key of a subtask's checkpoint in the DHT."""
    return keyspace.CHECKPOINT_RECORD.key(task, subtask)


def stronger(one: bytes, other: bytes) -> bytes:
    """Return which of two concurrent checkpoints stands: the later attempt's, then the later one, then by its bytes."""

    def rank(value: bytes) -> tuple[int, int, bytes]:
        found = _decoded(value)
        return (found.attempt, found.at_ns, value) if found is not None else (-1, 0, value)

    return max(one, other, key=rank)


def _decoded(value: bytes) -> Checkpoint | None:
    try:
        return msgspec.json.decode(value, type=Checkpoint)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


async def read_checkpoint(dht: Dht, task: str, subtask: str) -> Checkpoint | None:
    """Return a subtask's last checkpoint; None when there is none, or it cannot be had now."""
    try:
        record = await dht.read(checkpoint_key(task, subtask))
    except SwiftbotError as error:
        # The attempt begins from the start: that costs time and doubles nothing.
        log.warning("a checkpoint cannot be had", task=task, subtask=subtask, reason=str(error))
        return None
    return _decoded(record.value) if record is not None else None


async def remove_checkpoint(dht: Dht, task: str, subtask: str) -> None:
    """Remove a subtask's checkpoint; what cannot be removed now is left to `retention`."""
    key = checkpoint_key(task, subtask)
    try:
        if (record := await dht.read(key)) is not None:
            await dht.remove(key, expected=record.version)
    except SwiftbotError as error:
        log.info("a checkpoint is left for later", key=key, reason=str(error))


class _Run:
    """The checkpoints of one run."""

    def __init__(self) -> None:
        self.newest: RunEvent | None = None
        self.version: VersionVector | None = None
        self.writer: asyncio.Task[None] | None = None
        self.wake = asyncio.Event()
        """What waits is to be written at once."""
        self.ended = False
        self.outdated = False
        self.taken = 0
        """Checkpoints that came."""
        self.kept = 0
        """How many of them had come when the last write was done."""
        self.written = asyncio.Event()


class Checkpoints:
    """Keeps the checkpoints of the runs of one gateway.

    Args:
        dht: where they are kept.
        gateway: this gateway.
        max_bytes: largest checkpoint, as JSON.
        tell: gets an event for each that is kept, without its data, and a log line for each that is not.
        refuse: counts those that are refused.
    """

    def __init__(
        self,
        dht: Dht,
        *,
        gateway: str,
        max_bytes: int,
        tell: Callable[[RunEvent], None],
        refuse: Callable[[str, str], None],
    ) -> None:
        self._dht = dht
        self._gateway = gateway
        self._max_bytes = max_bytes
        self._tell = tell
        self._refuse = refuse
        self._runs: dict[tuple[str, str, int], _Run] = {}

    def add(self, event: RunEvent) -> None:
        """Take a run's checkpoint; it is written at once, or when the last write is long enough ago."""
        problem = result_problem(event.result, max_bytes=self._max_bytes)
        if problem is not None:
            reason = problem.message.replace("the result", "the checkpoint", 1)
            self._refuse("checkpoint", reason)
            told = f"checkpoint refused: {reason}; the last one before it stands"
            self._tell(replace(event, kind=RunEventKind.LOG, result=None, note=told))
            return
        key = _key(event)
        run = self._runs.setdefault(key, _Run())
        run.newest = event
        run.taken += 1
        if run.writer is None:
            run.writer = asyncio.create_task(
                self._keep_writing(key, run), name=f"checkpoints of {'/'.join(map(str, key))}"
            )

    def any_of(self, run_id: tuple[str, str, int]) -> bool:
        """Whether a checkpoint of a run has come."""
        run = self._runs.get(run_id)
        return run is not None and run.taken > 0

    async def fresh(
        self, run_id: tuple[str, str, int], ask: Callable[[], Awaitable[bool]], *, wait_s: float, may_save: bool
    ) -> bool:
        """Have the newest checkpoint of a run written now; returns whether one came for the asking.

        Args:
            run_id: task, subtask, attempt.
            ask: tells the run's handler that a checkpoint is wanted; False when it cannot hear.
            wait_s: how long to wait for it, and for what came to be written.
            may_save: whether its skill says that it saves when it is asked to.
        """
        run = self._runs.setdefault(run_id, _Run())
        before, wanted = run.taken, run.taken
        if (may_save or run.taken) and await ask():
            wanted += 1
        try:
            async with asyncio.timeout(wait_s):
                while not run.outdated and (run.taken < wanted or run.kept < run.taken):
                    run.wake.set()
                    run.written.clear()
                    await run.written.wait()
        except TimeoutError:
            log.info("a run goes from its last checkpoint", run="/".join(map(str, run_id)), waited_s=wait_s)
        return run.taken > before and run.kept == run.taken

    async def end(self, event: RunEvent) -> None:
        """A run has ended: what waits is written if another attempt may go on from it, else dropped."""
        run = self._runs.pop(_key(event), None)
        if run is None or run.writer is None:
            return
        run.ended = True
        run.wake.set()
        if event.kind is RunEventKind.SUCCEEDED:
            run.newest = None
            return
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_S):
                await run.writer

    async def _keep_writing(self, key: tuple[str, str, int], run: _Run) -> None:
        """Write the newest one, again and again, until the run has ended or nothing came for a while."""
        while (event := run.newest) is not None and not run.outdated:
            run.newest, taken = None, run.taken
            try:
                await self._write(event, run)
                run.kept = taken
            except SwiftbotError as error:
                log.warning("a checkpoint could not be kept", task=event.task, subtask=event.subtask, reason=str(error))
            run.written.set()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.0 if run.ended else EVERY_S):
                    await run.wake.wait()
            run.wake.clear()
        run.writer = None
        run.written.set()
        if run.ended or run.outdated:
            self._runs.pop(key, None)

    async def _write(self, event: RunEvent, run: _Run) -> None:
        kept = Checkpoint(
            attempt=event.attempt, gateway=self._gateway, at_ns=time.time_ns(), data=event.result or {},
            calls=event.calls,
        )  # fmt: skip
        key, value = checkpoint_key(event.task, event.subtask), encode(kept)
        while True:
            try:
                # Survives the death of processes; a power cut of the whole site costs the handler the way since.
                run.version = await self._dht.write(key, value, expected=run.version, durable=False)
                break
            except ConflictError:
                record = await self._dht.read(key)
                found = _decoded(record.value) if record is not None else None
                if found is not None and found.attempt > event.attempt:
                    run.outdated = True
                    return
                run.version = record.version if record is not None else None
        self._tell(replace(event, result=None, note=f"checkpoint of {size_text(len(value))} kept"))


def _key(event: RunEvent) -> tuple[str, str, int]:
    return (event.task, event.subtask, event.attempt)
