"""The giving side: manifests, chunks and images' layouts for gateways that ask.

Chunks are answered outside the RPC: raw bytes, of low priority, in a queue of their own, and in no exchange record.
"""

import asyncio
import hashlib
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import BinaryIO, TypeVar

import structlog

from appliance.errors import NotFoundError, PayloadError, PoolError, RefusedError
from appliance.plane.node import Plane
from appliance.plane.session import Closer
from appliance.pool.storage import PodmanStorage
from appliance.pool.transfer.api import ImageAsk, ImageLayout, ImageOffer, ManifestAsk, ManifestOffer
from appliance.pool.transfer.archive import Digests, no_room, pack
from appliance.pool.transfer.manifest import Manifest
from appliance.pool.transfer.offers import Offers
from appliance.pool.transfer.settings import TransferConfig
from appliance.pool.volumes import Volumes

log = structlog.get_logger(__name__)

T = TypeVar("T")

ZSTD = b"zstd"
"""A question for a chunk with this payload may be answered compressed."""
ANSWER_S = 2.0
"""How long a question waits for what is made ready before it is answered with `pending`."""
_JOBS = 8
_COPY = 2**20
REFERENCE_PREFIX = "localhost/"
"""Only images of this machine's own making are given: what came from a registry may not be ours to hand on."""


class Giver:
    """Answers for one gateway."""

    def __init__(
        self,
        config: TransferConfig,
        *,
        plane: Plane,
        volumes: Volumes,
        storage: PodmanStorage,
        offers: Offers,
        refused: Counter[str],
    ) -> None:
        self._config, self._plane, self._volumes = config, plane, volumes
        self._storage, self.offers, self._refused = storage, offers, refused
        self._threads = ThreadPoolExecutor(max_workers=2, thread_name_prefix="giving")
        self._serving = 0
        self._jobs: dict[str, asyncio.Task[object]] = {}
        self._closer: Closer | None = None
        self.chunk_bytes = min(config.chunk_kb * 2**10, plane.config.max_payload_bytes // 2)

    def start(self) -> None:
        """Serve."""
        plane = self._plane
        plane.rpc.register("transfer_manifest", ManifestAsk, self._on_manifest)
        plane.rpc.register("image_layout", ImageAsk, self._on_image)
        self._closer = plane.session.serve(plane.keys.chunk(plane.gateway), self._on_chunk, bulk=True)

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
        digest, _, index = key.rpartition("/chunk/")[2].partition("/")
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
            chunk = partial(offer.chunk, int(index), zstd=payload == ZSTD)
            return await asyncio.get_running_loop().run_in_executor(self._threads, chunk)
        except NotFoundError:
            self._refused["transfer damaged here"] += 1
            self.offers.drop(digest)
            raise
        finally:
            self._serving -= 1

    # --- manifests --------------------------------------------------------------------------------------------

    async def _on_manifest(self, ask: ManifestAsk) -> ManifestOffer:
        if ask.kind == "blob":
            offer = self.offers.find("blob", ask.name)
            if offer is None:
                raise NotFoundError(
                    f"blob {ask.name[:12]} is not kept on {self._plane.gateway}", remedy="ask for its image's layout"
                )
            return ManifestOffer(manifest=offer.manifest)
        if ask.kind != "volume":
            raise PayloadError(f"{ask.kind[:20]!r} is nothing that is moved", remedy="volume or blob")
        found = await self._prepared(f"volume/{ask.name}", partial(self._snapshot, ask.name))
        return found or ManifestOffer(pending=True)

    async def _prepared(self, what: str, make: Callable[[], Awaitable[T]]) -> T | None:
        """Return what is made ready, by one job however many ask; None when it takes longer."""
        job = self._jobs.get(what)
        if job is None:
            # What nobody came back for is kept among the offers all the same.
            self._jobs = {name: each for name, each in self._jobs.items() if not each.done()}
            if len(self._jobs) >= _JOBS:
                self._refused["transfer busy"] += 1
                raise RefusedError(f"{_JOBS} things are being made ready", remedy="ask again in a moment")
            job = self._jobs[what] = asyncio.create_task(self._made(make), name=f"make {what} ready")
            job.add_done_callback(_seen)
        done, _ = await asyncio.wait([job], timeout=ANSWER_S)
        if not done:
            return None
        self._jobs.pop(what, None)
        return job.result()  # pyright: ignore[reportReturnType] - one kind of thing for one name

    async def _made(self, make: Callable[[], Awaitable[object]]) -> object:
        async with asyncio.timeout(self._config.prepare_s):
            return await make()

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

    async def _on_image(self, ask: ImageAsk) -> ImageOffer:
        if not ask.reference.startswith(REFERENCE_PREFIX) or len(ask.reference) > 300:
            self._refused["image not given"] += 1
            raise RefusedError(f"{ask.reference[:100]!r} is not given", remedy=f"only {REFERENCE_PREFIX}… are")
        return await self._prepared(f"image/{ask.reference}", partial(self._lay_out, ask.reference)) or ImageOffer(
            pending=True
        )

    async def _lay_out(self, reference: str) -> ImageOffer:
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
        return ImageOffer(layout=ImageLayout(reference=reference, image_id=facts.id, layers=facts.layers))

    def _keep_blob(self, digest: str, body: BinaryIO) -> None:
        """Take a blob as it comes from Podman; blocks."""
        if self.offers.find("blob", digest) is not None:
            return
        draft, digests, content = self.offers.draft(), Digests(self.chunk_bytes), hashlib.sha256()
        try:
            with draft.open("wb") as out:
                while data := body.read(_COPY):
                    out.write(data)
                    digests.update(data)
                    content.update(data)
            if content.hexdigest() == digest:
                self.offers.add(digests.manifest("blob", digest), draft)
            else:
                log.warning("Podman gave a blob that is not what it says", blob=digest)
        except OSError as error:
            raise no_room(error, f"blob {digest[:12]}") from error
        finally:
            draft.unlink(missing_ok=True)


def _seen(job: asyncio.Task[object]) -> None:
    """A job that failed when nobody waited any more is no fault of the event loop's."""
    if not job.cancelled() and job.exception() is not None:
        log.info("not made ready", job=job.get_name(), reason=str(job.exception()))
