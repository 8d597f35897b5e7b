"""Links that outlive a standstill of this process and must not: they are made anew.

All others close their links with a process that stands still for a lease, and dial again. When it runs again it may
take a new connection before it has noticed that the old one is closed. Zenoh 1.10 then goes on with what it knew of the
other side, which has begun anew: questions arrive at wrong doors there, answers nowhere, and neither side sees the
other's facts, for as long as that link lives (zenoh issue 1886). It shows here, by no word of anybody:

- this process stood still for a lease,
- the tokens of others have gone and come, as they do when links are closed, so that they noticed (on a machine that was
  suspended, or starves, all of a fleet stand still together and nobody loses anybody),
- one's token has not, and it does not answer.
"""

import asyncio
from collections.abc import Awaitable, Callable, Set
from typing import Protocol

import structlog

from appliance.plane.pulse import Pulse, Standstill, clock

log = structlog.get_logger(__name__)

PAUSE_LEASES = 0.5
"""Leases after which the others' tokens must have gone and come: on loopback that takes a tenth of this."""
ANSWER_LEASES = 2.0
"""Leases that a member is given to answer, who may be busy with the same news."""
REST_S = 30.0
"""Least time between two such looks: where a machine starves, links made anew are more work and no help."""
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


class Outlived:
    """Looks, after each standstill, for members that should have been lost and were not.

    Args:
        pulse: tells of standstills.
        lease_s: of the links.
        members: who is there.
        answers: asks a member something; whether it answered within so many seconds.
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
        answers: Callable[[str, float], Awaitable[bool]],
        renew: Callable[[str], None],
        now: Callable[[], float] = clock,
        pause: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._pulse = pulse
        self._lease_s = lease_s
        self._members = members
        self._answers = answers
        self._renew = renew
        self._now = now
        self._pause = pause
        self._looking: asyncio.Task[None] | None = None
        self._not_before = 0.0
        pulse.on_stalled.append(self._on_stalled)

    def _on_stalled(self, standstill: Standstill) -> None:
        # After less than a lease the others may not have closed their links at all.
        if standstill.lasted_s < self._lease_s or self._now() < self._not_before:
            return
        if self._looking is not None and not self._looking.done():
            return  # with long leases a look lasts longer than the rest after it
        self._not_before = self._now() + REST_S
        self._looking = asyncio.create_task(self._look(standstill.since), name="links after a standstill")

    async def _look(self, since: float) -> None:
        await self._pause(self._lease_s * PAUSE_LEASES)
        kept = sorted(self._members.seen_since(since))
        noticed = len(self._members.members) - 1 > len(kept)
        if not kept or (not noticed and len(kept) > 1):
            return
        asked = kept[:MOST_ASKED]
        answered = await asyncio.gather(*(self._answers(each, self._lease_s * ANSWER_LEASES) for each in asked))
        silent = [name for name, well in zip(asked, answered, strict=True) if not well]
        # One that has gone meanwhile has no link any more.
        silent = [name for name in silent if name in self._members.seen_since(since)]
        if silent:
            log.warning("members that were never lost in a standstill do not answer", members=silent)
            self._renew("they outlived a standstill")

    async def close(self) -> None:
        """Look no more, whatever the pulse tells until it is closed too; more than once does no harm."""
        if self._on_stalled in self._pulse.on_stalled:
            self._pulse.on_stalled.remove(self._on_stalled)
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.gather(self._looking, return_exceptions=True)
