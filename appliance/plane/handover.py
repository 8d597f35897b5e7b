"""Copies that belong elsewhere: given to all their replicas, then dropped; and removals of long ago, forgotten."""

import asyncio
import time

import structlog

from appliance.errors import SwiftbotError
from appliance.plane.comparing import BREATH
from appliance.plane.membership import Membership
from appliance.plane.messages import Found, StoreAsk
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.plane.versions import Record

log = structlog.get_logger(__name__)

_ASK_S = 2.0
_AT_ONCE = 8
"""Copies on their way: more would hold up what people wait for."""


class HandOver:
    """Tidies one gateway's shard."""

    def __init__(self, config: PlaneConfig, *, gateway: str, store: Store, rpc: Rpc, membership: Membership) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership

    async def run(self, ring: Ring) -> bool:
        """Hand over what belongs elsewhere on that ring; False when a replica did not take it, or the ring changed."""
        await self._store.forget_tombstones(time.time_ns() - int(self._config.tombstone_hours * 3.6e12))
        strangers: list[tuple[str, tuple[str, ...]]] = []
        for number, (key, _) in enumerate(await self._store.digests()):
            if number % BREATH == BREATH - 1:
                await asyncio.sleep(0)
            replicas = ring.successors(key, self._config.replicas)
            if self._gateway not in replicas:
                strangers.append((key, replicas))
        complete = True
        for start in range(0, len(strangers), _AT_ONCE):
            if ring != self._membership.ring:
                return False
            page = strangers[start : start + _AT_ONCE]
            complete &= all(await asyncio.gather(*(self._give(ring, key, replicas) for key, replicas in page)))
        return complete

    async def give_all(self) -> int:
        """Give a copy of everything here to those that would hold it without this gateway; returns how many were taken.

        For one that goes where nobody can ask it for what it has: another answers to its id.
        """
        ring = self._membership.ring.without_member(self._gateway)
        keys = [key for key, _ in await self._store.digests()] if ring.members else []
        taken = 0
        for start in range(0, len(keys), _AT_ONCE):
            page = keys[start : start + _AT_ONCE]
            gives = (self._offer(key, ring.successors(key, self._config.replicas)) for key in page)
            taken += sum(await asyncio.gather(*gives))
        return taken

    async def _offer(self, key: str, replicas: tuple[str, ...]) -> bool:
        record = await self._store.record(key)
        return record is not None and await self._stored(record, replicas)

    async def _give(self, ring: Ring, key: str, replicas: tuple[str, ...]) -> bool:
        record = await self._store.record(key)
        if record is None:
            return True
        if not await self._stored(record, replicas):
            return False
        if ring == self._membership.ring:
            await self._store.forget(record)
        return True

    async def _stored(self, record: Record, replicas: tuple[str, ...]) -> bool:
        """Have all these store a record; False when one did not."""
        ask = StoreAsk(record)
        try:
            await asyncio.gather(
                *(self._rpc.call(each, "dht_store", ask, Found, timeout_s=_ASK_S) for each in replicas)
            )
        except SwiftbotError as error:
            log.warning("a copy that belongs elsewhere is kept", key=record.key, reason=str(error))
            return False
        return True
