"""What the authority signs and numbers spreads between the gateways by itself: what one of them has, all have.

The roster and the list of parts are such files. Each is signed, so that it does not matter who hands it on: every
gateway checks it against the authority's certificate in its own keys. It compares numbers with each member that it has
not compared this one with, and takes or gives the newer one. An older one is never taken, and the one that counts is
kept with the gateway's data: an old copy brings nothing back, over a restart neither.
"""

import asyncio
from collections.abc import Callable, Set
from typing import Protocol

import structlog

from appliance.errors import IdentityError, RefusedError, SwiftbotError
from appliance.model.keys import Verb
from appliance.model.plane_api import SealedAsk, SealedTold
from appliance.plane.rpc import Rpc

log = structlog.get_logger(__name__)

AT_ONCE = 8
"""Members that are asked at once."""


class Held(Protocol):
    """A signed file of the authority, as a gateway has it."""

    @property
    def number(self) -> int:
        """Of the one that counts; 0: there is none."""
        ...

    @property
    def sealed(self) -> bytes:
        """The one that counts, as its file has it."""
        ...

    def take(self, sealed: bytes, /) -> None:
        """Go by another; IdentityError where the authority has not signed it, or it is older. Blocks."""
        ...

    def keep(self) -> None:
        """Have the one that counts on the disk; blocks."""
        ...


class Handing:
    """One gateway's part in handing a signed file on.

    Args:
        held: the file; None without keys: then there is none.
        verb: by which gateways compare; its name is the file's in logs and counts.
        gateway: its id.
        rpc: answers and asks the verb.
        members: ids of the gateways that are there.
        on_taken: called when another one counts.
    """

    def __init__(
        self,
        held: Held | None,
        verb: Verb[SealedAsk, SealedTold],
        *,
        gateway: str,
        rpc: Rpc,
        members: Callable[[], Set[str]],
        on_taken: Callable[[], None] = lambda: None,
    ) -> None:
        self._held, self._verb, self._gateway = held, verb, gateway
        self._rpc, self._members, self._on_taken = rpc, members, on_taken
        self._known: dict[str, int] = {}
        """Member -> the number that it has, as far as is known."""
        rpc.register(verb, self._on_asked)

    async def _on_asked(self, ask: SealedAsk) -> SealedTold:
        if (held := self._held) is None:
            raise RefusedError(f"{self._gateway} has no keys", remedy="set plane.keys (docs/security.md)")
        if ask.sealed and ask.number > held.number:
            await self._take(held, ask.number, ask.sealed)
        number = held.number
        return SealedTold(number=number, sealed=held.sealed if number > ask.number else b"")

    async def _take(self, held: Held, number: int, sealed: bytes) -> None:
        """Go by another; IdentityError, counted, when the authority has not signed it, or it is older."""
        try:
            await asyncio.to_thread(held.take, sealed)
        except IdentityError as error:
            if held.number >= number:
                return  # a newer one came from elsewhere meanwhile
            self._rpc.deny(f"bad {self._verb.name}", self._verb.name, error.message)
            raise
        log.info("another one counts", what=self._verb.name, number=held.number)
        self._on_taken()

    async def spread(self) -> None:
        """Compare with those members that may have another one."""
        if (held := self._held) is None:
            return
        await asyncio.to_thread(held.keep)
        members = self._members() - {self._gateway}
        self._known = {name: number for name, number in self._known.items() if name in members}
        at_once = asyncio.Semaphore(AT_ONCE)

        async def one(member: str) -> None:
            async with at_once:
                try:
                    await self._compare(held, member)
                except SwiftbotError as error:
                    log.info("what a member has is not known", what=self._verb.name, member=member, reason=str(error))

        number = held.number
        await asyncio.gather(*(one(each) for each in sorted(members) if self._known.get(each) != number))

    async def _compare(self, held: Held, member: str) -> None:
        told = await self._rpc.call(member, self._verb, SealedAsk(number=held.number))
        if told.sealed and told.number > held.number:
            await self._take(held, told.number, told.sealed)
            await asyncio.to_thread(held.keep)
        elif told.number < (number := held.number):
            told = await self._rpc.call(member, self._verb, SealedAsk(number=number, sealed=held.sealed))
        self._known[member] = told.number
