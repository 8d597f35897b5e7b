"""What arrives, chunk by chunk, on the disk: it outlives broken transfers and restarts, within bounds.

One folder an arriving thing: its manifest, its bytes at their places, and which chunks are there. What is said to be
there is believed only after it was digested again, so nothing needs to be synced on the way.
"""

import contextlib
import hashlib
import os
import shutil
import threading
from pathlib import Path

import msgspec

from appliance.errors import PayloadError, RefusedError
from appliance.pool.transfer.archive import FULL, no_room
from appliance.pool.transfer.manifest import Manifest, missing, reusable
from appliance.pool.transfer.settings import TransferConfig


class Arrival:
    """Something that arrives. Made by `Spool.open`; all methods but the properties block."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder, self.manifest = folder, manifest
        self.path = folder / "data"
        self._have: set[int] = set()
        self._marks = folder / "have"
        self._file = self._marks_file = -1
        self._lock = threading.Lock()
        """A chunk may still be written when whoever waited for it has been cancelled."""

    @property
    def what(self) -> str:
        """Kind and name, for messages."""
        return f"{self.manifest.kind} {self.manifest.name[:80]}"

    @property
    def have(self) -> frozenset[int]:
        """Chunks that are there and right."""
        return frozenset(self._have)

    @property
    def missing(self) -> list[int]:
        """Chunks that are not."""
        return missing(self.manifest, self._have)

    @property
    def bytes_there(self) -> int:
        """Bytes of the chunks that are there."""
        return sum(self.manifest.span(index)[1] for index in self._have)

    def open(self) -> None:
        """Make or open the files, and look which of the chunks that are said to be there are right.

        Raises:
            RefusedError: there is no room; nothing is left behind.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            (self.folder / "manifest").write_bytes(msgspec.json.encode(self.manifest))
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            if self.manifest.size_bytes:
                # Its whole room at once: a disk that is too full says so before anything was moved.
                os.posix_fallocate(self._file, 0, self.manifest.size_bytes)
                os.truncate(self._file, self.manifest.size_bytes)
            said = self._marks.read_bytes() if self._marks.exists() else b""
            for index in range(min(len(said), self.manifest.count)):
                if said[index] == 1 and self._is_right(index):
                    self._have.add(index)
            self._marks.write_bytes(bytes(index in self._have for index in range(self.manifest.count)))
            self._marks_file = os.open(self._marks, os.O_WRONLY | os.O_CLOEXEC)
        except OSError as error:
            self.remove()
            raise no_room(error, self.what) from error

    def _is_right(self, index: int) -> bool:
        offset, length = self.manifest.span(index)
        return hashlib.sha256(os.pread(self._file, length, offset)).digest() == self.manifest.chunk(index)

    def put(self, index: int, data: bytes) -> None:
        """Keep a chunk, if it is what was announced.

        Raises:
            PayloadError: it is not.
            RefusedError: there is no room; the whole arrival is removed, so that it makes some.
        """
        offset, length = self.manifest.span(index)
        if len(data) != length or hashlib.sha256(data).digest() != self.manifest.chunk(index):
            raise PayloadError(f"chunk {index} of {self.what} is not what was announced")
        with self._lock:
            if self._file < 0:
                raise RefusedError(f"{self.what} is not being fetched any more")
            self._keep(index, data, offset)

    def _keep(self, index: int, data: bytes, offset: int) -> None:
        try:
            self._write(data, offset)
            os.pwrite(self._marks_file, b"\x01", index)
        except OSError as error:
            if error.errno in FULL:
                self._end()
                shutil.rmtree(self.folder, ignore_errors=True)
            raise no_room(error, self.what) from error
        self._have.add(index)

    def _write(self, data: bytes, offset: int) -> None:
        view = memoryview(data)
        while view:
            written = os.pwrite(self._file, view, offset)
            view, offset = view[written:], offset + written

    def seed(self, other: Manifest, path: Path, have: frozenset[int]) -> int:
        """Copy what is the same as in something else that is here; returns the bytes that need not come."""
        copied = 0
        with contextlib.suppress(OSError), path.open("rb") as file:
            for index, source in reusable(self.manifest, other, have, self.missing).items():
                offset, length = other.span(source)
                data = os.pread(file.fileno(), length, offset)
                with contextlib.suppress(PayloadError):
                    self.put(index, data)
                    copied += length
        return copied

    def close(self) -> None:
        """Let go of the files; they stay for the next try."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        for handle in (self._file, self._marks_file):
            if handle >= 0:
                os.close(handle)
        self._file = self._marks_file = -1

    def remove(self) -> None:
        """Remove all of it."""
        self.close()
        shutil.rmtree(self.folder, ignore_errors=True)


class Spool:
    """The folder of what arrives at one gateway. Its methods block; one thread at a time uses an arrival."""

    def __init__(self, folder: Path, config: TransferConfig) -> None:
        self._folder, self._config = folder, config
        self._open: set[str] = set()

    def start(self) -> None:
        """Remove what cannot be gone on with, and what is beyond the bound."""
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        for folder in self._folder.iterdir():
            if self._manifest(folder) is None:
                shutil.rmtree(folder, ignore_errors=True)
        self.make_room(0)

    def open(self, manifest: Manifest) -> Arrival:
        """Go on with what arrives, or begin with it, with what an earlier state of the same thing has in common.

        Raises:
            RefusedError: it is arriving already, or there is no room.
        """
        if manifest.digest in self._open:
            raise RefusedError(f"{manifest.kind} {manifest.name[:80]} is arriving already", remedy="wait for that")
        self._open.add(manifest.digest)
        try:
            folder = self._folder / manifest.digest
            if not folder.exists():
                self.make_room(manifest.size_bytes)
            arrival = Arrival(folder, manifest)
            arrival.open()
            for other in self._folder.iterdir():
                before = None if other == folder else self._manifest(other)
                if before is None or (before.kind, before.name) != (manifest.kind, manifest.name):
                    continue
                if before.digest not in self._open:
                    self._take_over(arrival, other, before)
        except BaseException:
            self._open.discard(manifest.digest)
            raise
        return arrival

    def _take_over(self, arrival: Arrival, folder: Path, manifest: Manifest) -> None:
        """What arrived of an earlier state of the same thing serves this one; the rest of it will not be wanted."""
        marks = folder / "have"
        said = marks.read_bytes() if marks.exists() else b""
        have = frozenset(index for index in range(min(len(said), manifest.count)) if said[index] == 1)
        arrival.seed(manifest, folder / "data", have)
        shutil.rmtree(folder, ignore_errors=True)

    def close(self, arrival: Arrival) -> None:
        """Let go of an arrival; what there is of it stays."""
        arrival.close()
        self._open.discard(arrival.manifest.digest)

    def make_room(self, size_bytes: int) -> None:
        """Remove what was touched longest ago until so much more fits.

        Raises:
            RefusedError: it does not, on the disk or within `spool_mb`.
        """
        resting = sorted(
            (folder.stat().st_mtime, folder) for folder in self._folder.iterdir() if folder.name not in self._open
        )
        bound, reserve = self._config.spool_mb * 2**20, self._config.reserve_mb * 2**20
        while True:
            used = sum(_size(folder) for folder in self._folder.iterdir())
            free = shutil.disk_usage(self._folder).free
            if used + size_bytes <= bound and (not size_bytes or free - size_bytes >= reserve):
                return
            if not resting:
                if not size_bytes:
                    return
                raise RefusedError(
                    f"{size_bytes:,} bytes do not fit: {free:,} are free on the disk of {self._folder}, "
                    f"{reserve:,} stay so; {used:,} of {bound:,} are taken by other transfers",
                    remedy="free space there, or change pool.transfer.spool_mb or reserve_mb",
                )
            shutil.rmtree(resting.pop(0)[1], ignore_errors=True)

    def _manifest(self, folder: Path) -> Manifest | None:
        try:
            manifest = msgspec.json.decode((folder / "manifest").read_bytes(), type=Manifest)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError):
            return None
        return manifest if manifest.digest == folder.name else None


def _size(folder: Path) -> int:
    total = 0
    with contextlib.suppress(OSError):
        for each in folder.iterdir():
            total += each.stat().st_blocks * 512
    return total
