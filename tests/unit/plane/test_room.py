"""Room in the log of a SQLite file: fewer commits that make it longer, and nothing else changes."""

import os
import shutil
import sqlite3
from pathlib import Path

import pytest

from appliance.plane.room import Room


def _open(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None)
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("CREATE TABLE IF NOT EXISTS t (number INTEGER PRIMARY KEY, value BLOB)")
    return db


def _put(db: sqlite3.Connection, number: int, size: int = 400) -> None:
    db.execute("INSERT INTO t VALUES (?, ?)", (number, b"x" * size))


def test_commits_find_room(tmp_path: Path) -> None:
    """Of some hundred commits few make the log longer; once it is overwritten from the start, none do."""
    db, log = _open(tmp_path / "a"), tmp_path / "a-wal"
    room = Room(tmp_path / "a")
    longer = 0
    for number in range(3000):
        before = log.stat().st_size
        _put(db, number)
        longer += log.stat().st_size != before
        room.make()
    assert longer < 30
    assert log.stat().st_size <= 8 * 2**20
    assert db.execute("SELECT count(*) FROM t").fetchone() == (3000,)
    room.close()
    room.make()
    db.close()


@pytest.mark.parametrize("torn", [0, 1, 5000])
def test_what_was_committed_is_there_after_a_crash(tmp_path: Path, torn: int) -> None:
    """A copy of the files as a crash leaves them, with zeros after the last frame, some of them lost, has it all."""
    db = _open(tmp_path / "a")
    room = Room(tmp_path / "a")
    for number in range(20):
        _put(db, number)
        room.make()
    for suffix in ("", "-wal"):
        shutil.copy(tmp_path / f"a{suffix}", tmp_path / f"b{suffix}")
    log = tmp_path / "b-wal"
    assert log.read_bytes().endswith(bytes(10_000))
    os.truncate(log, log.stat().st_size - torn)
    again = _open(tmp_path / "b")
    assert again.execute("PRAGMA quick_check").fetchone() == ("ok",)
    assert again.execute("SELECT count(*) FROM t").fetchone() == (20,)
    _put(again, 20)
    assert again.execute("SELECT count(*) FROM t").fetchone() == (21,)
    again.close()
    room.close()
    db.close()


def test_what_cannot_be_done_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No log, a full disk or a log that is long already: commits go on as they would."""
    Room(tmp_path / "nothing").make()
    db = _open(tmp_path / "a")

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    room = Room(tmp_path / "a")
    with monkeypatch.context() as patched:
        patched.setattr(os, "pwrite", full)
        _put(db, 1)
        room.make()
    size = (tmp_path / "a-wal").stat().st_size
    room.make()
    assert (tmp_path / "a-wal").stat().st_size == size
    room.close()
    _put(db, 2, 9 * 2**20)
    large = Room(tmp_path / "a")
    size = (tmp_path / "a-wal").stat().st_size
    large.make()
    assert (tmp_path / "a-wal").stat().st_size == size > 8 * 2**20
    large.close()
    assert db.execute("SELECT count(*) FROM t").fetchone() == (2,)
    db.close()
