"""Links that outlive a standstill of this process and must not: they are made anew.

All others close their links with a process that stands still for a lease, and dial again. When it runs again it may
take a new connection before it has noticed that the old one is closed. Zenoh 1.10 then goes on with what it knew of the
other side, which has begun anew: questions arrive at wrong doors there, answers nowhere, and neither side sees the
other's facts, for as long as that link lives (zenoh issue 1886). Two things then show it here, by no word of anybody:
this process stood still for a lease, and yet the token of the other has never gone, as it does when a link is closed.
"""

import asyncio
from collections.abc import Awaitable, Callable, Set
from typing import Protocol

import structlog

from appliance.plane.pulse import Pulse, clock

log = structlog.get_logger(__name__)

PAUSE_LEASES = 0.5
"""Leases after which the others' tokens must have gone and come: on loopback that takes a tenth of this."""
TRIES = 2
"""Links that are made anew may be mixed up again; more often than this is not tried for one standstill."""


class Members(Protocol):
    """What is needed of the membership."""

    def seen_since(self, moment: float) -> Set[str]:
        """The other members whose token was there at that moment and has never gone since."""
        ...


class Outlived:
    """Looks, after each standstill, for members that should have been lost and were not.

    Args:
        pulse: tells of standstills.
        lease_s: of the links.
        members: who is there.
        renew: makes all links anew; told why.
        now: the pulse's clock.
        pause: waits so many seconds.
    """

    def __init__(
        self,
        pulse: Pulse,
        *,
        lease_s: float,
        members: Members,
        renew: Callable[[str], None],
        now: Callable[[], float] = clock,
        pause: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._pulse = pulse
        self._lease_s = lease_s
        self._members = members
        self._renew = renew
        self._now = now
        self._pause = pause
        self._looking: asyncio.Task[None] | None = None
        pulse.on_stalled.append(self._on_stalled)

    def _on_stalled(self) -> None:
        since, lasted_s = self._pulse.last_standstill
        # After less than a lease the others may not have closed their links at all.
        if lasted_s < self._lease_s:
            return
        if self._looking is not None:
            self._looking.cancel()
        self._looking = asyncio.create_task(self._look(since), name="links after a standstill")

    async def _look(self, since: float) -> None:
        for _ in range(TRIES):
            await self._pause(self._lease_s * PAUSE_LEASES)
            kept = self._members.seen_since(since)
            if not kept:
                return
            log.warning("members were never lost in a standstill", members=sorted(kept))
            since = self._now()
            self._renew("they outlived a standstill")

    async def close(self) -> None:
        """Look no more."""
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.gather(self._looking, return_exceptions=True)
