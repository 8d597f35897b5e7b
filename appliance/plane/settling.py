"""Whether a gateway may answer for a key: it has compared its shard as the key's owner, with all who may know more."""

import asyncio
import contextlib
from collections.abc import Callable

import structlog

from appliance.plane.membership import Membership
from appliance.plane.pulse import Pulse
from appliance.plane.ring import Ring

log = structlog.get_logger(__name__)

SETTLE_S = 2.0
"""How long an owner lets requests wait for its reconciling; then it answers with what it has."""
RETURNED_S = 0.4
"""How long of it a write waits for one that has come back and is not compared with yet: if it holds something newer, it
says so when it is given the write. One that is silent must hold up no takeover for long, `reconcile.LOSS_S`."""


class Settling:
    """What `reconcile` has compared, and the requests that wait for it. `replicas`: copies of a record."""

    def __init__(
        self, *, gateway: str, membership: Membership, pulse: Pulse, replicas: int, virtual_nodes: int
    ) -> None:
        self.on_wanted: Callable[[], None] = lambda: None
        """Called when a request waits for the shard to be reconciled."""
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
            shard is reconciled with a ring in which the key is another's: whoever asked has to ask there.
        """
        if self.mine(key):
            return True
        self.on_wanted()

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
        self.on_wanted()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(RETURNED_S), self._changed:
                await self._changed.wait_for(self.met)
