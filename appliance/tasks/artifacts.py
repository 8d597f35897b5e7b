"""Files that handlers produce (pictures, videos, reports), kept by content on the gateway where they were made.

A reference `{"artifact": sha256, "name", "media_type", "bytes", "gateway"}` travels in results; other gateways ask for
the bytes piece by piece over RPC. Content addressing makes a repeated attempt store the same file once.

Each file has owners: keys of the records that it belongs to, such as `task/ID`. It is kept while one of them is needed
and removed with the last (`Artifacts.forget`, called by retention). A file of which no owner is known stays: it was
written by an earlier version, whose records may still refer to it, or its owner's mark was lost with the power.

`ArtifactCopies` has each new file copied to other gateways, so that it outlives the one that made it.
"""

import asyncio
import contextlib
import errno
import hashlib
import os
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import anyio
import anyio.to_thread
import structlog
from msgspec import Struct

from appliance.errors import (
    DeadlineError,
    NotFoundError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model.task_api import ArtifactAsk, ArtifactKeep, ArtifactKept, ArtifactPiece

log = structlog.get_logger(__name__)

PIECE = 1 << 20
MAX_OWNER = 255
"""Characters of an owner's key, quoted: so many a file's name has room for."""
_OWNERS = "owners"
"""Folder with a folder for each owner, in which an empty file marks each digest that it owns."""
_DIGEST = re.compile(r"[0-9a-f]{64}")

Ask = Callable[[str, ArtifactAsk], Awaitable[ArtifactPiece]]
"""Ask a gateway for a piece of a file."""


class Reference(Struct, frozen=True, kw_only=True):
    """What a result carries in place of a file."""

    artifact: str
    name: str
    media_type: str
    bytes: int
    gateway: str


class Artifacts:
    """The files of one gateway, under `directory/ab/abcdef…`.

    Args:
        directory: where they lie.
        gateway: this gateway's id.
        max_bytes: largest file.
        reserve_bytes: what stays free on the disk: a handler may store any number of files.
    """

    def __init__(self, directory: Path, *, gateway: str, max_bytes: int, reserve_bytes: int = 0) -> None:
        self._directory = directory
        self._gateway = gateway
        self._max_bytes = max_bytes
        self._reserve_bytes = reserve_bytes
        self._lock = threading.Lock()
        """Of marks and files: a file that is stored again while its last owner goes is there afterwards."""

    def path(self, digest: str) -> Path:
        """Where a file of that SHA-256 is kept; PayloadError if it is not one."""
        if not _DIGEST.fullmatch(digest):
            raise PayloadError(f"{digest[:80]!r} is not an artifact", remedy="give the SHA-256 from a result")
        return self._directory / digest[:2] / digest

    async def put(self, name: str, data: bytes, media_type: str, *, owner: str) -> Reference:
        """Store a file durably for an owner. RefusedError when it is too large or the disk is full."""
        if len(data) > self._max_bytes:
            raise RefusedError(
                f"{name} has {len(data):,} bytes, more than the {self._max_bytes:,} a file may have",
                remedy="make it smaller, or raise tasks.max_artifact_mb",
            )
        digest = await anyio.to_thread.run_sync(self._write, name, data, owner)
        return Reference(
            artifact=digest, name=name[:120], media_type=media_type[:80], bytes=len(data), gateway=self._gateway
        )

    def _write(self, name: str, data: bytes, owner: str) -> str:
        digest = hashlib.sha256(data).hexdigest()
        target = self.path(digest)
        temporary = ""
        try:
            with self._lock:
                if target.exists():
                    self._mark(digest, owner)
                    return digest
            target.parent.mkdir(parents=True, exist_ok=True)
            self._check_room(target.parent, len(data))
            handle, temporary = tempfile.mkstemp(dir=target.parent)
            with os.fdopen(handle, "wb") as out:
                out.write(data)
                out.flush()
                os.fsync(out.fileno())
            with self._lock:
                self._mark(digest, owner)
                Path(temporary).replace(target)
        except OSError as error:
            if temporary:
                Path(temporary).unlink(missing_ok=True)
            raise RefusedError(
                f"{name} could not be stored: {error.strerror}", remedy=f"free space in {self._directory}"
            ) from error
        return digest

    # --- owners --------------------------------------------------------------------------------------------------

    def _folder(self, owner: str) -> Path:
        name = quote(owner, safe="")
        if not 0 < len(name) <= MAX_OWNER:
            raise PayloadError(f"a file's owner has {len(name)} characters, quoted", remedy=f"give 1 to {MAX_OWNER}")
        return self._directory / _OWNERS / name

    def _mark(self, digest: str, owner: str) -> None:
        folder = self._folder(owner)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / digest).touch()

    async def owners(self) -> tuple[str, ...]:
        """Return the keys of all owners of files here."""
        return await anyio.to_thread.run_sync(self._list_owners)

    def _list_owners(self) -> tuple[str, ...]:
        folder = self._directory / _OWNERS
        return tuple(sorted(unquote(each.name) for each in folder.iterdir())) if folder.is_dir() else ()

    async def owned(self, owner: str) -> frozenset[str]:
        """Return the digests of an owner's files here."""
        return await anyio.to_thread.run_sync(self._list_owned, owner)

    def _list_owned(self, owner: str) -> frozenset[str]:
        folder = self._folder(owner)
        return frozenset(each.name for each in folder.iterdir()) if folder.is_dir() else frozenset()

    async def forget(self, owner: str) -> int:
        """Remove an owner, and those of its files that no other owner has; returns how many files."""
        return await anyio.to_thread.run_sync(self._forget, owner)

    def _forget(self, owner: str) -> int:
        removed = 0
        with self._lock:
            folder = self._folder(owner)
            digests = self._list_owned(owner)
            others = [each for each in self._list_owners() if each != owner]
            for digest in digests:
                if not any((self._folder(other) / digest).exists() for other in others) and _DIGEST.fullmatch(digest):
                    self.path(digest).unlink(missing_ok=True)
                    removed += 1
            shutil.rmtree(folder, ignore_errors=True)
        return removed

    async def forget_temporary(self, older_s: float) -> int:
        """Remove what writes that a crash cut short have left, after so many seconds; returns how many files."""
        return await anyio.to_thread.run_sync(self._forget_temporary, older_s)

    def _forget_temporary(self, older_s: float) -> int:
        before, removed = time.time() - older_s, 0
        for path in self._directory.glob(f"??/{tempfile.gettempprefix()}*"):
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_mtime < before:
                    path.unlink()
                    removed += 1
        return removed

    # --- files ---------------------------------------------------------------------------------------------------

    def _check_room(self, folder: Path, size: int) -> None:
        """Raise OSError where a file of that size would take the reserve."""
        left = max(0, shutil.disk_usage(folder).free - size)
        if left < self._reserve_bytes:
            raise OSError(errno.ENOSPC, f"{left:,} bytes would be left, {self._reserve_bytes:,} stay free")

    async def piece(self, ask: ArtifactAsk) -> ArtifactPiece:
        """Read a piece of a file kept here; NotFoundError when it is not."""
        path = self.path(ask.artifact)
        if not 0 <= ask.offset <= self._max_bytes or ask.length < 0:
            raise PayloadError(f"no piece of {ask.length:,} bytes at {ask.offset:,}", remedy="ask within the file")

        def read() -> ArtifactPiece:
            try:
                with path.open("rb") as file:
                    file.seek(max(0, ask.offset))
                    return ArtifactPiece(data=file.read(min(max(0, ask.length), PIECE)), size=path.stat().st_size)
            except FileNotFoundError:
                raise NotFoundError(f"artifact {ask.artifact[:12]}… is not on {self._gateway}") from None

        return await anyio.to_thread.run_sync(read)

    async def get(self, reference: dict[str, Any], *, ask: Ask, members: frozenset[str], owner: str) -> bytes:
        """Return a file from here, from the gateway that made it, or from any that has it, verified.

        One that is fetched is kept here too, for `owner`.

        Raises:
            PayloadError: not a reference, or every copy is damaged.
            NotFoundError: no gateway that answers has it.
        """
        digest = str(reference.get("artifact", ""))
        path = self.path(digest)
        if path.exists():
            return await anyio.Path(path).read_bytes()
        maker = str(reference.get("gateway", ""))
        damaged: list[str] = []
        others = sorted(members - {self._gateway}, key=lambda member: (member != maker, member))
        for member in others:
            try:
                data = await self._fetch(digest, member, ask)
            except (NotFoundError, UnreachableError, DeadlineError, RefusedError) as error:
                log.info("artifact is not to be had there", artifact=digest, gateway=member, reason=str(error))
                continue
            if hashlib.sha256(data).hexdigest() != digest:
                # A damaged copy must not hide a good one elsewhere.
                log.warning("artifact does not match its digest", artifact=digest, gateway=member)
                damaged.append(member)
                continue
            try:
                await anyio.to_thread.run_sync(self._write, digest, data, owner)
            except RefusedError as error:
                log.warning("artifact is not kept here as well", artifact=digest, reason=str(error))
            return data
        if damaged:
            raise PayloadError(f"artifact {digest[:12]}… from {', '.join(damaged)} does not match its digest")
        raise NotFoundError(
            f"artifact {digest[:12]}… ({reference.get('name', '')}) is on no gateway that answers",
            remedy=f"bring {maker or 'the gateway that made it'} back",
        )

    async def _fetch(self, digest: str, member: str, ask: Ask) -> bytes:
        data = bytearray()
        while True:
            piece = await ask(member, ArtifactAsk(artifact=digest, offset=len(data)))
            if piece.size > self._max_bytes:
                raise RefusedError(f"artifact {digest[:12]}… on {member} has {piece.size:,} bytes, too many")
            data += piece.data
            if len(data) >= piece.size or not piece.data:
                return bytes(data)

    async def keep(self, asked: ArtifactKeep, *, ask: Ask) -> ArtifactKept:
        """Keep a copy of a file of another gateway for an owner.

        Raises:
            PayloadError: no digest, or what is sent does not match it.
            RefusedError: the file is too large, or the disk is full.
            NotFoundError, UnreachableError, DeadlineError: that gateway does not give it.
        """
        self.path(asked.artifact)
        if not await anyio.to_thread.run_sync(self._mark_existing, asked.artifact, asked.owner):
            data = await self._fetch(asked.artifact, asked.source, ask)
            if hashlib.sha256(data).hexdigest() != asked.artifact:
                raise PayloadError(f"artifact {asked.artifact[:12]}… from {asked.source} does not match its digest")
            await anyio.to_thread.run_sync(self._write, asked.artifact, data, asked.owner)
        return ArtifactKept(artifact=asked.artifact, gateway=self._gateway)

    def _mark_existing(self, digest: str, owner: str) -> bool:
        """Give a file that is here another owner; whether it is here."""
        with self._lock:
            if not self.path(digest).exists():
                return False
            self._mark(digest, owner)
            return True


MAX_WAITING = 1000
"""Files that wait to be copied; more are not copied, which is logged."""
AT_ONCE = 2
"""Files copied at once: what runs has the network first."""
SPARE_PLACES = 3
"""Gateways that are asked beyond the number of copies, where some cannot keep one."""
TRIES = 3
AGAIN_S = 5.0


class ArtifactCopies:
    """Has files copied to other gateways.

    Args:
        gateway: this gateway's id.
        copies: on how many gateways a file is to be, this one included.
        places: returns the gateways in the order in which copies of a digest are asked for.
        ask: asks a gateway to keep a copy.
    """

    def __init__(
        self,
        *,
        gateway: str,
        copies: int,
        places: Callable[[str], Sequence[str]],
        ask: Callable[[str, ArtifactKeep], Awaitable[ArtifactKept]],
    ) -> None:
        self._gateway = gateway
        self._copies = copies
        self._places = places
        self._ask = ask
        self._waiting: asyncio.Queue[tuple[Reference, str]] = asyncio.Queue(MAX_WAITING)
        self.missed = 0
        """Files of which fewer copies were made than wanted, since start."""

    async def spread(self, reference: Reference, owner: str, *, copies: int) -> tuple[str, ...]:
        """Copy a file that is here; returns the gateways that hold it then: fewer than `copies` where others cannot."""
        holding = [self._gateway]
        asked = ArtifactKeep(artifact=reference.artifact, source=self._gateway, owner=owner)
        for place in self._places(reference.artifact):
            if len(holding) >= copies:
                break
            if place in holding:
                continue
            try:
                await self._ask(place, asked)
            except SwiftbotError as error:
                log.info("no copy is kept there", artifact=reference.artifact, gateway=place, reason=str(error))
            else:
                holding.append(place)
        return tuple(holding)

    def later(self, reference: Reference, owner: str) -> None:
        """Have a file copied in the background."""
        if self._copies < 2:
            return
        try:
            self._waiting.put_nowait((reference, owner))
        except asyncio.QueueFull:
            self._miss(reference, f"{MAX_WAITING} files wait to be copied")

    async def run(self) -> None:
        """Copy what waits; never ends by itself."""
        async with asyncio.TaskGroup() as group:
            for _ in range(AT_ONCE):
                group.create_task(self._work())

    async def _work(self) -> None:
        while True:
            reference, owner = await self._waiting.get()
            for attempt in range(TRIES):
                holding = await self.spread(reference, owner, copies=self._copies)
                # A fleet of one gateway has nobody to ask, and is not asked again.
                if len(holding) >= min(self._copies, len({*self._places(reference.artifact), self._gateway})):
                    break
                if attempt + 1 < TRIES:
                    await asyncio.sleep(AGAIN_S)
            else:
                self._miss(reference, "other gateways do not keep it")

    def _miss(self, reference: Reference, reason: str) -> None:
        self.missed += 1
        log.warning(
            "a file has too few copies and is lost with this gateway",
            artifact=reference.artifact,
            name=reference.name,
            reason=reason,
            since_start=self.missed,
        )
