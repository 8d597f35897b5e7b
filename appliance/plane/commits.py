"""The one thread that touches a gateway's SQLite file: what waits for it is done in the order in which it came.

Calls that queue up while the disk is busy share one commit. A call that writes with one statement, and comes alone,
needs no transaction around it: a statement is one. Whoever waits is told after the commit, on this thread.
"""

import contextlib
import queue
import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import structlog

from appliance.errors import RefusedError
from appliance.plane.file import File, problem_of
from appliance.plane.picture import Picture
from appliance.plane.rows import put_row, read_keys, read_row
from appliance.plane.versions import Record

log = structlog.get_logger(__name__)

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
    """The thread and what waits for it. `opened` is told, on the thread, when the file is open or why it is not."""

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
        """Have the thread look what waits; whoever calls has the lock."""
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
        except Exception as error:  # noqa: BLE001 - supervision boundary: whatever went wrong must reach whoever opens
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
        """Whether one of them must be on the disk when it is told."""
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
