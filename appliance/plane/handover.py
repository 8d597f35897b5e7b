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

    async def _give(self, ring: Ring, key: str, replicas: tuple[str, ...]) -> bool:
        record = await self._store.record(key)
        if record is None:
            return True
        ask = StoreAsk(record)
        try:
            await asyncio.gather(
                *(self._rpc.call(each, "dht_store", ask, Found, timeout_s=_ASK_S) for each in replicas)
            )
        except SwiftbotError as error:
            log.warning("a copy that belongs elsewhere is kept", key=key, reason=str(error))
            return False
        if ring == self._membership.ring:
            await self._store.forget(record)
        return True
