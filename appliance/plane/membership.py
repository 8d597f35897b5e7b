"""Membership and failure detection: which gateways are there, and when one cannot trust what it sees of them.

A gateway is there while its liveliness token is seen; the ring is made of those. A token goes when its process dies (at
once) or its link has been silent for a lease, so nobody is asked. When a link is cut and reopened while the other end
stands still, Zenoh may forget a token that is there and never mention it again; who hears from a gateway that it is
not seen shows a further token, and is there while any of them is (`Membership`).

**Who is a gateway.** Where there are keys, a token alone makes no member. A session that may show tokens could show any
number of them under any names, and each would own a part of the ring. So a gateway is asked first, at its own key, to
sign something new with its certificate, and belongs to the ring once that has its name and is neither expired nor
revoked. It is asked again when the roster changes.

**Stalls** (`StallDetector`): this process was frozen, suspended with its machine, or starved of the processor. A
gateway that stands still for a lease is taken for dead and succeeded, and does not know it: when it runs again it
first finds the requests that waited for it, and would order writes that its successor has ordered since, from records
that are stale. So after a stall it orders no write for a lease (the one that asked asks again, at the right gateway by
then), and compares its shard with the others' before it answers as an owner.

**Stale links** (`Outlived`): links that outlive a stall and must not, and those that do not come back, are reopened.
All others close their links with a process that stands still for a lease, and dial again. When it runs again it may
take a new connection before it has noticed that the old one is closed. Zenoh 1.10 then goes on with what it knew of
the other side, which has started over: questions arrive at wrong doors there, answers nowhere, and neither side sees
the other's facts, for as long as that link lives (zenoh issue 1886). It shows here, by no word of anybody:

- this process stood still for a lease,
- the tokens of others have gone and come, as they do when links are closed, so that they noticed (on a machine that was
  suspended, or starves, all of a fleet stand still together and nobody loses anybody),
- one's token has not, and it does not answer.

Or the two never link again: each took the other's new connection for one that it had already, dropped it, and dials no
more, though each is named in the other's `connect`. Then a member that was there before is lost for good, while others,
which have come back, see it. Links that are reopened have it told of by those at their other ends, and dialled.

**Duplicate ids** (`Namesakes`): another gateway with this one's id, met after both have joined, since they began at one
moment or a cut has healed. Who joins asks whether its name is free; that tells nothing of one that cannot be seen just
then. Two of one name answer the same questions and order writes of the same keys, so one of the two must go. Each hears
what the other tells of itself under their key and can tell it from its own by the process that tells it. What was put
may have been put by a program that plays a log, so before it counts the key is asked (the verb `facts`), and another
process must answer.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Awaitable, Callable, Iterable, Set
from typing import Protocol

import msgspec
import structlog

from appliance.errors import ConfigError, IdentityError, PayloadError, SwiftbotError
from appliance.model import GatewayStatus, encode, gateways, keyspace
from appliance.model.keys import check_name
from appliance.model.plane_api import Facts, FactsAsk
from appliance.plane.events import FleetEvent, FleetEvents, Joined, Lost, Stage, Stall, Stalled
from appliance.plane.ring import Ring
from appliance.plane.session import Closer, Session

log = structlog.get_logger(__name__)


def clock() -> float:
    """Seconds, those of a suspended machine among them."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class StallDetector:
    """Beats on a thread of its own: what only holds up the event loop makes nobody take this gateway for dead.

    Publishes `Stalled` once for each stall.
    """

    def __init__(self, lease_s: float, *, events: FleetEvents, clock: Callable[[], float] = clock) -> None:
        self._events = events
        self._lease_s = lease_s
        self._clock = clock
        self._lock = threading.Lock()
        self._last = clock()
        self._until = self._last
        self._stalls = 0
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def start(self) -> None:
        """Begin to beat."""
        self._loop = asyncio.get_running_loop()
        self._last = self._clock()
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)
        self._thread.start()

    @property
    def stalls(self) -> int:
        """How often the process stood still; what was learned at another count may be out of date."""
        self._beat()
        return self._stalls

    @property
    def doubtful(self) -> bool:
        """Whether the process stood still within the last lease: requests sent before may only arrive now."""
        return self._beat() < self._until

    def _run(self) -> None:
        while not self._closing.wait(self._lease_s / 4):
            self._beat()

    def _beat(self) -> float:
        """Look at the clock, from any thread; the one that does so first after a stall finds it."""
        with self._lock:
            now = self._clock()
            since, stood_s, self._last = self._last, now - self._last, now
            # Silent for a quarter of a lease before it stopped: the others may know after three more.
            stalled = self._thread is not None and stood_s >= self._lease_s * 0.75
            if stalled:
                self._until = now + self._lease_s
                self._stalls += 1
        if stalled:
            log.warning("this process stood still; it may have been succeeded", seconds=round(stood_s, 3))
            # The loop may be gone when the process ends without closing: then nobody listens.
            with contextlib.suppress(RuntimeError):
                if self._loop is not None:
                    self._loop.call_soon_threadsafe(self._events.publish, Stalled(Stall(since, stood_s)))
        return now

    def close(self) -> None:
        """Beat no more."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None


PROVE_AGAIN_S = (0.5, 30.0)
"""After a gateway has not proved who it is, while its token is there: first so long, doubled up to that."""
LATE_S = 2.0
"""The longest such pause for one that has not answered: it may just be busy, and is needed in the ring."""
Prove = Callable[[str], Awaitable[None]]
"""Has a gateway prove that it is the one of that id: IdentityError when it is not, another when it does not say."""
MOST_MEMBERS = 1000
"""Gateways known at once; liveliness of more costs too much (design/platform). More are refused and counted."""
_MOST_TOKENS = 8
"""Of one gateway; more than two mean a mistake."""


class Membership:
    """The gateways of a fleet as this process sees them; publishes `Joined` and `Lost`.

    `gateway` is this one's id; None for clients. `prove`: asked before another counts; None: tokens do.
    """

    def __init__(
        self,
        session: Session,
        *,
        gateway: str | None,
        virtual_nodes: int,
        events: FleetEvents,
        prove: Prove | None = None,
    ) -> None:
        self._prove = prove
        self._candidates: dict[str, set[str]] = {}
        """Those whose token is seen and who have not proved who they are -> keys of their tokens."""
        self._proving: dict[str, asyncio.Task[None]] = {}
        self._session = session
        self._gateway = gateway
        self._members: frozenset[str] = frozenset() if gateway is None else frozenset({gateway})
        self._made = self._members, Ring(self._members, virtual_nodes=virtual_nodes)
        """The members that the ring was last made of, and it."""
        self._events = events
        self._tokens: dict[str, set[str]] = {}
        """Name -> keys of the tokens seen."""
        self._since: dict[str, float] = {}
        """Name -> since when a token of it has been seen without a break, by the pulse's clock."""
        self._gone: dict[str, float] = {}
        """Name -> when the last token of it went, by the pulse's clock, of those that have not come back; the last."""
        self._watches: list[Closer] = []
        self._token: Closer | None = None
        self._again: Closer | None = None
        self._shown = 0

    @property
    def members(self) -> frozenset[str]:
        """Ids of the gateways that are there; this one counts itself in."""
        return self._members

    @property
    def ring(self) -> Ring:
        """The ring of the members; made when it is asked for, so that a burst of news makes it once."""
        members, (made_of, ring) = self._members, self._made
        if made_of is not members:
            ring = ring.changed_to(members)
            self._made = members, ring
        return ring

    def sees(self, name: str) -> bool:
        """Whether a gateway counts as there for its questions about records."""
        return name in self._members

    def seen_since(self, moment: float) -> frozenset[str]:
        """The other members whose token was there at a moment of the pulse's clock and has never gone since."""
        return frozenset(name for name, at in self._since.items() if at <= moment)

    def lost_since(self, moment: float) -> frozenset[str]:
        """Those whose last token went after a moment of the pulse's clock, and who have not come back."""
        return frozenset(name for name, at in self._gone.items() if at >= moment)

    def owns(self, key: str) -> bool:
        """Whether a key belongs to this gateway just now."""
        return self.ring.owner(key) == self._gateway

    def start(self) -> None:
        """Begin to watch."""
        keys = self._session.keys
        self._watches = [
            self._session.watch_alive(each, self._seen)
            for each in (keys(keyspace.GATEWAY_ALIVE), keys(keyspace.GATEWAY_ALIVE_AGAIN))
        ]

    def add(self, key: str) -> None:
        """Count a gateway in by the key of its token, before tokens are watched."""
        self._seen(key, alive=True)

    def join(self) -> None:
        """Show the others that this gateway is there."""
        if self._gateway is not None:
            self._token = self._session.declare_alive(self._session.keys(keyspace.GATEWAY_ALIVE, self._gateway))

    def show_again(self) -> None:
        """Show a token that nobody can have forgotten: somebody does not see the first."""
        if self._gateway is None or self._token is None:
            return
        self._shown += 1
        before, again = self._again, self._session.keys(keyspace.GATEWAY_ALIVE_AGAIN, self._gateway, str(self._shown))
        self._again = self._session.declare_alive(again)
        if before is not None:
            before.close()

    def _seen(self, key: str, alive: bool) -> None:
        # A stranger's token may be on any expression that matches ours: it has no name, and is refused below.
        name, *_ = keyspace.GATEWAY_ALIVE.match(key) or keyspace.GATEWAY_ALIVE_AGAIN.match(key) or ("",)
        if self._prove is not None and name not in (*self._members, self._gateway):
            self._seen_candidate(self._prove, name, key, alive)
        else:
            self._counted(name, key, alive)

    def _seen_candidate(self, prove: Prove, name: str, key: str, alive: bool) -> None:
        """Note a token of one that has not proved who it is."""
        tokens = self._candidates.get(name)
        if alive and tokens is None:
            if len(self._candidates) >= MOST_MEMBERS:
                self._session.refuse("too many gateways", key=key)
                return
            self._candidates[name] = {key}
            self._proving[name] = asyncio.create_task(self._have_proved(prove, name), name=f"is it {name}")
        elif alive and tokens is not None and len(tokens) < _MOST_TOKENS:
            tokens.add(key)
        elif not alive and tokens is not None:
            tokens.discard(key)
            if not tokens:
                self._forget_candidate(name)

    def _forget_candidate(self, name: str) -> set[str]:
        task = self._proving.pop(name, None)
        if task is not None and task is not asyncio.current_task():
            task.cancel()
        return self._candidates.pop(name, set())

    async def _have_proved(self, prove: Prove, name: str) -> None:
        """Count a gateway in once it has proved who it is, for as long as a token of it is there."""
        pause_s, longest_s = PROVE_AGAIN_S
        while True:
            try:
                await prove(name)
            except SwiftbotError as error:
                if isinstance(error, IdentityError):
                    self._session.deny("token without a gateway", name, str(error))
                else:
                    self._session.refuse("token without a gateway", member=name, reason=str(error))
                    pause_s = min(LATE_S, pause_s)
                await asyncio.sleep(pause_s)
                pause_s = min(longest_s, pause_s * 2)
                continue
            for key in sorted(self._forget_candidate(name)):
                self._counted(name, key, alive=True)
            return

    async def proved(self, timeout_s: float) -> None:
        """Wait until those whose tokens were seen have proved who they are, or did not for so long."""
        if self._proving:
            await asyncio.wait(tuple(self._proving.values()), timeout=timeout_s)

    async def prove_again(self) -> None:
        """Have all members prove once more who they are; those that turn out to be others are lost.

        One that does not answer just now stays: its token says whether it is there.
        """
        if (prove := self._prove) is None:
            return
        at_once = asyncio.Semaphore(MOST_ASKED)

        async def again(name: str) -> None:
            try:
                async with at_once:
                    await prove(name)
            except IdentityError as error:
                log.warning("a member is no gateway of the fleet any more", member=name, reason=str(error))
                for key in tuple(self._tokens.get(name, ())):
                    self._counted(name, key, alive=False)
                    self._seen_candidate(prove, name, key, alive=True)
            except SwiftbotError as error:
                log.info("a member did not prove who it is", member=name, reason=str(error))

        # At once: one that is silent must not delay that a revoked one is lost.
        await asyncio.gather(*(again(name) for name in sorted(self._members - {self._gateway})))

    def _counted(self, name: str, key: str, alive: bool) -> None:
        if name == self._gateway or not self._count(name, key, alive):
            return
        try:
            check_name(name, "gateway")
        except PayloadError as error:
            self._session.refuse("malformed gw/*/alive", key=key, reason=str(error))
            return
        if alive and len(self._members) >= MOST_MEMBERS:
            self._session.refuse("too many gateways", key=key)
            return
        self._gone.pop(name, None)
        if alive:
            self._tokens[name], self._since[name] = {key}, clock()
        else:
            self._since.pop(name, None)
            self._gone[name] = clock()
            while len(self._gone) > MOST_MEMBERS:
                del self._gone[next(iter(self._gone))]
        self._members = self._members | {name} if alive else self._members - {name}
        log.info("gateway joined" if alive else "gateway lost", member=name, members=len(self._members))
        self._events.publish(Joined(name) if alive else Lost(name))

    def _count(self, name: str, key: str, alive: bool) -> bool:
        """Note a token's coming or going; returns whether its gateway comes or goes with it."""
        if name not in self._members:
            return alive
        tokens = self._tokens[name]
        if not alive:
            tokens.discard(key)
            if not tokens:
                del self._tokens[name]
            return not tokens
        if len(tokens) >= _MOST_TOKENS and key not in tokens:
            self._session.refuse("too many tokens of a gateway", key=key)
        else:
            tokens.add(key)
        return False

    def close(self) -> None:
        """Leave: the token is taken back first, so the others take over before this gateway stops answering."""
        for name in tuple(self._candidates):
            self._forget_candidate(name)
        for closer in (self._again, self._token, *self._watches):
            if closer is not None:
                closer.close()
        self._token = None


PAUSE_LEASES = 0.5
"""Leases after which the others' tokens must have gone and come: on loopback that takes a tenth of this."""
ANSWER_LEASES = 2.0
"""Leases that a member is given to answer, who may be busy with the same news."""
BACK_LEASES = 2.0
"""Leases after which those that were lost must have come back: of each two one dials again every 0.2 s."""
RELINK_REST_S = 30.0
"""Least time between two such looks: where a machine starves, links reopened are more work and no help. A standstill
within it is looked at once it is over."""
RELINK_TRIES = 3
"""Times that links are reopened after one standstill."""
WITNESSES = 3
"""Members that are asked whether one that has not come back is there."""
MOST_ASKED = 32
"""Members asked at once; in a larger fleet links are few, and what one of them is asked goes over the same one."""


class Members(Protocol):
    """What is needed of the membership."""

    @property
    def members(self) -> Set[str]:
        """Who is there, this gateway among them."""
        ...

    def seen_since(self, moment: float) -> Set[str]:
        """The other members whose token was there at that moment and has never gone since."""
        ...

    def lost_since(self, moment: float) -> Set[str]:
        """Those that were lost after that moment, and are not there."""
        ...


class Outlived:
    """Looks, after each standstill, for members that should have been lost and were not.

    Args:
        events: publishes stalls.
        lease_s: of the links.
        members: who is there.
        answers: asks a member something; whether it answered within so many seconds.
        sees: asks a member whether it sees another; False as well where it does not answer within so many seconds.
        renew: reopens all links; told why.
        now: the pulse's clock.
        pause: waits so many seconds.
    """

    def __init__(
        self,
        events: FleetEvents,
        *,
        lease_s: float,
        members: Members,
        answers: Callable[[str, float], Awaitable[bool]],
        sees: Callable[[str, str, float], Awaitable[bool]],
        renew: Callable[[str], None],
        now: Callable[[], float] = clock,
        pause: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._lease_s = lease_s
        self._members = members
        self._answers = answers
        self._sees = sees
        self._renew = renew
        self._now = now
        self._pause = pause
        self._looking: asyncio.Task[None] | None = None
        self._not_before = 0.0
        self._unsubscribe = events.subscribe(Stage.LINKS, self._on_event)

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, Stalled):
            self._on_stalled(event.stall)

    def _on_stalled(self, stall: Stall) -> None:
        # After less than a lease the others may not have closed their links at all.
        if stall.lasted_s < self._lease_s:
            return
        if self._looking is not None and not self._looking.done():
            return  # with long leases a look lasts longer than the rest after it
        wait_s = max(0.0, self._not_before - self._now())
        self._not_before = self._now() + wait_s + RELINK_REST_S
        self._looking = asyncio.create_task(self._look(stall.since, wait_s), name="links after a standstill")

    async def _look(self, since: float, wait_s: float) -> None:
        if wait_s:
            await self._pause(wait_s)
        await self._pause(self._lease_s * PAUSE_LEASES)
        # Links that were reopened can be mixed up again: then all are asked.
        for number in range(RELINK_TRIES):
            if silent := await (self._mute() if number else self._silent(since)):
                log.warning("members do not answer after a standstill", members=silent)
                self._renew("they outlived a standstill")
            await self._pause(self._lease_s * BACK_LEASES)
            if apart := await self._apart(since):
                log.warning("members that were lost in a standstill are there and do not come back", members=apart)
                self._renew("others see members that did not come back")
                # They link again just then: none is silent for that reason.
                await self._pause(self._lease_s * PAUSE_LEASES)
            if not silent and not apart:
                return

    async def _silent(self, since: float) -> list[str]:
        """Those whose tokens never went, and that do not answer, where others noticed the standstill."""
        kept = sorted(self._members.seen_since(since))
        noticed = len(self._members.members) - 1 > len(kept)
        if not kept or (not noticed and len(kept) > 1):
            return []
        silent = await self._unanswered(kept)
        # One that has gone meanwhile has no link any more.
        return [name for name in silent if name in self._members.seen_since(since)]

    async def _mute(self) -> list[str]:
        """Those that are there and do not answer."""
        silent = await self._unanswered(sorted(self._members.seen_since(self._now())))
        return [name for name in silent if name in self._members.members]

    async def _unanswered(self, names: list[str]) -> list[str]:
        asked = names[:MOST_ASKED]
        answered = await asyncio.gather(*(self._answers(each, self._lease_s * ANSWER_LEASES) for each in asked))
        return [name for name, well in zip(asked, answered, strict=True) if not well]

    async def _apart(self, since: float) -> list[str]:
        """Those that went in the standstill and are not here, though others see them."""
        lost = sorted(self._members.lost_since(since))[:MOST_ASKED]
        # Who came back, or never went, can tell of the others.
        witnesses = sorted(self._members.seen_since(self._now()))[:WITNESSES]
        within_s = self._lease_s * ANSWER_LEASES
        seen = await asyncio.gather(
            *(asyncio.gather(*(self._sees(each, name, within_s) for each in witnesses)) for name in lost)
        )
        still = self._members.lost_since(since)
        return [name for name, told in zip(lost, seen, strict=True) if any(told) and name in still]

    async def close(self) -> None:
        """Stop looking, though stalls may still be published; more than once does no harm."""
        self._unsubscribe()
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.gather(self._looking, return_exceptions=True)


NAMESAKE_STATUSES = 3
"""Statuses of another process before it is asked: last words of one that has ended may still be on their way."""
NAMESAKE_S = 3.0
"""The least time from the first of these to the last; a status comes every two seconds, whatever happens."""
_MOST_PROCESSES = 8
"""Processes remembered: those heard of last."""
_NAMESAKE_ASK_S = 2.0

Process = tuple[int, int]


def process(status: GatewayStatus) -> Process:
    """What tells a process from all others: when it began, to the nanosecond, and its number."""
    return status.started_ns, status.pid


def goes(own: Process, others: Iterable[Process]) -> bool:
    """Whether of several processes of one id this one has to go: all but the one that says it began first.

    That needs no right clocks, only that all decide alike.
    """
    return own > min(others, default=own)


def displaced(gateway: str) -> ConfigError:
    """Return what is wrong, for the one that goes."""
    return ConfigError(
        f"another gateway named {gateway} is in the fleet, and began before this one",
        remedy="give each gateway an id of its own",
    )


class Suspicion:
    """Whether another process seems to put a gateway's status. Pure; time is passed in."""

    def __init__(self) -> None:
        self._others: dict[Process, tuple[float, int]] = {}
        """Processes heard under this gateway's key -> when first, and how often."""

    def heard(self, status: GatewayStatus, own: GatewayStatus | None, now: float) -> bool:
        """Take in a status put under this gateway's key; returns whether another process goes on putting them.

        Args:
            status: what was put.
            own: what this process has told of itself last; None: nothing yet.
            now: by the monotonic clock.
        """
        other = process(status)
        if own is None or not own.started_ns or not status.started_ns or other == process(own):
            return False
        since, count = self._others.pop(other, (now, 0))
        if len(self._others) >= _MOST_PROCESSES:
            del self._others[next(iter(self._others))]
        self._others[other] = since, count + 1
        return count + 1 >= NAMESAKE_STATUSES and now - since >= NAMESAKE_S


class Versions:
    """Finds out whether gateways are here that this one does not work beside, and whether this one has to go.

    The later one goes: a fleet that works is not disturbed by one that comes.

    Args:
        session: of this gateway.
        own: what it has told of itself last.
    """

    def __init__(self, session: Session, *, own: Callable[[], GatewayStatus | None]) -> None:
        self.displaced = asyncio.Event()
        """Another gateway was here first, and this one does not work beside it."""
        self.problem: ConfigError | None = None
        self._session = session
        self._own = own
        self._told: set[Process] = set()

    def heard(self, status: GatewayStatus) -> None:
        """Take in what another gateway says of itself."""
        if gateways.works_beside(status) or process(status) in self._told:
            return
        if len(self._told) < _MOST_PROCESSES:
            self._told.add(process(status))
        newer = status.oldest_protocol > gateways.PROTOCOL
        text = (
            f"gateway {status.id} (version {status.version or 'unknown'}) speaks protocol {status.protocol} and works "
            f"beside {status.oldest_protocol} and later; this one speaks {gateways.PROTOCOL} and works beside "
            f"{gateways.OLDEST_PROTOCOL} and later"
        )
        self._session.refuse("incompatible gateway", reason=text)
        own = self._own()
        if own is None or process(own) > process(status):
            remedy = "upgrade this gateway" if newer else f"upgrade {status.id} first, version by version"
            self.problem = ConfigError(text, remedy=f"{remedy} (`swiftbot upgrade`)")
            self.displaced.set()


class Namesakes:
    """Finds out whether other processes go by a gateway's id, and whether this one has to go.

    Args:
        session: of this gateway.
        gateway: its id.
        own: what it has told of itself last.
    """

    def __init__(self, session: Session, gateway: str, *, own: Callable[[], GatewayStatus | None]) -> None:
        self.displaced = asyncio.Event()
        """Another process goes by this gateway's id, and this one has to go."""
        self._session = session
        self._gateway = gateway
        self._own = own
        self._suspicion = Suspicion()
        self._asking: asyncio.Task[None] | None = None

    def heard(self, status: GatewayStatus) -> None:
        """Take in a status that was put under this gateway's key, by whomever."""
        if self._suspicion.heard(status, self._own(), time.monotonic()) and self._asking is None:
            self._asking = asyncio.create_task(self._ask(), name="namesakes")
            self._asking.add_done_callback(self._asked)

    def _asked(self, _: asyncio.Task[None]) -> None:
        self._asking = None

    async def _ask(self) -> None:
        key, ask = self._session.keys(keyspace.RPC, self._gateway, "facts"), encode(FactsAsk())
        try:
            answers = await self._session.query_all(key, ask, timeout_s=_NAMESAKE_ASK_S)
        except SwiftbotError as error:
            log.info("who else goes by this id could not be asked", reason=str(error))
            return
        own = self._own()
        others: dict[Process, GatewayStatus] = {}
        for answer in answers:
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                status = msgspec.json.decode(answer.payload, type=Facts).status
                if status is not None and status.started_ns and own is not None and process(status) != process(own):
                    others[process(status)] = status
        for status in others.values():
            ends = ", ".join(status.endpoints) or "no endpoint"
            self._session.refuse("another gateway with this id", says=status.id, its_pid=status.pid, listens_on=ends)
        if own is not None and goes(process(own), others):
            self.displaced.set()

    async def close(self) -> None:
        """Ask no more."""
        if self._asking is not None:
            self._asking.cancel()
            await asyncio.gather(self._asking, return_exceptions=True)
