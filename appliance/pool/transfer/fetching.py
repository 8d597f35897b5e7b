"""The fetching side: one thing, chunk by chunk, from whoever has it, until it is whole in the spool.

A gateway that goes away, lies or is too slow is left for the next; when none is left to ask, what has arrived stays
for the next try. Decisions are in `flow`; here they are carried out.
"""

import asyncio
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import structlog

from appliance.errors import (
    DeadlineError,
    NotFoundError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.plane.node import Plane
from appliance.pool.transfer.api import ManifestAsk, ManifestOffer
from appliance.pool.transfer.flow import Link, Next, Window, after_failure, learned
from appliance.pool.transfer.giving import ANSWER_S, ZSTD
from appliance.pool.transfer.manifest import Manifest, check
from appliance.pool.transfer.offers import Offers, opened
from appliance.pool.transfer.settings import TransferConfig
from appliance.pool.transfer.spool import Arrival, Spool

log = structlog.get_logger(__name__)

T = TypeVar("T")

ASK_S = 5.0
"""For an answer that needs no work; what does is answered with `pending` before."""
_AGAIN_S = 0.3
_WORTH_ZSTD_BYTES_PER_S = 150e6
"""On a faster link compressing takes longer than it saves."""
_TELLING_BYTES = 256 * 1024
"""What is smaller tells of the round trip, not of the bandwidth."""


class Job:
    """A transfer as it goes on; `Progress` is made of it."""

    def __init__(self, identity: str, what: str) -> None:
        self.id, self.what = identity, what
        self.source, self.state, self.problem = "", "waiting", ""
        self.done_bytes = self.size_bytes = self.wire_bytes = self.resumed_bytes = 0
        self.rate_bytes_per_s = 0.0
        self.last_chunk = time.monotonic()


class _Leave(Exception):  # noqa: N818 - not an error of its own: what follows from one
    """This gateway is not asked any more, or has to be asked anew; `cause` says why."""

    def __init__(self, step: Next, cause: SwiftbotError) -> None:
        super().__init__(str(cause))
        self.step, self.cause = step, cause


class Fetcher:
    """Fetches for one gateway; keeps what it learns of the links to others."""

    def __init__(
        self,
        config: TransferConfig,
        *,
        plane: Plane,
        spool: Spool,
        offers: Offers,
        refused: Counter[str],
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._sleep = sleep
        self.links: dict[str, Link] = {}
        self._config, self._plane, self._spool, self._offers, self._refused = config, plane, spool, offers, refused
        self._threads = ThreadPoolExecutor(max_workers=2, thread_name_prefix="fetching")

    async def close(self) -> None:
        """Let go of the threads."""
        await asyncio.to_thread(self._threads.shutdown, wait=True, cancel_futures=True)

    async def fetch(
        self,
        kind: str,
        name: str,
        sources: Sequence[str],
        job: Job,
        *,
        accept: Callable[[Manifest], str] = lambda _: "",
    ) -> Arrival:
        """Bring something into the spool, whole and checked, from any of the sources; the caller closes it.

        Args:
            kind: `volume` or `blob`.
            name: which.
            sources: gateways to ask, the best first.
            job: what progress is noted in.
            accept: says why a manifest will not do; empty when it does.

        Raises:
            NotFoundError, PayloadError: no source has it as it should be.
            UnreachableError, DeadlineError: none answers; it can be gone on with.
            RefusedError: there is no room here, or none of them gives it now.
        """
        left = deque(dict.fromkeys(sources))
        before, seen = job.done_bytes, set[str]()
        job.last_chunk = time.monotonic()
        problem: SwiftbotError = NotFoundError(
            f"no gateway that answers has {kind} {name[:80]}", remedy="swiftbot fleet shows who is there"
        )
        while left:
            source = job.source = left[0]
            try:
                manifest = await self._manifest(source, kind, name, job, accept)
            except (PayloadError, NotFoundError) as error:
                problem = self._left(error, source, kind)
                left.popleft()
                continue
            except (UnreachableError, DeadlineError, RefusedError) as error:
                problem = error
                await self._wait(error, job)
                left.rotate(-1)
                continue
            arrival = await self._thread(lambda manifest=manifest: self._spool.open(manifest))
            try:
                await self._seed(arrival)
                if manifest.digest not in seen:
                    job.resumed_bytes += arrival.bytes_there
                    seen.add(manifest.digest)
                job.size_bytes = before + manifest.size_bytes
                job.done_bytes = before + arrival.bytes_there
                await self._chunks(source, arrival, job)
            except _Leave as leave:
                await self._thread(lambda arrival=arrival: self._spool.close(arrival))
                problem = leave.cause
                if leave.step is Next.OTHER and isinstance(leave.cause, PayloadError):
                    left.popleft()
                    continue
                await self._wait(leave.cause, job)
                left.rotate(-1 if leave.step is Next.OTHER else 0)
            except BaseException:
                await asyncio.shield(self._thread(lambda arrival=arrival: self._spool.close(arrival)))
                raise
            else:
                return arrival
        raise problem

    def _left(self, error: SwiftbotError, source: str, kind: str) -> SwiftbotError:
        if isinstance(error, PayloadError):
            self._refused["transfer bad manifest"] += 1
        log.info("not to be had there", what=kind, gateway=source, reason=str(error))
        return error

    async def _wait(self, error: SwiftbotError, job: Job) -> None:
        """Pause before the next source; give up when nothing came for long."""
        if time.monotonic() - job.last_chunk > self._config.patience_s:
            raise error
        await self._sleep(_AGAIN_S)

    async def _manifest(
        self, source: str, kind: str, name: str, job: Job, accept: Callable[[Manifest], str]
    ) -> Manifest:
        until = time.monotonic() + self._config.prepare_s
        while True:
            ask = ManifestAsk(kind=kind, name=name)
            offer = await self._plane.rpc.call(
                source, "transfer_manifest", ask, ManifestOffer, timeout_s=ANSWER_S + ASK_S
            )
            if offer.manifest is not None:
                check(offer.manifest, kind=kind, name=name, most_bytes=self._config.most_mb * 2**20)
                if offer.pack_ms > 0:
                    self._learn(source, size_bytes=offer.manifest.size_bytes, pack_s=offer.pack_ms / 1e3)
                if why := accept(offer.manifest):
                    raise NotFoundError(f"{kind} {name[:80]} on {source}: {why}")
                return offer.manifest
            if not offer.pending or time.monotonic() > until:
                raise DeadlineError(f"{source} did not make {kind} {name[:80]} ready in time")
            job.state = "preparing"
            job.last_chunk = time.monotonic()
            await self._sleep(_AGAIN_S)

    async def _seed(self, arrival: Arrival) -> None:
        """What our own last state has in common with what arrives need not come."""
        offer = self._offers.find(arrival.manifest.kind, arrival.manifest.name)
        if offer is not None and arrival.missing:
            there = offer.manifest
            everything = frozenset(range(there.count))
            await self._thread(lambda: arrival.seed(there, offer.path, everything))

    async def _chunks(self, source: str, arrival: Arrival, job: Job) -> None:
        manifest, config = arrival.manifest, self._config
        link = self.links.get(source)
        known = link.bytes_per_s if link is not None else None
        window = Window(
            most=config.window, in_flight_s=config.in_flight_s, chunk_bytes=manifest.chunk_bytes, bytes_per_s=known
        )
        zstd = known is None or known < _WORTH_ZSTD_BYTES_PER_S
        job.state = "moving"
        began, content = time.monotonic(), 0
        pending = deque(arrival.missing)
        running: dict[asyncio.Task[int | SwiftbotError], int] = {}
        in_a_row = bad = 0
        try:
            while pending or running:
                while pending and len(running) < window.size:
                    index = pending.popleft()
                    wait_s = window.timeout_s(config.chunk_timeout_s)
                    asking = self._chunk(source, arrival, index, zstd=zstd, timeout_s=wait_s)
                    running[asyncio.create_task(asking)] = index
                done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    index = running.pop(task)
                    outcome = task.result()
                    if isinstance(outcome, int):
                        in_a_row = 0
                        content += manifest.span(index)[1]
                        job.done_bytes += manifest.span(index)[1]
                        job.wire_bytes += outcome
                        job.last_chunk = time.monotonic()
                        window.arrived(outcome, job.last_chunk)
                        job.rate_bytes_per_s = content / max(1e-3, job.last_chunk - began)
                        continue
                    pending.appendleft(index)
                    in_a_row += 1
                    if isinstance(outcome, PayloadError):
                        bad += 1
                        self._refused["transfer bad chunk"] += 1
                        log.warning("a chunk is not what was announced", gateway=source, what=arrival.what, chunk=index)
                    else:
                        window.lost()
                    step = after_failure(outcome, in_a_row=in_a_row, bad=bad)
                    if step.next is not Next.AGAIN:
                        raise _Leave(step.next, outcome)
                    await self._sleep(step.wait_s)
        finally:
            for task in running:
                task.cancel()
            if running:
                await asyncio.wait(running)
        self._learn(source, size_bytes=content, move_s=time.monotonic() - began)

    async def _chunk(
        self, source: str, arrival: Arrival, index: int, *, zstd: bool, timeout_s: float
    ) -> int | SwiftbotError:
        """Ask for a chunk and keep it; returns its bytes on the wire, or why the source has not given it.

        Raises:
            RefusedError: it cannot be kept here.
        """
        key = self._plane.keys.chunk(source, arrival.manifest.digest, index)
        try:
            answer = await self._plane.session.query(key, ZSTD if zstd else b"", timeout_s=timeout_s, bulk=True)
        except SwiftbotError as error:
            return error
        length = arrival.manifest.span(index)[1]
        try:
            await self._thread(lambda: arrival.put(index, opened(answer, length)))
        except PayloadError as error:
            return error
        return len(answer)

    async def _thread(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, work)

    def _learn(self, source: str, *, size_bytes: int, move_s: float = 0.0, pack_s: float = 0.0) -> None:
        if size_bytes >= _TELLING_BYTES:
            self.links[source] = learned(
                self.links.get(source, Link()), size_bytes=size_bytes, move_s=move_s, pack_s=pack_s
            )

    def unpacked(self, source: str, size_bytes: int, took_s: float) -> None:
        """Note what unpacking took."""
        if source and size_bytes >= _TELLING_BYTES:
            self.links[source] = learned(self.links.get(source, Link()), size_bytes=size_bytes, unpack_s=took_s)
