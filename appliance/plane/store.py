"""What a gateway must not forget, in one SQLite file (WAL), touched by one thread only.

Everything acknowledged is on the disk: commits are synchronous (`FULL`), and calls that queue up while the disk
is busy share one commit. Measured on a development machine's SSD: a commit of one 4 KB record takes 0.27 ms with
FULL and 0.03 ms without, so only what may be lost with the power (`durable=False`) goes without.
"""

import asyncio
import contextlib
import sqlite3
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

from appliance.plane.ahead import NOTHING, Mark
from appliance.plane.commits import Call, Commits
from appliance.plane.rows import read_digests, read_kept, read_records, read_row
from appliance.plane.versions import Record, digest

T = TypeVar("T")


class Store:
    """Records of the DHT and a plain key-value table for the rooms above; made by `open`."""

    def __init__(self, path: Path, loop: asyncio.AbstractEventLoop) -> None:
        self.path = path
        self._loop = loop
        self._opened: asyncio.Future[None] = loop.create_future()
        self._commits = Commits(path, partial(self._post, self._opened, None))
        self.wake = self._commits.wake

    @classmethod
    async def open(cls, path: Path) -> "Store":
        """Open or make the file; one that is damaged is moved aside, never overwritten.

        Raises:
            ConfigError: the folder cannot be written, or another gateway uses the file.
            PrerequisiteError: the disk is full or fails.
        """
        store = cls(path, asyncio.get_running_loop())
        store._commits.start()
        await store._opened
        return store

    @property
    def set_aside(self) -> Path | None:
        """Where a file that could not be read was moved at start."""
        return self._commits.file.set_aside

    # --- plain keys -------------------------------------------------------------------------------------------

    async def get(self, key: str) -> bytes | None:
        """Return what is kept under a key."""
        rows = await self._read("SELECT value FROM kept WHERE key = ?", key)
        return rows[0][0] if rows else None

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Keep a value; on the disk when this returns, unless not `durable`."""
        await self._execute("INSERT OR REPLACE INTO kept VALUES (?, ?)", key, value, durable=durable)

    async def delete(self, key: str) -> bool:
        """Forget a key; returns whether it was there."""
        return await self._call(
            lambda db: db.execute("DELETE FROM kept WHERE key = ?", (key,)).rowcount > 0, writes=True
        )

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return (key, value) of every key with that prefix, in order."""
        return await self._call(partial(read_kept, prefix=prefix))

    # --- records ----------------------------------------------------------------------------------------------

    def look(self, key: str) -> tuple[bool, Record | None]:
        """Whether a record is known without asking the disk, and it; from any thread."""
        return self._commits.picture.look(key)

    async def record(self, key: str) -> Record | None:
        """Return a record, a tombstone too."""
        known, record = self._commits.picture.look(key)
        return record if known else await self._call(partial(self._read_record, key))

    def _read_record(self, key: str, db: sqlite3.Connection) -> Record | None:
        record = read_row(db, key)
        # Within a transaction it may be one that is not committed.
        if record is not None and not db.in_transaction:
            self._commits.picture.read(record)
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
        self._commits.submit(
            _change_call(partial(self._change, key, decide), partial(self._post, future), key, durable)
        )
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

        with self._commits.lock:
            if self._decide_now(key, decide, decided, committed, durable=durable):
                return decided, committed

        def run(db: sqlite3.Connection) -> Record | None:
            record = self._change(key, decide, db)
            self._post(decided, record, None)
            return record

        self._commits.submit(_change_call(run, done, key, durable))
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
        found = None if self._commits.closing else self._commits.ahead.known(key, self._commits.picture.look)
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
        with self._commits.lock:
            found = self._commits.ahead.known(key, self._commits.picture.look)
            record = None if found is None else decide(found.record)
            if found is None or record is None or record == found.record:
                return None
            self._submit_decided(record, done, durable=durable)
        return record

    def _submit_decided(
        self, record: Record, done: Callable[[Record | None, Exception | None], None], *, durable: bool
    ) -> None:
        mark = Mark(decided=record)
        call = Call(partial(self._commits.put, record), done, writes=True, durable=durable, mark=mark, single=True)
        self._commits.submit(call, wake=False)

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
        self._commits.submit(_change_call(partial(self._change, key, decide), done, key, durable))

    def _change(
        self, key: str, decide: Callable[[Record | None], Record | None], db: sqlite3.Connection
    ) -> Record | None:
        current = self._commits.current(key, db)
        decided = decide(current)
        if decided is not None and decided != current:
            self._commits.put(decided, db)
        return decided

    async def forget(self, record: Record) -> None:
        """Drop a copy that belongs elsewhere, if it is still that version."""
        await self._drop("DELETE FROM records WHERE key = ? AND digest = ? RETURNING key", record.key, digest(record))

    async def forget_tombstones(self, before_ns: int) -> None:
        """Drop removals older than that (Unix nanoseconds, this machine's clock)."""
        await self._drop("DELETE FROM records WHERE deleted AND updated_ns < ? RETURNING key", before_ns, durable=False)

    async def _drop(self, sql: str, *values: Any, durable: bool = True) -> None:
        def run(db: sqlite3.Connection) -> None:
            self._commits.dropped([row[0] for row in db.execute(sql, values).fetchall()])

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
        self._commits.submit(Call(run, partial(self._post, future), writes, durable, mark))
        return cast("T", await future)

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
        await asyncio.to_thread(self._commits.close)


def _change_call(
    run: Callable[[sqlite3.Connection], Record | None],
    done: Callable[[Any, Exception | None], None],
    key: str,
    durable: bool,
) -> Call:
    return Call(run, done, writes=True, durable=durable, mark=Mark(touches=key), single=True)


def _looked_at(future: asyncio.Future[Record | None]) -> None:
    if not future.cancelled():
        future.exception()
