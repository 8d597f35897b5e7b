"""The distributed hash table: each key has an owner on the ring that orders its writes, and r-1 further replicas.

A write goes to the owner, which compares the version the writer saw with its own, stores, and has the replicas store
before it acknowledges. When the owner dies its successor on the ring, a replica, is the owner; `anti_entropy` brings
every gateway up to date before it answers for keys that have become its own. Two owners at once (views of the
membership differ for a moment, or a partition) make concurrent versions, which every gateway resolves alike.

- `Settling`: whether this gateway may answer for a key as its owner: it has compared its shard, with all who may know
  more.
- `Absence`: whether a record that is not here is nowhere. A copy that is here answers a read; none is no answer until
  all are heard that may hold one. Two kinds are not: *silent* members, which are seen and with which the shard was to
  be compared, and which did not answer; and members that are *gone*, where all holders of a key were lost together:
  copies are for r-1 of them. They may be on the other side of a cut, or late for their leases on a machine that
  starves, and have the record all the same. What is gone counts for `GONE_S`; by then it is taken for lost, with what
  only it had. Until then the one that asks for such a key gets `unreachable`.
- `Pushing`: replication, a record's copies on their way to its replicas: with a write, and again to one that was too
  slow.
- `Ordering`: writes as the owner orders them, one after the other.
- `Dht`: reads and writes from any gateway, with retries while the membership settles.
- `Browsing`: which records there are, where their copies lie, and whether these agree.
"""

import asyncio
import contextlib
import math
import random
import secrets
import time
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from functools import partial
from typing import Any

import structlog

from appliance.background import Background
from appliance.errors import ConflictError, DeadlineError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import VersionVector, keyspace
from appliance.model.plane_api import (
    Copy,
    Found,
    KeyAsk,
    Listed,
    Record,
    RecordAsk,
    RecordChange,
    RecordList,
    RecordPlace,
    RecordsAsk,
    StoreAsk,
    Write,
    Written,
)
from appliance.plane.membership import Membership, StallDetector
from appliance.plane.records import (
    MAX_KEY,
    Behind,
    Resolver,
    by_bytes,
    check_key,
    check_record,
    check_write,
    decide,
    descends,
    digest,
    follows_here,
    settle,
)
from appliance.plane.ring import Ring
from appliance.plane.rpc import Call, Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import LeaveOut, Store

log = structlog.get_logger(__name__)

SETTLE_S = 2.0
"""How long an owner lets requests wait for its reconciling; then it answers with what it has."""
RETURNED_S = 0.4
"""How long of it a write waits for one that has come back and is not compared with yet: if it holds something newer, it
says so when it is given the write. One that is silent must hold up no takeover for long, `anti_entropy.LOSS_S`."""


class Settling:
    """What `anti_entropy` has compared, and the requests that wait for it. `replicas`: copies of a record."""

    def __init__(
        self, *, gateway: str, membership: Membership, pulse: StallDetector, replicas: int, virtual_nodes: int
    ) -> None:
        self.wanted = asyncio.Event()
        """A request waits for the shard to be reconciled; the reconciler clears it."""
        self.returned: frozenset[str] = frozenset()
        """Members that were away and have come back, with whom the shard is not compared yet: on the other side of a
        cut they may have ordered writes."""
        self._gateway = gateway
        self._membership = membership
        self._pulse = pulse
        self._replicas = replicas
        self._stalls = 0
        self._ring = Ring((), virtual_nodes=virtual_nodes)
        self._changed = asyncio.Condition()

    def reconciled(self) -> bool:
        """Whether the shard has been reconciled with the members of the ring as it is just now."""
        return self._ring == self._membership.ring and self._stalls == self._pulse.stalls

    async def settled(self, ring: Ring, stalls: int) -> None:
        """The shard has been reconciled with the members of that ring, `stalls` so far: what waited for it goes on."""
        self._ring, self._stalls = ring, stalls
        async with self._changed:
            self._changed.notify_all()

    def _compared(self, key: str) -> bool:
        """Whether a key was this gateway's when it last reconciled."""
        settled = self._ring
        known = bool(settled.members) and self._stalls == self._pulse.stalls
        return known and settled.owner(key) == self._gateway

    def mine(self, key: str) -> bool:
        """The same, and nobody has come back since who may know more."""
        if not self._compared(key):
            return False
        returned = self.returned
        return not returned or returned.isdisjoint(self._membership.ring.successors(key, self._replicas))

    async def until_mine(self, key: str, *, returned_s: float | None = None) -> bool:
        """Wait until this gateway has reconciled as the key's owner, which it may have become just now.

        Args:
            key: of a record.
            returned_s: how long of it for members that have come back and are not compared with yet; None: as long.

        Returns:
            Whether it has; False after `SETTLE_S` at most: then it goes on with what it has. False too as soon as the
            shard is reconciled with a ring in which the key is another's: the one that asked has to ask there.
        """
        if self.mine(key):
            return True
        self.wanted.set()

        def compared() -> bool:
            return self._compared(key) or self._given_away(key)

        def mine() -> bool:
            return self.mine(key) or self._given_away(key)

        loop = asyncio.get_running_loop()
        until = loop.time() + (SETTLE_S if returned_s is None else returned_s)
        try:
            async with asyncio.timeout(SETTLE_S), self._changed:
                await self._changed.wait_for(compared)
                async with asyncio.timeout_at(until):
                    await self._changed.wait_for(mine)
        except TimeoutError:
            if returned_s is None or not self._compared(key):
                log.warning("answering before the shard is reconciled", key=key, waited_s=SETTLE_S)
            return False
        return self.mine(key)

    def _given_away(self, key: str) -> bool:
        """Whether a key is another gateway's by the ring as it is, with which the shard is reconciled."""
        return self.reconciled() and self._ring.owner(key) != self._gateway

    def met(self) -> bool:
        """Whether the shard is compared with everybody who is there: who began apart may have what is not here."""
        return self._membership.ring.members <= self._ring.members

    async def until_met(self) -> None:
        """Wait a moment until it has: in a large fleet somebody always has just come."""
        self.wanted.set()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(RETURNED_S), self._changed:
                await self._changed.wait_for(self.met)


GONE_S = 600.0
"""For so long members that were lost may come back with what only they have: as long as they are asked whether they are
there after all (`anti_entropy`)."""
_MOST_RINGS = 8


class Absence:
    """What one gateway has not heard of others' copies.

    Args:
        replicas: copies of a record.
    """

    def __init__(self, *, replicas: int) -> None:
        self._replicas = replicas
        self.silent: frozenset[str] = frozenset()
        """Members that are seen and have not answered yet when they were to be compared with."""
        self._gone: dict[str, float] = {}
        """Member that was lost -> until when it counts, on the caller's monotonic clock."""
        self._rings: tuple[Ring, ...] = ()
        """Rings on which copies were where they belong; the last one, and those before it whose keys are in doubt."""

    def lost(self, name: str, now: float) -> None:
        """A member is not seen any more."""
        self.silent -= {name}
        self._gone[name] = now + GONE_S

    def asked(self, members: Iterable[str], silent: frozenset[str]) -> None:
        """These were to be compared with, and of these some did not answer."""
        self.silent = (self.silent - frozenset(members)) | silent

    def heard(self, members: Iterable[str]) -> None:
        """These have answered."""
        self.silent -= frozenset(members)

    def settled(self, ring: Ring) -> None:
        """The shard is reconciled for a ring: with all who came, but for the silent."""
        for name in ring.members:
            self._gone.pop(name, None)
        if not self._rings or self._rings[-1].members <= ring.members:
            self._rings = (*self._rings[:-1], ring)

    def calm(self, ring: Ring, now: float) -> None:
        """All have answered a while after the last change: copies are where they belong on this ring."""
        self._gone = {name: until for name, until in self._gone.items() if until > now}
        if not self.silent:
            doubtful = (each for each in self._rings if each != ring and len(self._missing(each)) >= self._replicas)
            self._rings = (*doubtful, ring)[-_MOST_RINGS:]

    def doubt(self, key: str, now: float) -> tuple[str, ...]:
        """Gateways that may have a record of a key and were not heard; none: all that may have it have answered."""
        if self.silent:
            return tuple(sorted(self.silent))
        gone = {name for name, until in self._gone.items() if until > now}
        if len(gone) < self._replicas:
            return ()
        for ring in self._rings:
            holders = ring.successors(key, self._replicas)
            if gone.issuperset(holders):
                return holders
        return ()

    def _missing(self, ring: Ring) -> frozenset[str]:
        return ring.members & self._gone.keys()


_PUSH_S = 1.5
_PUSH_AGAIN_S = (0.5, 2.0)
"""When a replica that was too slow for a write is offered the record again."""
_MOST_PUSHED = 256
_TELL_S = 60.0
"""Between two warnings of slow replicas: they are slow together, when the machine or the network is."""


class Push:
    """A record on its way to a replica."""

    def __init__(self, call: Call[Found], heard: Callable[[Call[Found]], Awaitable[Record | None]]) -> None:
        self._call = call
        self._heard = heard

    async def done(self) -> Record | None:
        """Wait until the replica has stored it, or is away, slow or failing; returns what it holds instead."""
        return await self._heard(self._call)

    def end(self) -> None:
        """Wait for it no more."""
        self._call.end()


class Pushing:
    """The copies that one gateway gives to others. `keep` stores here what a replica holds instead."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        keep: Callable[[Record], Awaitable[Record]],
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._keep = keep
        self._pushes = Background()
        self._slow: Counter[str] = Counter()
        """Writes that replicas did not confirm in time since that was told last, by replica."""
        self._told_at = -math.inf

    def begin(self, gateway: str, record: Record, *, durable: bool = True) -> "Push":
        """Send a replica a record to store; what comes of it is awaited afterwards."""
        ask, timeout_s = StoreAsk(record, durable), self._config.replica_timeout_s
        call = self._rpc.begin(gateway, keyspace.DHT_STORE, ask, timeout_s=timeout_s, direct=True)
        return Push(call, partial(self._heard, gateway, record))

    async def push(self, gateway: str, record: Record, *, durable: bool = True) -> Record | None:
        """Have a replica store a record; returns what it holds if that is something else."""
        return await self.begin(gateway, record, durable=durable).done()

    async def _heard(self, gateway: str, record: Record, call: Call[Found]) -> Record | None:
        try:
            answer = await call.answer()
        except SwiftbotError as error:
            self.failed(gateway, record, error)
            return None
        return answer.record

    def failed(self, gateway: str, record: Record, error: SwiftbotError) -> None:
        """A replica has not said that it stored a record: it is offered it again, unless it is gone or cannot."""
        if isinstance(error, UnreachableError):
            return  # gone: its successor in the replica set takes the record when it reconciles
        if isinstance(error, DeadlineError | RefusedError):
            self._slow[gateway] += 1
            if (now := time.monotonic()) >= self._told_at + _TELL_S:
                log.warning("replicas are slow", writes=dict(self._slow), key=record.key, reason=str(error))
                self._told_at = now
                self._slow.clear()
            self._later(self._push_again(gateway, record.key))
        else:
            log.error("a replica cannot store", replica=gateway, key=record.key, reason=str(error))

    def _later(self, push: Coroutine[Any, Any, None]) -> None:
        if self._pushes.count >= _MOST_PUSHED:
            push.close()  # anti-entropy will find it
            return
        self._pushes.start(push, "copies of records")

    async def _push_again(self, gateway: str, key: str) -> None:
        for wait_s in _PUSH_AGAIN_S:
            await asyncio.sleep(wait_s)
            record = await self._store.record(key)
            if record is None or gateway not in self._membership.members:
                return
            with contextlib.suppress(SwiftbotError):
                answer = await self._rpc.call(gateway, keyspace.DHT_STORE, StoreAsk(record), timeout_s=_PUSH_S)
                if answer.record is not None:
                    await self._keep(answer.record)
                return

    async def close(self) -> None:
        """Give up what is on its way."""
        await self._pushes.close()


_MOST_REMEMBERED = 4096
"""Writes whose ids are remembered: who asks again does so within seconds."""


class Acknowledged:
    """The writes that this gateway ordered last, by their ids.

    A writer whose answer was lost asks again with the same id. While its write is the newest the record itself tells;
    once another has followed it, only its orderer knows that it is done, and a writer that heard of a conflict
    would do it a second time.
    """

    def __init__(self, most: int = _MOST_REMEMBERED) -> None:
        self._most = most
        self._known: OrderedDict[tuple[str, str], VersionVector | None] = OrderedDict()
        """Key and id -> the version it made; None: it is under way."""

    def note(self, key: str, write: str, version: VersionVector | None) -> None:
        """A write was ordered (None), or acknowledged with a version."""
        if not write:
            return
        self._known[key, write] = version
        self._known.move_to_end((key, write))
        if len(self._known) > self._most:
            self._known.popitem(last=False)

    def failed(self, key: str, write: str) -> None:
        """It was not acknowledged: asked again, it is looked at again."""
        self._known.pop((key, write), None)

    def of(self, key: str, write: str) -> tuple[bool, VersionVector | None]:
        """Whether a write is known here, and the version it made once it is acknowledged."""
        return (key, write) in self._known, self._known.get((key, write))


class Ordering:
    """The writes that one gateway orders. `keep` stores what stands of a version from elsewhere and the one here."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        settling: Settling,
        pulse: StallDetector,
        pushing: Pushing,
        keep: Callable[[Record], Awaitable[Record]],
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._settling = settling
        self._pulse = pulse
        self._pushing = pushing
        self._keep = keep
        self._unsaved: set[str] = set()
        """Keys whose last decision here the replicas may have and the disk has not."""
        self._acknowledged = Acknowledged()
        rpc.register(keyspace.DHT_WRITE, self.order)

    async def order(self, asked: Write) -> Written:
        """Order a write as the owner of its key, and have the replicas follow.

        Raises:
            RefusedError: the key is another's, or this gateway may have been succeeded, or the write is under way.
            ConflictError: the record has moved on, or was written elsewhere too.
            SwiftbotError: the disk fails.
        """
        check_write(asked, max_bytes=self._config.max_record_bytes)
        self._check_owned(asked.key)
        if not await self._settling.until_mine(asked.key, returned_s=RETURNED_S):
            self._check_owned(asked.key)  # the ring may have given it away meanwhile
        if asked.key in self._unsaved:
            await self._catch_up(asked.key)
        try:
            try:
                record, committed = await self._decide(asked)
            except Behind:
                await self._catch_up(asked.key)
                record, committed = await self._decide(asked)
        except Behind:
            raise ConflictError(
                f"{asked.key}: nobody here knows the version expected", remedy="read it and decide again"
            ) from None
        except ConflictError:
            known, done = self._acknowledged.of(asked.key, asked.write)
            if done is not None:
                return Written(done)
            if known:
                raise RefusedError(f"{asked.key} is being written so", remedy="ask again in a moment") from None
            raise
        self._acknowledged.note(asked.key, asked.write, None)
        try:
            version = await self._replicate(record, asked, committed)
        except BaseException:
            self._acknowledged.failed(asked.key, asked.write)
            raise
        self._acknowledged.note(asked.key, asked.write, version)
        return Written(version)

    def _check_owned(self, key: str) -> None:
        """Raise RefusedError when a key is another gateway's."""
        if not self._membership.owns(key):
            owner = self._membership.ring.owner(key)
            raise RefusedError(f"{key} belongs to {owner}, not to {self._gateway}", remedy="ask there")

    async def _decide(self, asked: Write) -> tuple[Record, asyncio.Future[Record | None]]:
        """Decide as the owner; returns the record, and what ends when it is committed here."""

        def order(current: Record | None) -> Record:
            if self._pulse.doubtful:
                raise RefusedError(f"{self._gateway} stood still and may have been succeeded", remedy="ask again")
            return decide(current, asked, self._gateway)

        decided, committed = self._store.change_soon(asked.key, order, durable=asked.durable)
        record = await decided
        if record is None:
            raise SwiftbotError("a decision without a record")
        return record, committed

    async def _replicate(self, record: Record, asked: Write, committed: asyncio.Future[Record | None]) -> VersionVector:
        """Have the other replicas store a record while this one commits it.

        Returns:
            Its version, once they and this gateway agree.
        """
        others = [each for each in self._replicas(record.key) if each != self._gateway]
        pushes = [self._pushing.begin(each, record, durable=asked.durable) for each in others]
        try:
            await committed
            # All are on their way: the slowest is what is waited for.
            answers = [await each.done() for each in pushes]
        except SwiftbotError:
            # The replicas may have it: before the next decision on this key they are asked.
            self._unsaved.add(record.key)
            raise
        finally:
            for each in pushes:
                each.end()
        return await self._agree(record, asked, [answer for answer in answers if answer is not None])

    async def _agree(self, record: Record, asked: Write, newer: list[Record]) -> VersionVector:
        """The version that stands once replicas and this gateway agree; `newer`: what the former hold in its place."""
        if newer:
            newer = await self._not_from_here(newer, record)
        if not newer:
            return record.version
        # A replica held a version that this owner had not seen: both now hold what `settle` made of the two.
        for each in newer:
            record = await self._keep(each)
        if record.write != asked.write:
            raise ConflictError(f"{record.key} was written elsewhere too", remedy="read it and decide again")
        others = [each for each in self._replicas(record.key) if each != self._gateway]
        await asyncio.gather(*(self._pushing.push(each, record) for each in others))
        return record.version

    async def _not_from_here(self, newer: list[Record], record: Record) -> list[Record]:
        """Those of what replicas hold in place of a record that this gateway has not itself decided upon it since.

        A later decision may overtake it on the way, one sent directly, the other by the sender's queue: then this write
        is in what the replica holds, and done. A writer that got a conflict would do it a second time.
        """
        known: list[Record | None] = []

        def look(current: Record | None) -> None:
            known.append(current)

        await self._store.change(record.key, look)  # after every decision that was made by now
        current = known[-1]
        if current is None:
            return newer
        return [
            each
            for each in newer
            if not (descends(current.version, each.version) and follows_here(each, record, self._gateway))
        ]

    async def _catch_up(self, key: str) -> None:
        """Ask every other replica for its version: the writer has seen one newer than ours."""

        async def ask(gateway: str) -> None:
            with contextlib.suppress(SwiftbotError):
                found = await self._rpc.call(
                    gateway, keyspace.DHT_READ, KeyAsk(key), timeout_s=self._config.replica_timeout_s
                )
                if found.record is not None:
                    await self._keep(found.record)

        # One more than the replicas: the owner before the last change of membership may hold it.
        near = self._membership.ring.successors(key, self._config.replicas + 1)
        await asyncio.gather(*(ask(each) for each in near if each != self._gateway))
        self._unsaved.discard(key)

    def _replicas(self, key: str) -> tuple[str, ...]:
        return self._membership.ring.successors(key, self._config.replicas)


_ATTEMPT_S = 1.5
"""One try at an owner: longer than it waits for its replicas, shorter than the whole write."""
_RETRY_S = 0.03
"""Between tries while the membership settles."""
_APART_S = 1.0
"""How long a reader asks again when whom it takes for a key's owner is not there, or says that the key is another's."""
_MOST_NAMED = 5
"""Gateways named in an error."""


class Dht:
    """The replicated records as one gateway sees them. `resolver`: merges versions that were made apart."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        pulse: StallDetector,
        resolver: Resolver = by_bytes,
    ) -> None:
        self._resolver = resolver
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._pulse = pulse
        self.settling = Settling(
            gateway=gateway, membership=membership, pulse=pulse, replicas=config.replicas,
            virtual_nodes=config.virtual_nodes,
        )  # fmt: skip
        self.absence = Absence(replicas=config.replicas)
        self._pushing = Pushing(config, gateway=gateway, store=store, rpc=rpc, membership=membership, keep=self.keep)
        self.ordering = Ordering(
            config, gateway=gateway, store=store, rpc=rpc, membership=membership, settling=self.settling, pulse=pulse,
            pushing=self._pushing, keep=self.keep,
        )  # fmt: skip
        rpc.register(keyspace.DHT_READ, self._on_read)
        rpc.register(keyspace.DHT_STORE, self._on_store)
        rpc.register(keyspace.RECORD_READ, self._on_record_read)
        rpc.register(keyspace.RECORD_WRITE, self._on_record_write)

    # --- the door ---------------------------------------------------------------------------------------------

    async def read(self, key: str, *, replica: bool = False) -> Record | None:
        """Return a record from its owner or, when that does not answer, the next replica; None: there is none.

        That there is none only the key's owner knows, and only when it has heard all that may have a copy: what a
        replica lacks the owner may have, which was slow to tell.

        `replica`: as this gateway has it if it holds a copy, else as any of those that do; it may be behind.

        Raises:
            UnreachableError: the one that answered has none, and others may have one.
        """
        check_key(key)
        loop = asyncio.get_running_loop()
        until = loop.time() + _APART_S
        while True:
            found, apart = await self._ask_holders(key, replica=replica)
            if found.record is not None or not found.unsure:
                return None if found.record is None or found.record.deleted else found.record
            if not apart or loop.time() > until:
                raise UnreachableError(
                    f"whether there is a record {key} is not known: {found.unsure}", remedy="try again in a second"
                )
            await asyncio.sleep(_RETRY_S)

    async def removed(self, key: str) -> bool:
        """Whether a record was removed, as far as those that hold its key remember; False too where none ever was."""
        found, _ = await self._ask_holders(check_key(key), replica=False)
        return found.record is not None and found.record.deleted

    async def _ask_holders(self, key: str, *, replica: bool) -> tuple[Found, bool]:
        """Ask the holders of a key one after the other, until one has it or knows that there is none.

        Returns:
            What was found, and whether that may be about to change: the owner says that the key is another's, or is not
            there or about to go, of which the membership will tell.
        """
        holders = list(self._membership.ring.successors(key, self._config.replicas))
        owner, problems, apart = holders[0], dict[str, str](), False
        if replica:
            random.shuffle(holders)
            holders.sort(key=lambda name: name != self._gateway)
        for gateway in holders:
            try:
                if gateway == self._gateway:
                    found = await (self._copy(key) if replica else self._on_read(KeyAsk(key)))
                else:
                    found = await self._rpc.call(
                        gateway, keyspace.DHT_READ, KeyAsk(key), timeout_s=_ATTEMPT_S, direct=True
                    )
            except SwiftbotError as error:
                # Away, late, or with a disk that fails: the others have copies.
                problems[gateway] = str(error)
                apart = apart or (gateway == owner and isinstance(error, UnreachableError | RefusedError))
                continue
            if found.record is not None or not found.unsure:
                return found, False
            if gateway == owner:
                problems[gateway], apart = found.unsure, bool(found.owner)
        return Found(unsure=problems.get(owner) or "its owner was not asked"), apart

    async def write(
        self, key: str, value: bytes, *, expected: VersionVector | None, durable: bool = True
    ) -> VersionVector:
        """Compare and set: `expected` is the version that was read, None when there must be no record.

        Returns:
            The new version; by then the value is on the disk of the owner and of every reachable replica (not
            `durable`: written, but the last moments may be lost with the power of all of them).

        Raises:
            ConflictError: the record has moved on; read, decide again, retry.
            UnreachableError: no owner could be reached within `write_timeout_s`; it may or may not be written.
            PayloadError: the value or key is too large.
        """
        asked = Write(key=key, value=value, expected=expected, write=secrets.token_hex(16), durable=durable)
        return await self._write(asked)

    async def remove(self, key: str, *, expected: VersionVector) -> None:
        """Remove a record; errors as for `write`."""
        asked = Write(key=key, deleted=True, expected=expected, write=secrets.token_hex(16))
        await self._write(asked)

    def owns(self, key: str) -> bool:
        """Whether a key belongs to this gateway just now."""
        return self._membership.owns(key)

    async def local(self, prefix: str, *, leave_out: LeaveOut | None = None) -> list[Record]:
        """Return this gateway's shard: the records it holds, as owner or replica, without those removed.

        `leave_out`: nor those with such a value. Read page by page: it is no picture of one moment.
        """
        found: list[Record] = []
        after = ""
        while page := await self._store.page(prefix, after, leave_out):
            found += (record for record in page if not record.deleted)
            after = page[-1].key
        return found

    def watch(self, heed: Callable[[str], bool], tell: Callable[[Record], None]) -> Callable[[], None]:
        """Have `tell` hear of every change of a copy that this gateway holds (`Store.watch`); returns what ends it."""
        return self._store.watch(heed, tell)

    # --- writing ----------------------------------------------------------------------------------------------

    async def _write(self, asked: Write) -> VersionVector:
        check_write(asked, max_bytes=self._config.max_record_bytes)
        loop = asyncio.get_running_loop()
        until = loop.time() + self._config.write_timeout_s
        while True:
            try:
                owner = self._membership.ring.owner(asked.key)
                if owner == self._gateway:
                    return (await self.ordering.order(asked)).version
                answer = await self._rpc.call(owner, keyspace.DHT_WRITE, asked, timeout_s=_ATTEMPT_S, direct=True)
            except (UnreachableError, DeadlineError, RefusedError) as error:
                # Dead, not yet known to be; or of another mind about who owns the key: both pass.
                if loop.time() > until:
                    raise UnreachableError(
                        f"{asked.key} could not be written: {error}", remedy="try again; it may have been written"
                    ) from error
                await asyncio.sleep(_RETRY_S)
            else:
                return answer.version

    # --- answering --------------------------------------------------------------------------------------------

    async def _on_read(self, asked: KeyAsk) -> Found:
        key, unsure = check_key(asked.key), ""
        if self.owns(key) and not await self.settling.until_mine(key):
            unsure = f"{self._gateway} owns it and has not compared its copies with the others' yet"
        record = await self._store.record(key)
        if record is None and self.owns(key) and not self.settling.met():
            await self.settling.until_met()
            record = await self._store.record(key)
        if record is not None:
            return Found(record)
        if not self.owns(key):
            return Found(unsure=f"it is not {self._gateway}'s", owner=self._membership.ring.owner(key))
        if not unsure and (doubt := self.absence.doubt(key, time.monotonic())):
            unsure = f"{', '.join(doubt[:_MOST_NAMED])} may have it and did not answer"
        return Found(unsure=unsure)

    async def _copy(self, key: str) -> Found:
        """The copy that is here, regardless of the owner."""
        record = await self._store.record(key)
        return Found(record) if record is not None else await self._on_read(KeyAsk(key))

    async def _on_store(self, asked: StoreAsk) -> Found:
        check_record(asked.record, max_bytes=self._config.max_record_bytes)
        kept = await self.keep(asked.record)
        return Found(None if kept == asked.record else kept)

    async def keep(self, record: Record) -> Record:
        """Store what stands of a version from elsewhere and the one here; returns it."""
        kept = await self._store.change(record.key, partial(_settle, record, self._resolver))
        return record if kept is None else kept

    async def _on_record_read(self, asked: RecordAsk) -> Found:
        return Found(await self.read(asked.key, replica=asked.replica))

    async def _on_record_write(self, asked: RecordChange) -> Written:
        write = Write(
            key=asked.key,
            value=asked.value,
            deleted=asked.deleted,
            expected=asked.expected,
            write=asked.write or secrets.token_hex(16),
        )
        check_write(write, max_bytes=self._config.max_record_bytes)
        return Written(await self._write(write))

    async def close(self) -> None:
        """Give up what is still being written and pushed."""
        await self._pushing.close()


def _settle(other: Record, resolver: Resolver, mine: Record | None) -> Record:
    return settle(mine, other, resolver)


_BROWSE_S = 1.0


class Browsing:
    """Answers questions about records on one gateway."""

    def __init__(self, config: PlaneConfig, *, gateway: str, store: Store, rpc: Rpc, membership: Membership) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        rpc.register(keyspace.RECORDS, self._on_records)
        rpc.register(keyspace.RECORD_PLACE, self._on_place)

    async def _on_records(self, asked: RecordsAsk) -> RecordList:
        if len(asked.prefix) > MAX_KEY or len(asked.after) > MAX_KEY:
            raise PayloadError("a prefix longer than any key", remedy=f"at most {MAX_KEY} characters")
        keys = [key for key, _ in await self._store.digests() if key.startswith(asked.prefix) and key > asked.after]
        listed: list[Listed] = []
        for key in keys[: asked.limit]:
            record = await self._store.record(key)
            if record is not None:
                holders = self._membership.ring.successors(key, self._config.replicas)
                copy = copy_of(self._gateway, record)
                listed.append(Listed(key=key, copy=copy, owner=holders[0], replicas=holders))
        return RecordList(tuple(listed), more=len(keys) > asked.limit)

    async def _on_place(self, asked: KeyAsk) -> RecordPlace:
        holders = self._membership.ring.successors(check_key(asked.key), self._config.replicas)
        copies = await asyncio.gather(*(self._copy(each, asked) for each in holders))
        return RecordPlace(key=asked.key, owner=holders[0], replicas=holders, copies=tuple(copies))

    async def _copy(self, gateway: str, asked: KeyAsk) -> Copy:
        try:
            if gateway == self._gateway:
                record = await self._store.record(asked.key)
            else:
                record = (await self._rpc.call(gateway, keyspace.DHT_READ, asked, timeout_s=_BROWSE_S)).record
        except SwiftbotError as error:
            return Copy(gateway=gateway, problem=error.message)
        return copy_of(gateway, record)


def copy_of(gateway: str, record: Record | None) -> Copy:
    """What is listed of a gateway's copy of a record."""
    if record is None:
        return Copy(gateway=gateway)
    return Copy(
        gateway=gateway, version=record.version, deleted=record.deleted, size_bytes=len(record.value),
        digest=digest(record),
    )  # fmt: skip
