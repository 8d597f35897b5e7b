"""The thin wrapper around a Zenoh session: put, subscribe, query, serve, liveliness.

It exists to keep three promises. What a subscriber or handler is called with comes on the event loop's thread (a filter
and `Flood` alone run on threads of their own). Every payload that arrives is bounded, and one that is malformed or
oversize is counted, logged and dropped or answered with an ErrorReply. Nothing that is sent can hang the loop: sends
block when a peer is stuck (dropping would lose facts silently), but they do so on a thread of their own, and a peer
stuck for a lease is disconnected.

`Session` puts its parts together, each around the same `Wire`, which has the library's session and the two queues to
and from its threads, `Inbox` and `Outbox`:

- `Publishing`: facts that are put for all listeners; `Flood` for consumers of all of them,
- `Presence`: liveliness tokens,
- `Answering` and `Verbs`: questions of others, each in a task of its own, bounded; every defect of a handler ends here,
- `Asking`: questions to one that serves a key, or to everybody: bounded in time and size, and over when the session is,
- `Doors`: which links are reopened when questions arrive at wrong doors.

**Wrong doors.** After links were reopened Zenoh 1.10 has been seen to deliver questions to the wrong queryable, for
good: the two ends of a link disagree about which number stands for which key (zenoh issue 1886). The one that is asked
refuses such a question, and a new link mends it. But anybody may attach a wrong key to a question, or answer that a
door is the wrong one, and say that it is somebody else. So nobody's word breaks a link that others use:

- the one that *asked*, and is linked to the one that answered, reopens just that link. The one that was asked does
  nothing: the link is the same, and the asker has no doubt about what it meant.
- where there is something between the two, the link that is mixed up is not known. Then all of Zenoh's links of this
  process are reopened, but only when two different sessions have met a wrong door here within a minute: one is not
  believed, and an attempt that fails for such a reason is made by another gateway next.
- one that *finds by itself* that links of its own cannot be right (`membership.Outlived`) reopens all of them: nobody
  said so.

**Reopening.** Zenoh fixes access control and certificate of a session when it opens (zenoh issue 2169).
`Session.reopen` closes the library's session and opens another in its place, with what is configured by then, in some
15 ms. What is declared (`Wire.declare`) is declared again there, in the order of `Rank`. Nothing that is sent meanwhile
is lost: it waits in its queue until those who were linked before are linked again. Tokens that were seen count as there
until `BACK_S` later, and questions and answers under way have `QUIET_S` to end before.

**One queryable for all verbs.** Among peers all verbs of a gateway are behind one queryable, `gw/{gateway}/rpc/*`;
behind a router there is one for each. A queryable for each would be some eighty of a gateway, and Zenoh tells every
session of each and compares every key with all of them: with eight gateways on two cores one that was restarted showed
its token 30 ms after its session was open, and 19 ms with one queryable. With 300 members behind one router, though,
three of four fleets with one queryable each never came to rest: some members were seen, but nothing they said was heard
(docs/benchmarks.md). Why is not known; of ten with a queryable for each verb all did. The recorder and other clients of
Zenoh see no difference: the keys are the same.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false

import asyncio
import contextlib
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec
import structlog
import zenoh
from msgspec import Struct

from appliance.errors import (
    DeadlineError,
    IdentityError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.identity.member import SENDER, Identity
from appliance.model import encode, keyspace
from appliance.model.keys import Keys, P, Roles, Topic
from appliance.plane import link
from appliance.plane.backlog import Backlog
from appliance.plane.link import CALM_S, SocketWatch, address_of
from appliance.plane.settings import PlaneConfig

if TYPE_CHECKING:
    from appliance.identity.credentials import Credentials

log = structlog.get_logger(__name__)

REVOKED = "the certificate of that robot is revoked"
_INBOX_TURN = 256
"""Deliveries per turn of the loop, so that a flood does not starve everything else."""
_OUTBOX_TURN = 64
"""Sends that the sender's thread takes at once."""


class Inbox:
    """Calls from any thread to the event loop's thread, in order; one wake-up however many wait.

    `on_dropped` is called on the loop's thread with how many were dropped, once the burst is over.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        *,
        messages: int,
        payload_bytes: int,
        on_dropped: Callable[[int], None] | None = None,
    ) -> None:
        self._loop = loop
        self._on_dropped = on_dropped
        self._told = 0
        self._most, self._most_bytes = messages, payload_bytes
        self._waiting: deque[tuple[Callable[[], None], int]] = deque()
        self._bytes = 0
        self._woken = False
        self._lock = threading.Lock()
        self._closed = False
        self.dropped = 0

    def post(self, call: Callable[[], None], size: int = 0, *, must: bool = False) -> bool:
        """Queue a call; False when it was dropped. `must` is for the few that are never many (ends of queries)."""
        with self._lock:
            if self._closed:
                return False
            if not must and (len(self._waiting) >= self._most or self._bytes + size > self._most_bytes):
                self.dropped += 1
                return False
            self._waiting.append((call, size))
            self._bytes += size
            wake, self._woken = not self._woken, True
        if wake:
            self._wake()
        return True

    def _wake(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self._deliver)
        except RuntimeError:  # the loop was closed without closing the session: nobody is left to deliver to
            self.close()

    def _deliver(self) -> None:
        for _ in range(_INBOX_TURN):
            with self._lock:
                if not self._waiting:
                    self._woken = False
                    break
                call, size = self._waiting.popleft()
                self._bytes -= size
            try:
                call()
            except Exception:  # supervision boundary: one receiver's defect must not end the others' deliveries
                log.exception("a receiver failed")
        else:
            self._loop.call_soon(self._deliver)
            return
        dropped = self.dropped
        if dropped > self._told and self._on_dropped is not None:
            self._on_dropped(dropped - self._told)
        self._told = dropped

    def close(self) -> None:
        """Forget what waits and take no more."""
        with self._lock:
            self._closed = True
            self._waiting.clear()


TELEMETRY_PART = 0.75
"""Of a queue that telemetry may fill: the rest is for orders, tasks, stops and all else that comes seldom."""


class Outbox:
    """Sends in order on a thread of its own, so that a stuck peer holds up that thread and never the loop."""

    def __init__(self, *, messages: int, payload_bytes: int) -> None:
        self._most, self._most_bytes = messages, payload_bytes
        self._waiting: deque[tuple[Callable[[], None], int]] = deque()
        self._taken: deque[tuple[Callable[[], None], int]] = deque()
        """Sends that the thread has taken and not made yet."""
        self._bytes = 0
        self._some = threading.Condition(threading.Lock())
        self._idle = False
        self._closed = False
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="zenoh sender", daemon=True)
        self._thread.start()

    def send(self, call: Callable[[], None], size: int, *, part: float = 1.0) -> bool:
        """Queue a send; False when it was dropped because the queue is full, or as full as `part` of it."""
        with self._some:
            if self._closed or len(self._waiting) >= part * self._most or self._bytes + size > part * self._most_bytes:
                self.dropped += 1
                return False
            self._waiting.append((call, size))
            self._bytes += size
            if self._idle:
                self._some.notify()
        return True

    @property
    def waiting(self) -> int:
        """Sends that wait."""
        return len(self._waiting) + len(self._taken)

    def _run(self) -> None:
        waiting, taken, taken_bytes = self._waiting, self._taken, 0
        while True:
            with self._some:
                self._bytes -= taken_bytes
                while not waiting:
                    if self._closed:
                        return
                    self._idle = True
                    self._some.wait()
                    self._idle = False
                # Some at once: the lock costs as much as a small send.
                taken.extend(waiting.popleft() for _ in range(min(len(waiting), _OUTBOX_TURN)))
                taken_bytes = sum(size for _, size in taken)
            while taken:
                call, _ = taken.popleft()
                try:
                    call()
                except Exception:  # supervision boundary: one failed send must not end the others
                    log.exception("a send failed")

    def close(self, timeout_s: float) -> None:
        """Send what waits, for at most that long. Blocks; call it off the loop."""
        with self._some:
            self._closed = True
            self._some.notify()
        self._thread.join(timeout_s)
        with self._some:
            self._waiting.clear()
            self._taken.clear()


# The library's stubs leave out the return types of methods that return nothing.


class Closer:
    """Ends a subscription, service or token; more than once does no harm."""

    def __init__(self, end: Callable[[], None]) -> None:
        self._end: Callable[[], None] | None = end

    @property
    def closed(self) -> bool:
        """Whether it was ended; what was under way to the loop then is not delivered any more."""
        return self._end is None

    def close(self) -> None:
        """End it."""
        end, self._end = self._end, None
        if end is not None:
            # An entity of a closed session is gone already.
            with contextlib.suppress(zenoh.ZError):
                end()


class Rank(IntEnum):
    """The order in which what is declared is declared again on a session that was reopened."""

    SUBSCRIPTION = 1
    """With services: who sees the token of this process is heard and answered."""
    WATCH = 2
    TOKEN = 3


class _Declared:
    """Something declared on a session, which `make` declares on another one."""

    def __init__(self, rank: Rank, make: Callable[[zenoh.Session], Callable[[], None]]) -> None:
        self.rank = rank
        self.make = make
        self.undeclare: Callable[[], None] | None = None
        """None while the session is being reopened."""


class Wire:
    """A Zenoh session with its queues; `plane.session` makes and closes it."""

    def __init__(
        self,
        config: PlaneConfig,
        fleet: str,
        raw: zenoh.Session,
        loop: asyncio.AbstractEventLoop,
        credentials: "Credentials | None" = None,
    ) -> None:
        self.config = config
        self.credentials = credentials
        self.keys = Keys(fleet)
        self.raw = raw
        self.source = zenoh.SourceInfo(raw.id, 0)
        """Where puts come from: the same for as long as this process lives, so that their numbers go on."""
        self.asker = self.source
        """What questions say of where they come from: the session that is linked."""
        self.held = False
        """Questions wait: the session is about to be reopened, or others are not linked again yet."""
        self._held_questions: deque[tuple[str, Callable[[], None], int]] = deque()
        self._go_on = threading.Event()
        """What holds up the senders' threads meanwhile, until it is set."""
        self.reopening = False
        """There is no session of the library just now: nothing may use `raw`."""
        self._declared: dict[int, _Declared] = {}
        self.backlog = Backlog(payload_bytes=config.backlog_bytes, seconds=config.backlog_s)
        """What this session has put lately."""
        self.loop = loop
        self.refused: dict[str, int] = {}
        self.on_denied: Callable[[str, str, str, str], None] | None = None
        """Called by `deny`, with its arguments."""
        self.closed = False
        self.inbox = Inbox(
            loop,
            messages=config.queue_messages,
            payload_bytes=config.queue_bytes,
            on_dropped=lambda count: self.refuse("incoming queue full", count=count),
        )
        self.outbox = self._new_outbox()
        self._bulk: Outbox | None = None
        """Of its own, so that facts and orders never wait behind a volume on a slow link."""

    def _new_outbox(self) -> Outbox:
        return Outbox(messages=self.config.queue_messages, payload_bytes=self.config.queue_bytes)

    def declare(self, rank: Rank, make: Callable[[zenoh.Session], Callable[[], None]]) -> Closer:
        """Declare something now, and again whenever the session is reopened; on the event loop's thread.

        Args:
            rank: in which order then.
            make: declares it on a session, and returns what undeclares it.
        """
        declared = _Declared(rank, make)
        if not self.reopening:
            declared.undeclare = make(self.raw)
        self._declared[id(declared)] = declared

        def end() -> None:
            del self._declared[id(declared)]
            if declared.undeclare is not None:
                declared.undeclare()

        return Closer(end)

    def hold_questions(self) -> None:
        """Have questions wait from now on, but urgent ones; `let_go` sends them. Puts and answers go on."""
        self.held = True

    async def hold_all(self, within_s: float) -> None:
        """Send what waits, and hold what comes after it; a stuck peer holds this up for so long at most."""
        self._go_on = go_on = threading.Event()
        reached: list[threading.Event] = []
        for outbox in (self.outbox, self._bulk):
            if outbox is None:
                continue
            here = threading.Event()

            def wait(here: threading.Event = here) -> None:
                here.set()
                go_on.wait()

            if outbox.send(wait, 0):
                reached.append(here)
        until = time.monotonic() + within_s
        for each in reached:
            await asyncio.to_thread(each.wait, max(0.0, until - time.monotonic()))

    def let_go(self) -> None:
        """Send again, first what waited."""
        self._go_on.set()
        self.held = False
        while self._held_questions:
            self.send(*self._held_questions.popleft())

    def ask(self, key: str, ask: Callable[[], None], size: int, *, direct: bool = False, urgent: bool = False) -> None:
        """Have a question sent, by the sender's thread; `direct`: by this one, where nothing holds it up.

        `urgent`: also while questions wait for the session to be reopened.
        """
        if urgent:
            self.send(key, ask, size)
        elif self.held and len(self._held_questions) >= self.config.queue_messages:
            self.refuse("outgoing queue full", key=key)
        elif self.held:
            self._held_questions.append((key, ask, size))
        elif direct:
            link.quietly(ask, key)
        else:
            self.send(key, ask, size)

    async def replace(self, open_raw: Callable[[], zenoh.Session]) -> None:
        """Close the library's session, open another and declare there what was declared. Errors of `open_raw`."""
        if not self.reopening:
            self.reopening = True
            for declared in self._declared.values():
                declared.undeclare = None
            await asyncio.to_thread(self.raw.close)
        opening = asyncio.ensure_future(asyncio.to_thread(open_raw))
        try:
            self.raw = raw = await asyncio.shield(opening)
        except asyncio.CancelledError:
            # It opens all the same, and has to be closed with this one.
            self.raw = await opening
            raise
        self.asker = zenoh.SourceInfo(raw.id, 0)
        for declared in sorted(self._declared.values(), key=lambda each: each.rank):
            declared.undeclare = declared.make(raw)
        self.reopening = False

    def send(self, key: str, send: Callable[[], None], size: int, *, bulk: bool = False, part: float = 1.0) -> bool:
        """Have the sender's thread send; False when it does not fit into its queue, which is counted.

        `part`: of the queue that it may fill.
        """
        outbox = self.outbox
        if bulk:
            outbox = self._bulk = self._bulk or self._new_outbox()
        queued = outbox.send(partial(link.quietly, send, key), size, part=part)
        if not queued and not self.closed:
            self.refuse("outgoing queue full" if part == 1.0 else "outgoing telemetry thinned", key=key)
        return queued

    def refuse(self, what: str, *, count: int = 1, **fields: Any) -> None:
        """Count bad input; logged the first ten times, then at powers of two: a flood does not fill the log."""
        before = self.refused.get(what, 0)
        total = self.refused[what] = before + count
        if total <= 10 or before.bit_length() != total.bit_length():
            fields = {key: value[:300] if isinstance(value, str) else value for key, value in fields.items()}
            log.warning("refused", what=what, count=total, **fields)

    def deny(self, what: str, key: str, reason: str, by: str = "") -> None:
        """Refuse something for whom it is from: counted as bad input is, and told to the audit.

        Args:
            what: the kind.
            key: where it came.
            reason: why.
            by: name of who it was, where that is proven.
        """
        self.refuse(what, key=key, reason=reason)
        if self.on_denied is not None:
            self.on_denied(what, key, reason, by)

    def check_role(self, roles: Roles, what: str) -> None:
        """Raise IdentityError when this process has keys of a role that is not among those."""
        if self.credentials is not None:
            self.credentials.check_role(roles, what)

    def barred(self, key: str) -> bool:
        """Whether a key is of a robot whose certificate is revoked: Zenoh goes on letting its messages in."""
        if self.credentials is None or not self.credentials.barred:
            return False
        kind, _, rest = self.name(key).partition("/")
        return kind == "robot" and rest.partition("/")[0] in self.credentials.barred

    def name(self, expr: str) -> str:
        """A key without the fleet's root, for counts."""
        return expr.removeprefix(f"{self.keys.root}/")

    async def close(self, timeout_s: float) -> None:
        """Send what waits, for at most so long each queue, and close the library's session."""
        await asyncio.to_thread(self.outbox.close, timeout_s)
        if self._bulk is not None:
            await asyncio.to_thread(self._bulk.close, timeout_s)
        await asyncio.to_thread(self.raw.close)


WITNESS_S = 60.0
"""Within so long a second session must have met a wrong door, for links that are not known to be the ones."""
WITNESSES = 2
_MOST_KNOWN = 64
_AFTER_ANSWER_S = 0.05
"""Before links are broken, for answers that are on their way over them."""


class Mixups:
    """Decides when links are reopened. Pure; times are seconds of one monotonic clock."""

    def __init__(self) -> None:
        self._seen: OrderedDict[str, float] = OrderedDict()
        """Session of the other side -> when it last met a wrong door here, with something between."""
        self._broken: OrderedDict[str, float] = OrderedDict()
        """Session at the other end of a link -> when that was reopened; "" for all links."""

    def direct(self, other: str, now: float) -> bool:
        """Whether the link with a session is to be reopened, that answered a question of ours as not its own."""
        return self._calm(other, now)

    def relayed(self, other: str, now: float) -> bool:
        """Whether all links are, after a wrong door between this session and another that it has no link with."""
        if not other:
            return False  # nobody's word
        self._seen[other] = now
        self._seen.move_to_end(other)
        while len(self._seen) > _MOST_KNOWN or now - next(iter(self._seen.values())) > WITNESS_S:
            self._seen.popitem(last=False)
        if len(self._seen) < WITNESSES or not self._calm("", now):
            return False
        self._seen.clear()
        return True

    def renewed(self, now: float) -> None:
        """All links are reopened, for another reason."""
        self._broken[""] = now
        self._seen.clear()

    def _calm(self, link: str, now: float) -> bool:
        if now < self._broken.get(link, -CALM_S) + CALM_S:
            return False
        self._broken[link] = now
        self._broken.move_to_end(link)
        while len(self._broken) > _MOST_KNOWN:
            self._broken.popitem(last=False)
        return True


class Doors:
    """Reopens the links of one session when `Mixups` says so; called on the event loop's thread."""

    def __init__(self, wire: Wire, sockets: SocketWatch) -> None:
        self._wire = wire
        self._sockets = sockets
        self._mixups = Mixups()

    def was_wrong(self, asker: str) -> None:
        """A question came here that was meant for another key; `asker`: the session that it says it is of."""
        if not self._links(asker) and self._mixups.relayed(asker, self._wire.loop.time()):
            self._soon("")

    def met_wrong(self, replier: str) -> None:
        """A question of ours was answered by a session, which says it was meant for another key."""
        if self._links(replier):
            if self._mixups.direct(replier, self._wire.loop.time()):
                self._soon(replier)
        elif self._mixups.relayed(replier, self._wire.loop.time()):
            self._soon("")

    def renew(self, why: str) -> None:
        """Reopen all links; `why` is for the log."""
        self._mixups.renewed(self._wire.loop.time())
        self._break("", why)

    def _links(self, other: str) -> list[tuple[str, str]]:
        """Ends of the links with a session, or of all for the empty name."""
        if self._wire.closed or self._wire.reopening:
            return []
        found = self._wire.raw.info.links()
        return [(each.src, each.dst) for each in found if not other or str(each.zid) == other]

    def _soon(self, other: str) -> None:
        self._wire.loop.call_later(_AFTER_ANSWER_S, self._break, other, "questions arrived at wrong doors")

    def _break(self, other: str, why: str) -> None:
        ends = [(address_of(one), address_of(another)) for one, another in self._links(other)]
        broken = self._sockets.shut({(one, another) for one, another in ends if one and another})
        if broken:
            log.warning("links are reopened", why=why, links=broken, other=other or "all")


T = TypeVar("T")

FLOOD_QUEUED = 16_384
"""Messages that Zenoh queues: a third of a second at 50,000 a second."""
_FLOOD_BATCH = 2_048
_FLOOD_REST_S = (0.001, 0.02)
"""After nothing was there: first so long, doubled up to that. A log may be so late, a decision might not."""
_FLOOD_END_S = 5.0


class Flood(Generic[T]):
    """A subscription that is drained by a thread of its own.

    Args:
        raw: the Zenoh session.
        expr: what to hear.
        make: makes a message of key, time (Unix nanoseconds of the sender's clock, or of arrival without one), payload,
            Zenoh encoding, whether it is a deletion, and the session and number it has there (`plane.backlog`; "" and 0
            where the sender does not say).
        take: gets batches, in order, on the draining thread; must not block.
        limit: payload bytes beyond which a message is not taken.
        on_oversize: told key and size of such a one, on the draining thread.
    """

    def __init__(
        self,
        raw: zenoh.Session,
        expr: str,
        *,
        make: Callable[[str, int, bytes, str, bool, str, int], T],
        take: Callable[[list[T]], None],
        limit: int,
        on_oversize: Callable[[str, int], None],
    ) -> None:
        self._make, self._take = make, take
        self._limit, self._on_oversize = limit, on_oversize
        self._ending = threading.Event()
        self._encodings: dict[Any, str] = {}
        self._expr = expr
        self._subscriber = raw.declare_subscriber(expr, zenoh.handlers.FifoChannel(FLOOD_QUEUED))
        self._thread = threading.Thread(target=self._run, name="flood", daemon=True)
        self._thread.start()

    def go_on(self, raw: zenoh.Session) -> None:
        """Subscribe at another session: the one before was closed."""
        self._subscriber = raw.declare_subscriber(self._expr, zenoh.handlers.FifoChannel(FLOOD_QUEUED))

    def close(self) -> None:
        """Hand over what is there and end."""
        self._ending.set()
        self._thread.join(_FLOOD_END_S)
        with contextlib.suppress(zenoh.ZError):  # gone with its session
            self._subscriber.undeclare()

    def _run(self) -> None:
        rest_s = _FLOOD_REST_S[0]
        while True:
            ending = self._ending.is_set()
            subscriber, batch = self._subscriber, list[T]()
            receive = subscriber.handler.try_recv
            # The session may be closed under it, for good or to be reopened: then what has come is still there.
            with contextlib.suppress(zenoh.ZError):
                while len(batch) < _FLOOD_BATCH and (sample := receive()) is not None:
                    self._add(sample, batch)
            if batch:
                try:
                    self._take(batch)
                except Exception:  # supervision boundary: one receiver's defect must not stop the queue
                    log.exception("a receiver failed")
                rest_s = _FLOOD_REST_S[0]
            elif ending:
                return
            else:
                self._ending.wait(rest_s)
                rest_s = min(_FLOOD_REST_S[1], rest_s * 2)

    def _add(self, sample: zenoh.Sample, batch: list[T]) -> None:
        payload, stamp = sample.payload, sample.timestamp
        key = str(sample.key_expr)
        if len(payload) > self._limit:
            self._on_oversize(key, len(payload))
            return
        at_ns = stamp.get_time_as_ntp64().as_nanos() if stamp is not None else time.time_ns()
        deleted = sample.kind == zenoh.SampleKind.DELETE
        info = sample.source_info
        source, number = (f"{info.source_id.zid}/{info.source_id.eid}", info.source_sn) if info is not None else ("", 0)
        batch.append(self._make(key, at_ns, payload.to_bytes(), str(sample.encoding), deleted, source, number))


# The library's stubs leave out the return types of methods that return nothing.


class Message(Struct, frozen=True):
    """A put or delete as it arrived. `at_ns` is the sender's hybrid logical clock, Unix nanoseconds."""

    key: str
    payload: bytes
    deleted: bool
    at_ns: int
    encoding: str


class Publisher:
    """Puts of one key that has many facts a second: Zenoh looks the key up once, so that a put costs it a quarter."""

    def __init__(self, wire: Wire, publishing: "Publishing", key: str, encoding: str) -> None:
        self._wire = wire
        self._publishing = publishing
        self._key = key
        self._encoding = encoding
        self._raw: zenoh.Publisher | None = None
        """Declared at the first put; on the sender's thread alone."""
        self._at: zenoh.Session | None = None
        """Where it is declared."""

    def put(self, payload: bytes) -> None:
        """Publish; returns at once. As `Session.put` otherwise."""
        if len(payload) > self._wire.config.max_payload_bytes:
            self._wire.refuse("oversize put", key=self._key, size=len(payload))
        else:
            # What comes so often leaves a part of the queue to what does not: it is thinned before an order is lost.
            self._publishing.queue(self._key, partial(self._say, payload), len(payload), part=TELEMETRY_PART)

    def _say(self, payload: bytes) -> None:
        stamp, source = self._publishing.number(self._key, payload, self._encoding)
        if self._raw is None or self._at is not self._wire.raw:
            block, self._at = zenoh.CongestionControl.BLOCK, self._wire.raw
            self._raw = self._at.declare_publisher(self._key, encoding=self._encoding, congestion_control=block)
        self._raw.put(payload, timestamp=stamp, source_info=source)

    def close(self) -> None:
        """Undeclare it, behind what was put."""
        self._wire.send(self._key, self._undeclare, 0)

    def _undeclare(self) -> None:
        raw, self._raw = self._raw, None
        if raw is not None and self._at is self._wire.raw:
            raw.undeclare()


class Publishing:
    """Facts out and in of one session."""

    def __init__(self, wire: Wire, on_first: Callable[[], None] = lambda: None) -> None:
        """`on_first` is called on the sender's thread before the first put."""
        self._wire = wire
        self._on_first = on_first
        self._recorded = f"{wire.keys.root}/"
        self._source_id = wire.source.source_id

    def put(self, key: str, payload: bytes, *, encoding: str = "application/json", express: bool = False) -> None:
        """Publish; returns at once. What cannot be sent (too large, queue full) is counted and logged.

        `express`: at once, and what waits before it with it. Others may wait for a millisecond on each link for more
        to go in one packet, where something was sent just before.
        """
        if len(payload) > self._wire.config.max_payload_bytes:
            self._wire.refuse("oversize put", key=key, size=len(payload))
            return
        self._send(key, payload, encoding=encoding, express=express)

    def publish(self, topic: Topic[P], value: P, *names: str, express: bool = False) -> None:
        """Put a fact on the key of its topic with these names; as `put`.

        Raises:
            IdentityError: the role of this process may not put there; others would drop it without a word.
        """
        self._wire.check_role(topic.puts, f"put {topic.text}")
        self.put(self._wire.keys(topic, *names), encode(value), express=express)

    def delete(self, key: str) -> None:
        """Publish that a key's fact is gone."""
        self._send(key, None)

    def publisher(self, key: str, encoding: str) -> "Publisher":
        """Return the way to put a key that has many facts a second; to be closed when it has no more."""
        return Publisher(self._wire, self, key, encoding)

    def _send(self, key: str, payload: bytes | None, *, encoding: str = "", express: bool = False) -> None:
        self.queue(key, partial(self._say, key, payload, encoding, express), len(payload or b""))

    def queue(self, key: str, say: Callable[[], None], size: int, *, part: float = 1.0) -> None:
        """Have a put or delete of a key made on the sender's thread; `part` of its queue that this may fill."""
        if not self._wire.send(key, say, size, part=part) and self._is_recorded(key):
            self._wire.backlog.not_sent(key)

    def _is_recorded(self, key: str) -> bool:
        """Whether recorders subscribe to a key: they cannot miss what no wildcard matches."""
        return key.startswith(self._recorded) and "/@" not in key

    def number(self, key: str, payload: bytes | None, encoding: str) -> tuple[zenoh.Timestamp, zenoh.SourceInfo | None]:
        """Return the time and the number of a put made now (a delete: no payload); on the sender's thread."""
        backlog, stamp = self._wire.backlog, self._wire.raw.new_timestamp()
        if not self._is_recorded(key):
            return stamp, None
        if not backlog.last:
            self._on_first()
        at_ns = stamp.get_time_as_ntp64().as_nanos()
        number = backlog.say(key, at_ns, payload or b"", encoding, deleted=payload is None)
        return stamp, zenoh.SourceInfo(self._source_id, number)

    def _say(self, key: str, payload: bytes | None, encoding: str, express: bool) -> None:
        """Put, or delete where there is no payload, with number and time of its own; on the sender's thread."""
        raw, block = self._wire.raw, zenoh.CongestionControl.BLOCK
        stamp, source = self.number(key, payload, encoding)
        if payload is None:
            raw.delete(key, congestion_control=block, timestamp=stamp, source_info=source)
        else:
            raw.put(
                key,
                payload,
                encoding=encoding,
                congestion_control=block,
                express=express,
                timestamp=stamp,
                source_info=source,
            )

    def subscribe(
        self, expr: str, callback: Callable[[Message], None], *, heed: Callable[[str], bool] = lambda _: True
    ) -> Closer:
        """Have every put and delete under `expr` delivered, as bytes; oversize ones are counted and dropped.

        So is one on a key with `**`: Zenoh takes it for a put on all keys that this matches, of whatever form.
        `heed` is asked first, on a thread of Zenoh's, whether a key is anybody's business here: what is not does not
        wake the event loop. It must neither block nor go through what the event loop changes meanwhile.
        """
        name, limit = self._wire.name(expr), self._wire.config.max_payload_bytes

        def take(sample: zenoh.Sample) -> None:
            key, size = str(sample.key_expr), len(sample.payload)
            if "**" in key:
                self._wire.inbox.post(partial(self._wire.refuse, f"wildcard {name}", key=key))
                return
            if not heed(key):
                return
            if self._wire.barred(key):
                self._wire.inbox.post(partial(self._wire.deny, f"revoked {name}", key, REVOKED))
                return
            if size > limit:
                self._wire.inbox.post(partial(self._wire.refuse, f"oversize {name}", key=key, size=size))
                return
            stamp = sample.timestamp
            message = Message(
                key,
                sample.payload.to_bytes(),
                sample.kind == zenoh.SampleKind.DELETE,
                stamp.get_time_as_ntp64().as_nanos() if stamp else time.time_ns(),
                str(sample.encoding),
            )
            self._wire.inbox.post(partial(deliver, message), size)

        def deliver(message: Message) -> None:
            if not closer.closed:
                callback(message)

        def declare(raw: zenoh.Session) -> Callable[[], None]:
            return raw.declare_subscriber(expr, link.callback(take)).undeclare

        closer = self._wire.declare(Rank.SUBSCRIPTION, declare)
        return closer

    def flood(
        self, expr: str, make: Callable[[str, int, bytes, str, bool, str, int], T], take: Callable[[list[T]], None]
    ) -> Closer:
        """Have everything under `expr` delivered in batches, past the event loop, on a thread of its own (`Flood`).

        Oversize messages are counted as those of a subscription are.
        """
        wire, name = self._wire, self._wire.name(expr)

        def oversize(key: str, size: int) -> None:
            wire.inbox.post(partial(wire.refuse, f"oversize {name}", key=key, size=size))

        limit = wire.config.max_payload_bytes
        flood: Flood[T] | None = None

        def declare(raw: zenoh.Session) -> Callable[[], None]:
            nonlocal flood
            if flood is None:
                flood = Flood(raw, expr, make=make, take=take, limit=limit, on_oversize=oversize)
            else:
                flood.go_on(raw)
            return flood.close

        return wire.declare(Rank.SUBSCRIPTION, declare)

    def subscribe_typed(
        self,
        topic: Topic[P],
        callback: Callable[[str, P | None], None],
        *names: str,
        wanted: Callable[[str], bool] = lambda _: True,
        heed: Callable[[str], bool] = lambda _: True,
    ) -> Closer:
        """Have the facts of a topic delivered decoded, None when one is deleted; malformed ones are counted, dropped.

        With `names` those of the keys that have them; `*`, and names left out, are any.
        Those whose key is not `wanted` are not even decoded; `heed` as of `subscribe`.
        """
        expr = self._wire.keys(topic, *names)
        decoder, name = msgspec.json.Decoder(topic.payload), self._wire.name(expr)

        def take(message: Message) -> None:
            if not wanted(message.key):
                return
            if message.deleted:
                callback(message.key, None)
                return
            try:
                value = decoder.decode(message.payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                self._wire.refuse(f"malformed {name}", key=message.key, reason=str(error))
                return
            callback(message.key, value)

        return self.subscribe(expr, take, heed=heed)


# The library's stubs leave out the return types of methods that return nothing.


BACK_S = 3.0
"""After a session was reopened, its own or another gateway's, those who were there have so long to be seen again: a
client of plain Zenoh dials again after 1 s."""


class _Watch:
    """The tokens that a watch has seen; on the event loop's thread."""

    def __init__(self, callback: Callable[[str, bool], None], loop: asyncio.AbstractEventLoop) -> None:
        self._callback, self._loop = callback, loop
        self._alive: set[str] = set()
        self.going: dict[str, asyncio.TimerHandle] = {}
        """Tokens that have gone and may come back before that is reported."""

    def came(self, key: str) -> None:
        """A token is there."""
        if (timer := self.going.pop(key, None)) is not None:
            timer.cancel()
        if key not in self._alive:
            self._alive.add(key)
            self._callback(key, True)

    def went(self, key: str, *, held_s: float) -> None:
        """A token has gone; unless it comes back within so long, the callback hears of it then."""
        if key not in self._alive or key in self.going:
            return
        if held_s > 0:
            self.going[key] = self._loop.call_later(held_s, self._gone, key)
        else:
            self._gone(key)

    def all_went(self, *, held_s: float) -> None:
        """No token is seen any more: the session is being reopened."""
        for key in tuple(self._alive):
            self.went(key, held_s=held_s)

    def _gone(self, key: str) -> None:
        self.going.pop(key, None)
        self._alive.discard(key)
        self._callback(key, False)

    def close(self) -> None:
        """Tell of nothing more."""
        for timer in self.going.values():
            timer.cancel()


class Presence:
    """The tokens of one session."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._watches: set[_Watch] = set()
        self._held: list[tuple[Callable[[str], bool], float]] = []
        """Which tokens may go for a moment, and until when, by the loop's clock."""

    def declare_alive(self, key: str) -> Closer:
        """Show a liveliness token until closed, or until this process dies."""

        # Kept with the session: the garbage collector takes back a token without a reference.
        def declare(raw: zenoh.Session) -> Callable[[], None]:
            return raw.liveliness().declare_token(key).undeclare

        return self._wire.declare(Rank.TOKEN, declare)

    def hold_alive(self, which: Callable[[str], bool], seconds: float) -> None:
        """Count tokens that go as there for a moment: a session that shows them is being reopened.

        A token that goes within `seconds` and is not back within `BACK_S` of that counts as gone.
        """
        now = self._wire.loop.time()
        self._held = [each for each in self._held if each[1] > now]
        self._held.append((which, now + seconds))

    def all_held(self) -> None:
        """The session is being reopened: every token may go for a moment."""
        for watch in self._watches:
            watch.all_went(held_s=BACK_S)

    @property
    def awaits_gateways(self) -> bool:
        """Whether gateways that were seen before the session was reopened are not seen again yet."""
        return any(keyspace.GATEWAY_ALIVE.match(key) for watch in self._watches for key in watch.going)

    def _held_s(self, key: str) -> float:
        """How long a token that goes now has to come back."""
        now = self._wire.loop.time()
        return BACK_S if any(until > now and which(key) for which, until in self._held) else 0.0

    async def alive_now(self, expr: str, *, timeout_s: float = 1.0) -> list[str]:
        """Return the keys of the tokens that are there now; those that could be had in time."""
        inbox = self._wire.inbox
        found: list[str] = []
        ended = asyncio.Event()

        def take(reply: zenoh.Reply) -> None:
            if (sample := reply.ok) is not None:
                inbox.post(partial(found.append, str(sample.key_expr)), must=True)

        handler = link.callback(take, drop=partial(inbox.post, ended.set, must=True))

        def ask() -> None:
            self._wire.raw.liveliness().get(expr, handler, timeout=timeout_s)

        self._wire.ask(expr, ask, 0)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await ended.wait()
        return sorted(found)

    def watch_alive(self, expr: str, callback: Callable[[str, bool], None]) -> Closer:
        """Have the coming (True) and going (False) of tokens delivered, those already there first.

        One whose key has `**` is counted and dropped, as a put is.
        """
        inbox, name = self._wire.inbox, self._wire.name(expr)
        watch = _Watch(callback, self._wire.loop)

        def take(raw: zenoh.Session, sample: zenoh.Sample) -> None:
            key, alive = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            if "**" in key:
                inbox.post(partial(self._wire.refuse, f"wildcard {name}", key=key))
                return
            if alive and self._wire.barred(key):
                inbox.post(partial(self._wire.deny, f"revoked {name}", key, REVOKED))
                return
            inbox.post(partial(deliver, raw, key, alive), must=True)

        def deliver(raw: zenoh.Session, key: str, alive: bool) -> None:
            # What a session saw that is closed by now is seen again on the next, or has gone.
            if watch not in self._watches or raw is not self._wire.raw or self._wire.reopening:
                return
            if alive:
                watch.came(key)
            else:
                watch.went(key, held_s=self._held_s(key))

        def declare(raw: zenoh.Session) -> Callable[[], None]:
            return raw.liveliness().declare_subscriber(expr, link.callback(partial(take, raw)), history=True).undeclare

        self._watches.add(watch)
        declared = self._wire.declare(Rank.WATCH, declare)

        def end() -> None:
            self._watches.discard(watch)
            watch.close()
            declared.close()

        return Closer(end)


# The library's stubs leave out the return types of methods that return nothing.


Answer = Callable[[bytes | None, SwiftbotError | None], None]
"""Answers one question, from any thread."""
Handler = Callable[[str, bytes], Awaitable[bytes]]
"""Answers a question for a key, on the event loop."""


class Answering:
    """What is served on one session."""

    def __init__(self, wire: Wire, doors: Doors) -> None:
        self.wire = wire
        self._doors = doors
        self.under_way: set[asyncio.Task[None]] = set()
        """Answers that are being made."""

    def serve(self, expr: str, handler: Handler, *, bulk: bool = False, signers: Roles | None = None) -> Closer:
        """Answer queries on `expr`, each in a task of its own, at most `concurrent_queries` at once.

        `bulk`: answers are raw bytes and wait in a queue of their own; their priority is that of the question.
        `signers`: on a session with keys, one of these roles must have signed the question; the handler finds who it
        was in `identity.member.SENDER`.

        A SwiftbotError of the handler is answered as ErrorReply; any other exception is logged with its traceback
        and answered as ErrorReply of code `internal`: this is where a handler's defects are contained.

        A question that was meant for another key is refused as `unreachable`: after links were reopened Zenoh 1.10 has
        been seen to deliver a query to the wrong queryable of a session or process, which made one robot do another's
        command. `query` writes down for whom it is; what other Zenoh clients ask says nothing of it.
        """
        served = Served(self, expr, handler, bulk=bulk, signers=signers)
        return self.declare(served)

    def declare(self, served: "Served") -> Closer:
        """Have the questions for what is served come there."""

        def declare(raw: zenoh.Session) -> Callable[[], None]:
            return raw.declare_queryable(served.expr, link.callback(served.take), complete=True).undeclare

        return self.wire.declare(Rank.SUBSCRIPTION, declare)

    def begin(self, served: "Served", key: str, data: bytes, reply: Answer, signature: bytes) -> None:
        """Have a handler answer, unless too many are at it; on the event loop's thread."""
        if len(served.running) >= self.wire.config.concurrent_queries:
            error = RefusedError(f"{key}: {len(served.running)} queries are being answered", remedy="try again later")
            self.refuse(f"too many {served.name}", key, reply, error)
            return
        task = self.wire.loop.create_task(self._answer(served, key, data, reply, signature))
        for group in (served.running, self.under_way):
            group.add(task)
            task.add_done_callback(group.discard)

    def _sender(self, served: "Served", key: str, data: bytes, signature: bytes) -> Identity | None:
        """Who signed a question; IdentityError where it has to be signed and is not, or by another role."""
        credentials = self.wire.credentials
        if credentials is None or served.signers is None:
            return None
        try:
            return credentials.verify(signature, key, data, roles=served.signers)
        except Exception as error:
            if not served.urgent:
                raise
            # A stop is carried out for every asker, also where a defect keeps its signature from being read.
            self.wire.deny(f"unverified {served.name}", key, str(error))
            return None

    async def _answer(self, served: "Served", key: str, data: bytes, reply: Answer, signature: bytes) -> None:
        name = served.name
        answer: bytes | None = None
        error: SwiftbotError | None = None
        known = False
        try:
            SENDER.set(self._sender(served, key, data, signature))
            known = True
            answer = await served.handler(key, data)
            if len(answer) > self.wire.config.max_payload_bytes:
                error = PayloadError(f"{key}: the answer has {len(answer):,} bytes", remedy="ask for less at once")
        except SwiftbotError as refusal:
            if isinstance(refusal, PayloadError):
                self.wire.refuse(f"malformed {name}", key=key, reason=str(refusal))
            elif isinstance(refusal, IdentityError) and known:
                self.wire.refuse(f"unauthorized {name}", key=key, reason=str(refusal))
            elif isinstance(refusal, IdentityError):
                self.wire.deny(f"unauthorized {name}", key, str(refusal), refusal.sender)
            error = refusal
        except asyncio.CancelledError:
            error = UnreachableError("the one that was asked is stopping", remedy="ask another gateway")
            raise
        except Exception as defect:  # the supervision boundary of `serve`
            log.exception("a query's handler failed", key=key)
            error = SwiftbotError(f"{type(defect).__name__}: {defect}")
        finally:
            reply(answer, error)

    def reply(
        self, query: zenoh.Query, expr: str, bulk: bool, marked: bool, answer: bytes | None, error: SwiftbotError | None
    ) -> None:
        """Answer a query; one marked as direct from here, others on the sender's thread."""
        if self.wire.closed:
            link.reply(query, expr, answer, error)
        elif marked:
            link.reply_direct(query, expr, answer, error)
        else:
            size = len(answer) if answer is not None and error is None else 0
            self.wire.send(expr, partial(link.reply, query, expr, answer, error, bulk=bulk), size, bulk=bulk)

    def misrouted(self, name: str, expr: str, asker: str, reply: Answer, error: SwiftbotError) -> None:
        """Refuse a question for another key; the links over which it came may be mixed up."""
        self.refuse(f"misrouted {name}", expr, reply, error)
        self._doors.was_wrong(asker)

    def refuse(self, what: str, key: str, reply: Answer, error: SwiftbotError) -> None:
        """Refuse a question as bad input, which is counted."""
        self.wire.refuse(what, key=key, reason=str(error))
        reply(None, error)

    def deny(self, what: str, key: str, reply: Answer, error: IdentityError) -> None:
        """Refuse a question for whom it is from, which is counted and told to the audit."""
        self.wire.deny(what, key, str(error), error.sender)
        reply(None, error)

    async def stop(self, wait_s: float) -> None:
        """End every answer under way with an error, waiting at most so long for handlers that tidy up."""
        for task in tuple(self.under_way):
            task.cancel()
        if self.under_way:
            await asyncio.wait(self.under_way, timeout=wait_s)


class Served:
    """What answers the questions for one key, or for those of an expression; `take`, on Zenoh's threads, has them."""

    def __init__(
        self,
        answering: Answering,
        expr: str,
        handler: Handler,
        *,
        bulk: bool = False,
        signers: Roles | None = None,
        urgent: bool = False,
    ) -> None:
        self.expr, self.handler = expr, handler
        self.signers, self.urgent = signers, urgent
        self.name = answering.wire.name(expr)
        self.running: set[asyncio.Task[None]] = set()
        self._answering, self._wire = answering, answering.wire
        self._door = None if "*" in expr else expr.encode()
        self._bulk = bulk

    def take(self, query: zenoh.Query) -> None:
        """A question came."""
        self.take_marked(query, link.read_mark(query))

    def take_marked(self, query: zenoh.Query, mark: link.Mark) -> None:
        """The same, with what it says of itself read."""
        marked, meant, signature = mark
        answering, limit = self._answering, self._wire.config.max_payload_bytes
        payload = query.payload
        size = len(payload) if payload is not None else 0
        reply = partial(answering.reply, query, self.expr, self._bulk, marked)
        if meant and self._door is not None and meant != self._door:
            error = UnreachableError(f"{self.expr}: {link.WRONG_DOOR}", remedy="ask again in a moment")
            begin = partial(answering.misrouted, self.name, self.expr, link.asker_of(query), reply, error)
            size = 0
        elif self._wire.barred(str(query.key_expr)):
            error = IdentityError(f"{query.key_expr}: {REVOKED}")
            begin = partial(answering.deny, f"revoked {self.name}", str(query.key_expr), reply, error)
            size = 0
        elif size > limit:
            error = PayloadError(f"{query.key_expr}: {size:,} bytes", remedy=f"at most {limit:,}")
            begin = partial(answering.refuse, f"oversize {self.name}", str(query.key_expr), reply, error)
            size = 0
        else:
            data = payload.to_bytes() if payload is not None else b""
            begin = partial(answering.begin, self, str(query.key_expr), data, reply, signature)
        if not self._wire.inbox.post(begin, size):
            link.reply(query, self.expr, None, RefusedError("too busy", remedy="try again in a moment"))


# The library's stubs leave out the return types of methods that return nothing.


class Verbs:
    """The verbs of `expr`, which ends in `/*`; one that is not there is answered as where nobody is."""

    def __init__(self, answering: Answering, expr: str) -> None:
        self._answering = answering
        self._prefix = expr.removesuffix("*")
        self._served: dict[str, Served] = {}
        self._nobody = Served(answering, expr, _nobody)
        self._wrong = Served(answering, self._prefix.removesuffix("/"), _nobody)
        self._closers: list[Closer] = []
        self._one = answering.wire.config.mode == "peer"
        if self._one:

            def declare(raw: zenoh.Session) -> Callable[[], None]:
                return raw.declare_queryable(expr, link.callback(self._take), complete=True).undeclare

            self._closers.append(answering.wire.declare(Rank.SUBSCRIPTION, declare))

    def add(self, verb: str, handler: Handler, *, signers: Roles | None = None, urgent: bool = False) -> None:
        """Answer a verb from now on; `signers` as of `serve`, `urgent`: also where the signature is not good."""
        expr = f"{self._prefix}{verb}"
        served = Served(self._answering, expr, handler, signers=signers, urgent=urgent)
        if self._one:
            self._served[verb] = served
        else:
            self._closers.append(self._answering.declare(served))

    def _take(self, query: zenoh.Query) -> None:
        mark = link.read_mark(query)
        meant, key = mark.meant, str(query.key_expr)
        served = self._served.get(key.rpartition("/")[2])
        if served is None:
            # Other clients of Zenoh do not write down what they mean.
            served = self._nobody if not meant or meant == key.encode() else self._wrong
        served.take_marked(query, mark)

    def close(self) -> None:
        """Answer no more."""
        for closer in self._closers:
            closer.close()


async def _nobody(key: str, payload: bytes) -> bytes:
    del payload
    raise UnreachableError(f"nobody answers on {key}", remedy=link.NOBODY_REMEDY)


# The library's stubs leave out the return types of methods that return nothing.


MOST_ANSWERS = 2_000
"""To one question that everybody may answer; twice the gateways that a fleet may have."""


class Asking:
    """The questions under way of one session."""

    def __init__(self, wire: Wire, doors: Doors) -> None:
        self._wire = wire
        self._doors = doors
        self.open: set[asyncio.Future[bytes]] = set()
        """Answers that are awaited."""
        self.urgent: set[asyncio.Future[bytes]] = set()
        """Those of them that are urgent."""

    async def query(
        self,
        key: str,
        payload: bytes,
        *,
        timeout_s: float,
        bulk: bool = False,
        direct: bool = False,
        sign: bool = False,
        urgent: bool = False,
    ) -> bytes:
        """Ask the one that serves a key and return the first answer; `bulk`: other messages go before it.

        `direct`: sent from here, past the queue of the sender's thread, and dropped when the link is full. For small
        questions that can be asked again, where the way there and back matters.
        `sign`: with the keys of this process, if it has any.
        `urgent`: also while others wait for the session to be reopened; not with `direct`.

        Raises:
            UnreachableError: nobody serves the key, or (`sent`) one that may have heard it went away before answering.
            DeadlineError: no answer within `timeout_s` seconds.
            PayloadError: the request or the answer is too large.
            SwiftbotError: what the answering side raised.
        """
        question = self.ask(key, payload, timeout_s=timeout_s, bulk=bulk, direct=direct, sign=sign, urgent=urgent)
        return await question.answer()

    def ask(
        self,
        key: str,
        payload: bytes,
        *,
        timeout_s: float,
        bulk: bool = False,
        direct: bool = False,
        sign: bool = False,
        urgent: bool = False,
    ) -> "Question":
        """Do the same, but only send the question, and have the answer awaited afterwards."""
        return Question(self, self._wire, key, payload, timeout_s, bulk=bulk, direct=direct, sign=sign, urgent=urgent)

    async def query_all(self, expr: str, payload: bytes, *, timeout_s: float) -> list[Message]:
        """Ask everybody who serves a key of `expr`; returns the answers that came in time, errors left out.

        At most `MOST_ANSWERS`, and `queue_bytes` of them together: what comes beyond that is counted as refused.
        """
        messages: list[Message] = []
        ended = asyncio.Event()

        def on_reply(key: str, data: bytes | None, error: SwiftbotError | None) -> None:
            if data is not None:
                messages.append(Message(key, data, deleted=False, at_ns=time.time_ns(), encoding="application/json"))
            elif error is not None:
                log.debug("an answer is an error", expr=expr, error=str(error))

        self.get(expr, payload, timeout_s, on_reply, lambda _: ended.set(), target=zenoh.QueryTarget.ALL)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await ended.wait()
        return list(messages)

    async def answerers(self, key: str, payload: bytes, *, timeout_s: float) -> int:
        """Ask everybody who serves a key, and return how many answered in time, whatever they said."""
        found: set[str] = set()
        ended = asyncio.Event()
        inbox = self._wire.inbox

        def take(reply: zenoh.Reply) -> None:
            who = reply.replier_id
            inbox.post(partial(found.add, f"{who.zid}/{who.eid}" if who is not None else f"{len(found)}"), must=True)

        handler = link.callback(take, drop=partial(inbox.post, ended.set, must=True))

        def ask() -> None:
            self._wire.raw.get(
                key,
                handler,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                payload=payload,
            )

        self._wire.ask(key, ask, len(payload))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await ended.wait()
        return len(found)

    def get(
        self,
        expr: str,
        payload: bytes,
        timeout_s: float,
        on_reply: Callable[[str, bytes | None, SwiftbotError | None], None],
        on_end: Callable[[bool], None],
        *,
        target: zenoh.QueryTarget,
        bulk: bool = False,
        direct: bool = False,
        urgent: bool = False,
        meant: bytes | None = None,
    ) -> None:
        """Send a query; both callbacks come by the event loop, `on_end` only where no answer came first."""
        first = target != zenoh.QueryTarget.ALL
        limit = self._wire.config.max_payload_bytes
        if len(payload) > limit:
            raise PayloadError(f"a request of {len(payload):,} bytes on {expr}", remedy=f"at most {limit:,}")
        if self._wire.closed:
            raise UnreachableError("the session is closed")

        answered, sender = False, 0
        # One answer is all that counts of a question to one; the one that is asked may send more.
        taken = _Bounds(1 if first else MOST_ANSWERS, self._wire.config.queue_bytes)

        def take(reply: zenoh.Reply) -> None:
            nonlocal answered
            answered = True
            sample = reply.ok
            size = len(sample.payload) if sample is not None else 0
            if not taken.one(0 if first or size > limit else size):
                return
            if sample is None:
                error = link.error_of(reply.err)
                if link.WRONG_DOOR in error.message:
                    replier = str(reply.replier_id.zid) if reply.replier_id is not None else ""
                    self._wire.inbox.post(partial(self._doors.met_wrong, replier))
                self._wire.inbox.post(partial(on_reply, expr, None, error), must=True)
            elif size > limit:
                self._wire.inbox.post(partial(self._wire.refuse, "oversize answer", key=expr, size=size))
                error = PayloadError(f"the answer on {expr} has {size:,} bytes", remedy=f"at most {limit:,}")
                self._wire.inbox.post(partial(on_reply, expr, None, error), must=True)
            else:
                data = sample.payload.to_bytes()
                key = expr if first else str(sample.key_expr)
                self._wire.inbox.post(partial(on_reply, key, data, None), size, must=True)

        def end() -> None:
            if taken.left_out and not first:
                refuse = partial(self._wire.refuse, "answers beyond the limit", count=taken.left_out, key=expr)
                self._wire.inbox.post(refuse, must=True)
            # Where the first answer is all that counts, waking the event loop for the end after it is for nothing.
            if not (first and answered):
                # One that nobody serves ends within the call that sends it.
                self._wire.inbox.post(partial(on_end, sender != threading.get_ident()), must=True)

        priority = zenoh.Priority.DATA_LOW if bulk else zenoh.Priority.DATA
        control = zenoh.CongestionControl
        handler = link.callback(take, drop=end)

        def ask() -> None:
            nonlocal sender
            sender = threading.get_ident()
            self._wire.raw.get(
                expr,
                handler,
                target=target,
                consolidation=zenoh.ConsolidationMode.NONE,
                # Ours decides; Zenoh's only makes sure that nothing is kept for ever.
                timeout=timeout_s + 1.0,
                congestion_control=control.DROP if direct else control.BLOCK,
                priority=zenoh.Priority.DATA_HIGH if direct else priority,
                express=True,
                payload=payload,
                attachment=meant,
                source_info=self._wire.asker,
            )
            sender = 0

        self._wire.ask(expr, ask, len(payload), direct=direct, urgent=urgent)

    def stop(self) -> None:
        """End every question under way with an error."""
        for answer in self.open:
            if not answer.done():
                answer.set_exception(UnreachableError("the session was closed", sent=True))


class Question:
    """A question that is under way; what went wrong with sending it is raised with the answer."""

    def __init__(
        self,
        asking: Asking,
        wire: Wire,
        key: str,
        payload: bytes,
        timeout_s: float,
        *,
        bulk: bool,
        direct: bool,
        sign: bool,
        urgent: bool,
    ) -> None:
        self._asking = asking
        self._sign, self._urgent = sign, urgent
        self._credentials = wire.credentials
        self._key, self._payload = key, payload
        self._timeout_s, self._until = timeout_s, wire.loop.time() + timeout_s
        self._bulk, self._direct = bulk, direct and len(payload) <= link.MOST_DIRECT
        self._loop = wire.loop
        self._answer: asyncio.Future[bytes] = wire.loop.create_future()
        asking.open.add(self._answer)
        if urgent:
            asking.urgent.add(self._answer)
        self._timer = wire.loop.call_at(self._until, self._on_time)
        try:
            self._send()
        except SwiftbotError as error:
            self._answer.set_exception(error)

    def _send(self) -> None:
        signing = self._credentials if self._sign else None
        signature = signing.sign(self._key, self._payload) if signing is not None else b""
        self._asking.get(
            self._key,
            self._payload,
            self._timeout_s,
            self._on_reply,
            self._on_end,
            target=zenoh.QueryTarget.BEST_MATCHING,
            bulk=self._bulk,
            direct=self._direct,
            urgent=self._urgent,
            meant=link.mark(self._key, direct=self._direct, signature=signature),
        )

    def _on_answer(self, data: bytes | None, error: SwiftbotError | None) -> None:
        if not self._answer.done():
            if error is not None:
                self._answer.set_exception(error)
            elif data is not None:
                self._answer.set_result(data)

    def _on_reply(self, _: str, data: bytes | None, error: SwiftbotError | None) -> None:
        self._on_answer(data, error)

    def _on_end(self, sent: bool) -> None:
        self._on_answer(None, UnreachableError(f"nobody answers on {self._key}", remedy=link.NOBODY_REMEDY, sent=sent))

    def _on_time(self) -> None:
        self._on_answer(None, DeadlineError(f"no answer on {self._key} within {self._timeout_s:g} s"))

    async def answer(self) -> bytes:
        """Wait for the answer; errors as of `Asking.query`, whose time has run since the question was sent."""
        try:
            data = await self._answer
            if data or not self._direct:
                return data
        finally:
            self.end()
        # The answer is too large to be sent so.
        left_s = max(0.0, self._until - self._loop.time())
        return await self._asking.query(self._key, self._payload, timeout_s=left_s, bulk=self._bulk, sign=self._sign)

    def end(self) -> None:
        """Wait for it no more; more than once does no harm."""
        self._timer.cancel()
        self._asking.open.discard(self._answer)
        self._asking.urgent.discard(self._answer)
        if not self._answer.cancel() and not self._answer.cancelled():
            self._answer.exception()  # looked at: nobody else may come to


class _Bounds:
    """Counts the answers to one question, on whatever threads they come."""

    def __init__(self, most: int, most_bytes: int) -> None:
        self.left_out = 0
        self._left, self._left_bytes = most, most_bytes
        self._lock = threading.Lock()

    def one(self, size: int) -> bool:
        """Whether one more of that size is within the bounds."""
        with self._lock:
            if self._left <= 0 or self._left_bytes < size:
                self.left_out += 1
                return False
            self._left -= 1
            self._left_bytes -= size
            return True


# The library's stubs leave out the return types of methods that return nothing.


_CLOSE_S = 2.0
"""How long a closing session keeps sending what waits."""
QUIET_S = 0.5
"""How long questions and answers under way have to end before a session is reopened."""
_AGAIN_S = 0.2
"""Between tries to open a session again."""
_GIVE_UP_S = 30.0
"""After so long without a session this process is of no use; its supervisor starts it again."""


class Reopened(Struct, frozen=True):
    """How a session was reopened."""

    gap_s: float
    """From the end of one to the moment when those who were linked before are linked again."""
    linked: int
    """How many of them are."""
    of: int
    """How many there were."""


class Session:
    """A Zenoh session of one fleet; made by `open`, ended by `close`."""

    def __init__(self, wire: Wire, gateway: str = "") -> None:
        config = self.config = wire.config
        self._gateway = gateway
        self.credentials = wire.credentials
        """Its keys; None on links within this machine without."""
        self.keys: Keys = wire.keys
        self.refused: dict[str, int] = wire.refused
        """Counts of bad input by kind."""
        self.refuse = wire.refuse
        self.deny = wire.deny
        self.check_role = wire.check_role
        self._wire = wire
        self._sockets = SocketWatch.shared(config.lease_ms)
        doors = Doors(wire, self._sockets)
        publishing, presence = Publishing(wire, self._serve_backlog), Presence(wire)
        self._presence = presence
        self._answering, self._asking = Answering(wire, doors), Asking(wire, doors)
        self.put = publishing.put
        self.publisher = publishing.publisher
        self.delete = publishing.delete
        self.flood = publishing.flood
        self.subscribe = publishing.subscribe
        self.publish = publishing.publish
        self.subscribe_typed = publishing.subscribe_typed
        self.serve = self._answering.serve
        self.serve_verbs = partial(Verbs, self._answering)
        self.query = self._asking.query
        self.ask = self._asking.ask
        self.query_all = self._asking.query_all
        self.answerers = self._asking.answerers
        self.declare_alive = presence.declare_alive
        self.alive_now = presence.alive_now
        self.watch_alive = presence.watch_alive
        self.hold_alive = presence.hold_alive
        self.renew_links = doors.renew

    def watch_denied(self, callback: Callable[[str, str, str, str], None]) -> None:
        """Call back with what is refused for whom it is from: kind, key, reason, and whose it was, where proven."""
        self._wire.on_denied = callback

    @classmethod
    async def open(cls, config: PlaneConfig, fleet: str, gateway: str = "", *, roster: Path | None = None) -> "Session":
        """Open a session as configured. Peers start in any order and keep looking for each other for ever.

        `gateway`: whose it is, where it is one's: which of two dials the other goes by their names.
        `roster`: where the roster that counts is kept.

        Raises:
            ConfigError: a setting is wrong, or an endpoint to listen on is in use or not of this machine.
            UnreachableError: a client found no endpoint that answers.
            IdentityError: its keys are absent, not good, or another gateway's.
        """
        config.check()
        config.check_links()
        Keys(fleet)
        credentials = await asyncio.to_thread(link.read_credentials, config, fleet, roster) if config.keys else None
        if credentials is not None and (gateway or config.listen):
            credentials.check_listener(gateway)
        raw = await asyncio.to_thread(link.open_raw, config, gateway, credentials)
        return cls(Wire(config, fleet, raw, asyncio.get_running_loop(), credentials), gateway)

    async def reopen(self) -> Reopened:
        """Close the library's session and open another with the keys and the roster of now, in this one's place.

        Raises:
            SwiftbotError: it can be opened neither so nor as it was, for `_GIVE_UP_S`.
        """
        wire, credentials = self._wire, self.credentials
        before = credentials.opened if credentials is not None else None
        linked = set(self._peers())
        wire.hold_questions()
        try:
            under_way = {*self._answering.under_way, *self._asking.open} - {asyncio.current_task()}
            quiet = wire.loop.time() + QUIET_S
            # A stop that is given meanwhile goes to its robots at once, and its answer is waited for as well.
            while pending := {each for each in {*under_way, *self._asking.urgent} if not each.done()}:
                if (left_s := quiet - wire.loop.time()) <= 0:
                    break
                await asyncio.wait(pending, timeout=left_s)
            await wire.hold_all(QUIET_S)
            began = wire.loop.time()
            self._presence.all_held()
            while True:
                try:
                    await wire.replace(partial(link.open_raw, self.config, self._gateway, credentials))
                    break
                except SwiftbotError as error:
                    log.warning("the session cannot be opened again", reason=str(error))
                    if wire.loop.time() - began > _GIVE_UP_S:
                        raise
                    if credentials is not None and before is not None:
                        credentials.fall_back(before)
                    await asyncio.sleep(_AGAIN_S)
            until = wire.loop.time() + self.config.lease_ms / 1e3
            # A gateway's token comes behind what it subscribes to and serves.
            while linked - set(self._peers()) or self._presence.awaits_gateways:
                if wire.loop.time() > until:
                    break
                await asyncio.sleep(0.001)
            return Reopened(wire.loop.time() - began, len(linked & set(self._peers())), len(linked))
        finally:
            wire.let_go()

    def _peers(self) -> list[str]:
        """Session ids of the gateways and routers that this one is linked to."""
        info = self._wire.raw.info
        return [str(each) for each in (*info.peers_zid(), *info.routers_zid())]

    def _serve_backlog(self) -> None:
        """Answer for what this session puts; one that never puts has no such queryable."""
        backlog = self._wire.backlog
        source = str(self._wire.source.source_id.zid)
        self._answering.serve(self.keys(keyspace.BACKLOG, source), backlog.answered, bulk=True)

    @property
    def gone(self) -> bool:
        """Whether there is no session of the library: after a reopening that failed it does not come back."""
        return self._wire.reopening

    @property
    def linked(self) -> int:
        """Sessions linked to directly just now, however they came about."""
        return 0 if self._wire.reopening else len(self._peers())

    @property
    def missed(self) -> int:
        """Messages that arrived and were dropped because the queue to the event loop was full."""
        return self._wire.inbox.dropped

    @property
    def unsent(self) -> int:
        """Messages that wait to be sent: the one that sends many waits for the others to take them."""
        return self._wire.outbox.waiting

    async def close(self) -> None:
        """End every query under way with an error, send what waits, close. Needed: Zenoh hangs the exit without."""
        if self._wire.closed:
            return
        await self._answering.stop(_CLOSE_S)
        self._wire.closed = True
        self._asking.stop()
        await self._wire.close(_CLOSE_S)
        self._sockets.close()
        self._wire.inbox.close()
