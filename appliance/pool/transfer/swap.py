"""Putting a new state in the place of a volume's old one, so that either is whole whenever the power goes.

Containers have the volume's folder mounted, so the folder itself must stay: what is in it is moved out, and the
new moved in, by renames on one file system, after a journal on the disk says which. Whoever finds a journal goes
on from it, forward; there is nothing to undo.
"""

import ctypes
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance.model import VersionVector

WORK = ".swiftbot"
"""Folder beside the volume's own, of the same file system and removed with the volume."""
_libc = ctypes.CDLL(None, use_errno=True)


class Journal(Struct, frozen=True, kw_only=True):
    """A swap that has begun: everything needed to end it."""

    old: tuple[bytes, ...]
    """Names in the volume before, as the file system has them."""
    new: tuple[bytes, ...]
    """Names in the new state."""
    version: VersionVector
    writer: str
    keep: str = ""
    """Name of the volume that the old state is kept in; empty: it is removed."""


class Place:
    """Where a volume lies (`root`, its mount point) and the work area beside it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.work = root.parent / WORK
        self.incoming = self.work / "incoming"
        self.outgoing = self.work / "outgoing"
        self._journal = self.work / "journal"

    def prepare(self) -> Path:
        """Return the empty folder for a new state; what an earlier try left is removed."""
        shutil.rmtree(self.work, ignore_errors=True)
        self.incoming.mkdir(parents=True, mode=0o700)
        self.outgoing.mkdir(mode=0o700)
        return self.incoming

    def begin(self, version: VersionVector, writer: str, *, keep: str = "") -> Journal:
        """Decide, on the disk, that what lies in `incoming` takes the place; from here on it will. Blocks."""
        journal = Journal(
            old=_names(self.root),
            new=_names(self.incoming),
            version=version,
            writer=writer,
            keep=keep,
        )
        sync(self.incoming)
        draft = self.work / "journal.draft"
        with draft.open("wb") as out:
            out.write(msgspec.json.encode(journal))
            out.flush()
            os.fsync(out.fileno())
        draft.replace(self._journal)
        sync_folder(self.work)
        return journal

    def journal(self) -> Journal | None:
        """Return the swap that has begun and not ended; None when there is none that counts."""
        try:
            return msgspec.json.decode(self._journal.read_bytes(), type=Journal)
        except (FileNotFoundError, NotADirectoryError, msgspec.DecodeError):
            return None

    def steps(self, journal: Journal) -> Iterator[tuple[Path, Path]]:
        """The renames that are still to be done, each (from, to), each asked for after the one before was done."""
        for raw in journal.old:
            name = os.fsdecode(raw)
            old, out = self.root / name, self.outgoing / name
            is_new = raw in journal.new and not os.path.lexists(self.incoming / name)
            if os.path.lexists(old) and not is_new and not os.path.lexists(out):
                yield old, out
        for name in map(os.fsdecode, journal.new):
            if os.path.lexists(self.incoming / name):
                yield self.incoming / name, self.root / name

    def finish(self, journal: Journal) -> None:
        """Do what is still to be done. Blocks."""
        for source, target in self.steps(journal):
            source.rename(target)
        sync_folder(self.root)
        sync_folder(self.outgoing)

    def forget(self) -> None:
        """The swap is done and noted: remove the journal, then all that is left. Blocks."""
        self._journal.unlink(missing_ok=True)
        shutil.rmtree(self.work, ignore_errors=True)


def _names(folder: Path) -> tuple[bytes, ...]:
    return tuple(sorted(os.fsencode(each.name) for each in folder.iterdir()))


def sync_folder(folder: Path) -> None:
    """Have a folder's entries on the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync(folder: Path) -> None:
    """Have all that was written to a folder's file system on the disk: syncfs(2), one call for however many files."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if _libc.syncfs(handle) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    finally:
        os.close(handle)
