"""Retention: forgets what nobody will ask for again, old finished tasks and what is left over of tasks.

A finished record is kept whole while it is among the newest (`tasks.keep_finished`); then it is replaced in place by a
small one without plan, subtasks and results (a tombstone), under the same key and version history, so that at no moment
the id is free: it is never done again; submitted again, it is answered with the outcome. Tombstones go after
`tasks.remember_days`, or sooner, the oldest first, where there are more than `tasks.remember_most`. What is left over
are the effects of tasks that were trimmed or forgotten, and the checkpoints of tasks that have ended.

Each gateway looks only at the records it owns, so nothing is removed twice and nobody is in charge. A removed task
is still in the logs; `LogFiles` knows from what recorders have told which files were being written when.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable, Collection, Iterable
from typing import NamedTuple

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import ConflictError, PayloadError, SwiftbotError, UnreachableError
from appliance.model import TaskRecord, encode, keyspace
from appliance.model.keys import RecordKind
from appliance.model.recorder_api import RecorderStatus
from appliance.plane.dht import LeaveOut, Record
from appliance.plane.node import Plane
from appliance.tasks.artifacts import Artifacts
from appliance.tasks.records import PREFIX, may_trim, read_record, task_key, trimmed
from appliance.tasks.settings import TasksConfig

TRIMMED = LeaveOut(has=b'"remembered":{', lacks=b'"plan":')
"""What tells a tombstone as it is stored from a whole record, without decoding it.

Within a JSON text quotes are escaped, so that the mark can only be a field's name: this one, or a parameter's, which
only a record with a plan has.
"""
_DAY_NS = 86_400 * 10**9


class Kept(NamedTuple):
    """A finished task's record, of one gateway's shard."""

    key: str
    ended_ns: int
    """Unix nanoseconds, on its coordinator's clock."""
    trimmed: bool
    """Whether it is a tombstone already."""


class Due(NamedTuple):
    """What is to be done, by key."""

    trim: tuple[str, ...]
    forget: tuple[str, ...]
    early: frozenset[str]
    """Those of `forget` whose time is not over: there are more than may be remembered."""


def due(kept: Collection[Kept], *, now_ns: int, keep: int, days: float, most: int) -> Due:
    """Return which finished tasks are to be trimmed, and which to be forgotten for good.

    Args:
        kept: all finished records of the shard.
        now_ns: Unix nanoseconds.
        keep: how many stay whole, the newest.
        days: how long after its end an id is remembered; 0: not at all.
        most: how many tombstones there may be; the oldest beyond it are forgotten.
    """
    whole = sorted((each for each in kept if not each.trimmed), key=_newest)
    surplus = whole[max(0, keep) :]
    small = sorted((*surplus, *(each for each in kept if each.trimmed)), key=_newest)
    since_ns = now_ns - int(days * _DAY_NS)
    fresh = [each for each in small if days > 0 and each.ended_ns >= since_ns]
    stay = {each.key for each in fresh[: max(0, most)]}
    early = frozenset(each.key for each in fresh[max(0, most) :])
    return Due(
        trim=tuple(each.key for each in surplus if each.key in stay),
        forget=tuple(each.key for each in small if each.key not in stay),
        early=early,
    )


def _newest(each: Kept) -> tuple[int, str]:
    return (-each.ended_ns, each.key)


MOST_FILES = 500
"""Files remembered; with a new one each half hour, ten days of one recorder."""
MOST_NAMED = 3
SLACK_NS = 5 * 10**9
"""A recorder tells of itself once a second, and clocks of gateways differ a little."""


class Span(Struct, kw_only=True):
    """A file and the time in which its recorder said that it writes to it; Unix nanoseconds."""

    recorder: str
    file: str
    since_ns: int
    until_ns: int


class LogFiles:
    """The files of a fleet's recorders, as far as they were heard of."""

    def __init__(self, spans: Iterable[Span] = ()) -> None:
        self.spans = list(spans)[-MOST_FILES:]
        """In the order in which they were begun."""

    def heard(self, recorder: str, file: str, now_ns: int) -> None:
        """Take in what a recorder tells; `file`: the one it writes to, empty when it writes to none."""
        if not file:
            return
        for span in reversed(self.spans):
            if span.recorder == recorder:
                if span.file == file:
                    span.until_ns = max(span.until_ns, now_ns)
                    return
                break
        self.spans.append(Span(recorder=recorder, file=file, since_ns=now_ns, until_ns=now_ns))
        del self.spans[:-MOST_FILES]

    def at(self, when_ns: int) -> str:
        """Return the names of the files written to at a time, by recorder, at most 3; empty where none is known."""
        found: dict[str, str] = {}
        for span in self.spans:
            if span.since_ns - SLACK_NS <= when_ns <= span.until_ns + SLACK_NS:
                found[span.recorder] = span.file
        return ", ".join(found[recorder] for recorder in sorted(found)[:MOST_NAMED])


log = structlog.get_logger(__name__)

ABSENT_S = 86_400.0
"""How long a task has no record before its files go."""
_CUT_SHORT_S = 3600.0
"""How old a file is that a crash has left half written: none takes so long to write."""
AT_ONCE = 200
"""Removals in one round: a backlog must not crowd out the tasks that run."""


_FILES = "recorder/files"
"""Key of the log files heard of, in the gateway's own store."""


class Retention:
    """Forgets in the background; `run` never ends by itself.

    Args:
        plane: the fleet.
        config: how much is kept.
        artifacts: files of handlers here, which go with their task's record; None: there are none.
        needed: whether what belongs to a run that is of no task is needed still.
    """

    def __init__(
        self,
        plane: Plane,
        config: TasksConfig,
        artifacts: Artifacts | None = None,
        *,
        needed: Callable[[str], Awaitable[bool]] | None = None,
    ) -> None:
        self._needed_elsewhere = needed
        self._plane = plane
        self._config = config
        self._artifacts = artifacts
        self._absent: dict[str, float] = {}
        """Task with files here -> since when it has no record, on this machine's monotonic clock."""
        self._owners_after = ""
        """The owner of files up to which was looked."""
        self._after: dict[RecordKind, str] = {}
        """Kind -> the key up to which was looked, where there was more than a round may look up."""
        self.files = LogFiles()
        """What recorders of the fleet have written when."""
        self.forgotten = 0
        """Ids of tasks forgotten before their time, since there were more than may be remembered; since start."""

    async def run(self) -> None:
        """Look through the shard now and then."""
        session = self._plane.session
        try:
            spans = msgspec.json.decode(await self._plane.store.get(_FILES) or b"[]", type=list[Span])
        except (msgspec.DecodeError, SwiftbotError) as error:
            log.warning("which log files were written when is not known any more", reason=str(error))
        else:
            self.files = LogFiles([*spans, *self.files.spans])
        session.subscribe_typed(keyspace.RECORDER_STATUS, self._on_recorder)
        while True:
            await asyncio.sleep(self._config.retention_s)
            try:
                await self._plane.store.put(_FILES, encode(self.files.spans), durable=False)
                removed = await self.round()
            except (SwiftbotError, OSError) as error:
                log.warning("forgetting is tried again later", reason=str(error))
                continue
            except Exception:  # supervision boundary: a record that breaks it would end the gateway of each next owner
                log.exception("forgetting broke off, and is tried again later")
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
            *await self._orphaned(keyspace.EFFECT_RECORD, ended=False),
            *await self._orphaned(keyspace.ENQUIRY_RECORD, ended=False),
            *await self._orphaned(keyspace.CHECKPOINT_RECORD, ended=True),
        ][: AT_ONCE - done]
        for record in orphaned:
            with contextlib.suppress(ConflictError):
                await self._plane.dht.remove(record.key, expected=record.version)
        await self._old_files()
        return done + len(orphaned)

    async def _old_files(self) -> None:
        """Remove files whose task is gone or trimmed: those of some owners a round, all in turn."""
        if self._artifacts is None:
            return
        owners = await self._artifacts.owners()
        waiting = [owner for owner in owners if owner > self._owners_after]
        self._owners_after = "" if len(waiting) <= AT_ONCE else waiting[AT_ONCE - 1]
        removed = 0
        for owner in waiting[:AT_ONCE]:
            if owner.startswith(PREFIX) and await self._done_with(owner.removeprefix(PREFIX)):
                removed += await self._artifacts.forget(owner)
        removed += await self._artifacts.forget_temporary(_CUT_SHORT_S)
        self._absent = {task: since for task, since in self._absent.items() if task_key(task) in owners}
        if removed:
            log.info("files of old tasks removed", count=removed)

    async def _done_with(self, task: str) -> bool:
        """Whether a task's files may go: it is trimmed, or its record has been absent for a day.

        A gateway by itself, or on the small side of a partition, finds no record of tasks that the others run.
        """
        if await self._needed(task, ended=False):
            self._absent.pop(task, None)
            return False
        if await self._plane.dht.read(task_key(task)) is not None:
            return True
        now = time.monotonic()
        return now - self._absent.setdefault(task, now) >= ABSENT_S

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

    async def _orphaned(self, kind: RecordKind, *, ended: bool) -> list[Record]:
        """Records of a kind whose task (the first name in their key) is gone or trimmed, or `ended`.

        A task that runs is never gone, so what belongs to it stays. What a round does not come to is the next one's.
        """
        owned = await self._owned(kind.prefix)
        orphaned: list[Record] = []
        needed: dict[str, bool] = {}
        after, last = self._after.pop(kind, ""), ""
        for key in sorted(key for key in owned if key > after):
            # Not by the kind's whole template: keys of a newer version may have more names behind it.
            task = key.removeprefix(kind.prefix).partition("/")[0]
            if task not in needed:
                if len(needed) >= AT_ONCE:
                    self._after[kind] = last
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
            return True  # the gateway that has its record may only be away
        if stored is None:
            return self._needed_elsewhere is not None and await self._needed_elsewhere(task)
        try:
            record = read_record(stored.value)
        except PayloadError:
            return True
        return record.remembered is None and not (ended and record.state.final)
