"""A gateway's session is reopened while the fleet goes on: others are informed, and no two gateways do it at once.

Zenoh's access control and certificate are those of the moment when a session opened (zenoh issue 2169). A gateway with
other keys, or with robots that its session lets in no more or not yet, therefore opens another in its place
(`session.Session.reopen`), which takes some 15 ms. The others would take that for its end: they would fail its runs and
take its tasks over. So it asks all members for its turn first (verb `reopening`). One that grants it counts its token,
and those of robots, which may be linked to it, as there for a moment, and has its own questions to it wait.

A new roster comes to all gateways at about the same time. One member at a time has its turn: `Turns` refuses it while
another has it, and of two that want it at once the one whose name comes first goes first. Who gets none for `WAIT_S`,
or is not answered, goes all the same: the others then see it leave and come back.

What others put while the session was closed did not arrive: the event `Relinked` says so for each member, and its
consumers ask.
"""

import asyncio
import random
import time
from collections.abc import Callable, Set

import structlog

from appliance.errors import IdentityError, RefusedError, SwiftbotError
from appliance.identity.member import SENDER
from appliance.model import keyspace
from appliance.model.keys import check_name
from appliance.model.plane_api import Reopening, ReopeningAsk
from appliance.plane.events import FleetEvents, Relinked
from appliance.plane.rpc import Rpc
from appliance.plane.session import QUIET_S, Session

log = structlog.get_logger(__name__)

TURN_S = 3.0
"""How long a turn lasts at most: questions under way have half a second to end, and reopening takes 15 ms."""
WAIT_S = 25.0
"""How long a gateway waits for its turn: with the look at the roster and the reopening itself, half a minute."""
_PAUSE_S = (0.1, 0.3)
"""Before it asks again, drawn: those that wait must not all ask at once."""


class Turns:
    """Decides who may reopen its session. Pure; times are seconds of one monotonic clock.

    Args:
        gateway: this one's id.
    """

    def __init__(self, gateway: str) -> None:
        self._gateway = gateway
        self._has: tuple[str, float] = ("", 0.0)
        """Who was granted a turn, and until when it lasts."""
        self.wanted = False
        """Whether this gateway wants a turn of its own."""
        self.taken = False
        """Whether it has it."""

    def before(self, gateway: str, now: float) -> str:
        """Id of the gateway that goes before one that asks for its turn; empty: the turn is granted."""
        holder, until = self._has
        if holder and now < until and holder != gateway:
            return holder
        if gateway != self._gateway:
            if self.taken or (self.wanted and self._gateway < gateway):
                return self._gateway
            self._has = (gateway, now + TURN_S)
        return ""

    def ended(self, gateway: str) -> None:
        """A gateway needs its turn no more."""
        if self._has[0] == gateway:
            self._has = ("", 0.0)


class Reopener:
    """Reopens one gateway's session, and makes room for others' reopening.

    Args:
        session: of the gateway.
        gateway: its id.
        rpc: answers and asks the verb.
        members: ids of the gateways that are there.
        events: publishes `Relinked`.
    """

    def __init__(
        self, session: Session, *, gateway: str, rpc: Rpc, members: Callable[[], Set[str]], events: FleetEvents
    ) -> None:
        self._session, self._gateway = session, gateway
        self._rpc, self._members, self._events = rpc, members, events
        self._turns = Turns(gateway)
        self._lock = asyncio.Lock()
        rpc.register(keyspace.REOPENING, self._on_asked)

    async def _on_asked(self, ask: ReopeningAsk) -> Reopening:
        gateway, sender = check_name(ask.gateway, "gateway"), SENDER.get()
        if sender is not None and sender.name != gateway:
            raise IdentityError(f"{sender.text} may not ask for the turn of {gateway}")
        if ask.done:
            self._turns.ended(gateway)
            self._rpc.back(gateway)
        elif first := self._turns.before(gateway, time.monotonic()):
            raise RefusedError(f"{first} reopens its session first", remedy="ask again in a moment")
        else:
            self._session.hold_alive(self._shown_through(gateway), TURN_S)
            # What is still on its way there would be lost with its session.
            await self._rpc.away(gateway, quiet_s=QUIET_S, seconds=TURN_S)
        return Reopening()

    def _shown_through(self, gateway: str) -> Callable[[str], bool]:
        """Which tokens go while a gateway reopens its session: its own, and of robots those linked to it."""
        keys = self._session.keys
        prefixes = (keys(keyspace.GATEWAY_ALIVE, gateway), keys(keyspace.ROBOT_ALIVE, "*").partition("*")[0])
        return lambda key: key.startswith(prefixes)

    async def reopen(self, why: str) -> None:
        """Reopen the session once it is this gateway's turn; SwiftbotError as of `Session.reopen`."""
        async with self._lock:
            self._turns.wanted = True
            try:
                told = await self._have_turn()
                try:
                    self._turns.taken = True
                    reopened = await self._session.reopen()
                finally:
                    self._turns.taken = False
                    await self._tell(told, done=True)
            finally:
                self._turns.wanted = False
        log.info(
            "the session is reopened", why=why, gap_ms=round(reopened.gap_s * 1e3, 1), linked=reopened.linked,
            of=reopened.of,
        )  # fmt: skip
        for member in sorted(self._members() - {self._gateway}):
            self._events.publish(Relinked(member))

    async def _have_turn(self) -> list[str]:
        """Wait for the turn; returns the members that granted it."""
        until = time.monotonic() + WAIT_S
        while True:
            first = self._turns.before(self._gateway, time.monotonic())
            granted: list[str] = []
            if not first:
                granted, first = await self._tell(sorted(self._members() - {self._gateway}), done=False)
            if not first:
                return granted
            await self._tell(granted, done=True)
            if time.monotonic() > until:
                log.warning(
                    "the session is reopened without a turn: others lose this gateway for a moment", first=first
                )
                return []
            await asyncio.sleep(random.uniform(*_PAUSE_S))  # noqa: S311 - spreads load, protects nothing

    async def _tell(self, members: list[str], *, done: bool) -> tuple[list[str], str]:
        """Ask members for the turn, or tell them that it is over; returns who granted it, and who refused it why."""
        ask = ReopeningAsk(gateway=self._gateway, done=done)
        answers = await asyncio.gather(
            *(self._rpc.call(each, keyspace.REOPENING, ask) for each in members), return_exceptions=True
        )
        granted, refused = list[str](), ""
        for member, answer in zip(members, answers, strict=True):
            if isinstance(answer, Reopening):
                granted.append(member)
            elif isinstance(answer, RefusedError):
                refused = answer.message
            elif isinstance(answer, SwiftbotError):
                # One that is silent, or of a version before: it sees this gateway leave and come back.
                log.info("a member does not know of the reopening", member=member, reason=str(answer))
            else:
                raise answer
        return granted, refused
