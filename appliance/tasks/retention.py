"""Forgets what nobody will ask for again: old finished tasks, and what is left over of tasks.

That is the effects of tasks that are forgotten, and the checkpoints of tasks that have ended.

Each gateway looks only at the records it owns, so nothing is removed twice and nobody is in charge. A removed task
is still in the logs.
"""

import asyncio
import contextlib

import structlog

from appliance.errors import ConflictError, PayloadError, SwiftbotError, UnreachableError
from appliance.plane.dht import Record
from appliance.plane.node import Plane
from appliance.tasks import checkpoints
from appliance.tasks.bounds import read_record
from appliance.tasks.settings import TasksConfig
from appliance.tasks.steering import enquiries

log = structlog.get_logger(__name__)

AT_ONCE = 200
"""Removals in one round: a backlog must not crowd out the tasks that run."""


def surplus(finished: list[tuple[int, str]], keep: int) -> list[str]:
    """Keys of the oldest beyond `keep`; `finished` is (end, Unix nanoseconds; key)."""
    newest_first = sorted(finished, reverse=True)
    return [key for _, key in newest_first[max(0, keep) :]]


class Retention:
    """Forgets in the background; `run` never ends by itself."""

    def __init__(self, plane: Plane, config: TasksConfig) -> None:
        self._plane = plane
        self._config = config
        self._after: dict[str, str] = {}
        """Prefix -> the key up to which was looked, where there was more than a round may look up."""

    async def run(self) -> None:
        """Look through the shard now and then."""
        while True:
            await asyncio.sleep(self._config.retention_s)
            try:
                removed = await self.round()
            except (SwiftbotError, OSError) as error:
                log.warning("forgetting is tried again later", reason=str(error))
                continue
            if removed:
                log.info("old records forgotten", count=removed)

    async def round(self) -> int:
        """Remove what is due; returns how many records."""
        due = [
            *await self._old_tasks(),
            *await self._orphaned("effect/", ended=False),
            *await self._orphaned(enquiries.PREFIX, ended=False),
            *await self._orphaned(checkpoints.PREFIX, ended=True),
        ]
        for record in due[:AT_ONCE]:
            with contextlib.suppress(ConflictError):
                await self._plane.dht.remove(record.key, expected=record.version)
        return len(due[:AT_ONCE])

    async def _owned(self, prefix: str) -> dict[str, Record]:
        return {each.key: each for each in await self._plane.dht.local(prefix) if self._plane.dht.owns(each.key)}

    async def _old_tasks(self) -> list[Record]:
        owned = await self._owned("task/")
        finished: list[tuple[int, str]] = []
        for key, stored in owned.items():
            with contextlib.suppress(PayloadError):
                record = read_record(stored.value)
                if record.state.final:
                    finished.append((record.updated_ns, key))
        return [owned[key] for key in surplus(finished, self._config.keep_finished)]

    async def _orphaned(self, prefix: str, *, ended: bool) -> list[Record]:
        """Records whose task (the second part of their key) is gone, or `ended`.

        A task that runs is never gone, so what belongs to it stays. What a round does not come to is the next one's.
        """
        owned = await self._owned(prefix)
        orphaned: list[Record] = []
        needed: dict[str, bool] = {}
        after, last = self._after.pop(prefix, ""), ""
        for key in sorted(key for key in owned if key > after):
            task = key.split("/")[1]
            if task not in needed:
                if len(needed) >= AT_ONCE:
                    self._after[prefix] = last
                    break
                needed[task] = await self._needed(task, ended=ended)
            if not needed[task]:
                orphaned.append(owned[key])
            last = key
        return orphaned

    async def _needed(self, task: str, *, ended: bool) -> bool:
        try:
            stored = await self._plane.dht.read(f"task/{task}")
        except UnreachableError:
            return True  # whoever has its record may only be away
        if stored is None or not ended:
            return stored is not None
        try:
            return not read_record(stored.value).state.final
        except PayloadError:
            return True
