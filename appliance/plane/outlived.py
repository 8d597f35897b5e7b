"""Links that outlive a standstill of this process and must not, and those that do not come back: made anew.

All others close their links with a process that stands still for a lease, and dial again. When it runs again it may
take a new connection before it has noticed that the old one is closed. Zenoh 1.10 then goes on with what it knew of the
other side, which has begun anew: questions arrive at wrong doors there, answers nowhere, and neither side sees the
other's facts, for as long as that link lives (zenoh issue 1886). It shows here, by no word of anybody:

- this process stood still for a lease,
- the tokens of others have gone and come, as they do when links are closed, so that they noticed (on a machine that was
  suspended, or starves, all of a fleet stand still together and nobody loses anybody),
- one's token has not, and it does not answer.

Or the two never link again: each took the other's new connection for one that it had already, dropped it, and dials no
more, though each is named in the other's `connect`. Then a member that was there before is lost for good, while others,
which have come back, see it. Links that are made anew have it told of by those at their other ends, and dialled.
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
BACK_LEASES = 2.0
"""Leases after which those that were lost must have come back: of each two one dials again every 0.2 s."""
REST_S = 30.0
"""Least time between two such looks: where a machine starves, links made anew are more work and no help. A standstill
within it is looked at once it is over."""
TRIES = 3
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
        pulse: Pulse,
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

    def _on_stalled(self, standstill: Standstill) -> None:
        # After less than a lease the others may not have closed their links at all.
        if standstill.lasted_s < self._lease_s:
            return
        if self._looking is not None and not self._looking.done():
            return  # with long leases a look lasts longer than the rest after it
        wait_s = max(0.0, self._not_before - self._now())
        self._not_before = self._now() + wait_s + REST_S
        self._looking = asyncio.create_task(self._look(standstill.since, wait_s), name="links after a standstill")

    async def _look(self, since: float, wait_s: float) -> None:
        if wait_s:
            await self._pause(wait_s)
        await self._pause(self._lease_s * PAUSE_LEASES)
        # Links that were made anew can be mixed up again: then all are asked.
        for number in range(TRIES):
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
