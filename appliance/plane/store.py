"""What a gateway must not forget, in one SQLite file (WAL), touched by one thread only.

Everything acknowledged is on the disk: commits are synchronous (`FULL`), and calls that queue up while the disk
is busy share one commit. Measured on a development machine's SSD: a commit of one 4 KB record takes 0.27 ms with
FULL and 0.03 ms without, so only what may be lost with the power (`durable=False`) goes without.
"""

import asyncio
import contextlib
import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import structlog

from appliance.errors import RefusedError
from appliance.plane.ahead import NOTHING, Ahead, Mark
from appliance.plane.file import File, problem_of
from appliance.plane.picture import Picture
from appliance.plane.room import Room
from appliance.plane.rows import put_row, read_digests, read_kept, read_keys, read_records, read_row
from appliance.plane.versions import Record, digest

log = structlog.get_logger(__name__)

T = TypeVar("T")

_MOST_WAITING = 10_000
_MOST_TOGETHER = 128
"""Calls in one commit: enough to amortise it, few enough that the first does not wait long."""


class _Call(NamedTuple):
    run: Callable[[sqlite3.Connection], Any]
    done: Callable[[Any, Exception | None], None]
    """Told on the store's thread, after the commit."""
    writes: bool
    durable: bool
    mark: Mark = NOTHING
    single: bool = False
    """It writes with one statement at most, which needs no transaction around it."""


class Store:
    """Records of the DHT and a plain key-value table for the rooms above; made by `open`."""

    def __init__(self, path: Path, loop: asyncio.AbstractEventLoop) -> None:
        self.path = path
        self._loop = loop
        self._waiting: deque[_Call] = deque()
        self._some = threading.Condition()
        self._closing = False
        self._file = File(path)
        self._synchronous = "FULL"
        self._picture = Picture()
        self._changed: list[Record | str] = []
        """What the open transaction has put (records) and dropped (keys)."""
        self._ahead = Ahead()
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)
        self._opened: asyncio.Future[None] = loop.create_future()

    @classmethod
    async def open(cls, path: Path) -> "Store":
        """Open or make the file; one that is damaged is moved aside, never overwritten.

        Raises:
            ConfigError: the folder cannot be written, or another gateway uses the file.
            PrerequisiteError: the disk is full or fails.
        """
        store = cls(path, asyncio.get_running_loop())
        store._thread.start()
        await store._opened
        return store

    @property
    def set_aside(self) -> Path | None:
        """Where a file that could not be read was moved at start."""
        return self._file.set_aside

    # --- plain keys -------------------------------------------------------------------------------------------

    async def get(self, key: str) -> bytes | None:
        """Return what is kept under a key."""
        rows = await self._read("SELECT value FROM kept WHERE key = ?", key)
        return rows[0][0] if rows else None

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Keep a value; on the disk when this returns, unless not `durable`."""
        await self._execute("INSERT OR REPLACE INTO kept VALUES (?, ?)", key, value, durable=durable)

    async def alter(self, key: str, change: Callable[[bytes | None], bytes | None]) -> None:
        """Read a value and put what `change` makes of it, with nothing in between; None: leave it.

        `change` runs on the store's thread, and again if the commit it was part of fails.
        """

        def run(db: sqlite3.Connection) -> None:
            row = db.execute("SELECT value FROM kept WHERE key = ?", (key,)).fetchone()
            changed = change(row[0] if row else None)
            if changed is not None:
                db.execute("INSERT OR REPLACE INTO kept VALUES (?, ?)", (key, changed))

        await self._call(run, writes=True)

    async def delete(self, key: str, *, only: bytes | None = None) -> bool:
        """Forget a key, if it is there and (`only`) has just that value; returns whether it was forgotten."""
        where, values = ("", (key,)) if only is None else (" AND value = ?", (key, only))
        sql = f"DELETE FROM kept WHERE key = ?{where}"  # noqa: S608 - one of two texts of ours
        return await self._call(lambda db: db.execute(sql, values).rowcount > 0, writes=True)

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return (key, value) of every key with that prefix, in order."""
        return await self._call(partial(read_kept, prefix=prefix))

    # --- records ----------------------------------------------------------------------------------------------

    def look(self, key: str) -> tuple[bool, Record | None]:
        """Whether a record is known without asking the disk, and it; from any thread."""
        return self._picture.look(key)

    async def record(self, key: str) -> Record | None:
        """Return a record, a tombstone too."""
        known, record = self._picture.look(key)
        return record if known else await self._call(partial(self._read_record, key))

    def _read_record(self, key: str, db: sqlite3.Connection) -> Record | None:
        record = read_row(db, key)
        # Within a transaction it may be one that is not committed.
        if record is not None and not db.in_transaction:
            self._picture.read(record)
        return record

    async def records(self, prefix: str) -> list[Record]:
        """Return every record with that prefix, tombstones too, in order of keys."""
        return await self._call(partial(read_records, prefix=prefix))

    async def digests(self) -> list[tuple[str, str]]:
        """Return (key, digest) of every record, in order of keys."""
        return await self._call(read_digests)

    async def change(
        self, key: str, decide: Callable[[Record | None], Record | None], *, durable: bool = True
    ) -> Record | None:
        """Read a record, decide, and store what was decided, with nothing in between.

        `decide` runs on the store's thread and must be pure: it may be run again. What it raises is raised here.
        Returns what it returned; nothing is written when that is None or what is stored already.
        """
        future: asyncio.Future[Record | None] = self._loop.create_future()
        self._submit(_change_call(partial(self._change, key, decide), partial(self._post, future), key, durable))
        return await future

    def change_soon(
        self, key: str, decide: Callable[[Record | None], Record | None], *, durable: bool = True
    ) -> tuple[asyncio.Future[Record | None], asyncio.Future[Record | None]]:
        """Do the same; returns what was decided, as soon as it is, and the same once it is committed.

        The decision is made here and now where the record's present state is known in memory and nothing is queued that
        may change it; otherwise on the store's thread in its turn. The two fail alike; when only the second does, the
        decision was made and the disk did not take it.
        """
        decided: asyncio.Future[Record | None] = self._loop.create_future()
        committed: asyncio.Future[Record | None] = self._loop.create_future()
        # Who awaits the first need not look at the second when that has failed.
        committed.add_done_callback(_looked_at)

        def done(record: Record | None, error: Exception | None) -> None:
            self._post(decided, record, error)
            self._post(committed, record, error)

        with self._some:
            if self._decide_now(key, decide, decided, committed, durable=durable):
                return decided, committed

        def run(db: sqlite3.Connection) -> Record | None:
            record = self._change(key, decide, db)
            self._post(decided, record, None)
            return record

        self._submit(_change_call(run, done, key, durable))
        return decided, committed

    def _decide_now(
        self,
        key: str,
        decide: Callable[[Record | None], Record | None],
        decided: asyncio.Future[Record | None],
        committed: asyncio.Future[Record | None],
        *,
        durable: bool,
    ) -> bool:
        """Decide on the caller's thread, which has the lock; False where the store's thread has to."""
        found = None if self._closing else self._ahead.known(key, self._picture.look)
        if found is None:
            return False
        try:
            record = decide(found.record)
        except Exception as error:  # noqa: BLE001 - a decision's own error is its caller's, whatever it is
            if found.on_its_way:
                return False  # whoever is told of a conflict must be able to read what it is with
            for each in (decided, committed):
                each.set_exception(error)
            return True
        if record is None or record == found.record:
            if found.on_its_way:
                return False  # acknowledged only with the commit of what it found done
            for each in (decided, committed):
                each.set_result(record)
            return True
        self._submit_decided(record, partial(self._post, committed), durable=durable)
        # The store's thread wants the interpreter, and so does whoever sends the decision to others now: that first.
        self._loop.call_soon(self.wake)
        decided.set_result(record)
        return True

    def decide_now(
        self,
        key: str,
        decide: Callable[[Record | None], Record | None],
        done: Callable[[Record | None, Exception | None], None],
        *,
        durable: bool = True,
    ) -> Record | None:
        """Decide on the thread that calls, any, and have the store's commit it; whoever calls wakes that (`wake`).

        Returns:
            What was decided, of which `done` is told on the store's thread once it is committed; None: nothing was
            done, since the record's present state is not known here, or it is to stay as it is.

        Raises:
            RefusedError: the store is closed, or too much waits for the disk.
            Exception: what `decide` raises.
        """
        with self._some:
            found = self._ahead.known(key, self._picture.look)
            record = None if found is None else decide(found.record)
            if found is None or record is None or record == found.record:
                return None
            self._submit_decided(record, done, durable=durable)
        return record

    def _submit_decided(
        self, record: Record, done: Callable[[Record | None, Exception | None], None], *, durable: bool
    ) -> None:
        mark = Mark(decided=record)
        call = _Call(partial(self._put, record), done, writes=True, durable=durable, mark=mark, single=True)
        self._submit(call, wake=False)

    def change_then(
        self,
        key: str,
        decide: Callable[[Record | None], Record | None],
        done: Callable[[Record | None, Exception | None], None],
        *,
        durable: bool = True,
    ) -> None:
        """Do the same, from any thread; `done` is told on the store's thread, once it is committed.

        Raises:
            RefusedError: the store is closed, or too much waits for the disk.
        """
        self._submit(_change_call(partial(self._change, key, decide), done, key, durable))

    def _change(
        self, key: str, decide: Callable[[Record | None], Record | None], db: sqlite3.Connection
    ) -> Record | None:
        current = self._current(key, db)
        decided = decide(current)
        if decided is not None and decided != current:
            self._put(decided, db)
        return decided

    def _put(self, record: Record, db: sqlite3.Connection) -> Record:
        put_row(db, record)
        self._changed.append(record)
        return record

    def _current(self, key: str, db: sqlite3.Connection) -> Record | None:
        """The record as the open transaction sees it."""
        for change in reversed(self._changed):
            if isinstance(change, str):
                if change == key:
                    return None
            elif change.key == key:
                return change
        known, record = self._picture.look(key)
        return record if known else read_row(db, key)

    async def forget(self, record: Record) -> None:
        """Drop a copy that belongs elsewhere, if it is still that version."""
        await self._drop("DELETE FROM records WHERE key = ? AND digest = ? RETURNING key", record.key, digest(record))

    async def forget_tombstones(self, before_ns: int) -> None:
        """Drop removals older than that (Unix nanoseconds, this machine's clock)."""
        await self._drop("DELETE FROM records WHERE deleted AND updated_ns < ? RETURNING key", before_ns, durable=False)

    async def _drop(self, sql: str, *values: Any, durable: bool = True) -> None:
        def run(db: sqlite3.Connection) -> None:
            self._changed += [row[0] for row in db.execute(sql, values).fetchall()]

        await self._call(run, writes=True, durable=durable, mark=Mark(touches=""))

    # --- the thread -------------------------------------------------------------------------------------------

    async def _read(self, sql: str, *values: Any) -> list[Any]:
        return await self._call(lambda db: db.execute(sql, values).fetchall())

    async def _execute(self, sql: str, *values: Any, durable: bool = True) -> None:
        await self._call(lambda db: db.execute(sql, values) and None, writes=True, durable=durable)

    async def _call(
        self, run: Callable[[sqlite3.Connection], T], *, writes: bool = False, durable: bool = True,
        mark: Mark = NOTHING,
    ) -> T:  # fmt: skip
        future: asyncio.Future[Any] = self._loop.create_future()
        self._submit(_Call(run, partial(self._post, future), writes, durable, mark))
        return cast("T", await future)

    def _submit(self, call: _Call, *, wake: bool = True) -> None:
        with self._some:
            if self._closing:
                raise RefusedError("the store is closed")
            if len(self._waiting) >= _MOST_WAITING:
                raise RefusedError(
                    f"{len(self._waiting)} calls wait for the disk", remedy="the disk is too slow or fails"
                )
            self._waiting.append(call)
            self._ahead.queued(call.mark)
            if wake:
                self._some.notify()

    def wake(self) -> None:
        """Have the store's thread look what waits; from any thread."""
        with self._some:
            self._some.notify()

    def _run(self) -> None:
        try:
            db = self._file.connect()
            self._picture = Picture(read_keys(db))
        except Exception as error:  # noqa: BLE001 - supervision boundary: whatever went wrong must reach the caller of `open`
            self._post(self._opened, None, error)
            return
        self._post(self._opened, None, None)
        room = Room(self.path)
        while batch := self._take():
            self._do(db, batch)
            if any(call.durable for call in batch if call.writes):
                room.make()
        room.close()
        with contextlib.suppress(sqlite3.Error):
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        db.close()
        self._file.release()

    def _take(self) -> list[_Call]:
        with self._some:
            while not self._waiting and not self._closing:
                self._some.wait()
            return [self._waiting.popleft() for _ in range(min(len(self._waiting), _MOST_TOGETHER))]

    def _do(self, db: sqlite3.Connection, batch: list[_Call]) -> None:
        """Run a batch in one commit; if that fails, each call on its own, so that one cannot fail the others."""
        try:
            outcomes = self._commit(db, batch)
        except sqlite3.Error as error:
            if len(batch) > 1:
                for call in batch:
                    self._do(db, [call])
                return
            problem = problem_of(error, self.path)
            log.error("the store failed", path=str(self.path), reason=str(problem))  # noqa: TRY400 - cause named
            outcomes = [(None, problem)]
        self._settle(batch)
        for call, (result, error) in zip(batch, outcomes, strict=True):
            try:
                call.done(result, error)
            except Exception:  # supervision boundary: one caller's defect must not end the thread of all
                log.exception("who waited for the store failed")

    def _settle(self, batch: list[_Call]) -> None:
        """What these calls did, or failed to, shows in the picture: they stand in no decision's way any more."""
        with self._some:
            for call in batch:
                self._ahead.settled(call.mark)

    def _commit(self, db: sqlite3.Connection, batch: list[_Call]) -> list[tuple[Any, Exception | None]]:
        writes = any(call.writes for call in batch)
        alone = len(batch) == 1 and batch[0].single
        self._changed.clear()
        if writes:
            self._set_synchronous(db, "FULL" if any(call.durable for call in batch if call.writes) else "NORMAL")
            if not alone:
                db.execute("BEGIN IMMEDIATE")
        try:
            outcomes: list[tuple[Any, Exception | None]] = []
            for call in batch:
                try:
                    outcomes.append((call.run(db), None))
                except sqlite3.Error:
                    raise
                except Exception as error:  # noqa: BLE001 - a decision's own error is its caller's, whatever it is
                    outcomes.append((None, error))
            if writes:
                if not alone:
                    db.execute("COMMIT")
                self._show()
        except BaseException:
            self._changed.clear()
            if db.in_transaction:
                with contextlib.suppress(sqlite3.Error):
                    db.execute("ROLLBACK")
            raise
        return outcomes

    def _show(self) -> None:
        """Have the picture follow a commit."""
        for change in self._changed:
            if isinstance(change, str):
                self._picture.drop(change)
            else:
                self._picture.put(change)
        self._changed.clear()

    def _set_synchronous(self, db: sqlite3.Connection, mode: str) -> None:
        if mode != self._synchronous:
            db.execute(f"PRAGMA synchronous = {mode}")
            self._synchronous = mode

    def _post(self, future: asyncio.Future[Any], result: Any, error: Exception | None) -> None:
        def settle() -> None:
            if future.done():
                return
            if error is not None:
                future.set_exception(error)
            else:
                future.set_result(result)

        # The loop may be gone when the process ends without closing: then nobody waits.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(settle)

    async def close(self) -> None:
        """Do what waits, then close the file."""
        with self._some:
            self._closing = True
            self._some.notify()
        await asyncio.to_thread(self._thread.join)


def _change_call(
    run: Callable[[sqlite3.Connection], Record | None],
    done: Callable[[Any, Exception | None], None],
    key: str,
    durable: bool,
) -> _Call:
    return _Call(run, done, writes=True, durable=durable, mark=Mark(touches=key), single=True)


def _looked_at(future: asyncio.Future[Record | None]) -> None:
    if not future.cancelled():
        future.exception()
