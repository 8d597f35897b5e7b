"""The ordinary write, ordered on the thread on which it comes, and acknowledged on the one that hears of its last copy.

Through the event loop a write wakes it five times: for itself, for the answer of each replica, for its own commit and
for what follows. Each time a thread hands over to another, and on a gateway with two cores the work of that is a good
part of a put (docs/benchmarks.md). Here a write that comes from another gateway is decided on Zenoh's thread, one of
this gateway on the event loop's; the copies go out at once, and what Zenoh's threads and the store's hear is counted
(`Copies`).

Only the ordinary: the ring is known whole, the key is this gateway's and compared, the record's state is in memory, all
replicas are known to listen. Whatever else there is the event loop does (`ordering`), and whatever is not as it should
be afterwards it mends: a replica that is late, gone, fails, or holds something else, or a commit that failed.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Final

import structlog

from appliance.errors import DeadlineError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import VersionVector, encode
from appliance.plane.lately import Lately
from appliance.plane.membership import Membership
from appliance.plane.messages import Found, StoreAsk, Written
from appliance.plane.pulse import Pulse
from appliance.plane.pushing import Pushing
from appliance.plane.rpc import AtOnce, Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.settling import Settling
from appliance.plane.store import Store
from appliance.plane.versions import Behind, Record, Write, decide

log = structlog.get_logger(__name__)

STORED: Final = encode(Found())
"""What a replica answers that keeps just what it was given."""
_ALL_STORED: Final = frozenset({STORED})
_MOST = 1024
"""Writes under way here; more go by the event loop, which refuses what is too much."""
_MOST_VALUE = 16 * 1024
"""Bytes of a value that fits into a plain message with all that goes with it."""
_LOOK_S = 0.1
"""Between looks for replicas that are late."""
_READY_S = 0.5
"""After a change of the ring before ways are made to who is new: a gateway that starts has other things to do."""
_NEXT_S = 0.01
"""Between two ways."""
_MOST_READY = 64
"""Members beyond which ways are made only when they are needed."""
_QUIET_LOOKS = 10
"""Looks that find nothing under way before nobody looks any more."""


class Copies:
    """What is heard of the copies of one decision: the owner's own, and one of each other replica. Any thread.

    `ended` is called once, on whichever thread hears the last: when its own is on the disk and all others have answered
    or are given up, or when its own could not be written.
    """

    def __init__(
        self, asked: Write, others: tuple[str, ...], ended: "Callable[[Copies], None]", answer: AtOnce
    ) -> None:
        self.asked = asked
        self.answer = answer
        self.record: Record | None = None
        self.problem: SwiftbotError | None = None
        """Why its own copy could not be written."""
        self.outcomes: dict[str, bytes | SwiftbotError] = {}
        """Replica -> what it answered; empty: it must be asked again, by the event loop."""
        self.numbers: list[int] = []
        """Of the questions that were sent."""
        self.over = False
        self.began = time.monotonic()
        self._missing = set(others)
        self._committed = False
        self._ended = ended
        self._lock = threading.Lock()

    def committed(self, record: Record | None, error: Exception | None) -> None:
        """Its own copy is on the disk, or could not be written."""
        with self._lock:
            self._committed = True
            self.record = record or self.record
            if error is not None:
                self.problem = error if isinstance(error, SwiftbotError) else SwiftbotError(f"not stored: {error}")
            over = self._finish()
        if over:
            self._ended(self)

    def heard(self, replica: str, outcome: bytes | SwiftbotError) -> None:
        """A replica answered, or is known not to; only the first counts."""
        with self._lock:
            if replica not in self._missing:
                return
            self._missing.discard(replica)
            self.outcomes[replica] = outcome
            over = self._finish()
        if over:
            self._ended(self)

    def give_up(self, error: SwiftbotError) -> None:
        """Wait for no more answers."""
        for replica in tuple(self._missing):
            self.heard(replica, error)

    def abandon(self, error: SwiftbotError) -> bool:
        """Count nothing any more; whether this is what ended it, and whoever asked is still to be told."""
        with self._lock:
            if self.over:
                return False
            self.over, self.problem = True, error
        return True

    def _finish(self) -> bool:
        if self.over or not self._committed or (self._missing and self.problem is None):
            return False
        self.over = True
        return True

    @property
    def stored(self) -> bool:
        """Whether all have just what was decided."""
        return self.problem is None and set(self.outcomes.values()) <= _ALL_STORED


class FastPath:
    """The ordinary writes under way at one gateway.

    `unsaved`: keys whose last decision here the replicas may have and the disk has not. `agree` makes of a record, and
    what replicas hold in its place, the version that stands (errors as of `Dht.write`).
    """

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        settling: Settling,
        pulse: Pulse,
        pushing: Pushing,
        unsaved: set[str],
        lately: Lately,
        agree: Callable[[Record, Write, list[Record]], Awaitable[VersionVector]],
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._settling = settling
        self._pulse = pulse
        self._pushing = pushing
        self._unsaved = unsaved
        self._lately = lately
        self._agree = agree
        self._loop = asyncio.get_running_loop()
        self._under_way: set[Copies] = set()
        self._mending: set[asyncio.Task[None]] = set()
        self._readying: list[str] | None = None
        """Members to whom ways are still to be made."""
        self._watching = False
        self._quiet = 0
        self._closed = False

    async def write(self, asked: Write) -> Written | None:
        """Order a write of this gateway's own; None: nothing was done, it has to go the other way.

        Raises:
            ConflictError: a replica holds what somebody else has written.
            SwiftbotError: the disk fails.
        """
        done: asyncio.Future[Written] = self._loop.create_future()

        def answer(outcome: object) -> None:
            # The loop may be gone when the process ends without closing: then nobody waits.
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(_settle, done, outcome)

        copies = self._order(asked, answer)
        if copies is None:
            return None
        # Looked at by the clock: one that is silent must hold up a takeover no longer than it has to.
        timer = self._loop.call_later(self._config.replica_timeout_s, self._late, copies)
        try:
            return await done
        finally:
            timer.cancel()

    def order(self, asked: Write, answer: AtOnce) -> bool:
        """Order another gateway's write, on a thread of Zenoh's; False: nothing was done, the event loop has to."""
        copies = self._order(asked, answer)
        if copies is not None and not self._watching:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._watch)
        return copies is not None

    def _order(self, asked: Write, answer: AtOnce) -> Copies | None:
        key = asked.key
        if self._closed or len(asked.value) > _MOST_VALUE:
            return None
        if key in self._unsaved or len(self._under_way) >= _MOST or not self._settling.mine(key):
            return None
        owner, *others = self._membership.ring.successors(key, self._config.replicas)
        ways = [self._rpc.known_way(each, "dht_store") for each in others]
        if owner != self._gateway or None in ways:
            return None
        copies = Copies(asked, tuple(others), self._ended, answer)
        try:
            record = self._store.decide_now(key, partial(self._decide, copies), copies.committed, durable=asked.durable)
        except (SwiftbotError, Behind):
            record = None  # whoever asked is told why by the event loop, which looks again
        if record is None:
            if copies in self._under_way:  # it was decided and could not be queued
                self._under_way.discard(copies)
                self._lately.failed(key, asked.write)
            return None
        try:
            payload = encode(StoreAsk(record, asked.durable))
            for replica, way in zip(others, ways, strict=True):
                heard = partial(copies.heard, replica)
                number = None if way is None else self._rpc.ask_here(way, replica, "dht_store", payload, heard)
                if number is None:
                    copies.heard(replica, b"")
                else:
                    copies.numbers.append(number)
        finally:
            # Only now: the store's thread wants the interpreter too. What was decided is committed, whatever happens.
            self._store.wake()
        if copies.over:
            self._forget(copies)  # those that were sent after it had ended
        return copies

    def _forget(self, copies: Copies) -> None:
        for number in copies.numbers:
            self._rpc.forget(number)

    def _decide(self, copies: Copies, current: Record | None) -> Record:
        if self._pulse.doubtful:
            raise RefusedError(f"{self._gateway} stood still and may have been succeeded", remedy="ask again")
        asked = copies.asked
        record = decide(current, asked, self._gateway)
        if record is not current:
            # Before the store has it: where nobody else has a copy its commit may end it on the spot.
            copies.record = record
            self._lately.began(asked.key, asked.write)
            self._under_way.add(copies)
        return record

    # --- ways -------------------------------------------------------------------------------------------------

    def ring_changed(self) -> None:
        """Others may hold copies from now on: the ways to them are made before the first write wants them."""
        members = self._membership.members
        if self._config.mode != "peer" or len(members) > _MOST_READY:
            return
        waits, self._readying = self._readying is not None, sorted(members - {self._gateway})
        if not waits:
            self._loop.call_later(_READY_S, self._make_ready)

    def _make_ready(self) -> None:
        if not self._readying or self._closed:
            self._readying = None
            return
        name = self._readying.pop()
        if self._rpc.known_way(name, "dht_store") is None:
            self._rpc.make_way(name, "dht_store")
        self._loop.call_later(_NEXT_S, self._make_ready)

    # --- what was heard ---------------------------------------------------------------------------------------

    def _ended(self, copies: Copies) -> None:
        """The last was heard, on some thread."""
        self._under_way.discard(copies)
        record = copies.record
        if copies.stored and record is not None:
            self._lately.ended(record.key, copies.asked.write, record.version)
            copies.answer(Written(record.version))
            return
        if copies.problem is not None:
            # The replicas may have it: before the next decision on this key they are asked.
            self._unsaved.add(copies.asked.key)
        # The loop may be gone when the process ends without closing: then nobody waits.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._begin_mending, copies)

    def _begin_mending(self, copies: Copies) -> None:
        task = self._loop.create_task(self._mend(copies))
        self._mending.add(task)
        task.add_done_callback(self._mending.discard)

    async def _mend(self, copies: Copies) -> None:
        """Do what an unusual end asks for, and tell whoever asked."""
        self._forget(copies)
        asked = copies.asked
        try:
            version = await self._mended(copies)
        except SwiftbotError as error:
            problem = error
        except asyncio.CancelledError:
            copies.answer(_STOPPING)
            raise
        except Exception as defect:  # supervision boundary: whoever asked must hear of it
            log.exception("a write could not be ended", key=asked.key)
            problem = SwiftbotError(f"{type(defect).__name__}: {defect}")
        else:
            self._lately.ended(asked.key, asked.write, version)
            copies.answer(Written(version))
            return
        self._lately.failed(asked.key, asked.write)
        copies.answer(problem)

    async def _mended(self, copies: Copies) -> VersionVector:
        record = copies.record
        if copies.problem is not None or record is None:
            raise copies.problem or SwiftbotError("a decision without a record")
        held = [await self._held(copies, record, replica, each) for replica, each in copies.outcomes.items()]
        return await self._agree(record, copies.asked, [each for each in held if each is not None])

    async def _held(
        self, copies: Copies, record: Record, replica: str, outcome: bytes | SwiftbotError
    ) -> Record | None:
        """What a replica holds in place of a record, if anything."""
        if isinstance(outcome, SwiftbotError):
            self._pushing.failed(replica, record, outcome)
            return None
        if not outcome:
            return await self._pushing.push(replica, record, durable=copies.asked.durable)
        try:
            return self._rpc.decode(replica, "dht_store", outcome, Found).record
        except SwiftbotError as error:
            self._pushing.failed(replica, record, error)
            return None

    # --- time -------------------------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Look for replicas that are late, as long as there is something to look for; on the event loop's thread."""
        if not self._watching and not self._closed:
            self._watching, self._quiet = True, 0
            self._loop.call_later(_LOOK_S, self._look)

    def _look(self) -> None:
        until = time.monotonic() - self._config.replica_timeout_s
        under_way = tuple(self._under_way)
        for copies in under_way:
            if copies.began <= until:
                self._late(copies)
        self._quiet = 0 if under_way else self._quiet + 1
        if self._quiet < _QUIET_LOOKS and not self._closed:
            self._loop.call_later(_LOOK_S, self._look)
            return
        self._watching = False
        # One that began in this moment has seen that somebody looks.
        if self._under_way:
            self._watch()

    def _late(self, copies: Copies) -> None:
        copies.give_up(DeadlineError(f"no answer within {self._config.replica_timeout_s:g} s"))

    async def close(self) -> None:
        """Tell whoever waits that this gateway stops."""
        self._closed = True
        for copies in tuple(self._under_way):
            if copies.abandon(_STOPPING):
                copies.answer(_STOPPING)
        self._under_way.clear()
        for task in tuple(self._mending):
            task.cancel()
        await asyncio.gather(*self._mending, return_exceptions=True)


_STOPPING: Final = UnreachableError("whoever was asked is stopping", remedy="ask another gateway")


def _settle(done: "asyncio.Future[Written]", outcome: object) -> None:
    if done.done():
        return
    if isinstance(outcome, Written):
        done.set_result(outcome)
    else:
        done.set_exception(outcome if isinstance(outcome, SwiftbotError) else SwiftbotError(f"no answer: {outcome!r}"))
