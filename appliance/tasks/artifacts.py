"""Files that handlers produce (pictures, videos, reports), kept by content on the gateway where they were made.

A reference `{"artifact": sha256, "name", "media_type", "bytes", "gateway"}` travels in results; the bytes stay
until another gateway's handler asks for them, piece by piece over RPC. Content addressing makes a repeated
attempt store the same file once.
"""

import errno
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import structlog
from msgspec import Struct

from appliance.errors import DeadlineError, NotFoundError, PayloadError, RefusedError, UnreachableError
from appliance.tasks.api import ArtifactAsk, ArtifactPiece

log = structlog.get_logger(__name__)

PIECE = 1 << 20
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

    def path(self, digest: str) -> Path:
        """Where a file of that SHA-256 is kept; PayloadError if it is not one."""
        if not _DIGEST.fullmatch(digest):
            raise PayloadError(f"{digest[:80]!r} is not an artifact", remedy="give the SHA-256 from a result")
        return self._directory / digest[:2] / digest

    async def put(self, name: str, data: bytes, media_type: str) -> Reference:
        """Store a file durably. RefusedError when it is too large or the disk is full."""
        if len(data) > self._max_bytes:
            raise RefusedError(
                f"{name} has {len(data):,} bytes, more than the {self._max_bytes:,} a file may have",
                remedy="make it smaller, or raise tasks.max_artifact_mb",
            )
        digest = await anyio.to_thread.run_sync(self._write, name, data)
        return Reference(
            artifact=digest, name=name[:120], media_type=media_type[:80], bytes=len(data), gateway=self._gateway
        )

    def _write(self, name: str, data: bytes) -> str:
        digest = hashlib.sha256(data).hexdigest()
        target = self.path(digest)
        if target.exists():
            return digest
        temporary = ""
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            self._check_room(target.parent, len(data))
            handle, temporary = tempfile.mkstemp(dir=target.parent)
            with os.fdopen(handle, "wb") as out:
                out.write(data)
                out.flush()
                os.fsync(out.fileno())
            Path(temporary).replace(target)
        except OSError as error:
            if temporary:
                Path(temporary).unlink(missing_ok=True)
            raise RefusedError(
                f"{name} could not be stored: {error.strerror}", remedy=f"free space in {self._directory}"
            ) from error
        return digest

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

    async def get(self, reference: dict[str, Any], *, ask: Ask, members: frozenset[str]) -> bytes:
        """Return a file from here, from the gateway that made it, or from any that has it, verified.

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
                await anyio.to_thread.run_sync(self._write, digest, data)
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
