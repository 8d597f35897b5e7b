"""How many chunks may be on their way, what a transfer will take, and what follows from a failure. Pure.

Bulk must not hold up what the gateways tell each other, so no more is on its way than the link carries in a fixed
time (`in_flight_s`): on a fast link that is the whole window, on a slow one a single chunk.
"""

import enum

from msgspec import Struct

from appliance.errors import (
    DeadlineError,
    NotFoundError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)

GUESS_BYTES_PER_S = 12.5e6
"""A link nobody has measured: 100 Mbit/s, the slowest wired one on a site."""
GUESS_HANDLING_BYTES_PER_S = 200e6
"""Packing or unpacking before it was measured: half of what one loaded core does."""
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


class Link(Struct, frozen=True, kw_only=True):
    """What is known of moving state from a gateway: moving averages, bytes per second; None: not measured yet."""

    bytes_per_s: float | None = None
    pack_bytes_per_s: float | None = None
    """Serialise, there."""
    unpack_bytes_per_s: float | None = None
    """Deserialise, here."""

    @property
    def bandwidth(self) -> float:
        """Bytes per second, a careful guess before it was measured."""
        return self.bytes_per_s or GUESS_BYTES_PER_S

    def cost_ms(self, size_bytes: int) -> float:
        """MigCost without the start: size / bandwidth + serialise + deserialise (algorithms, Container selection)."""
        pack = self.pack_bytes_per_s or GUESS_HANDLING_BYTES_PER_S
        unpack = self.unpack_bytes_per_s or GUESS_HANDLING_BYTES_PER_S
        return max(0, size_bytes) * (1 / self.bandwidth + 1 / pack + 1 / unpack) * 1e3


def average(before: float | None, sample: float) -> float:
    """Exponentially weighted moving average; the first sample replaces a guess."""
    return sample if before is None else (1 - _SHARE) * before + _SHARE * sample


def learned(link: Link, *, size_bytes: int, move_s: float = 0.0, pack_s: float = 0.0, unpack_s: float = 0.0) -> Link:
    """A link after one more transfer of `size_bytes`; a time of 0 was not measured."""

    def seen(before: float | None, took_s: float) -> float | None:
        if took_s <= 0 or size_bytes <= 0:
            return before
        return average(before, size_bytes / max(took_s, _LEAST_SAMPLE_S))

    return Link(
        bytes_per_s=seen(link.bytes_per_s, move_s),
        pack_bytes_per_s=seen(link.pack_bytes_per_s, pack_s),
        unpack_bytes_per_s=seen(link.unpack_bytes_per_s, unpack_s),
    )


class Next(enum.Enum):
    """What to do after a chunk could not be had."""

    AGAIN = "again"
    """Ask the same gateway again after a pause."""
    ASK_ANEW = "ask anew"
    """It no longer has what it announced: ask for its manifest anew."""
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
            return Step(Next.ASK_ANEW, 0.1 * in_a_row)
        case DeadlineError() | RefusedError() if in_a_row < FAILURES:
            return Step(Next.AGAIN, min(2.0, 0.05 * 2**in_a_row))
        case UnreachableError():
            return Step(Next.OTHER)
        case _:
            return Step(Next.OTHER)
