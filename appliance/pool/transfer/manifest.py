"""What is moved, chunk by chunk: its manifest, the checks a stranger's manifest must pass, and what is missing. Pure.

A manifest names every chunk by its SHA-256, and itself by the digest over all of them (a hash tree of one level),
so each chunk is checked when it arrives, chunks of one content may come from any gateway, and what is the same as
in an earlier state need not come at all.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping

from msgspec import Struct

from appliance.errors import PayloadError, RefusedError
from appliance.model import VersionVector

DIGEST_BYTES = 32
MOST_CHUNK_BYTES = 4 * 2**20
"""Half a payload: `plane.max_payload_bytes`."""
LEAST_CHUNK_BYTES = 16 * 2**10
_HEX = re.compile(r"[0-9a-f]{64}")


class Manifest(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One thing that can be fetched in chunks of `chunk_bytes` (the last may be shorter)."""

    kind: str
    """`volume`: a tar archive of its files. `blob`: a layer or configuration of an image."""
    name: str
    """The volume's name, or the blob's SHA-256."""
    digest: str
    """`root_digest` of all that follows: the same content in the same chunks has the same one everywhere."""
    size_bytes: int
    chunk_bytes: int
    chunks: bytes
    """SHA-256 of each chunk, 32 bytes each, in order."""
    version: VersionVector = {}
    """Of a volume: which state this is."""
    writer: str = ""
    """Of a volume: the gateway that made this state."""

    @property
    def count(self) -> int:
        """How many chunks."""
        return len(self.chunks) // DIGEST_BYTES

    def chunk(self, index: int) -> bytes:
        """SHA-256 of a chunk."""
        return self.chunks[index * DIGEST_BYTES : (index + 1) * DIGEST_BYTES]

    def span(self, index: int) -> tuple[int, int]:
        """Offset and length of a chunk, bytes."""
        offset = index * self.chunk_bytes
        return offset, min(self.chunk_bytes, self.size_bytes - offset)


def root_digest(size_bytes: int, chunk_bytes: int, chunks: bytes) -> str:
    """SHA-256 over size, chunk size and the chunks' digests, hexadecimal."""
    return hashlib.sha256(b"chunks %d %d " % (size_bytes, chunk_bytes) + chunks).hexdigest()


def is_digest(text: str) -> bool:
    """Whether a text is a SHA-256 in hexadecimal."""
    return _HEX.fullmatch(text) is not None


def check(manifest: Manifest, *, kind: str, name: str, most_bytes: int) -> None:
    """Check what a gateway says it has before anything is done with it.

    Raises:
        PayloadError: it contradicts itself, or is not what was asked for.
        RefusedError: it is larger than is moved.
    """
    if (manifest.kind, manifest.name) != (kind, name):
        raise PayloadError(
            f"{kind} {name[:80]} was asked for, {manifest.kind[:20]} {manifest.name[:80]} is announced",
            remedy="ask another gateway",
        )
    if not LEAST_CHUNK_BYTES <= manifest.chunk_bytes <= MOST_CHUNK_BYTES or manifest.size_bytes < 0:
        raise PayloadError(f"a manifest of {manifest.size_bytes} bytes in chunks of {manifest.chunk_bytes}")
    if manifest.size_bytes > most_bytes:
        raise RefusedError(
            f"{kind} {name} has {manifest.size_bytes:,} bytes, more than the {most_bytes:,} that are moved",
            remedy="raise pool.transfer.most_mb, or make it smaller",
        )
    if len(manifest.chunks) != -(-manifest.size_bytes // manifest.chunk_bytes) * DIGEST_BYTES:
        raise PayloadError(
            f"a manifest of {manifest.size_bytes:,} bytes in chunks of {manifest.chunk_bytes:,} names "
            f"{len(manifest.chunks) / DIGEST_BYTES:g} chunks"
        )
    if manifest.digest != root_digest(manifest.size_bytes, manifest.chunk_bytes, manifest.chunks):
        raise PayloadError("a manifest does not match its own digest", remedy="ask another gateway")
    if not all(0 < count < 2**53 for count in manifest.version.values()):
        raise PayloadError("a manifest of an impossible version")


def missing(manifest: Manifest, have: Iterable[int]) -> list[int]:
    """Indices of the chunks that are not there, in order."""
    there = set(have)
    return [index for index in range(manifest.count) if index not in there]


def reusable(wanted: Manifest, there: Manifest, have: Iterable[int], needed: Iterable[int]) -> Mapping[int, int]:
    """Which chunks of `wanted` can be copied: index in `wanted` -> index in `there`, of those `have` and `needed`."""
    at = {there.chunk(index): index for index in have}
    found: dict[int, int] = {}
    for index in needed:
        source = at.get(wanted.chunk(index))
        if source is not None and there.span(source)[1] == wanted.span(index)[1]:
            found[index] = source
    return found
