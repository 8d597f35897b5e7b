"""The SQLite file of a gateway: opened by one gateway at a time, moved aside when it is damaged, never overwritten.

Split from `store`, which has what is done with it once it is open.
"""

import fcntl
import os
import sqlite3
import time
from pathlib import Path

import structlog

from appliance.errors import ConfigError, PrerequisiteError, SwiftbotError

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
