"""Writes as the owner of their keys orders them: one after the other, and on the replicas before it acknowledges."""

import asyncio
import contextlib
from collections import OrderedDict
from collections.abc import Awaitable, Callable

from appliance.errors import ConflictError, RefusedError, SwiftbotError
from appliance.model import VersionVector
from appliance.plane.membership import Membership
from appliance.plane.messages import Found, KeyAsk, Written
from appliance.plane.pulse import Pulse
from appliance.plane.pushing import Pushing
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.settling import RETURNED_S, Settling
from appliance.plane.store import Store
from appliance.plane.versions import (
    Behind,
    Record,
    Write,
    check_write,
    decide,
    descends,
    follows_here,
)

_MOST_REMEMBERED = 4096
"""Writes whose ids are remembered: who asks again does so within seconds."""


class Acknowledged:
    """The writes that this gateway ordered last, by their ids.

    A writer whose answer was lost asks again with the same id. While its write is the newest the record itself tells;
    once another has followed it, only whoever ordered it knows that it is done, and a writer that heard of a conflict
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
        """It was not acknowledged: asked again, it is looked at anew."""
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
        pulse: Pulse,
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
        rpc.register("dht_write", Write, self.order, exchange=False)

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
        is in what the replica holds, and done. A writer that was told of a conflict would do it a second time.
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
                    gateway, "dht_read", KeyAsk(key), Found, timeout_s=self._config.replica_timeout_s
                )
                if found.record is not None:
                    await self._keep(found.record)

        # One more than the replicas: the owner before the last change of membership may hold it.
        near = self._membership.ring.successors(key, self._config.replicas + 1)
        await asyncio.gather(*(ask(each) for each in near if each != self._gateway))
        self._unsaved.discard(key)

    def _replicas(self, key: str) -> tuple[str, ...]:
        return self._membership.ring.successors(key, self._config.replicas)
