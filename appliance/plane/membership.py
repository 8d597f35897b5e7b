"""Membership and failure detection: which gateways are there, and when one cannot trust what it sees of them.

A gateway is there while its liveliness token is seen; the ring is made of those. A token goes when its process dies (at
once) or its link has been silent for a lease, so nobody is asked. When a link is cut and made anew while the other end
stands still, Zenoh may forget a token that is there and never mention it again; whoever hears from a gateway that it is
not seen shows a further token, and is there while any of them is (`Membership`).

**Stalls** (`StallDetector`): this process was frozen, suspended with its machine, or starved of the processor. A
gateway that stands still for a lease is taken for dead and succeeded, and does not know it: when it runs again it
first finds the requests that waited for it, and would order writes that its successor has ordered since, from records
that are stale. So after a stall it orders no write for a lease (whoever asked asks again, at the right gateway by
then), and compares its shard with the others' before it answers as an owner.

**Stale links** (`Outlived`): links that outlive a stall and must not, and those that do not come back, are made anew.
All others close their links with a process that stands still for a lease, and dial again. When it runs again it may
take a new connection before it has noticed that the old one is closed. Zenoh 1.10 then goes on with what it knew of
the other side, which has begun anew: questions arrive at wrong doors there, answers nowhere, and neither side sees
the other's facts, for as long as that link lives (zenoh issue 1886). It shows here, by no word of anybody:

- this process stood still for a lease,
- the tokens of others have gone and come, as they do when links are closed, so that they noticed (on a machine that was
  suspended, or starves, all of a fleet stand still together and nobody loses anybody),
- one's token has not, and it does not answer.

Or the two never link again: each took the other's new connection for one that it had already, dropped it, and dials no
more, though each is named in the other's `connect`. Then a member that was there before is lost for good, while others,
which have come back, see it. Links that are made anew have it told of by those at their other ends, and dialled.

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
from typing import NamedTuple, Protocol

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import ConfigError, PayloadError, SwiftbotError
from appliance.model import ContainerInfo, GatewayStatus, RobotInfo, encode
from appliance.plane.keys import check_name
from appliance.plane.ring import Ring
from appliance.plane.session import Closer, Session

log = structlog.get_logger(__name__)


def clock() -> float:
    """Seconds, those of a suspended machine among them."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Stall(NamedTuple):
    """When a process stood still: since what moment of `clock`, and for how many seconds."""

    since: float
    lasted_s: float


class StallDetector:
    """Beats on a thread of its own: what only holds up the event loop makes nobody take this gateway for dead."""

    def __init__(self, lease_s: float, *, clock: Callable[[], float] = clock) -> None:
        self.on_stalled: list[Callable[[Stall], None]] = []
        """Called on the event loop after the process stood still, once for each standstill and told which."""
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
        """Look at the clock, from any thread; whoever does so first after a stall finds it."""
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
                    self._loop.call_soon_threadsafe(self._tell, Stall(since, stood_s))
        return now

    def _tell(self, standstill: Stall) -> None:
        for callback in tuple(self.on_stalled):
            callback(standstill)

    def close(self) -> None:
        """Beat no more."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None


MOST_MEMBERS = 1000
"""Gateways known at once; liveliness of more costs too much (design/platform). More are refused and counted."""
_MOST_TOKENS = 8
"""Of one gateway; more than two mean a mistake."""


class Membership:
    """The gateways of a fleet as this process sees them. `gateway` is this one's id; None for clients."""

    def __init__(self, session: Session, *, gateway: str | None, virtual_nodes: int) -> None:
        self._session = session
        self._gateway = gateway
        self._members: frozenset[str] = frozenset() if gateway is None else frozenset({gateway})
        self._made = self._members, Ring(self._members, virtual_nodes=virtual_nodes)
        """The members that the ring was last made of, and it."""
        self.on_joined: list[Callable[[str], None]] = []
        self.on_lost: list[Callable[[str], None]] = []
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
        self._watches = [self._session.watch_alive(each, self._seen) for each in (keys.alive(), keys.alive_again())]

    def add(self, name: str) -> None:
        """Count a gateway in before its token is watched."""
        self._seen(self._session.keys.alive(name), alive=True)

    def join(self) -> None:
        """Show the others that this gateway is there."""
        if self._gateway is not None:
            self._token = self._session.declare_alive(self._session.keys.alive(self._gateway))

    def show_again(self) -> None:
        """Show a token that nobody can have forgotten: somebody does not see the first."""
        if self._gateway is None or self._token is None:
            return
        self._shown += 1
        before, again = self._again, self._session.keys.alive_again(self._gateway, str(self._shown))
        self._again = self._session.declare_alive(again)
        if before is not None:
            before.close()

    def _seen(self, key: str, alive: bool) -> None:
        name = key.removeprefix(f"{self._session.keys.root}/gw/").partition("/")[0]
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
        self._tell(self.on_joined if alive else self.on_lost, name)

    def _tell(self, listeners: list[Callable[[str], None]], name: str) -> None:
        for callback in tuple(listeners):
            try:
                callback(name)
            except Exception:  # supervision boundary: the other listeners must hear of it all the same
                log.exception("a listener to the membership failed", member=name)

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
"""Least time between two such looks: where a machine starves, links made anew are more work and no help. A standstill
within it is looked at once it is over."""
RELINK_TRIES = 3
"""Times that links are made anew after one standstill."""
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
        pulse: tells of standstills.
        lease_s: of the links.
        members: who is there.
        answers: asks a member something; whether it answered within so many seconds.
        sees: asks a member whether it sees another; False as well where it does not answer within so many seconds.
        renew: makes all links anew; told why.
        now: the pulse's clock.
        pause: waits so many seconds.
    """

    def __init__(
        self,
        pulse: StallDetector,
        *,
        lease_s: float,
        members: Members,
        answers: Callable[[str, float], Awaitable[bool]],
        sees: Callable[[str, str, float], Awaitable[bool]],
        renew: Callable[[str], None],
        now: Callable[[], float] = clock,
        pause: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._pulse = pulse
        self._lease_s = lease_s
        self._members = members
        self._answers = answers
        self._sees = sees
        self._renew = renew
        self._now = now
        self._pause = pause
        self._looking: asyncio.Task[None] | None = None
        self._not_before = 0.0
        pulse.on_stalled.append(self._on_stalled)

    def _on_stalled(self, standstill: Stall) -> None:
        # After less than a lease the others may not have closed their links at all.
        if standstill.lasted_s < self._lease_s:
            return
        if self._looking is not None and not self._looking.done():
            return  # with long leases a look lasts longer than the rest after it
        wait_s = max(0.0, self._not_before - self._now())
        self._not_before = self._now() + wait_s + RELINK_REST_S
        self._looking = asyncio.create_task(self._look(standstill.since, wait_s), name="links after a standstill")

    async def _look(self, since: float, wait_s: float) -> None:
        if wait_s:
            await self._pause(wait_s)
        await self._pause(self._lease_s * PAUSE_LEASES)
        # Links that were made anew can be mixed up again: then all are asked.
        for number in range(RELINK_TRIES):
            if silent := await (self._mute() if number else self._silent(since)):
                log.warning("members do not answer after a standstill", members=silent)
                self._renew("they outlived a standstill")
            await self._pause(self._lease_s * BACK_LEASES)
            if apart := await self._apart(since):
                log.warning("members that were lost in a standstill are there and do not come back", members=apart)
                self._renew("others see members that did not come back")
                # They link anew just then: none is silent for that reason.
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
        """Look no more, whatever the pulse tells until it is closed too; more than once does no harm."""
        if self._on_stalled in self._pulse.on_stalled:
            self._pulse.on_stalled.remove(self._on_stalled)
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.gather(self._looking, return_exceptions=True)


class FactsAsk(Struct, frozen=True, omit_defaults=True):
    """`facts`: what do you know? `all`: of the other gateways too, of those whose ids come after `after`."""

    all: bool = False
    after: str = ""


class Known(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a gateway knows of another, and how old that is."""

    gateway: str
    status: GatewayStatus | None = None
    containers: tuple[ContainerInfo, ...] = ()
    age_ms: int = 0


class Facts(Struct, frozen=True, omit_defaults=True):
    """A gateway's own facts, the robots it knows of, and, if asked, what it knows of other gateways."""

    gateway: str
    status: GatewayStatus | None = None
    containers: tuple[ContainerInfo, ...] = ()
    robots: tuple[RobotInfo, ...] = ()
    others: tuple[Known, ...] = ()
    more: bool = False
    """There are further others."""


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
        key, ask = self._session.keys.rpc(self._gateway, "facts"), encode(FactsAsk())
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
