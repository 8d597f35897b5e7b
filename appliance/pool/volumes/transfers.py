"""The door of transfers: bring a volume's newest state or an image here, and give ours to others.

Guarantees:
    - What was there stays whole until what arrived is verified whole; a transfer that breaks changes nothing.
    - A broken transfer goes on where it was when it is asked for again, from the same gateway or another.
    - Transfers, what they hold on the disk and what is on its way are bounded (`TransferConfig`).

Images need no registry: any gateway that has one gives it. The layers that are not here are fetched, an OCI archive is
built of them, loaded and verified. Layers travel uncompressed by their SHA-256, compressed chunk by chunk on the way,
so a layer is the same thing on every gateway, and one that is here is never asked for.
"""

import asyncio
import contextlib
import hashlib
import secrets
import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import structlog

from appliance.errors import (
    CancelledByOperatorError,
    IdentityError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.identity.parts import ALL, InForce, Kind
from appliance.model import keyspace
from appliance.model.transfer_api import (
    Brought,
    CancelAsk,
    Cancelled,
    FetchAsk,
    ImageLayout,
    Manifest,
    Progress,
    TransferList,
    TransfersAsk,
)
from appliance.plane.node import Plane
from appliance.pool.engine import PodmanEngine
from appliance.pool.oci import oci_archive
from appliance.pool.selection import UNMEASURED, Link
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes.lineage import Relation, VolumeRecord, relation
from appliance.pool.volumes.protocol import is_digest
from appliance.pool.volumes.registry import Volumes
from appliance.pool.volumes.source import REFERENCE_PREFIX, Giver, Offers, content_digest, may_be_given
from appliance.pool.volumes.target import Arrival, Fetcher, Job, Spool

MOST_LAYERS = 128
MOST_CONFIG = 4 * 2**20
MOST_LAYOUT = 64 * 2**10
"""Several times what `MOST_LAYERS` digests take."""


def read_layout(data: bytes, reference: str) -> ImageLayout:
    """Return what a gateway says an image is made of; PayloadError when it cannot be."""
    try:
        layout = msgspec.json.decode(data, type=ImageLayout)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(f"the layout of image {reference[:100]} cannot be read: {error}") from error
    digests = (layout.image_id, *layout.layers)
    if layout.reference != reference or len(layout.layers) > MOST_LAYERS or not all(map(is_digest, digests)):
        raise PayloadError(f"image {reference[:100]} was asked for, and something else announced")
    return layout


def too_large(manifest: Manifest) -> str:
    """Why the layout of an image is not fetched: it is read whole, so one that is no layout must not come; or empty."""
    return f"a layout of {manifest.size_bytes:,} bytes" if manifest.size_bytes > MOST_LAYOUT else ""


def check_config(layout: ImageLayout, config: Path) -> bytes:
    """Return an image's configuration if it is the one announced, with the layers announced; PayloadError otherwise."""
    if config.stat().st_size > MOST_CONFIG:
        raise PayloadError(f"image {layout.reference} has a configuration of {config.stat().st_size:,} bytes")
    data = config.read_bytes()
    found: Any = None
    if hashlib.sha256(data).hexdigest() == layout.image_id:
        try:
            found = msgspec.json.decode(data, type=dict[str, Any]).get("rootfs", {}).get("diff_ids")
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, AttributeError):
            found = None
    if found != [f"sha256:{each}" for each in layout.layers]:
        raise PayloadError(f"image {layout.reference} is not made of what was announced")
    return data


log = structlog.get_logger(__name__)

_TELL_S = 0.5
_LOOK_S = 30.0
"""How often Podman is asked which images are there: one may have been built or removed by hand."""
_MOST_ASKED = 8
"""Gateways asked for an image that no status lists: one that has it lists it within seconds."""


class Transfers:
    """Transfers to and from one gateway.

    Args:
        config: table `[pool.transfer]`.
        plane: this gateway's membership.
        volumes: the ledger of its state volumes; started and closed by its owner.
        storage: Podman, a client of its own: an image takes seconds, and must not hold up starts. Closed by its owner.
        data_dir: the gateway's data folder; `transfer` in it is ours.
        on_change: called when `images` has changed.
        parts: which images may be fetched.
    """

    def __init__(
        self,
        config: TransferConfig,
        *,
        plane: Plane,
        volumes: Volumes,
        storage: PodmanEngine,
        data_dir: Path,
        on_change: Callable[[], None] = lambda: None,
        parts: InForce = ALL,
    ) -> None:
        self._parts = parts
        self.refused: Counter[str] = Counter()
        """Bad input and refusals by kind, for GatewayStatus.refused (`Volumes.refused` has those of the ledger)."""
        self._on_change = on_change
        self._config, self._plane, self._volumes, self._storage = config, plane, volumes, storage
        self._spool = Spool(data_dir / "transfer" / "arriving", config)
        self._offers = Offers(data_dir / "transfer" / "offered", config)
        self._giver = Giver(
            config, plane=plane, volumes=volumes, storage=storage, offers=self._offers, refused=self.refused
        )
        self._fetcher = Fetcher(config, plane=plane, spool=self._spool, offers=self._offers, refused=self.refused)
        self._slots = asyncio.Semaphore(config.at_once)
        self._jobs: dict[str, Job] = {}
        """By what is brought."""
        self._tasks: dict[str, asyncio.Task[Brought]] = {}
        self._images: tuple[str, ...] = ()
        self._looking: asyncio.Task[None] | None = None

    # --- life -------------------------------------------------------------------------------------------------

    async def start(self, signed: Callable[[str, Any], Any] = lambda _, handler: handler) -> None:
        """Serve what others ask for, and look at what an earlier life of this gateway left in the spool.

        Args:
            signed: puts an audit around the handler of an operator's verb.

        Raises:
            RefusedError: the folders cannot be made.
        """
        try:
            await asyncio.to_thread(self._spool.start)
            await asyncio.to_thread(self._offers.start)
        except OSError as error:
            raise RefusedError(f"transfers have no folder: {error}", remedy="make data_dir writable") from error
        self._giver.start()
        rpc = self._plane.rpc
        rpc.register(keyspace.IMAGE_FETCH, signed("image_fetch", self._on_fetch))
        rpc.register(keyspace.TRANSFERS, self._on_list)
        rpc.register(keyspace.TRANSFER_CANCEL, self._on_cancel)
        self._looking = asyncio.create_task(self._keep_looking(), name="look for images")

    async def close(self) -> None:
        """Give up what is under way (it can be gone on with) and serve no more."""
        tasks: list[asyncio.Task[Any]] = [*self._tasks.values(), *([self._looking] if self._looking else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._giver.close()
        await self._fetcher.close()

    # --- bringing here ----------------------------------------------------------------------------------------

    async def bring_volume(self, name: str, source_gateway: str = "") -> Brought:
        """Bring the newest state of a volume here; nothing when it is here already.

        `source_gateway` is asked first, then every other gateway that has that state. Waits (`use_wait_s`) until
        no run here uses the volume. Concurrent calls for one volume share one transfer.

        Raises:
            UnreachableError, DeadlineError, NotFoundError: no gateway that has the newest state gives it now; what is
                here is older. The transfer goes on where it was when it is asked for again.
            RefusedError: no room, too many transfers, too large, or a run uses the volume here or there.
            PayloadError: what arrived is not what was announced; counted, nothing changed.
            PoolError, CancelledByOperatorError: Podman will not; somebody cancelled it.
        """
        newest = await self._volumes.newest(name)
        if newest is None or self._volumes.has(name, newest):
            return Brought(what=f"volume/{name}")
        return await self._one(f"volume/{name}", partial(self._bring_volume, newest, source_gateway))

    async def bring_newest(self, names: Iterable[str]) -> None:
        """Bring the newest state of each volume here, as `bring_volume`: what a run asks for before it begins."""
        await asyncio.gather(*(self.bring_volume(name) for name in dict.fromkeys(names)))

    async def bring_image(self, reference: str, source_gateway: str = "") -> Brought:
        """Bring an image here from a gateway that has it, only the layers that are not here; errors as above.

        Raises:
            NotFoundError: no gateway that answers has it.
            IdentityError: what is here, or what all of them give, is not in the signed list of parts.
        """
        if await self._storage.has_image(reference):
            if self._parts.checked:
                self._check_signed(reference, (await self._storage.image(reference)).id)
            return Brought(what=f"image/{reference}")
        if not may_be_given(reference):
            raise RefusedError(f"{reference[:100]!r} is not given", remedy=f"only {REFERENCE_PREFIX}… are")
        return await self._one(f"image/{reference}", partial(self._bring_image, reference, source_gateway))

    def images(self) -> tuple[str, ...]:
        """References of the images that are here and can be given, for GatewayStatus.images."""
        return self._images

    async def _one(self, what: str, bring: Callable[[Job], Coroutine[Any, Any, Brought]]) -> Brought:
        """Join the transfer of that thing, or begin it."""
        task = self._tasks.get(what)
        if task is None:
            if len(self._tasks) >= self._config.at_once + self._config.waiting:
                self.refused["transfer queue full"] += 1
                raise RefusedError(f"{len(self._tasks)} transfers are under way or wait", remedy="try again later")
            job = self._jobs[what] = Job(secrets.token_hex(4), what)
            task = self._tasks[what] = asyncio.create_task(self._run(job, bring), name=f"bring {what}")
            # Said in the log already, also when nobody waits for it any more.
            task.add_done_callback(lambda done: done.cancelled() or done.exception())
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            if not task.cancelled():
                raise  # who asked is cancelled; what is fetched goes on for others, or for the next try
            raise CancelledByOperatorError(f"the transfer of {what} was cancelled") from None

    async def _run(self, job: Job, bring: Callable[[Job], Coroutine[Any, Any, Brought]]) -> Brought:
        began = time.monotonic()
        telling = asyncio.create_task(self._keep_telling(job), name=f"tell of {job.what}")
        try:
            async with self._slots:
                job.state = "preparing"
                brought = await bring(job)
            took_ms = (time.monotonic() - began) * 1e3
            brought = msgspec.structs.replace(brought, duration_ms=round(took_ms, 3))
            job.state = "done"
            log.info("brought", **msgspec.to_builtins(brought))
        except BaseException as error:
            job.state = "cancelled" if isinstance(error, asyncio.CancelledError) else "failed"
            job.problem = str(error)
            log.warning("not brought", what=job.what, gateway=job.source, state=job.state, reason=str(error))
            raise
        finally:
            telling.cancel()
            del self._jobs[job.what], self._tasks[job.what]
            self._tell(job)
        return brought

    # --- volumes ----------------------------------------------------------------------------------------------

    async def _bring_volume(self, newest: VolumeRecord, first: str, job: Job) -> Brought:
        name = newest.name

        def accept(manifest: Manifest) -> str:
            stands = relation(manifest.version, manifest.writer, newest.version, newest.gateway)
            return "an older state" if stands in (Relation.OLDER, Relation.LOSES) else ""

        sources = self._sources([first, newest.gateway, *self._volumes.where(name)])
        if not sources:
            raise UnreachableError(
                f"the newest state of volume {name} is on {newest.gateway}, which is not there",
                remedy="bring that gateway back",
            )
        async with self._fetched("volume", name, sources, job, accept=accept) as arrival:
            began = time.monotonic()
            job.state = "applying"
            await self._volumes.replace(name, arrival.manifest, arrival.path)
            self._fetcher.unpacked(job.source, arrival.manifest.size_bytes, time.monotonic() - began)
        return self._brought(job)

    @contextlib.asynccontextmanager
    async def _fetched(
        self,
        kind: str,
        name: str,
        sources: list[str],
        job: Job,
        *,
        accept: Callable[[Manifest], str] = lambda _: "",
        patient: bool = True,
    ) -> AsyncGenerator[Arrival]:
        """Something fetched whole; when it was put to use it is kept to be given, otherwise for the next try."""
        arrival = await self._fetcher.fetch(kind, name, sources, job, accept=accept, patient=patient)
        try:
            yield arrival
        except (PayloadError, IdentityError) as error:
            # Whole and as announced, and yet not what it should be: no part of it is worth keeping.
            if isinstance(error, PayloadError):
                self.refused[f"transfer bad {kind}"] += 1
            await asyncio.to_thread(arrival.remove)
            raise
        else:
            with contextlib.suppress(OSError):
                await asyncio.to_thread(self._offers.add, arrival.manifest, arrival.path)
            await asyncio.to_thread(arrival.remove)
        finally:
            await asyncio.to_thread(self._spool.close, arrival)

    def _sources(self, gateways: Iterable[str]) -> list[str]:
        members = self._plane.members() - {self._plane.gateway}
        return [each for each in dict.fromkeys(gateways) if each in members]

    def _brought(self, job: Job) -> Brought:
        return Brought(
            what=job.what,
            gateway=job.source,
            size_bytes=job.size_bytes,
            wire_bytes=job.wire_bytes,
            resumed_bytes=job.resumed_bytes,
        )

    # --- images -----------------------------------------------------------------------------------------------

    async def _bring_image(self, reference: str, first: str, job: Job) -> Brought:
        listed = [gateway for gateway, status in self._plane.registry.gateways.items() if reference in status.images]
        sources = self._sources([first, *listed]) or self._sources(sorted(self._plane.members()))[:_MOST_ASKED]
        while True:
            source = ""
            try:
                # A start waits for it: what does not answer is left at once, and what has begun to come is waited for.
                async with self._fetched("image", reference, sources, job, accept=too_large, patient=False) as arrival:
                    source = job.source
                    layout = read_layout(await asyncio.to_thread(arrival.path.read_bytes), reference)
                    self._check_signed(reference, layout.image_id)
                    await self._load(layout, [source, *(each for each in sources if each != source)], job)
            except (PayloadError, IdentityError):
                # The gateway whose layout it was is left, whichever gave the parts; without one all have been asked.
                sources = [each for each in sources if each != source]
                if not source or not sources:
                    raise
            else:
                await self._look()
                return self._brought(job)

    def _check_signed(self, reference: str, image_id: str) -> None:
        """Raise IdentityError, counted, unless an image is in the signed list of parts."""
        try:
            self._parts.check(Kind.IMAGE, reference, image_id)
        except IdentityError:
            self.refused["unsigned image"] += 1
            raise

    async def _load(self, layout: ImageLayout, sources: list[str], job: Job) -> None:
        """Fetch what is not here and have Podman load it; what Podman then says must be what was announced."""
        have, blobs = await self._storage.layers(), dict[str, Path]()
        for digest in dict.fromkeys((layout.image_id, *layout.layers)):
            if digest not in have:
                blobs[digest] = await self._blob(digest, sources, job)
        job.state = "applying"
        config = await asyncio.to_thread(check_config, layout, blobs.pop(layout.image_id))
        sizes = {digest: path.stat().st_size for digest, path in blobs.items()}
        await self._storage.load_image(partial(oci_archive, layout, config, blobs, sizes))
        facts = await self._storage.image(layout.reference)
        if facts.id != layout.image_id or facts.layers != layout.layers:
            await self._storage.remove_image(layout.reference)
            raise PayloadError(
                f"Podman loaded image {layout.reference} as {facts.id[:12]}, not as {layout.image_id[:12]}",
                remedy="look at the gateway that gave it",
            )

    async def _blob(self, digest: str, sources: list[str], job: Job) -> Path:
        offer = self._offers.find("blob", digest)
        if offer is None or await asyncio.to_thread(content_digest, offer.path) != digest:
            async with self._fetched("blob", digest, sources, job) as arrival:
                if await asyncio.to_thread(content_digest, arrival.path) != digest:
                    raise PayloadError(f"blob {digest[:12]} from {job.source} is something else")
            offer = self._offers.find("blob", digest)
        if offer is None:
            raise RefusedError(
                f"blob {digest[:12]} does not fit among what is kept", remedy="raise pool.transfer.cache_mb"
            )
        return offer.path

    async def _keep_looking(self) -> None:
        while True:
            await self._look()
            await asyncio.sleep(_LOOK_S)

    async def _look(self) -> None:
        with contextlib.suppress(SwiftbotError):
            tags = {tag for each in await self._storage.images() for tag in each.tags}
            found = tuple(sorted(tag for tag in tags if tag.startswith(REFERENCE_PREFIX)))
            if found != self._images:
                self._images = found
                self._on_change()

    async def _on_fetch(self, ask: FetchAsk) -> Brought:
        return await self.bring_image(ask.reference, ask.gateway)

    def link(self, gateway: str) -> Link:
        """All that was measured of moving state from a gateway."""
        return self._fetcher.links.get(gateway, UNMEASURED)

    # --- watching ---------------------------------------------------------------------------------------------

    def active(self) -> tuple[Progress, ...]:
        """Transfers to this gateway that are under way or wait."""
        return tuple(self._progress(job) for job in self._jobs.values())

    def cancel(self, transfer: str) -> bool:
        """End a transfer by its id; False when there is none. What arrived is kept for the next try."""
        for what, job in self._jobs.items():
            if job.id == transfer:
                self._tasks[what].cancel()
                return True
        return False

    async def _on_list(self, _: TransfersAsk) -> TransferList:
        return TransferList(transfers=self.active())

    async def _on_cancel(self, ask: CancelAsk) -> Cancelled:
        return Cancelled(cancelled=self.cancel(ask.id))

    def _progress(self, job: Job) -> Progress:
        return Progress(
            id=job.id,
            what=job.what,
            gateway=self._plane.gateway,
            state=job.state,
            source=job.source,
            done_bytes=job.done_bytes,
            size_bytes=job.size_bytes,
            rate_mbps=round(job.rate_bytes_per_s * 8 / 1e6, 3),
            problem=job.problem,
        )

    def _tell(self, job: Job) -> None:
        key = self._plane.keys(keyspace.TRANSFER, self._plane.gateway, job.id)
        self._plane.session.put(key, msgspec.json.encode(self._progress(job)))

    async def _keep_telling(self, job: Job) -> None:
        while True:
            self._tell(job)
            await asyncio.sleep(_TELL_S)
