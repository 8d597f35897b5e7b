"""Forgets what nobody will ask for again: old finished tasks, and what is left over of tasks.

Of an old finished task the id and the outcome stay for days (`remembering`), so that it is not done a second time when
the id is handed in again; then they go too. What is left over are the effects of tasks that were trimmed or forgotten,
and the checkpoints of tasks that have ended.

Each gateway looks only at the records it owns, so nothing is removed twice and nobody is in charge. A removed task
is still in the logs.
"""

import asyncio
import contextlib
import time

import msgspec
import structlog

from appliance.errors import ConflictError, PayloadError, SwiftbotError, UnreachableError
from appliance.model import TaskRecord, encode
from appliance.plane.dht import Record
from appliance.plane.node import Plane
from appliance.record.models import RecorderStatus
from appliance.tasks import checkpoints
from appliance.tasks.bounds import read_record
from appliance.tasks.recorded import LogFiles, Span
from appliance.tasks.remembering import Kept, due, may_trim, trimmed
from appliance.tasks.settings import TasksConfig
from appliance.tasks.steering import enquiries
from appliance.tasks.surroundings import PREFIX, task_key

log = structlog.get_logger(__name__)

AT_ONCE = 200
"""Removals in one round: a backlog must not crowd out the tasks that run."""


_FILES = "recorder/files"
"""Key of the log files heard of, in the gateway's own store."""


class Retention:
    """Forgets in the background; `run` never ends by itself."""

    def __init__(self, plane: Plane, config: TasksConfig) -> None:
        self._plane = plane
        self._config = config
        self._after: dict[str, str] = {}
        """Prefix -> the key up to which was looked, where there was more than a round may look up."""
        self.files = LogFiles()
        """What recorders of the fleet have written when."""
        self.forgotten = 0
        """Ids of tasks forgotten before their time, since there were more than may be remembered; since start."""

    async def run(self) -> None:
        """Look through the shard now and then."""
        session = self._plane.session
        try:
            spans = msgspec.json.decode(await self._plane.store.get(_FILES) or b"[]", type=list[Span])
        except msgspec.DecodeError as error:
            log.warning("which log files were written when is not known any more", reason=str(error))
        else:
            self.files = LogFiles([*spans, *self.files.spans])
        session.subscribe_typed(self._plane.keys.recorder_status(), RecorderStatus, self._on_recorder)
        while True:
            await asyncio.sleep(self._config.retention_s)
            try:
                await self._plane.store.put(_FILES, encode(self.files.spans), durable=False)
                removed = await self.round()
            except (SwiftbotError, OSError) as error:
                log.warning("forgetting is tried again later", reason=str(error))
                continue
            if removed:
                log.info("old records forgotten", count=removed)

    def _on_recorder(self, _: str, status: RecorderStatus | None) -> None:
        if status is not None:
            self.files.heard(status.id, status.file, time.time_ns())

    async def round(self) -> int:
        """Trim and remove what is due; returns how many records."""
        done = await self._old_tasks(time.time_ns())
        orphaned = [
            *await self._orphaned("effect/", ended=False),
            *await self._orphaned(enquiries.PREFIX, ended=False),
            *await self._orphaned(checkpoints.PREFIX, ended=True),
        ][: AT_ONCE - done]
        for record in orphaned:
            with contextlib.suppress(ConflictError):
                await self._plane.dht.remove(record.key, expected=record.version)
        return done + len(orphaned)

    async def _owned(self, prefix: str) -> dict[str, Record]:
        return {each.key: each for each in await self._plane.dht.local(prefix) if self._plane.dht.owns(each.key)}

    async def _old_tasks(self, now_ns: int) -> int:
        """Trim the oldest finished tasks, and forget those that were trimmed long ago; returns how many."""
        owned = await self._owned(PREFIX)
        finished: dict[str, TaskRecord] = {}
        for number, (key, stored) in enumerate(owned.items()):
            if number % AT_ONCE == 0:
                await asyncio.sleep(0)  # thousands take tens of milliseconds, in which runs have news
            with contextlib.suppress(PayloadError):
                record = read_record(stored.value)
                if may_trim(record):
                    finished[key] = record
        kept = [Kept(key, each.updated_ns, each.remembered is not None) for key, each in finished.items()]
        config = self._config
        found = due(
            kept, now_ns=now_ns, keep=config.keep_finished, days=config.remember_days, most=config.remember_most
        )
        trim, forget = found.trim[:AT_ONCE], found.forget[: AT_ONCE - len(found.trim[:AT_ONCE])]
        for key in trim:
            record = finished[key]
            small = encode(trimmed(record, self.files.at(record.updated_ns)))
            with contextlib.suppress(ConflictError):
                await self._plane.dht.write(key, small, expected=owned[key].version)
        early = 0
        for key in forget:
            with contextlib.suppress(ConflictError):
                await self._plane.dht.remove(key, expected=owned[key].version)
                early += key in found.early
        if early:
            self.forgotten += early
            log.warning(
                "ids of finished tasks are forgotten before their time: handed in again they would be done again",
                count=early,
                since_start=self.forgotten,
                remedy="raise tasks.remember_most, or lower tasks.remember_days",
            )
        return len(trim) + len(forget)

    async def _orphaned(self, prefix: str, *, ended: bool) -> list[Record]:
        """Records whose task (the second part of their key) is gone or trimmed, or `ended`.

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
            stored = await self._plane.dht.read(task_key(task))
        except UnreachableError:
            return True  # whoever has its record may only be away
        if stored is None:
            return False
        try:
            record = read_record(stored.value)
        except PayloadError:
            return True
        return record.remembered is None and not (ended and record.state.final)
