"""What this gateway keeps ready to give: snapshots of volumes and blobs of images, by digest, within bounds.

Each is a file and its manifest. What an earlier life of this gateway left is given too, but each chunk is digested
again before: a file that rotted, or that a power cut left half, must not be handed on.
"""

import contextlib
import hashlib
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import zstandard

from appliance.errors import NotFoundError, PayloadError, RefusedError
from appliance.pool.transfer.manifest import Manifest, check, is_digest
from appliance.pool.transfer.settings import TransferConfig

PLAIN, ZSTD = b"\x00", b"\x01"
"""First byte of a chunk's answer: as it is, or compressed."""
_LEVEL = 1
"""Compressing must not be slower than a fast link; level 1 takes text to a third at 300 MB/s."""
_WORTH = 0.9


class Offer:
    """Something that can be given."""

    def __init__(self, path: Path, manifest: Manifest, *, checked: bool) -> None:
        self.path, self.manifest = path, manifest
        self._checked = checked
        self._plain = 0

    def chunk(self, index: int, *, zstd: bool) -> bytes:
        """Return the answer to a question for a chunk. Blocks.

        Raises:
            NotFoundError: the file is gone, or no longer what it was.
        """
        if not 0 <= index < self.manifest.count:
            raise PayloadError(f"chunk {index} of {self.manifest.count}", remedy="ask for the manifest anew")
        offset, length = self.manifest.span(index)
        try:
            with self.path.open("rb") as file:
                data = os.pread(file.fileno(), length, offset)
        except OSError as error:
            raise NotFoundError(f"{self.manifest.digest[:12]} is not kept here any more") from error
        whole = len(data) == length
        if not whole or (not self._checked and hashlib.sha256(data).digest() != self.manifest.chunk(index)):
            raise NotFoundError(f"{self.manifest.digest[:12]} is damaged here", remedy="ask for the manifest anew")
        if not zstd or (self._plain > 3 and index % 16):
            return PLAIN + data
        packed = zstandard.ZstdCompressor(level=_LEVEL).compress(data)
        if len(packed) > _WORTH * length:
            self._plain += 1  # pictures and weights: tried again now and then only
            return PLAIN + data
        self._plain = 0
        return ZSTD + packed


def opened(answer: bytes, length: int) -> bytes:
    """Return the chunk in an answer; PayloadError when there is none of that length in it."""
    kind, body = answer[:1], answer[1:]
    if kind == PLAIN and len(body) == length:
        return body
    if kind == ZSTD:
        with contextlib.suppress(zstandard.ZstdError):
            # What it claims to be is checked before it is unpacked.
            if zstandard.frame_content_size(body) == length:
                return zstandard.ZstdDecompressor().decompress(body, max_output_size=length)
    raise PayloadError(f"an answer of {len(answer):,} bytes with no chunk of {length:,} in it")


class Offers:
    """The folder of what can be given; any thread may ask. `find` and `get` are quick, the others block."""

    def __init__(self, folder: Path, config: TransferConfig) -> None:
        self.folder, self._config = folder, config
        self._lock = threading.RLock()
        self._offers: dict[str, Offer] = {}
        """By digest, the longest unused first."""

    def start(self) -> None:
        """Take up what an earlier life left."""
        with self._lock:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            for file in sorted(self.folder.iterdir(), key=lambda each: each.stat().st_mtime):
                manifest = self._read(file) if file.suffix == ".json" else None
                if manifest is not None:
                    self._offers[manifest.digest] = Offer(file.with_suffix(".data"), manifest, checked=False)
            known = {name for digest in self._offers for name in (f"{digest}.json", f"{digest}.data")}
            for file in self.folder.iterdir():
                if file.name not in known:
                    with contextlib.suppress(OSError):
                        file.unlink()
            self.make_room(0)

    def _read(self, file: Path) -> Manifest | None:
        try:
            manifest = msgspec.json.decode(file.read_bytes(), type=Manifest)
            check(manifest, kind=manifest.kind, name=manifest.name, most_bytes=file.with_suffix(".data").stat().st_size)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, PayloadError, RefusedError):
            return None
        return manifest if manifest.digest == file.stem else None

    def draft(self) -> Path:
        """Return the path of a new file in the same folder; an `add` takes it in."""
        return self.folder / f"draft-{os.urandom(6).hex()}"

    def add(self, manifest: Manifest, path: Path) -> Offer:
        """Take in a file, which must be in the same file system; an older snapshot of the volume is dropped."""
        with self._lock:
            digest = manifest.digest
            for each in list(self._offers.values()):
                old = each.manifest
                if old.kind == manifest.kind == "volume" and old.name == manifest.name and old.digest != digest:
                    self.drop(old.digest)
            target = self.folder / f"{digest}.data"
            path.replace(target)
            (self.folder / f"{digest}.json").write_bytes(msgspec.json.encode(manifest))
            offer = self._offers[digest] = Offer(target, manifest, checked=True)
            self.make_room(0, spare=digest)
            return offer

    def drop(self, digest: str) -> None:
        """Give something no longer."""
        with self._lock:
            if self._offers.pop(digest, None) is not None:
                for suffix in (".json", ".data"):
                    (self.folder / f"{digest}{suffix}").unlink(missing_ok=True)

    def get(self, digest: str) -> Offer | None:
        """Return what can be given under a digest, and note that it is wanted."""
        with self._lock:
            offer = self._offers.pop(digest, None) if is_digest(digest) else None
            if offer is not None:
                self._offers[digest] = offer
            return offer

    def find(self, kind: str, name: str) -> Offer | None:
        """Return what can be given of that kind and name."""
        with self._lock:
            for offer in reversed(self._offers.values()):
                if (offer.manifest.kind, offer.manifest.name) == (kind, name) and offer.path.exists():
                    return offer
            return None

    def __iter__(self) -> Iterator[Offer]:
        with self._lock:
            return iter(tuple(self._offers.values()))

    def make_room(self, size_bytes: int, *, spare: str = "") -> None:
        """Drop what was wanted longest ago until so much more fits; RefusedError when the disk has not so much."""
        with self._lock:
            bound, reserve = self._config.cache_mb * 2**20, self._config.reserve_mb * 2**20
            for each in list(self._offers.values()):
                used = sum(offer.manifest.size_bytes for offer in self._offers.values())
                if used + size_bytes <= bound and shutil.disk_usage(self.folder).free - size_bytes >= reserve:
                    return
                if each.manifest.digest != spare:
                    self.drop(each.manifest.digest)
            free = shutil.disk_usage(self.folder).free
            if size_bytes and free - size_bytes < reserve:
                raise RefusedError(
                    f"{size_bytes:,} bytes to be given do not fit on the disk of {self.folder}: {free:,} are free",
                    remedy="free space there, or lower pool.transfer.reserve_mb",
                )
