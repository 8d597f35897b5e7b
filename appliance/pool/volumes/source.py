"""The source of a transfer: manifests and chunks for gateways that ask.

Chunks are answered outside the RPC: raw bytes, of low priority, in a queue of their own, and in no exchange record.

`Offers` is what this gateway keeps ready to give: snapshots of volumes and blobs of images, by digest, within bounds.
Each is a file and its manifest. What an earlier life of this gateway left is given too, but each chunk is digested
again before: a file that rotted, or that a power cut left half, must not be handed on.
"""

import asyncio
import contextlib
import hashlib
import io
import os
import shutil
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import structlog
import zstandard

from appliance.errors import NotFoundError, PayloadError, PoolError, RefusedError
from appliance.model import keyspace
from appliance.model.transfer_api import ImageLayout, Manifest, ManifestAsk, ManifestOffer
from appliance.plane.node import Plane
from appliance.plane.session import Closer
from appliance.pool.engine import PodmanEngine
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes.archive import Digests, no_room, pack
from appliance.pool.volumes.protocol import check_manifest, is_digest
from appliance.pool.volumes.registry import Volumes

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
            raise PayloadError(f"chunk {index} of {self.manifest.count}", remedy="ask for the manifest again")
        offset, length = self.manifest.span(index)
        try:
            with self.path.open("rb") as file:
                data = os.pread(file.fileno(), length, offset)
        except OSError as error:
            raise NotFoundError(f"{self.manifest.digest[:12]} is not kept here any more") from error
        whole = len(data) == length
        if not whole or (not self._checked and hashlib.sha256(data).digest() != self.manifest.chunk(index)):
            raise NotFoundError(f"{self.manifest.digest[:12]} is damaged here", remedy="ask for the manifest again")
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
            check_manifest(
                manifest, kind=manifest.kind, name=manifest.name, most_bytes=file.with_suffix(".data").stat().st_size
            )
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, PayloadError, RefusedError):
            return None
        return manifest if manifest.digest == file.stem else None

    def draft(self) -> Path:
        """Return the path of a new file in the same folder; an `add` takes it in."""
        return self.folder / f"draft-{os.urandom(6).hex()}"

    def add(self, manifest: Manifest, path: Path) -> Offer:
        """Take in a file, which must be in the same file system; an older state of the same thing is dropped."""
        with self._lock:
            digest = manifest.digest
            for each in list(self._offers.values()):
                old = each.manifest
                if (old.kind, old.name) == (manifest.kind, manifest.name) and old.digest != digest:
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


log = structlog.get_logger(__name__)

ACCEPT_ZSTD = b"zstd"
"""A question for a chunk with this payload may be answered compressed."""
ANSWER_S = 2.0
"""How long a question waits for what is made ready before it is answered with `pending`."""
_JOBS = 8
_COPY = 2**20
REFERENCE_PREFIX = "localhost/"
"""Only images of this machine's own making are given: what came from a registry may not be ours to hand on."""


def may_be_given(reference: str) -> bool:
    """Whether an image of that name is one that gateways give each other."""
    return reference.startswith(REFERENCE_PREFIX) and len(reference) <= 300


def content_digest(path: Path) -> str:
    """SHA-256 of a file. Blocks."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Giver:
    """Answers for one gateway."""

    def __init__(
        self,
        config: TransferConfig,
        *,
        plane: Plane,
        volumes: Volumes,
        storage: PodmanEngine,
        offers: Offers,
        refused: Counter[str],
    ) -> None:
        self._config, self._plane, self._volumes = config, plane, volumes
        self._storage, self.offers, self._refused = storage, offers, refused
        self._threads = ThreadPoolExecutor(max_workers=2, thread_name_prefix="giving")
        self._serving = 0
        self._jobs: dict[str, asyncio.Task[ManifestOffer]] = {}
        self._closer: Closer | None = None
        self.chunk_bytes = min(config.chunk_kb * 2**10, plane.config.max_payload_bytes // 2)

    def start(self) -> None:
        """Serve."""
        plane = self._plane
        plane.rpc.register(keyspace.TRANSFER_MANIFEST, self._on_manifest)
        self._closer = plane.session.serve(plane.keys(keyspace.CHUNK, plane.gateway), self._on_chunk, bulk=True)

    async def close(self) -> None:
        """Serve no more."""
        if self._closer is not None:
            self._closer.close()
        for job in self._jobs.values():
            job.cancel()
        await asyncio.gather(*self._jobs.values(), return_exceptions=True)
        await asyncio.to_thread(self._threads.shutdown, wait=True, cancel_futures=True)

    # --- chunks -----------------------------------------------------------------------------------------------

    async def _on_chunk(self, key: str, payload: bytes) -> bytes:
        _, digest, index = keyspace.CHUNK.names(key)
        if not index.isdecimal() or len(index) > 9:
            raise PayloadError(f"{index[:20]!r} is no chunk", remedy="docs/keyspace.md has the keys")
        offer = self.offers.get(digest)
        if offer is None:
            raise NotFoundError(f"{digest[:12]} is not kept on {self._plane.gateway}", remedy="ask for its manifest")
        if self._serving >= self._config.serving:
            self._refused["transfer busy"] += 1
            raise RefusedError(f"{self._serving} chunks are being read", remedy="ask again in a moment")
        self._serving += 1
        try:
            chunk = partial(offer.chunk, int(index), zstd=payload == ACCEPT_ZSTD)
            return await asyncio.get_running_loop().run_in_executor(self._threads, chunk)
        except NotFoundError:
            self._refused["transfer damaged here"] += 1
            self.offers.drop(digest)
            raise
        finally:
            self._serving -= 1

    # --- manifests --------------------------------------------------------------------------------------------

    async def _on_manifest(self, ask: ManifestAsk) -> ManifestOffer:
        match ask.kind:
            case "volume":
                return await self._prepared(f"volume/{ask.name}", self._snapshot(ask.name))
            case "image":
                return await self._prepared(f"image/{ask.name}", self._lay_out(ask.name))
            case "blob":
                offer = self.offers.find("blob", ask.name)
                if offer is None:
                    raise NotFoundError(
                        f"blob {ask.name[:12]} is not kept on {self._plane.gateway}", remedy="ask for its image"
                    )
                return ManifestOffer(manifest=offer.manifest)
            case other:
                raise PayloadError(f"{other[:20]!r} is nothing that is moved", remedy="volume, image or blob")

    async def _prepared(self, what: str, making: Coroutine[Any, Any, ManifestOffer]) -> ManifestOffer:
        """Return what is made ready, by one job however many ask; pending when it takes longer."""
        job = self._jobs.get(what)
        if job is None:
            # What nobody came back for is kept among the offers all the same.
            self._jobs = {name: each for name, each in self._jobs.items() if not each.done()}
            if len(self._jobs) >= _JOBS:
                self._refused["transfer busy"] += 1
                making.close()
                raise RefusedError(f"{_JOBS} things are being made ready", remedy="ask again in a moment")
            job = self._jobs[what] = asyncio.create_task(self._made(making), name=f"make {what} ready")
            job.add_done_callback(_seen)
        else:
            making.close()
        done, _ = await asyncio.wait([job], timeout=ANSWER_S)
        if not done:
            return ManifestOffer(pending=True)
        self._jobs.pop(what, None)
        return job.result()

    async def _made(self, making: Awaitable[ManifestOffer]) -> ManifestOffer:
        async with asyncio.timeout(self._config.prepare_s):
            return await making

    async def _snapshot(self, name: str) -> ManifestOffer:
        """Our newest state of a volume, packed unless it is packed already."""
        began = time.monotonic()
        kept = self.offers.find("volume", name)
        draft = self.offers.draft()

        def work(folder: Path) -> Manifest:
            return pack(
                folder,
                draft,
                name=name,
                chunk_bytes=self.chunk_bytes,
                most_files=self._config.most_files,
                most_bytes=self._config.most_mb * 2**20,
            )

        await asyncio.to_thread(self.offers.make_room, self._volumes.state(name).size_bytes)
        try:
            manifest = await self._volumes.packed(name, kept.manifest if kept else None, work)
            if kept is not None and manifest is kept.manifest:
                return ManifestOffer(manifest=manifest)
            await asyncio.to_thread(self.offers.add, manifest, draft)
        finally:
            await asyncio.to_thread(draft.unlink, missing_ok=True)
        return ManifestOffer(manifest=manifest, pack_ms=(time.monotonic() - began) * 1e3)

    # --- images -----------------------------------------------------------------------------------------------

    async def _lay_out(self, reference: str) -> ManifestOffer:
        """The layout of an image, each part that it names kept ready too."""
        if not may_be_given(reference):
            self._refused["image not given"] += 1
            raise NotFoundError(f"{reference[:100]!r} is not given", remedy=f"only {REFERENCE_PREFIX}… are")
        facts = await self._storage.image(reference)
        parts = (facts.id, *facts.layers)
        if any(self.offers.find("blob", each) is None for each in parts):
            await asyncio.to_thread(self.offers.make_room, facts.size_bytes)
            began = time.monotonic()
            await self._storage.export_image(facts.id, self._keep_blob)
            took_ms = round((time.monotonic() - began) * 1e3)
            log.info("image made ready for others", image=reference, size=facts.size_bytes, duration_ms=took_ms)
        if gone := [each[:12] for each in parts if self.offers.find("blob", each) is None]:
            raise PoolError(
                f"Podman gave image {reference} without {', '.join(gone)}",
                remedy="raise pool.transfer.cache_mb if the image is larger than that",
            )
        layout = msgspec.json.encode(ImageLayout(reference=reference, image_id=facts.id, layers=facts.layers))
        offer = await asyncio.to_thread(self._keep, "image", reference, io.BytesIO(layout))
        return ManifestOffer(manifest=offer.manifest)

    def _keep_blob(self, digest: str, body: BinaryIO) -> None:
        """Take a blob as it comes from Podman; blocks."""
        if self.offers.find("blob", digest) is None:
            offer = self._keep("blob", digest, body)
            if content_digest(offer.path) != digest:
                self.offers.drop(offer.manifest.digest)
                log.warning("Podman gave a blob that is not what it says", blob=digest)

    def _keep(self, kind: str, name: str, body: BinaryIO) -> Offer:
        """Take something to be given, as it comes; blocks."""
        draft, digests = self.offers.draft(), Digests(self.chunk_bytes)
        try:
            with draft.open("wb") as out:
                while data := body.read(_COPY):
                    out.write(data)
                    digests.update(data)
            return self.offers.add(digests.manifest(kind, name), draft)
        except OSError as error:
            raise no_room(error, f"{kind} {name[:80]}") from error
        finally:
            draft.unlink(missing_ok=True)


def _seen(job: asyncio.Task[ManifestOffer]) -> None:
    """A job that failed when nobody waited any more is no fault of the event loop's."""
    if not job.cancelled() and job.exception() is not None:
        log.info("not made ready", job=job.get_name(), reason=str(job.exception()))
