"""Many rows of the store at once, in pages."""

import sqlite3
from collections.abc import Iterator
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model.plane_api import Record
from appliance.plane import store
from appliance.plane.records import digest
from appliance.plane.store import TABLES, put_row, read_digests, read_kept, read_keys, read_records

_KEYS = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\U0010ffff"), min_size=1, max_size=6)
_RECORDS = st.dictionaries(
    _KEYS,
    st.builds(
        Record,
        key=st.just(""),
        value=st.binary(max_size=40),
        version=st.dictionaries(_KEYS, st.integers(1, 2**62), max_size=3),
        deleted=st.booleans(),
        write=st.text(st.characters(exclude_categories=("Cs",)), max_size=8),
    ),
    max_size=12,
).map(lambda found: [replace(each, key=key) for key, each in found.items()])


@pytest.fixture(autouse=True)
def small_pages() -> Iterator[None]:
    """Several pages of a few rows."""
    with patch.object(store, "_MOST_NAMES", 3), patch.object(store, "_MOST_VALUES", 2):
        yield


def _file() -> sqlite3.Connection:
    db = sqlite3.connect(":memory:", isolation_level=None)
    db.executescript(TABLES)
    return db


@given(_RECORDS, _KEYS)
def test_pages_of_records_hold_what_was_put(records: list[Record], prefix: str) -> None:
    """Records of any text and bytes come back as they were, in order of keys, with a prefix and without."""
    db = _file()
    for record in records:
        put_row(db, record)
    ordered = sorted(records, key=lambda each: each.key.encode())
    assert read_records(db, "") == ordered
    assert list(read_keys(db)) == [each.key for each in ordered]
    assert read_digests(db) == [(each.key, digest(each)) for each in ordered]
    assert read_records(db, prefix[:1]) == [each for each in ordered if each.key.startswith(prefix[:1])]


@given(st.dictionaries(_KEYS, st.binary(max_size=20), max_size=12), _KEYS)
def test_pages_of_plain_keys_hold_what_was_put(kept: dict[str, bytes], prefix: str) -> None:
    """Plain keys of any text come back with their bytes, in order, with a prefix and without."""
    db = _file()
    db.executemany("INSERT INTO kept VALUES (?, ?)", kept.items())
    ordered = sorted(kept.items(), key=lambda each: each[0].encode())
    assert read_kept(db, "") == ordered
    assert read_kept(db, prefix) == [each for each in ordered if each[0].startswith(prefix)]


def test_large_values_come_in_smaller_pages() -> None:
    """Where a page is longer than SQLite lets a text be, all rows come all the same; a row that is alone fails."""
    db = _file()
    records = [Record(key=f"k{number:02}", value=b"x" * (900 if number % 3 else 9), write="w") for number in range(10)]
    for record in records:
        put_row(db, record)
    db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2500)
    with patch.object(store, "_MOST_VALUES", 8):
        assert read_records(db, "k") == records
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 1500)
        with pytest.raises(sqlite3.DataError):
            read_records(db, "k")
