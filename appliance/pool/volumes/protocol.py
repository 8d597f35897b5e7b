"""The transfer protocol, without I/O: what is moved, what gateways ask of each other for it, and how fast.

A manifest names every chunk by its SHA-256, and itself by the digest over all of them (a hash tree of one level),
so each chunk is checked when it arrives, chunks of one content may come from any gateway, and what is the same as
in an earlier state need not come at all. A stranger's manifest must pass `check_manifest`.

Flow control: bulk must not hold up what the gateways tell each other, so no more is on its way than the link carries in
a fixed time (`in_flight_s`): on a fast link that is the whole window, on a slow one a single chunk. `updated_link` is
what a transfer taught of a link (`selection.mig_cost_ms` is what moving costs then); `after_failure` is what follows
from a failure.
"""

import enum
import hashlib
import re
from collections.abc import Iterable, Mapping

from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import DeadlineError, NotFoundError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.model.transfer_api import DIGEST_BYTES, Manifest
from appliance.pool.selection import Link

MOST_CHUNK_BYTES = 4 * 2**20
"""Half a payload: `plane.max_payload_bytes`."""
LEAST_CHUNK_BYTES = 16 * 2**10
_HEX = re.compile(r"[0-9a-f]{64}")


def root_digest(size_bytes: int, chunk_bytes: int, chunks: bytes) -> str:
    """SHA-256 over size, chunk size and the chunks' digests, hexadecimal."""
    return hashlib.sha256(b"chunks %d %d " % (size_bytes, chunk_bytes) + chunks).hexdigest()


def is_digest(text: str) -> bool:
    """Whether a text is a SHA-256 in hexadecimal."""
    return _HEX.fullmatch(text) is not None


def check_manifest(manifest: Manifest, *, kind: str, name: str, most_bytes: int) -> None:
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


_SHARE = 0.3
"""Of a new sample in a moving average: a handful of transfers tell the new state of a link."""
_LEAST_SAMPLE_S = 1e-4


class Window:
    """Flow control of one transfer: how many chunks may be outstanding.

    It begins with two, grows by one for each chunk that arrives (doubling in a round trip) up to what the link
    carries in `in_flight_s`, and is halved when one does not arrive in time. Always 1 to `most`.
    """

    def __init__(self, *, most: int, in_flight_s: float, chunk_bytes: int, bytes_per_s: float | None = None) -> None:
        self._most, self._in_flight_s, self._chunk_bytes = most, in_flight_s, chunk_bytes
        self.bytes_per_s = bytes_per_s
        self._size = min(2, most)
        self._since: float | None = None
        self._bytes = 0

    @property
    def size(self) -> int:
        """Chunks that may be outstanding now."""
        if self.bytes_per_s is None:
            return self._size
        carried = int(self.bytes_per_s * self._in_flight_s / self._chunk_bytes) + 1
        return max(1, min(self._size, carried, self._most))

    def arrived(self, wire_bytes: int, now: float) -> None:
        """A chunk arrived, of so many bytes on the wire; `now` in seconds of a monotonic clock."""
        self._size = min(self._size + 1, self._most)
        if self._since is None:
            self._since = now  # what came before is not known to have been sent in a known time
            return
        self._bytes += wire_bytes
        passed = now - self._since
        if passed >= 0.02 and self._bytes:
            self.bytes_per_s = average(self.bytes_per_s, self._bytes / passed)
            self._since, self._bytes = now, 0

    def lost(self) -> None:
        """A chunk did not arrive in time, or its gateway was too busy."""
        self._size = max(1, self._size // 2)

    def timeout_s(self, least_s: float) -> float:
        """How long a chunk asked for now may take: what is on its way before it, and `least_s` beyond that."""
        if not self.bytes_per_s:
            return least_s * 2
        return least_s + 2 * self._size * self._chunk_bytes / self.bytes_per_s


def average(before: float | None, sample: float) -> float:
    """Exponentially weighted moving average; the first sample replaces a guess."""
    return sample if before is None else (1 - _SHARE) * before + _SHARE * sample


def updated_link(
    link: Link, *, size_bytes: int, move_s: float = 0.0, pack_s: float = 0.0, unpack_s: float = 0.0
) -> Link:
    """A link after one more transfer of `size_bytes`; a time of 0 was not measured."""

    def seen(before: float | None, took_s: float) -> float | None:
        if took_s <= 0 or size_bytes <= 0:
            return before
        return average(before, size_bytes / max(took_s, _LEAST_SAMPLE_S))

    return replace(
        link,
        bytes_per_s=seen(link.bytes_per_s, move_s),
        pack_bytes_per_s=seen(link.pack_bytes_per_s, pack_s),
        unpack_bytes_per_s=seen(link.unpack_bytes_per_s, unpack_s),
    )


class Next(enum.Enum):
    """What to do after a chunk could not be had."""

    AGAIN = "again"
    """Ask the same gateway again after a pause."""
    REFRESH = "refresh"
    """It no longer has what it announced: ask for its manifest again."""
    OTHER = "other"
    """Leave that gateway alone in this transfer."""


class Step(Struct, frozen=True):
    """What to do, and after how many seconds."""

    next: Next
    wait_s: float = 0.0


TRUST = 3
"""Bad chunks of one gateway in one transfer after which it is not asked any more: a flipped bit is no habit."""
FAILURES = 6
"""Failures in a row of one gateway after which another is tried."""


def after_failure(error: SwiftbotError, *, in_a_row: int, bad: int) -> Step:
    """Decide what follows from a failed chunk.

    Args:
        error: why there is no chunk; PayloadError: it came, and is not what was announced.
        in_a_row: failures of this gateway since its last good chunk, this one included.
        bad: bad chunks of this gateway in this transfer, this one included.
    """
    match error:
        case PayloadError():
            return Step(Next.AGAIN) if bad < TRUST else Step(Next.OTHER)
        case NotFoundError():
            return Step(Next.REFRESH, 0.1 * in_a_row)
        case DeadlineError() | RefusedError() if in_a_row < FAILURES:
            return Step(Next.AGAIN, min(2.0, 0.05 * 2**in_a_row))
        case UnreachableError():
            return Step(Next.OTHER)
        case _:
            return Step(Next.OTHER)
