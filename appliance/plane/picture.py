"""The committed records in memory: reads on the event loop are answered from it, without the store's thread.

It is written only after a commit, by the store's thread, so that nobody is told what a failing disk could still take
back. All keys are known, so that it can say that there is no such record; of the records as many as fit, those used
last.
"""

import threading
from collections import OrderedDict
from collections.abc import Iterable

from appliance.plane.versions import Record

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
