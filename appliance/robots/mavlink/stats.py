"""What a link carries, loses and refuses: counted frame by frame, the clock passed in. Pure.

Loss is counted by sequence numbers, which each sender (system and component) raises by one for every frame, wrapping
after 255 (MAVLink guide, "Packet Loss"). What comes late was not lost after all. Latency is the time
of a TIMESYNC there and back (guide, "Time Synchronization Protocol").
"""

import math
from collections import OrderedDict

from msgspec import Struct

from appliance.robots.mavlink.address import Address

MAX_SENDERS = 256
"""Of one link; the longest silent is forgotten first."""
MAX_ASKED = 8
"""TIMESYNC questions to one end that may still be answered."""
_LATE = 128
"""A sequence number further ahead than this is one that comes late."""
_RESTARTED = 3
"""So many late ones in a row, each following the other, are a sender that began again."""
_SMOOTH = 0.25


class Sender(Struct):
    """What one sender's sequence numbers have told."""

    received: int = 0
    lost: int = 0
    late: int = 0
    repeated: int = 0
    heard_at: float = 0.0
    expected: int = -1
    """Sequence number of its next frame; below 0 before the first."""
    behind: int = 0
    """Late ones in a row, each following the other."""
    last_late: int = -1

    def hear(self, sequence: int, now: float) -> None:
        """Count a frame that is no repetition."""
        self.received += 1
        self.heard_at = now
        gap = 0 if self.expected < 0 else (sequence - self.expected) & 0xFF
        if gap >= _LATE:
            self.behind = self.behind + 1 if sequence == (self.last_late + 1) & 0xFF else 1
            self.last_late = sequence
            if self.behind < _RESTARTED:
                self.late += 1
                self.lost -= self.lost > 0
                return
            gap = 0  # it has begun again
        self.lost += gap
        self.behind, self.last_late = 0, -1
        self.expected = (sequence + 1) & 0xFF

    @property
    def loss(self) -> float:
        """Share of its frames that did not arrive."""
        sent = self.received + self.lost
        return self.lost / sent if sent else 0.0


class Latency(Struct):
    """Round trips to one end, milliseconds."""

    last_ms: float = math.nan
    least_ms: float = math.inf
    mean_ms: float = math.nan
    count: int = 0

    def add(self, milliseconds: float) -> None:
        """Take in a round trip."""
        self.last_ms = milliseconds
        self.least_ms = min(self.least_ms, milliseconds)
        self.mean_ms = milliseconds if not self.count else self.mean_ms + _SMOOTH * (milliseconds - self.mean_ms)
        self.count += 1


class Meter:
    """Frames and bytes a second, between two looks."""

    def __init__(self, now: float) -> None:
        self._at = now
        self._before = (0, 0, 0, 0)
        self.rates = (0.0, 0.0, 0.0, 0.0)

    def look(self, totals: tuple[int, int, int, int], now: float) -> None:
        """Work out the rates since the last look; one that comes too early changes nothing."""
        passed = now - self._at
        if passed < 0.5:
            return
        one, two, three, four = (
            round((total - before) / passed, 1) for total, before in zip(totals, self._before, strict=True)
        )
        self.rates = (one, two, three, four)
        self._at, self._before = now, totals


class LinkStats:
    """Counters of one link."""

    def __init__(self, now: float) -> None:
        self.frames_in = self.bytes_in = self.frames_out = self.bytes_out = 0
        self.repeated = 0
        self.senders: OrderedDict[tuple[int, int], Sender] = OrderedDict()
        self.latency: OrderedDict[Address, Latency] = OrderedDict()
        self.meter = Meter(now)
        self._asked: OrderedDict[tuple[Address, int], int] = OrderedDict()

    def sender(self, system: int, component: int) -> Sender:
        """Return a sender's counters."""
        found = self.senders.get((system, component))
        if found is None:
            while len(self.senders) >= MAX_SENDERS:
                del self.senders[min(self.senders, key=lambda each: self.senders[each].heard_at)]
            found = self.senders[system, component] = Sender()
        return found

    def look(self, now: float) -> None:
        """Bring the rates up to date."""
        self.meter.look((self.frames_in, self.bytes_in, self.frames_out, self.bytes_out), now)

    # --- latency -----------------------------------------------------------------------------------------------

    def asked(self, end: Address, stamp: int, now_ns: int) -> None:
        """Note that an end was asked for its time, with that stamp."""
        self._asked[end, stamp] = now_ns
        while len(self._asked) > MAX_ASKED * max(1, len(self.latency) + 1):
            self._asked.popitem(last=False)

    def answered(self, end: Address, stamp: int, now_ns: int) -> bool:
        """Take in an answer; whether it was one to a question of ours."""
        at = self._asked.pop((end, stamp), None)
        if at is None:
            return False
        found = self.latency.setdefault(end, Latency())
        found.add((now_ns - at) / 1e6)
        while len(self.latency) > MAX_SENDERS:
            self.latency.popitem(last=False)
        return True


class Bucket(Struct):
    """How much more one end may send just now."""

    level: float
    at: float


class Limiter:
    """Lets each end send so many frames a second, and a burst of as many; who sends more harms nobody else.

    Args:
        per_s: frames a second; 0 for no limit.
        most: ends remembered; the longest silent is forgotten first.
    """

    def __init__(self, per_s: float, *, most: int = 1024) -> None:
        self._per_s = per_s
        self._most = most
        self._ends: OrderedDict[Address, Bucket] = OrderedDict()

    def wait_s(self, end: Address, now: float) -> float:
        """Return for how long an end has to be silent before it is heard again; 0: not at all."""
        if not self._per_s:
            return 0.0
        bucket = self._bucket(end, now)
        bucket.level = min(self._per_s, bucket.level + (now - bucket.at) * self._per_s)
        bucket.at = now
        self._ends.move_to_end(end)
        return 0.0 if bucket.level > 0 else max(1e-3, -bucket.level / self._per_s)

    def spent(self, end: Address, frames: int, now: float) -> None:
        """Count what an end has sent, good or damaged."""
        if self._per_s:
            # One datagram or piece of a stream may overdraw, and is waited for.
            self._bucket(end, now).level -= frames

    def _bucket(self, end: Address, now: float) -> Bucket:
        found = self._ends.get(end)
        if found is None:
            found = self._ends[end] = Bucket(self._per_s, now)
            while len(self._ends) > self._most:
                self._ends.popitem(last=False)
        return found
