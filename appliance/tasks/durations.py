"""How long subtasks take: per skill the median of the last runs that this gateway coordinated.

The manifest's time limit says how long a run may take, which is far more than it does: too long to plan with. What
was measured is kept in the gateway's store and survives a restart.
"""

import asyncio
from collections import deque
from collections.abc import Mapping
from statistics import median
from typing import Any, Protocol

import msgspec
import structlog

from appliance.errors import SwiftbotError
from appliance.model import encode

log = structlog.get_logger(__name__)

DEFAULT_S = 3.0
"""Expected of a skill that has not been seen here."""
WINDOW = 15
"""Runs remembered of each skill: an odd number, few enough to follow a change within a shift."""
MOST_SKILLS = 512
PREFIX = "duration/"
WRITE_S = 5.0
"""What was measured is written together, at most so often."""


class Store(Protocol):
    """Where it is kept: the gateway's store."""

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Write a value."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Read all values whose keys begin so."""
        ...


class Durations:
    """Expected durations of skills, seconds."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._seen: dict[str, deque[float]] = {}
        self._changed: set[str] = set()
        self._writer: asyncio.Task[None] | None = None

    async def load(self) -> None:
        """Read what was measured before; what cannot be read is measured again."""
        for key, value in await self._store.scan(PREFIX):
            try:
                seen = msgspec.json.decode(value, type=list[float])
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                log.warning("measured durations cannot be read", key=key, reason=str(error))
                continue
            self._seen[key.removeprefix(PREFIX)] = deque(seen, maxlen=WINDOW)

    def of(self, skill: str, params: Mapping[str, Any]) -> float:
        """Return how long a subtask of a skill is expected to take; never less than the duration asked for."""
        seen = self._seen.get(skill)
        expected = median(seen) if seen else DEFAULT_S
        asked = params.get("duration_s", 0.0)
        return max(expected, asked) if isinstance(asked, int | float) and 0 < asked < 86_400 else expected

    def seen(self, skill: str) -> tuple[float, ...]:
        """Return how long the last runs of a skill took, oldest first."""
        return tuple(self._seen.get(skill, ()))

    def add(self, skill: str, took_s: float) -> None:
        """Note a run that succeeded."""
        if not 0 <= took_s < 86_400 or (skill not in self._seen and len(self._seen) >= MOST_SKILLS):
            return
        self._seen.setdefault(skill, deque(maxlen=WINDOW)).append(round(took_s, 3))
        self._changed.add(skill)
        if self._writer is None or self._writer.done():
            self._writer = asyncio.create_task(self._write_soon(), name="durations")

    async def _write_soon(self) -> None:
        await asyncio.sleep(WRITE_S)
        await self.write()

    async def write(self) -> None:
        """Write what has changed."""
        changed, self._changed = self._changed, set()
        for skill in changed:
            try:
                await self._store.put(PREFIX + skill, encode(list(self._seen[skill])), durable=False)
            except SwiftbotError as error:
                log.info("measured durations are not kept", skill=skill, reason=str(error))

    async def close(self) -> None:
        """Write what has not been written yet."""
        if self._writer is not None:
            self._writer.cancel()
        await self.write()
