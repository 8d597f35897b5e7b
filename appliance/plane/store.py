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

from appliance.plane.commits import Call, Commits
from appliance.plane.rows import LeaveOut, read_digests, read_kept, read_page, read_records, read_row
from appliance.plane.versions import Record, digest

T = TypeVar("T")


class Store:
    """Records of the DHT and a plain key-value table for the rooms above; made by `open`."""

    def __init__(self, path: Path, loop: asyncio.AbstractEventLoop) -> None:
        self.path = path
        self._loop = loop
        self._opened: asyncio.Future[None] = loop.create_future()
        self._commits = Commits(path, partial(self._post, self._opened, None))

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

    async def page(self, prefix: str, after: str = "", leave_out: LeaveOut | None = None) -> list[Record]:
        """Return the next records with that prefix and a key above `after`, in order; none: there are no more.

        Read so, many records do not hold up what else waits for the disk; between pages they may change.
        """
        return await self._call(partial(read_page, prefix=prefix, after=after, leave_out=leave_out))

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
        self._commits.submit(_change_call(partial(self._change, key, decide), partial(self._post, future), durable))
        return await future

    def change_soon(
        self, key: str, decide: Callable[[Record | None], Record | None], *, durable: bool = True
    ) -> tuple[asyncio.Future[Record | None], asyncio.Future[Record | None]]:
        """Do the same; returns what was decided, as soon as it is, and the same once it is committed.

        The two fail alike; when only the second does, the decision was made and the disk did not take it.
        """
        decided: asyncio.Future[Record | None] = self._loop.create_future()
        committed: asyncio.Future[Record | None] = self._loop.create_future()
        # Who awaits the first need not look at the second when that has failed.
        committed.add_done_callback(_looked_at)

        def done(record: Record | None, error: Exception | None) -> None:
            self._post(decided, record, error)
            self._post(committed, record, error)

        def run(db: sqlite3.Connection) -> Record | None:
            record = self._change(key, decide, db)
            self._post(decided, record, None)
            return record

        # In a transaction, so that it is told of before its commit: others store it meanwhile.
        self._commits.submit(Call(run, done, writes=True, durable=durable))
        return decided, committed

    def _change(
        self, key: str, decide: Callable[[Record | None], Record | None], db: sqlite3.Connection
    ) -> Record | None:
        current = self._commits.current(key, db)
        decided = decide(current)
        if decided is not None and decided != current:
            self._commits.put(decided, db)
        return decided

    def watch(self, heed: Callable[[str], bool], tell: Callable[[Record], None]) -> Callable[[], None]:
        """Have `tell` hear, on the event loop and in order, of every record committed from now on whose key is heeded.

        Whoever wrote it: this gateway, another one, or a comparison with other copies. Removals count too.

        Args:
            heed: whether a key is of interest; called on the store's thread for every record, so it must be quick, must
                not raise, and may only look at what is safe to read from any thread.
            tell: hears of the record.

        Returns:
            What ends it; records on their way to the event loop may still be told.
        """

        def committed(record: Record) -> None:
            if heed(record.key):
                # The loop may be gone when the process ends without closing: then nobody waits.
                with contextlib.suppress(RuntimeError):
                    self._loop.call_soon_threadsafe(tell, record)

        self._commits.watchers.append(committed)
        return lambda: self._commits.watchers.remove(committed)

    async def forget(self, record: Record) -> None:
        """Drop a copy that belongs elsewhere, if it is still that version."""
        await self._drop("DELETE FROM records WHERE key = ? AND digest = ? RETURNING key", record.key, digest(record))

    async def forget_tombstones(self, before_ns: int) -> None:
        """Drop removals older than that (Unix nanoseconds, this machine's clock)."""
        await self._drop("DELETE FROM records WHERE deleted AND updated_ns < ? RETURNING key", before_ns, durable=False)

    async def _drop(self, sql: str, *values: Any, durable: bool = True) -> None:
        def run(db: sqlite3.Connection) -> None:
            self._commits.dropped([row[0] for row in db.execute(sql, values).fetchall()])

        await self._call(run, writes=True, durable=durable)

    # --- the thread -------------------------------------------------------------------------------------------

    async def _read(self, sql: str, *values: Any) -> list[Any]:
        return await self._call(lambda db: db.execute(sql, values).fetchall())

    async def _execute(self, sql: str, *values: Any, durable: bool = True) -> None:
        await self._call(lambda db: db.execute(sql, values) and None, writes=True, durable=durable)

    async def _call(self, run: Callable[[sqlite3.Connection], T], *, writes: bool = False, durable: bool = True) -> T:
        future: asyncio.Future[Any] = self._loop.create_future()
        self._commits.submit(Call(run, partial(self._post, future), writes, durable))
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
    durable: bool,
) -> Call:
    return Call(run, done, writes=True, durable=durable, single=True)


def _looked_at(future: asyncio.Future[Record | None]) -> None:
    if not future.cancelled():
        future.exception()
