"""The target of a transfer: fetches one thing, chunk by chunk, from any gateway that has it, until it is whole here.

A gateway that goes away, lies or is too slow is left for the next; when none is left to ask, what has arrived stays
for the next try. Decisions are in `protocol`; here they are carried out.

`Spool` is what has arrived, on the disk: it outlives broken transfers and restarts, within bounds. One folder an
arriving thing: its manifest, its bytes at their places, and which chunks are there. What is said to be there is
believed only after it was digested again, so nothing needs to be synced on the way.
"""

import asyncio
import contextlib
import hashlib
import os
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import msgspec
import structlog

from appliance.errors import DeadlineError, NotFoundError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import keyspace
from appliance.model.transfer_api import Manifest, ManifestAsk
from appliance.plane.node import Plane
from appliance.pool.selection import UNMEASURED, Link
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes.archive import FULL, no_room
from appliance.pool.volumes.protocol import Next, Window, after_failure, check_manifest, missing, reusable, updated_link
from appliance.pool.volumes.source import ACCEPT_ZSTD, ANSWER_S, Offers, opened


class Arrival:
    """Something that arrives. Made by `Spool.open`; all methods but the properties block."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder, self.manifest = folder, manifest
        self.path = folder / "data"
        self._have: set[int] = set()
        self._marks = folder / "have"
        self._file = self._marks_file = -1
        self._lock = threading.Lock()
        """A chunk may still be written when the caller that waited for it has been cancelled."""

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
    """This gateway is not asked any more, or has to be asked again; `cause` says why."""

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
        patient: bool = True,
    ) -> Arrival:
        """Bring something into the spool, whole and checked, from any of the sources; the caller closes it.

        Args:
            kind: `volume`, `image` or `blob`.
            name: which.
            sources: gateways to ask, the best first.
            job: what progress is noted in.
            accept: says why a manifest will not do; empty when it does.
            patient: ask sources that do not answer again, for `patience_s`; otherwise a source that fails is left.

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
                if patient or isinstance(error, PayloadError) or isinstance(problem, NotFoundError):
                    problem = error  # otherwise: that another did not answer says more than that this has none
                self._left(error, source, kind)
                left.popleft()
                continue
            except (UnreachableError, DeadlineError, RefusedError) as error:
                problem = error
                if not patient:
                    self._left(error, source, kind)
                    left.popleft()
                    continue
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
                if not patient or (leave.step is Next.OTHER and isinstance(leave.cause, PayloadError)):
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

    def _left(self, error: SwiftbotError, source: str, kind: str) -> None:
        if isinstance(error, PayloadError):
            self._refused["transfer bad manifest"] += 1
        log.info("not to be had there", what=kind, gateway=source, reason=str(error))

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
            offer = await self._plane.rpc.call(source, keyspace.TRANSFER_MANIFEST, ask, timeout_s=ANSWER_S + ASK_S)
            if offer.manifest is not None:
                check_manifest(offer.manifest, kind=kind, name=name, most_bytes=self._config.most_mb * 2**20)
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
        key = self._plane.keys(keyspace.CHUNK, source, arrival.manifest.digest, str(index))
        try:
            answer = await self._plane.session.query(key, ACCEPT_ZSTD if zstd else b"", timeout_s=timeout_s, bulk=True)
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
            self.links[source] = updated_link(
                self.links.get(source, UNMEASURED), size_bytes=size_bytes, move_s=move_s, pack_s=pack_s
            )

    def unpacked(self, source: str, size_bytes: int, took_s: float) -> None:
        """Note what unpacking took."""
        if source and size_bytes >= _TELLING_BYTES:
            self.links[source] = updated_link(
                self.links.get(source, UNMEASURED), size_bytes=size_bytes, unpack_s=took_s
            )
