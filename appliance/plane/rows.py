"""Records as rows of the gateway's SQLite file (`file` has the tables)."""

import sqlite3
import time

import msgspec

from appliance.model import VersionVector
from appliance.plane.versions import Record, digest

COLUMNS = "key, value, version, deleted, write"


def put_row(db: sqlite3.Connection, record: Record) -> None:
    """Write a record."""
    db.execute(
        "INSERT OR REPLACE INTO records VALUES (?, ?, ?, ?, ?, ?, ?)",
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
    row = db.execute(f"SELECT {COLUMNS} FROM records WHERE key = ?", (key,)).fetchone()  # noqa: S608 - a text of ours
    return None if row is None else from_row(row)


def from_row(row: tuple[str, bytes, str, int, str]) -> Record:
    """A record of its columns."""
    key, value, version, deleted, write = row
    return Record(
        key=key,
        value=value,
        version=msgspec.json.decode(version, type=VersionVector),
        deleted=bool(deleted),
        write=write,
    )


def prefixed(prefix: str) -> tuple[str, tuple[str, ...]]:
    """The condition for keys of a prefix, so that the index serves it; code points end at U+10FFFF."""
    return ("WHERE key >= ? AND key < ?", (prefix, prefix + "\U0010ffff")) if prefix else ("", ())
