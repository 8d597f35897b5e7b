"""What a pool has learned, kept in the gateway's store: a restart must not make it a beginner again.

Cold costs by image, the demand with its histograms, and the learned eviction policy. Written now and then, not with
every run: losing a minute of it costs nothing. What cannot be read, or is of another version, is learned anew.
"""

import asyncio
from collections.abc import Callable
from typing import Protocol

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import SwiftbotError
from appliance.model import encode
from appliance.pool.policies import PlannerState

log = structlog.get_logger(__name__)

KEY = "pool/experience"
WRITE_S = 60.0


class Experience(Struct, frozen=True, kw_only=True):
    """All that is kept."""

    cold_ms: dict[str, tuple[float, ...]] = {}
    planner: PlannerState = PlannerState()


class Store(Protocol):
    """Where it is kept: the gateway's store."""

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Write a value."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Read all values whose keys begin so."""
        ...


class Keepsake:
    """Reads experience at the start and writes it from then on.

    Args:
        store: the gateway's; None: nothing is kept.
        recall: given what was kept.
        tell: returns what is to be kept.
    """

    def __init__(
        self, store: Store | None, *, recall: Callable[[Experience], None], tell: Callable[[], Experience]
    ) -> None:
        self._store = store
        self._recall = recall
        self._tell = tell
        self._written = b""
        self._writing: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Read what was kept, and begin to write."""
        if self._store is None:
            return
        for key, value in await self._store.scan(KEY):
            if key != KEY:
                continue
            try:
                self._recall(msgspec.json.decode(value, type=Experience))
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ValueError) as error:
                log.warning("what the pool had learned cannot be read; it learns anew", reason=str(error))
        self._writing = asyncio.create_task(self._write_forever(), name="keep what the pool learns")

    async def stop(self) -> None:
        """Write a last time."""
        if self._writing is not None:
            self._writing.cancel()
            await asyncio.gather(self._writing, return_exceptions=True)
            self._writing = None
            await self._write()

    async def _write_forever(self) -> None:
        while True:
            await asyncio.sleep(WRITE_S)
            await self._write()

    async def _write(self) -> None:
        if self._store is None:
            return
        value = encode(self._tell())
        if value == self._written:
            return
        try:
            await self._store.put(KEY, value, durable=False)
            self._written = value
        except SwiftbotError as error:
            log.warning("what the pool has learned could not be kept", reason=str(error))
