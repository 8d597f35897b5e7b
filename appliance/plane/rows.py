"""Rows of the gateway's SQLite file (`file` has the tables).

Many rows come as one JSON text for each page of them. The `sqlite3` module gives up the interpreter's lock for every
row it steps to, and waits for it again, up to the switch interval of 5 ms while another thread computes: 10,000 keys
and digests took 7 ms alone and 4.6 s beside a busy thread, in pages 8 ms and 15 ms.
"""

import sqlite3
import time
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeVar

import msgspec

from appliance.model import VersionVector
from appliance.plane.versions import Record, digest

T = TypeVar("T", bound=tuple[Any, ...])

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
    decoder: "msgspec.json.Decoder[list[T]]",
    most: int,
    page_of: Page = Page(),  # noqa: B008 - immutable
) -> Iterator[T]:
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
