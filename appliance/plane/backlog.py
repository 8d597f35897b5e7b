"""What a session has put lately, numbered, so that a recorder can tell what it lacks and fetch it.

A put reaches those who are linked at that moment. A recorder that is just being linked again (the gateway or the
recorder has started, or their link stood still for longer than a lease) lacks what was put meanwhile, and without
numbers does not even know. So every put and delete of a session carries a number (Zenoh's source info), and the session
keeps the last ones for a few seconds; of older ones it still knows under what kind of key they were. `Follower` in
`record.following` is the other side.
"""

import threading
import time
from collections import deque
from functools import lru_cache

import msgspec
from msgspec import Struct

from appliance.errors import PayloadError
from appliance.model import keyspace
from appliance.model.keys import fleet_and_rest

NUMBERS = 2**32 - 1
"""Numbers go from 1 to this and begin again: Zenoh has 32 bits for them, and 0 is none."""
MOST_KEYS = 20_000
"""Puts whose kind of key is remembered after they themselves are gone: about 2 MB."""
UNKNOWN = "(unknown)"
"""Kind of key of puts of which nobody knows it any more."""
ANSWER_BYTES = 2**20
"""Payloads of one answer; the asking side asks again for the rest."""
_ENTRY_BYTES = 250
"""What an entry takes beside its payload."""


class BacklogAsk(Struct, frozen=True, array_like=True):
    """Asks for puts `first` to `last`, both included; those from before `since_ns` are not wanted."""

    first: int
    last: int
    since_ns: int = 0


class Said(Struct, frozen=True, array_like=True, gc=False):
    """A put or delete as it was made; `at_ns` is its Zenoh timestamp."""

    number: int
    key: str
    at_ns: int
    payload: bytes
    encoding: str
    deleted: bool


class Backlogged(Struct, frozen=True, array_like=True):
    """The answer. `upto`: the last number that it accounts for; less than what was asked when there is more."""

    said: tuple[Said, ...]
    lost: dict[str, int]
    """Those that are not kept any more, by kind of key (`kind_of`)."""
    upto: int
    forgotten: int = 0
    """Of the wanted ones: those of which not even the key is known. Counted when the session began after `since_ns`."""


def after(number: int, other: int) -> int:
    """How far a number is behind another: 1 is the next one, 0 the same, negative: it is before it."""
    ahead = (number - other) % NUMBERS
    return ahead if ahead < NUMBERS // 2 else ahead - NUMBERS


def moved(number: int, by: int) -> int:
    """The number so many behind another (negative: before it)."""
    return (number - 1 + by) % NUMBERS + 1


@lru_cache(4096)
def kind_of(key: str) -> str:
    """The kind of a key, without fleet and names: `gw/*/log`, `robot/*/mavlink/*`, `operator/act/*`."""
    topic = keyspace.topic_of(key)
    if topic is not None:
        return topic.kind
    fleet, rest = fleet_and_rest(key)
    return f"{rest.partition('/')[0]}/**" if fleet else key


class Backlog:
    """The puts of one session. Thread-safe: puts come from the sender's thread, questions from the event loop.

    Args:
        payload_bytes: bound of what is kept, with what an entry takes beside its payload; 0: nothing is kept.
        seconds: how long a put is kept.
    """

    def __init__(self, *, payload_bytes: int, seconds: float) -> None:
        self._most_bytes, self._keep_ns = payload_bytes, int(seconds * 1e9)
        self._lock = threading.Lock()
        self._kept: deque[Said] = deque()
        self._bytes = 0
        self._older: deque[tuple[str, int, int]] = deque(maxlen=MOST_KEYS)
        """Kind of key, time and number of those that are gone."""
        self._last = 0
        self._began_ns = time.time_ns()
        self._unsent: list[str] = []

    @property
    def last(self) -> int:
        """The last number given; 0 before the first."""
        return self._last

    def say(self, key: str, at_ns: int, payload: bytes, encoding: str, *, deleted: bool = False) -> int:
        """Number a put that is made now; returns its number."""
        with self._lock:
            if self._unsent:
                for unsent in self._unsent:
                    self._older.append((kind_of(unsent), at_ns, self._next()))
                self._unsent.clear()
            number = self._next()
            if not self._most_bytes:
                self._older.append((kind_of(key), at_ns, number))
                return number
            kept = self._kept
            kept.append(Said(number, key, at_ns, payload, encoding, deleted))
            self._bytes += len(payload) + _ENTRY_BYTES
            # What is too old or too much goes.
            while kept and (self._bytes > self._most_bytes or at_ns - kept[0].at_ns > self._keep_ns):
                old = kept.popleft()
                self._bytes -= len(old.payload) + _ENTRY_BYTES
                self._older.append((kind_of(old.key), old.at_ns, old.number))
        return number

    def not_sent(self, key: str) -> None:
        """Give a number to a put that could not be sent: its absence is noticed at the next one that is."""
        with self._lock:
            if len(self._unsent) < MOST_KEYS:
                self._unsent.append(key)

    def answer(self, ask: BacklogAsk) -> Backlogged:
        """Return what is kept of what is asked for, and what is lost."""
        said: list[Said] = []
        size, upto, lost, known = 0, ask.last, dict[str, int](), 0

        def wanted(number: int) -> bool:
            return after(number, ask.first) >= 0 and after(ask.last, number) >= 0

        with self._lock:
            for kind, at_ns, number in self._older:
                if wanted(number):
                    known += 1
                    if at_ns >= ask.since_ns:
                        lost[kind] = lost.get(kind, 0) + 1
            for each in self._kept:
                if not wanted(each.number):
                    continue
                if size >= ANSWER_BYTES:
                    upto = said[-1].number
                    break
                known += 1
                if each.at_ns >= ask.since_ns:
                    said.append(each)
                    size += len(each.payload) + _ENTRY_BYTES
        forgotten = after(upto, ask.first) + 1 - known if self._began_ns >= ask.since_ns else 0
        return Backlogged(tuple(said), lost, upto, max(0, forgotten))

    async def answered(self, key: str, data: bytes) -> bytes:
        """Answer a question as it came; PayloadError when it is none."""
        try:
            ask = msgspec.msgpack.decode(data, type=BacklogAsk)
        except msgspec.MsgspecError as error:
            raise PayloadError(f"{key}: {error}") from error
        return msgspec.msgpack.encode(self.answer(ask))

    def _next(self) -> int:
        self._last = self._last % NUMBERS + 1
        return self._last
