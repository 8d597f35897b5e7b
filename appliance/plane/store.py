"""What a gateway must not forget, in one SQLite file (WAL), touched by one thread only.

Everything acknowledged is on the disk: commits are synchronous (`FULL`), and calls that queue up while the disk is busy
share one commit, in the order in which they came (`Commits`). A call that writes with one statement, and comes alone,
needs no transaction around it: a statement is one. Measured on a development machine's SSD: a commit of one 4 KB record
takes 0.27 ms with FULL and 0.03 ms without, so only what may be lost with the power (`durable=False`) goes without.

The file is opened by one gateway at a time, moved aside when it is damaged, and never overwritten (`File`).

Many rows come as one JSON text for each page of them. The `sqlite3` module gives up the interpreter's lock for every
row it steps to, and waits for it again, up to the switch interval of 5 ms while another thread computes: 10,000 keys
and digests took 7 ms alone and 4.6 s beside a busy thread, in pages 8 ms and 15 ms.

Reads on the event loop are answered from the committed records in memory, without the store's thread (`Picture`). It is
written only after a commit, by the store's thread, so that nobody hears what a failing disk could still take back.
All keys are known, so that it can say that there is no such record; of the records as many as fit, those used last.
"""

import asyncio
import contextlib
import fcntl
import os
import queue
import sqlite3
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import msgspec
import structlog

from appliance.errors import ConfigError, PrerequisiteError, RefusedError, SwiftbotError
from appliance.model import VersionVector
from appliance.model.plane_api import Record
from appliance.plane.records import digest

log = structlog.get_logger(__name__)

SCHEMA = 1
_BUSY_S = 5.0

TABLES = """
CREATE TABLE IF NOT EXISTS records (
    key TEXT PRIMARY KEY, value BLOB NOT NULL, version TEXT NOT NULL, deleted INTEGER NOT NULL,
    write TEXT NOT NULL, digest TEXT NOT NULL, updated_ns INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS kept (key TEXT PRIMARY KEY, value BLOB NOT NULL);
"""


class File:
    """A file that may not be there yet."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.set_aside: Path | None = None
        """Where a file that could not be read was moved."""
        self._lock = -1

    def connect(self) -> sqlite3.Connection:
        """Open it for the thread that calls; a file that is damaged is moved aside, never overwritten.

        Raises:
            ConfigError: the folder cannot be written, another gateway uses the file, or a newer version wrote it.
            PrerequisiteError: the disk is full or fails.
        """
        self._acquire()
        try:
            try:
                return self._prepare()
            except sqlite3.Error as error:
                if not _damaged(error):
                    raise
                self._move_aside(str(error))
            return self._prepare()
        except sqlite3.Error as error:
            os.close(self._lock)
            raise problem_of(error, self.path) from error
        except BaseException:
            os.close(self._lock)
            raise

    def _acquire(self) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._lock = os.open(f"{self.path}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise ConfigError(
                f"{self.path} cannot be written: {error.strerror}", remedy="set data_dir to a writable folder"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise ConfigError(
                f"{self.path} is in use by another gateway", remedy="give each gateway a data_dir of its own"
            ) from error

    def _prepare(self) -> sqlite3.Connection:
        db = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False, timeout=_BUSY_S)
        try:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            _check(db, self.path)
            db.executescript(TABLES)
            db.execute(f"PRAGMA user_version = {SCHEMA}")
        except BaseException:
            db.close()
            raise
        return db

    def _move_aside(self, reason: str) -> None:
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        aside = self.path.with_name(f"{self.path.name}.damaged-{stamp}")
        number = 1
        while aside.exists():
            number += 1
            aside = self.path.with_name(f"{self.path.name}.damaged-{stamp}-{number}")
        for suffix in ("", "-wal", "-shm"):
            part = self.path.with_name(self.path.name + suffix)
            if part.exists():
                part.rename(aside.with_name(aside.name + suffix))
        self.set_aside = aside
        log.error(
            "the store's file is damaged and was moved aside; starting with an empty one",
            path=str(self.path),
            moved_to=str(aside),
            reason=reason,
            remedy="records come back from the replicas; what was only here may be saved with `sqlite3 FILE .recover`",
        )

    def release(self) -> None:
        """Let others open it; the connection is closed already."""
        os.close(self._lock)


def _check(db: sqlite3.Connection, path: Path) -> None:
    found = db.execute("PRAGMA quick_check(1)").fetchone()
    if found != ("ok",):
        raise sqlite3.DatabaseError(f"malformed: {found[0] if found else 'no answer'}")
    version = db.execute("PRAGMA user_version").fetchone()[0]
    if version > SCHEMA:
        raise ConfigError(
            f"{path} was written by a newer version (schema {version}, this one knows {SCHEMA})",
            remedy="install that version again, or use another data_dir",
        )


def _damaged(error: sqlite3.Error) -> bool:
    text = str(error)
    return "malformed" in text or "not a database" in text


def problem_of(error: sqlite3.Error, path: Path) -> SwiftbotError:
    """What a failure of the library means to a person, and what to do about it."""
    text = str(error)
    if "full" in text:
        return PrerequisiteError(f"the disk that holds {path} is full", remedy="free some space; nothing is lost")
    if "readonly" in text or "unable to open" in text:
        return ConfigError(f"{path} cannot be written: {text}", remedy="check the owner and rights of data_dir")
    if _damaged(error):
        return PrerequisiteError(
            f"{path} is damaged: {text}", remedy="restart the gateway: it moves the file aside and asks the replicas"
        )
    return PrerequisiteError(f"{path} cannot be used: {text}", remedy="check the disk")


Row = TypeVar("Row", bound=tuple[Any, ...])

_COLUMNS = "key, value, version, deleted, write"
_LAST = "\U0010ffff"
"""Code points end here."""
_MOST_NAMES = 5000
"""Rows without values in a page."""
_MOST_VALUES = 128
"""Rows with values, which may be large, in a page."""
_KEYS = msgspec.json.Decoder(list[tuple[str]])
_NAMES = msgspec.json.Decoder(list[tuple[str, str]])
_RECORDS = msgspec.json.Decoder(list[tuple[str, str, str, int, str]])


def put_row(db: sqlite3.Connection, record: Record) -> None:
    """Write a record."""
    db.execute(
        # One that is there keeps its place: to replace it would write the pages of the key's index as well.
        "INSERT INTO records VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT(key) DO UPDATE SET value = excluded.value, "
        "version = excluded.version, deleted = excluded.deleted, write = excluded.write, digest = excluded.digest, "
        "updated_ns = excluded.updated_ns",
        (
            record.key,
            record.value,
            msgspec.json.encode(record.version).decode(),
            record.deleted,
            record.write,
            digest(record),
            time.time_ns(),
        ),
    )


def read_row(db: sqlite3.Connection, key: str) -> Record | None:
    """Read a record."""
    row = db.execute(f"SELECT {_COLUMNS} FROM records WHERE key = ?", (key,)).fetchone()  # noqa: S608 - a text of ours
    return None if row is None else _record(*row)


def _record(key: str, value: bytes, version: str, deleted: int, write: str) -> Record:
    return Record(
        key=key,
        value=value,
        version=msgspec.json.decode(version, type=VersionVector),
        deleted=bool(deleted),
        write=write,
    )


class LeaveOut(NamedTuple):
    """Records that are not wanted, by what is in their value: told apart by SQLite, which is far quicker than here."""

    has: bytes
    lacks: bytes


def read_records(db: sqlite3.Connection, prefix: str) -> list[Record]:
    """Every record with that prefix, tombstones too, in order of keys."""
    return _read_records(db, prefix, Page())


def read_page(db: sqlite3.Connection, prefix: str, after: str, leave_out: LeaveOut | None) -> list[Record]:
    """The next records with that prefix and a key above `after`, in order of keys; none: there are no more."""
    first = f"{after}\0" if after else prefix
    return _read_records(db, prefix, Page(first=first, once=True, leave_out=leave_out))


def _read_records(db: sqlite3.Connection, prefix: str, page: "Page") -> list[Record]:
    rows = _rows(
        db, f"{_COLUMNS} FROM records", _COLUMNS.replace("value", "hex(value)"), prefix, _RECORDS, _MOST_VALUES, page
    )
    return [_record(key, bytes.fromhex(value), version, deleted, write) for key, value, version, deleted, write in rows]


def read_digests(db: sqlite3.Connection) -> list[tuple[str, str]]:
    """(key, digest) of every record, in order of keys."""
    return list(_rows(db, "key, digest FROM records", "key, digest", "", _NAMES, _MOST_NAMES))


def read_keys(db: sqlite3.Connection) -> Iterator[str]:
    """The key of every record, in order."""
    return (key for (key,) in _rows(db, "key FROM records", "key", "", _KEYS, _MOST_NAMES))


def read_kept(db: sqlite3.Connection, prefix: str) -> list[tuple[str, bytes]]:
    """(key, value) of every plain key with that prefix, in order."""
    rows = _rows(db, "key, value FROM kept", "key, hex(value)", prefix, _NAMES, _MOST_VALUES)
    return [(key, bytes.fromhex(value)) for key, value in rows]


class Page(NamedTuple):
    """Where reading begins (empty: with the first), whether it is for one page alone, and what is left out."""

    first: str = ""
    once: bool = False
    leave_out: LeaveOut | None = None


def _rows(
    db: sqlite3.Connection,
    source: str,
    columns: str,
    prefix: str,
    decoder: "msgspec.json.Decoder[list[Row]]",
    most: int,
    page_of: Page = Page(),  # noqa: B008 - immutable
) -> Iterator[Row]:
    """`columns` of the rows whose `key`, the first of them, has that prefix; read in pages of at most `most`."""
    # So that the index serves it. Without a prefix there is no end: a key may begin with the last code point too.
    end, bounds = ("AND key < ?", (prefix + _LAST,)) if prefix else ("", ())
    if page_of.leave_out is not None:
        end, bounds = f"{end} AND NOT (instr(value, ?) > 0 AND instr(value, ?) = 0)", (*bounds, *page_of.leave_out)
    sql = (
        f"SELECT json_group_array(json_array({columns})) FROM "  # noqa: S608 - texts of ours
        f"(SELECT {source} WHERE key >= ? {end} ORDER BY key LIMIT ?)"
    )
    first = page_of.first or prefix
    while True:
        try:
            (text,) = db.execute(sql, (first, *bounds, most)).fetchone()
        except sqlite3.DataError:  # longer than a text may be: the values are large
            if most == 1:
                raise
            most //= 2
            continue
        page = decoder.decode(text)
        yield from page
        if len(page) < most or page_of.once:
            return
        first = f"{page[-1][0]}\0"  # the next text there is


MOST_BYTES = 32 * 2**20
"""Of values held: some ten thousand task records."""
_BESIDE = 300
"""Bytes of a record beside its value, about."""


class Picture:
    """Keys of all committed records, and the records used last; safe to use from any thread."""

    def __init__(self, keys: Iterable[str] = (), *, most_bytes: int = MOST_BYTES) -> None:
        self._most = most_bytes
        self._keys = set(keys)
        self._records: OrderedDict[str, Record] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def look(self, key: str) -> tuple[bool, Record | None]:
        """Whether the record of a key is known here, and it (None: there is none)."""
        with self._lock:
            record = self._records.get(key)
            if record is None:
                return key not in self._keys, None
            self._records.move_to_end(key)
            return True, record

    def put(self, record: Record) -> None:
        """A record was committed."""
        with self._lock:
            self._keys.add(record.key)
            self._hold(record)

    def read(self, record: Record) -> None:
        """A record was read from the file, by the thread that writes it."""
        with self._lock:
            if record.key in self._keys:
                self._hold(record)

    def drop(self, key: str) -> None:
        """A record is not held any more."""
        with self._lock:
            self._keys.discard(key)
            self._release(key)

    def _hold(self, record: Record) -> None:
        self._release(record.key)
        self._records[record.key] = record
        self._bytes += len(record.value) + _BESIDE
        while self._bytes > self._most:
            self._release(next(iter(self._records)))

    def _release(self, key: str) -> None:
        record = self._records.pop(key, None)
        if record is not None:
            self._bytes -= len(record.value) + _BESIDE


_MOST_WAITING = 10_000
_MOST_TOGETHER = 128
"""Calls in one commit: enough to amortise it, few enough that the first does not wait long."""


class Call(NamedTuple):
    """Something to be done with the file."""

    run: Callable[[sqlite3.Connection], Any]
    done: Callable[[Any, Exception | None], None]
    """Told on the store's thread, after the commit."""
    writes: bool
    durable: bool
    single: bool = False
    """It writes with one statement at most."""


Outcome = tuple[Any, Exception | None]


class Commits:
    """The thread and what waits for it. `opened` is called, on the thread, when the file is open or why it is not."""

    def __init__(self, path: Path, opened: Callable[[Exception | None], None]) -> None:
        self.path = path
        self.file = File(path)
        self.picture = Picture()
        """What is committed."""
        self._lock = threading.Lock()
        """Under which calls are queued."""
        self.closing = False
        self.watchers: list[Callable[[Record], None]] = []
        """Told each record that was committed, on the store's thread."""
        self._opened = opened
        self._waiting: deque[Call] = deque()
        # One that is written in C: a condition of Python's takes a good part of a commit's time.
        self._signals: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._signalled = False
        self._synchronous = "FULL"
        self._changed: list[Record | str] = []
        """What the open transaction has put (records) and dropped (keys)."""
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)

    def start(self) -> None:
        """Open the file, and begin."""
        self._thread.start()

    def submit(self, call: Call) -> None:
        """Queue a call, from any thread.

        Raises:
            RefusedError: the store is closed, or too much waits for the disk.
        """
        with self._lock:
            if self.closing:
                raise RefusedError("the store is closed")
            if len(self._waiting) >= _MOST_WAITING:
                raise RefusedError(
                    f"{len(self._waiting)} calls wait for the disk", remedy="the disk is too slow or fails"
                )
            self._waiting.append(call)
            self._wake()

    def _wake(self) -> None:
        """Have the thread look what waits; the one that calls has the lock."""
        if not self._signalled:
            self._signalled = True
            self._signals.put(None)

    def close(self) -> None:
        """Do what waits, then close the file; blocks."""
        with self._lock:
            self.closing = True
            self._wake()
        self._thread.join()

    # --- what calls do ----------------------------------------------------------------------------------------

    def put(self, record: Record, db: sqlite3.Connection) -> Record:
        """Write a record."""
        put_row(db, record)
        self._changed.append(record)
        return record

    def dropped(self, keys: list[str]) -> None:
        """A call has deleted the records of these keys."""
        self._changed += keys

    def current(self, key: str, db: sqlite3.Connection) -> Record | None:
        """The record as the open transaction sees it."""
        for change in reversed(self._changed):
            if isinstance(change, str):
                if change == key:
                    return None
            elif change.key == key:
                return change
        known, record = self.picture.look(key)
        return record if known else read_row(db, key)

    # --- the thread -------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            db = self.file.connect()
            self.picture = Picture(read_keys(db))
        except Exception as error:  # noqa: BLE001 - supervision boundary: whatever went wrong must reach the one that opens
            self._opened(error)
            return
        self._opened(None)
        while batch := self._take():
            self._do(db, batch)
        with contextlib.suppress(sqlite3.Error):
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        db.close()
        self.file.release()

    def _take(self) -> list[Call]:
        """Wait for calls; none: it is to close, and all that waited is done."""
        while True:
            self._signals.get()
            with self._lock:
                self._signalled = False
                waiting = self._waiting
                batch = [waiting.popleft() for _ in range(min(len(waiting), _MOST_TOGETHER))]
                if batch and (waiting or self.closing):
                    self._wake()
                if batch or self.closing:
                    return batch

    def _do(self, db: sqlite3.Connection, batch: list[Call]) -> None:
        """Run a batch in one commit; if that fails, each call on its own, so that one cannot fail the others."""
        try:
            alone = len(batch) == 1 and batch[0].single
            outcomes = [self._write_alone(db, batch[0])] if alone else self._commit(db, batch)
        except sqlite3.Error as error:
            if len(batch) > 1:
                for call in batch:
                    self._do(db, [call])
                return
            problem = problem_of(error, self.path)
            log.error("the store failed", path=str(self.path), reason=str(problem))  # noqa: TRY400 - cause named
            outcomes = [(None, problem)]
        for call, (result, error) in zip(batch, outcomes, strict=True):
            try:
                call.done(result, error)
            except Exception:  # supervision boundary: one caller's defect must not end the thread of all
                log.exception("who waited for the store failed")

    def _write_alone(self, db: sqlite3.Connection, call: Call) -> Outcome:
        self._changed.clear()
        self._set_synchronous(db, durable=call.durable)
        outcome = _outcome(db, call)
        self._show()
        return outcome

    def _commit(self, db: sqlite3.Connection, batch: list[Call]) -> list[Outcome]:
        writes = any(call.writes for call in batch)
        self._changed.clear()
        if writes:
            self._set_synchronous(db, durable=self._durable(batch))
            db.execute("BEGIN IMMEDIATE")
        try:
            outcomes = [_outcome(db, call) for call in batch]
            if writes:
                db.execute("COMMIT")
                self._show()
        except BaseException:
            self._changed.clear()
            if db.in_transaction:
                with contextlib.suppress(sqlite3.Error):
                    db.execute("ROLLBACK")
            raise
        return outcomes

    def _durable(self, batch: list[Call]) -> bool:
        """Whether one of them must be on the disk when it is acknowledged."""
        for call in batch:  # noqa: SIM110 - most often it is one
            if call.durable and call.writes:
                return True
        return False

    def _show(self) -> None:
        """Have the picture follow a commit, then those who watch records."""
        for change in self._changed:
            if isinstance(change, str):
                self.picture.drop(change)
            else:
                self.picture.put(change)
        for watcher in tuple(self.watchers):
            for change in self._changed:
                if not isinstance(change, str):
                    watcher(change)
        self._changed.clear()

    def _set_synchronous(self, db: sqlite3.Connection, *, durable: bool) -> None:
        mode = "FULL" if durable else "NORMAL"
        if mode != self._synchronous:
            db.execute(f"PRAGMA synchronous = {mode}")
            self._synchronous = mode


def _outcome(db: sqlite3.Connection, call: Call) -> Outcome:
    """Run a call; sqlite3.Error: the file failed."""
    try:
        return call.run(db), None
    except sqlite3.Error:
        raise
    except Exception as error:  # noqa: BLE001 - a decision's own error is its caller's, whatever it is
        return None, error


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

        # In a transaction, so that it is known before its commit: others store it meanwhile.
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

        The writer may be this gateway, another one, or a comparison with other copies. Removals count too.

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
