"""The authority's roster spreads between the gateways by itself: what one of them has, all have.

The roster is signed and numbered, so that it does not matter who hands it on. Every gateway compares numbers with each
member that it has not compared this one with, and takes or gives the newer one (verb `roster`). An older one is never
taken, and the one that counts is kept with the gateway's data: a copy from before a revocation brings nothing back,
over a restart neither.
"""

import asyncio
from collections.abc import Callable, Set
from typing import TYPE_CHECKING

import structlog

from appliance.errors import RefusedError, SwiftbotError
from appliance.model import keyspace
from appliance.model.plane_api import RosterAsk, RosterTold
from appliance.plane.rpc import Rpc

if TYPE_CHECKING:
    from appliance.identity.credentials import Credentials

log = structlog.get_logger(__name__)

AT_ONCE = 8
"""Members that are asked at once."""


class Rosters:
    """One gateway's part in handing the roster on.

    Args:
        credentials: have the roster; None without keys: then there is none.
        gateway: its id.
        rpc: answers and asks the verb.
        members: ids of the gateways that are there.
        on_taken: called when another roster counts.
    """

    def __init__(
        self,
        credentials: "Credentials | None",
        *,
        gateway: str,
        rpc: Rpc,
        members: Callable[[], Set[str]],
        on_taken: Callable[[], None],
    ) -> None:
        self._credentials, self._gateway = credentials, gateway
        self._rpc, self._members, self._on_taken = rpc, members, on_taken
        self._known: dict[str, int] = {}
        """Member -> the number of the roster that it has, as far as is known."""
        rpc.register(keyspace.ROSTER, self._on_asked)

    async def _on_asked(self, ask: RosterAsk) -> RosterTold:
        if (credentials := self._credentials) is None:
            raise RefusedError(f"{self._gateway} has no keys", remedy="set plane.keys (docs/security.md)")
        if ask.sealed and ask.number > credentials.roster.number:
            await self._take(credentials, ask.sealed)
        number = credentials.roster.number
        return RosterTold(number=number, sealed=credentials.sealed if number > ask.number else b"")

    async def _take(self, credentials: "Credentials", sealed: bytes) -> None:
        """Go by another roster; IdentityError when the authority has not signed it, or it is older."""
        await asyncio.to_thread(credentials.take, sealed)
        log.info("another roster counts", number=credentials.roster.number)
        self._on_taken()

    async def spread(self) -> None:
        """Compare with those members that may have another roster."""
        if (credentials := self._credentials) is None or not credentials.roster.number:
            return
        await asyncio.to_thread(credentials.keep)
        members = self._members() - {self._gateway}
        self._known = {name: number for name, number in self._known.items() if name in members}
        at_once = asyncio.Semaphore(AT_ONCE)

        async def one(member: str) -> None:
            async with at_once:
                try:
                    await self._compare(credentials, member)
                except SwiftbotError as error:
                    log.info("a member's roster is not known", member=member, reason=str(error))

        number = credentials.roster.number
        await asyncio.gather(*(one(each) for each in sorted(members) if self._known.get(each) != number))

    async def _compare(self, credentials: "Credentials", member: str) -> None:
        told = await self._rpc.call(member, keyspace.ROSTER, RosterAsk(number=credentials.roster.number))
        if told.sealed and told.number > credentials.roster.number:
            await self._take(credentials, told.sealed)
        elif told.number < (number := credentials.roster.number):
            told = await self._rpc.call(member, keyspace.ROSTER, RosterAsk(number=number, sealed=credentials.sealed))
        self._known[member] = told.number
