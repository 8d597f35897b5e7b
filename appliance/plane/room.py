"""Room in SQLite's write-ahead log: blocks written with zeros before a commit needs them.

A commit that makes the file longer has the file system write down its new length and blocks too, which takes as long
again as the data (and the commits of other gateways on the same disk wait for it); one that overwrites does not. SQLite
overwrites its log from the start once it has been checkpointed, after some 1,000 pages; until then it appends. Here it
finds zeros instead, which are no frames of it: a log that is read after a crash ends before them.
"""

import contextlib
import os
from pathlib import Path

import structlog

log = structlog.get_logger(__name__)

_FIRST = 4352 * 1024
"""As much as SQLite appends before it begins anew: some 1,000 pages with their headers."""
_STEP = 128 * 1024
"""At a time, between two commits: half a millisecond."""
_MOST = 8 * 2**20
"""More than a log has before it is overwritten."""


class Room:
    """The room in one log; for the one thread that writes it, between its commits."""

    def __init__(self, database: Path) -> None:
        self._path = database.with_name(f"{database.name}-wal")
        self._file: int | None = None
        self._size = 0
        """Of the file, as it was left here; it is longer when a commit had no room."""
        self._wanted = 0
        """How long it is to become."""
        self._given_up = False

    def make(self) -> None:
        """Make room if a commit had none, as much again as there was, a step at a time; what cannot be done is left."""
        if self._given_up:
            return
        try:
            if self._file is None:
                self._file = os.open(self._path, os.O_WRONLY | os.O_CLOEXEC)
            size = os.fstat(self._file).st_size
            if size > self._size:
                self._wanted = min(max(2 * size, size + _FIRST), _MOST)
                self._given_up = size >= _MOST
            if size < self._wanted:
                size += os.pwrite(self._file, bytes(min(_STEP, self._wanted - size)), size)
                # The next commit is not to wait for it.
                os.fdatasync(self._file)
            self._size = size
        except OSError as error:
            # A full disk: the next commit will say so.
            self._given_up = True
            log.info("no room is made in the store's log", path=str(self._path), reason=str(error))

    def close(self) -> None:
        """Make no more."""
        self._given_up = True
        if self._file is not None:
            with contextlib.suppress(OSError):
                os.close(self._file)
            self._file = None
