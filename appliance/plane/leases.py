"""Leases that a majority grants: mutual exclusion for work that one alone may do, in a fleet that may be cut in two.

Each key has r grantors, the first on the ring of all gateways that `plane.voters` names, whether they are there or
not; a lease needs the grant of a majority of them, and any two majorities have one in common.

A key may be leased in parts (the cells of a floor): two holders have it at once when no part is in both leases. Parts
outlast their lease: what held them, such as a robot, may still be there, so an ended lease on parts stands in the way
until an asker says that its holder has left them (`LeaseAsk.cleared`).

`Grantor` and the functions of answers are pure: time is passed in, and nothing is stored or sent. A grantor holds one
live grant for each key. It numbers grants by fences that only increase, over all its keys, so that what was sent
before a grant cannot replace it however late it arrives, and a resource that remembers the highest fence it has seen
can refuse a holder that was frozen while its lease ended. `Leases` asks the grantors and answers as one.

Sources: Gray, Cheriton, "Leases: an efficient fault-tolerant mechanism for distributed file cache consistency", 1989
(a lease ends by itself, each side by its own clock; a grantor that was restarted is silent for the longest lease);
Lamport, "Paxos made simple", 2001 (majorities, and numbers that only increase).
"""

import asyncio
import hashlib
import random
import secrets
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Sequence
from typing import TypeVar

import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import ConfigError, ConflictError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import keyspace
from appliance.model.keys import Q, R, Verb
from appliance.model.plane_api import LONGEST_S, Granted, LeaseAsk, LeaseEnd, Released
from appliance.plane.records import check_key
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store

MOST_GRANTS = 10_000
"""Live grants of one grantor."""
_MOST_JUMP = 2**32
"""A fence further ahead than that is no asker's: it would use up the numbers."""


class Grant(Struct, frozen=True):
    """A key, or parts of it, granted to a holder until a time on the grantor's clock."""

    holder: str
    fence: int
    until: float
    parts: frozenset[str] = frozenset()
    before: "Grant | None" = None
    """What it had before it got more parts: a release of this fence brings it back."""

    def bars(self, asked: LeaseAsk, now: float) -> bool:
        """Whether it stands in the way of what another asks for."""
        if self.until <= now and (not self.parts or self.holder in asked.cleared):
            return False
        return not asked.parts or not self.parts or not self.parts.isdisjoint(asked.parts)


class GrantCase(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An answer on parts of a key with all that it rested on, put as `gw/{gateway}/decided/grant`."""

    gateway: str
    asked: LeaseAsk
    now: float
    """Seconds of the grantor's own clock."""
    before: int
    """Its highest fence."""
    held: tuple[Grant, ...]
    """What the asker's holder has, and what others have of what is asked for."""
    granted: bool = False
    holder: str = ""
    """Where it is refused: who has a part of it."""
    part: str = ""
    twice: str = ""
    """Who else has a part of what was granted, under a lease that has not ended: must be nobody."""


def case_of(grantor: "Grantor", gateway: str, asked: LeaseAsk, now: float) -> GrantCase:
    """Return what an answer will rest on."""
    wanted = frozenset(asked.parts)
    others = [replace(each, parts=each.parts & wanted, before=None) for each in grantor.held(asked.key)]
    held = [each for each in others if each.parts and each.holder != asked.holder]
    mine = [replace(each, before=None) for each in grantor.held(asked.key) if each.holder == asked.holder]
    return GrantCase(gateway=gateway, asked=asked, now=now, before=grantor.fence, held=(*mine, *held))


def answered(case: GrantCase, answer: Granted) -> GrantCase:
    """Return a case with the answer that was given."""
    live = (each.holder for each in case.held if each.holder != case.asked.holder and each.until > case.now)
    twice = next(live, "") if answer.granted else ""
    return replace(case, granted=answer.granted, holder=answer.holder, part=answer.part, twice=twice)


def grant_again(case: GrantCase) -> dict[str, object]:
    """Answer again; the answer by the fields of the case."""
    grantor = Grantor(fence=0, now=case.now)
    grantor.restore(case.asked.key, case.held, case.before)
    found = answered(case, grantor.grant(case.asked, case.now))
    return {"granted": found.granted, "holder": found.holder, "part": found.part, "twice": ""}


class Grantor:
    """The grants of one gateway.

    Args:
        fence: the highest fence that it granted before its last restart; 0: it never granted any.
        now: seconds, on a clock that does not jump; may stand still while the machine is suspended.
    """

    def __init__(self, *, fence: int, now: float) -> None:
        self.fence = fence
        """Must be on the disk before the answer that made it is sent."""
        self._quiet_until = now + LONGEST_S if fence else now
        self._grants: dict[str, dict[str, Grant]] = {}
        """By key and holder."""

    def held(self, key: str) -> tuple[Grant, ...]:
        """Return what is granted of a key, ended leases on parts among it."""
        return tuple(self._grants.get(key, {}).values())

    def restore(self, key: str, held: Sequence[Grant], fence: int) -> None:
        """Take up what was granted of a key, to answer once more as then."""
        self._grants[key] = {each.holder: each for each in held}
        self.fence = fence

    def grant(self, asked: LeaseAsk, now: float) -> Granted:
        """Grant a key, also again to its holder, unless another has it or the fence is not higher than any before.

        Of a key in parts the holder keeps what it has until it renews (`after`) with less: what is refused it elsewhere
        costs it nothing.

        Raises:
            RefusedError: it was restarted less than the longest lease ago, or holds too many grants.
            PayloadError: the fence is absurd.
        """
        if now < self._quiet_until:
            left_s = self._quiet_until - now
            raise RefusedError(
                f"grants nothing for another {left_s:.1f} s: grants from before its restart may be live",
                remedy="ask again then",
            )
        if asked.fence > self.fence + _MOST_JUMP:
            raise PayloadError(f"a fence of {asked.fence:,} after {self.fence:,}")
        held = self._grants.setdefault(asked.key, {})
        mine = held.get(asked.holder)
        if mine is not None and not mine.parts and mine.until <= now:
            mine = None
        if mine is not None and 0 < asked.after < mine.fence:
            return Granted(fence=self.fence, holder=asked.holder, left_s=max(0.0, mine.until - now))
        bars = [each for each in held.values() if each.holder != asked.holder and each.bars(asked, now)]
        if bars:
            other = max(bars, key=lambda each: (each.until, each.holder))
            part = max(other.parts.intersection(asked.parts), default="")
            return Granted(fence=self.fence, holder=other.holder, left_s=max(0.0, other.until - now), part=part)
        if asked.fence <= self.fence:
            return Granted(fence=self.fence)
        if mine is None:
            self._make_room(now)
        held = self._grants.setdefault(asked.key, {})
        for name in [each.holder for each in held.values() if each.until <= now and each.holder in asked.cleared]:
            del held[name]
        parts = frozenset(asked.parts)
        if mine is not None and mine.parts and not (asked.after and parts <= mine.parts):
            parts, before = parts | mine.parts, replace(mine, before=None)
        else:
            before = None
        # Never shorter than what the holder was told before: it may not hear this answer.
        until = max(now + asked.ttl_s, now if mine is None else mine.until)
        held[asked.holder] = Grant(asked.holder, asked.fence, until, parts, before)
        self.fence = asked.fence
        return Granted(granted=True, fence=asked.fence)

    def _make_room(self, now: float) -> None:
        if sum(len(held) for held in self._grants.values()) < MOST_GRANTS:
            return
        kept = {
            key: {name: each for name, each in held.items() if each.parts or each.until > now}
            for key, held in self._grants.items()
        }
        self._grants = {key: held for key, held in kept.items() if held}
        if sum(len(held) for held in self._grants.values()) >= MOST_GRANTS:
            raise RefusedError(f"holds {MOST_GRANTS:,} grants", remedy="release leases, or ask for shorter ones")

    def release(self, ended: LeaseEnd) -> None:
        """Drop a grant, if it is still the one of that fence: a renewal that overtook the release stays.

        Parts that its holder had before stay its own.
        """
        held = self._grants.get(ended.key, {})
        mine = held.get(ended.holder)
        if mine is None or mine.fence != ended.fence:
            return
        del held[ended.holder]
        if mine.before is not None:
            held[ended.holder] = mine.before
        elif not held:
            del self._grants[ended.key]


def majority(grantors: int) -> int:
    """How many grantors decide: any two majorities have one in common."""
    return grantors // 2 + 1


def granted(answers: Sequence[Granted], grantors: int) -> bool:
    """Whether a majority has granted it."""
    return sum(answer.granted for answer in answers) >= majority(grantors)


def highest(fence: int, answers: Sequence[Granted]) -> int:
    """The highest fence heard of, an asker's own among them; one that is absurd is not believed."""
    return max(fence, *(answer.fence for answer in answers if answer.fence <= fence + _MOST_JUMP), 0)


def holder_of(answers: Sequence[Granted], grantors: int) -> tuple[str, float] | None:
    """Who else has the lease, as a majority says, and for how many seconds more; None: nobody is known to."""
    counts = Counter(answer.holder for answer in answers if answer.holder)
    for name, count in counts.most_common(1):
        if count >= majority(grantors):
            left = sorted((answer.left_s for answer in answers if answer.holder == name), reverse=True)
            # It has it for as long as a majority says so.
            return name, left[majority(grantors) - 1]
    return None


log = structlog.get_logger(__name__)

FENCE = "lease-fence"
"""Of the store: the highest fence that was granted."""
_LOST = "lease-lost"
_ASK_S = 1.0
"""One question to a grantor; all are asked at once, and a majority of answers is enough."""
_TRY_S = 1.0
"""How long an acquisition tries again while others' share the grantors with it, or its fence is behind."""
_BACK_OFF_S = (0.005, 0.05)
"""Between tries: drawn, so that two do not keep step."""
_DRIFT = 0.01
"""The holder's lease ends earlier than its grants by this share: clocks of two machines do not run equally fast."""

Asked = TypeVar("Asked", LeaseAsk, LeaseEnd)
Answer = TypeVar("Answer", bound=Struct)


class Lease(Struct, frozen=True, kw_only=True):
    """A lease as its holder has it."""

    key: str
    holder: str
    fence: int
    """Higher than that of every lease on the key before: hand it on with what the lease protects."""
    until: float
    """On the holder's clock (`CLOCK_BOOTTIME`, seconds), which runs on while the machine is suspended."""

    @property
    def left_s(self) -> float:
        """Seconds that are left; 0 when it has ended."""
        return max(0.0, self.until - _holder_clock())


class Claim(Struct, frozen=True, kw_only=True):
    """What came of asking for parts of a key: the lease, or who stands in the way."""

    lease: Lease | None = None
    holder: str = ""
    part: str = ""
    """One of the parts that the other has."""
    ended: bool = False
    """Whether the other's lease has ended, and it has not been seen to leave."""


class Leases:
    """One gateway's part in the leases: as a grantor, and for its own callers. `start` before use."""

    def __init__(self, config: PlaneConfig, *, gateway: str, store: Store, rpc: Rpc) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._ring = Ring(config.voters, virtual_nodes=config.virtual_nodes)
        named = f"{sorted(config.voters)} {config.replicas} {config.virtual_nodes}"
        self.digest = hashlib.blake2b(named.encode(), digest_size=8).hexdigest()
        """Of the grantors as they are configured here: all must have the same."""
        self._grantor: Grantor | None = None
        self._highest = 0
        """Highest fence heard of."""
        self._told: Callable[[GrantCase], None] | None = None
        rpc.register(keyspace.LEASE_GRANT, self.on_grant)
        rpc.register(keyspace.LEASE_RELEASE, self.on_release)

    async def start(self, *, lost: bool) -> None:
        """Begin to grant. `lost`: the store's file could not be read, and with it went the highest fence."""
        if lost:
            await self._store.put(_LOST, b"1")
        if await self._store.get(_LOST) is None:
            fence = int(await self._store.get(FENCE) or 0)
            self._grantor = Grantor(fence=fence, now=time.monotonic())
        elif self._gateway in self._config.voters:
            log.error(
                "this gateway grants no leases: its fences were lost with its file",
                remedy="give it a new id and name that in plane.voters in place of the old one",
            )

    # --- the door ---------------------------------------------------------------------------------------------

    def tell(self, told: Callable[[GrantCase], None]) -> None:
        """Have each answer on parts told, but for renewals."""
        self._told = told

    def grantors(self, key: str) -> tuple[str, ...]:
        """The gateways that grant a key, there or not; ConfigError when none are configured."""
        if not self._config.voters:
            raise ConfigError(
                "a lease was asked for, and plane.voters names nobody",
                remedy="name the gateways that grant leases in plane.voters, the same at every gateway",
            )
        return self._ring.successors(check_key(key), self._config.replicas)

    async def acquire(self, key: str, *, ttl_s: float) -> Lease:
        """Lease a key for `ttl_s` seconds (at most 30); while it lasts nobody else has it, on whatever side of a cut.

        Raises:
            ConfigError: `plane.voters` is empty, or `ttl_s` out of bounds.
            ConflictError: another has it.
            UnreachableError: fewer than a majority of the key's grantors answer.
        """
        holder = f"{self._gateway}:{secrets.token_hex(8)}"
        until = time.monotonic() + _TRY_S
        while True:
            fence, lease, answers = await self._ask(key, holder, ttl_s)
            if lease is not None:
                return lease
            if any(answer.granted for answer in answers):
                await self._end(key, holder, fence)  # what a minority has granted must not keep the next one out
            self._refuse(key, answers)
            if time.monotonic() > until:
                raise ConflictError(f"{key} is contended", remedy="try again in a moment")
            await asyncio.sleep(random.uniform(*_BACK_OFF_S))  # noqa: S311 - spreads load, protects nothing

    async def claim(
        self,
        key: str,
        holder: str,
        parts: Collection[str],
        *,
        ttl_s: float,
        after: int = 0,
        cleared: Collection[str] = (),
    ) -> Claim:
        """Lease parts of a key, all or none, for `ttl_s` seconds; renew, give up a part and get another alike.

        Args:
            key: what the parts are of: it names the grantors, and all parts have the same.
            holder: what holds them, such as a robot. Whoever asks for it has what it holds, at whatever gateway.
            parts: all that it needs from now on. What else it holds is given up with the first renewal.
            ttl_s: at most 30.
            after: fence of the lease that this renews: refused, with the holder's own name, where somebody else has
                asked for the holder since. 0: take over what it holds.
            cleared: holders that are known to have left what they held, where their leases have ended.

        Raises:
            ConfigError, UnreachableError: as `acquire`.
            ConflictError: others ask for the same at this moment.
        """
        if not parts:
            raise PayloadError(f"no parts of {key} are asked for")
        wanted, free = tuple(sorted(parts)), tuple(sorted(cleared))
        until = time.monotonic() + _TRY_S
        while True:
            fence, lease, answers = await self._ask(key, holder, ttl_s, parts=wanted, after=after, cleared=free)
            if lease is not None:
                return Claim(lease=lease)
            if any(answer.granted for answer in answers):
                await self._end(key, holder, fence)
            others = [answer for answer in answers if answer.holder]
            if others and len(answers) >= majority(len(self.grantors(key))):
                other = max(others, key=lambda answer: (answer.left_s, answer.part))
                return Claim(holder=other.holder, part=other.part, ended=other.left_s <= 0.0)
            self._refuse(key, answers)
            if time.monotonic() > until:
                raise ConflictError(f"{key} is contended", remedy="try again in a moment")
            await asyncio.sleep(random.uniform(*_BACK_OFF_S))  # noqa: S311 - spreads load, protects nothing

    async def renew(self, lease: Lease, *, ttl_s: float) -> Lease:
        """Hold a lease for `ttl_s` seconds from now; when that fails the lease given lasts as long as it did.

        Raises:
            ConflictError: it has ended: what it protected may be another's.
            UnreachableError: fewer than a majority of the key's grantors answer, or grant it.
        """
        if not lease.left_s:
            raise ConflictError(f"the lease on {lease.key} has ended", remedy="acquire it again")
        until = time.monotonic() + min(_TRY_S, lease.left_s)
        while True:
            _, renewed, answers = await self._ask(lease.key, lease.holder, ttl_s)
            if renewed is not None:
                return renewed
            self._refuse(lease.key, answers)
            if time.monotonic() > until:
                raise UnreachableError(f"the lease on {lease.key} could not be renewed", remedy="try again")
            await asyncio.sleep(random.uniform(*_BACK_OFF_S))  # noqa: S311 - spreads load, protects nothing

    async def release(self, lease: Lease) -> None:
        """Give a lease back; with grantors that do not hear of it it ends by itself."""
        await self._end(lease.key, lease.holder, lease.fence)

    # --- asking -----------------------------------------------------------------------------------------------

    async def _ask(
        self,
        key: str,
        holder: str,
        ttl_s: float,
        *,
        parts: tuple[str, ...] = (),
        after: int = 0,
        cleared: tuple[str, ...] = (),
    ) -> tuple[int, Lease | None, list[Granted]]:
        """Ask all grantors once, under a fence above all that were heard of.

        Returns:
            The fence, the lease if a majority granted it, and the answers.
        """
        grantors = self.grantors(key)
        if not 0 < ttl_s <= LONGEST_S:
            raise ConfigError(f"a lease of {ttl_s:g} s", remedy=f"more than 0, at most {LONGEST_S:g} s")
        self._highest += 1
        ask = LeaseAsk(
            key=key,
            holder=holder,
            fence=self._highest,
            ttl_s=ttl_s,
            voters=self.digest,
            parts=parts,
            after=after,
            cleared=cleared,
        )
        # From before they are asked: each grant ends later than this.
        until = _holder_clock() + ttl_s * (1 - _DRIFT)

        def enough(answers: list[Granted]) -> bool:
            return granted(answers, len(grantors)) or holder_of(answers, len(grantors)) is not None

        answers = await self._poll(grantors, keyspace.LEASE_GRANT, ask, self.on_grant, enough)
        self._highest = highest(self._highest, answers)
        if not granted(answers, len(grantors)) or until <= _holder_clock():
            return ask.fence, None, answers
        return ask.fence, Lease(key=key, holder=holder, fence=ask.fence, until=until), answers

    def _refuse(self, key: str, answers: list[Granted]) -> None:
        """Raise where asking again at once is of no use."""
        grantors = self.grantors(key)
        if (other := holder_of(answers, len(grantors))) is not None:
            name, left_s = other
            raise ConflictError(f"{key} is leased to {name} for {left_s:.1f} s", remedy="try again then")
        if len(answers) < majority(len(grantors)):
            raise UnreachableError(
                f"{len(answers)} of {', '.join(grantors)} answer for {key}, {majority(len(grantors))} are needed",
                remedy="try again when they are back",
            )

    async def _end(self, key: str, holder: str, fence: int) -> None:
        end = LeaseEnd(key=key, holder=holder, fence=fence, voters=self.digest)
        await self._poll(self.grantors(key), keyspace.LEASE_RELEASE, end, self.on_release, lambda _: False)

    async def _poll(
        self,
        grantors: tuple[str, ...],
        verb: Verb[Q, R],
        ask: Q,
        here: Callable[[Q], Awaitable[R]],
        enough: Callable[[list[R]], bool],
    ) -> list[R]:
        """Ask all grantors at once; returns the answers as soon as they are enough, or when no more will come."""

        async def one(grantor: str) -> R | None:
            try:
                if grantor == self._gateway:
                    return await here(ask)
                return await self._rpc.call(grantor, verb, ask, timeout_s=_ASK_S)
            except SwiftbotError as error:
                log.debug("a grantor does not answer", grantor=grantor, verb=verb.name, reason=str(error))
                return None

        answers: list[R] = []
        waiting = {asyncio.create_task(one(grantor)) for grantor in grantors}
        try:
            while waiting and not enough(answers):
                finished, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
                answers += [answer for task in finished if (answer := task.result()) is not None]
        finally:
            for task in waiting:
                task.cancel()
        return answers

    # --- granting ---------------------------------------------------------------------------------------------

    async def on_grant(self, asked: LeaseAsk) -> Granted:
        """Grant, with the fence on the disk before the answer."""
        grantor, now = self._granting(asked), time.monotonic()
        told = self._told if asked.parts and not asked.after else None
        case = case_of(grantor, self._gateway, asked, now) if told is not None else None
        answer = grantor.grant(asked, now)
        if answer.granted:
            await self._store.put(FENCE, str(grantor.fence).encode())
        if told is not None and case is not None:
            told(answered(case, answer))
        return answer

    async def on_release(self, ended: LeaseEnd) -> Released:
        """Drop a grant."""
        self._granting(ended).release(ended)
        return Released()

    def _granting(self, asked: LeaseAsk | LeaseEnd) -> Grantor:
        if asked.voters != self.digest:
            raise RefusedError(
                f"{self._gateway} is configured with other voters than the asking gateway",
                remedy="plane.voters, replicas and virtual_nodes must be the same at every gateway",
            )
        if self._gateway not in self.grantors(asked.key):
            raise RefusedError(f"{self._gateway} does not grant {asked.key}")
        if self._grantor is None:
            raise RefusedError(f"{self._gateway} has lost its fences and grants nothing", remedy="give it a new id")
        return self._grantor


def _holder_clock() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)
