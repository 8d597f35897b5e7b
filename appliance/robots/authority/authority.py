"""Who may command robots, as one gateway knows it: asked before every command, and told alike to every gateway.

Gateways that meet tell each other all they know of soft stops and leases, so that one that was away, restarted, or cut
off learns what it missed before long; what it knew itself it has on disk.
"""

import asyncio
import random
import zlib
from collections.abc import Callable, Sequence, Set
from typing import Any

import structlog

from appliance.background import Background
from appliance.errors import SwiftbotError
from appliance.identity.member import SENDER
from appliance.model import Lease, RobotCommand, SoftStop, keyspace
from appliance.model.robot_api import ResumeRobotsAsk, Standing, StandingAsk, StopAnswer, StopAsk
from appliance.model.roles import Role
from appliance.model.steering import MAX_STOPPED
from appliance.plane.events import AuthorityChanged, FleetEvent, Joined, Relinked, Stage
from appliance.plane.node import Plane
from appliance.robots.authority.lease import Leasing
from appliance.robots.authority.soft_stop import Stopping

log = structlog.get_logger(__name__)

HARMLESS = frozenset({"state", "stop", "hold"})
"""Verbs that are never refused: they move nothing."""
MEET_S = 0.5
"""Gateways that meet wait about so long before they compare: both have more to do just then."""
LEARN_S = 1.0
SHOWN = 32
"""Of each kind in a gateway's status."""


class Authority:
    """One per gateway. Publishes `AuthorityChanged` when a robot is stopped, freed, taken over or given back."""

    def __init__(
        self,
        plane: Plane,
        *,
        orders: Callable[[str, RobotCommand], RobotCommand] = lambda _, command: command,
        out_of_use: Callable[[str], str] = lambda _: "",
    ) -> None:
        """Make it.

        Args:
            plane: the fleet.
            orders: returns an operator's order as it may be sent to a robot; raises a SwiftbotError with the reason
                when it may not be.
            out_of_use: why a robot is in maintenance; "" when it is not.
        """
        self._out_of_use = out_of_use
        self._plane = plane
        self._stopping = Stopping(plane, changed=self._changed)
        self._leasing = Leasing(plane, changed=self._changed, refuses=self.refuses, orders=orders)
        self._tasks = Background()

    async def start(self, signed: Callable[[str, Any], Any] = lambda _, handler: handler) -> None:
        """Take up what was kept, listen, answer the verbs, and ask those who are there for what they know.

        Args:
            signed: puts an audit around the handler of an operator's verb.
        """
        await self._stopping.start()
        self._leasing.start()
        rpc = self._plane.rpc
        rpc.register(keyspace.SOFT_STOP, signed("soft_stop", self._stopping.stop))
        rpc.register(keyspace.SOFT_RESUME, signed("soft_resume", self._resume))
        rpc.register(keyspace.STANDING, self._standing)
        rpc.register(keyspace.CONTROL_TAKE, signed("control_take", self._leasing.take))
        rpc.register(keyspace.CONTROL_RENEW, self._leasing.renew)
        rpc.register(keyspace.CONTROL_MOVE, self._leasing.move)
        rpc.register(keyspace.CONTROL_GIVE, signed("control_give", self._leasing.give))
        self._plane.events.subscribe(Stage.ROBOTS, self._on_event)
        for member in self._plane.members() - {self._plane.gateway}:
            self._met(member)

    async def close(self) -> None:
        """Listen no more."""
        await self._tasks.close()
        await self._leasing.close()
        await self._stopping.close()

    async def hold_revoked(self, robots: Set[str]) -> None:
        """Stop those that are online of robots whose certificates have just been revoked: one that moves would go on.

        What comes of it is logged, for the operators who see the log.
        """
        roster, credentials = self._plane.registry.robots, self._plane.session.credentials
        online = sorted(each for each in robots if each in roster and roster[each].online)
        if not online or credentials is None:
            return
        number = credentials.roster.number
        parts = (tuple(online[start : start + MAX_STOPPED]) for start in range(0, len(online), MAX_STOPPED))
        await asyncio.gather(*(self._hold_revoked(part, number) for part in parts))

    async def _hold_revoked(self, online: tuple[str, ...], number: int) -> None:
        # One stop of all gateways that see the same robots online; of others under its id theirs would be lost.
        act = f"o-revoked-{number}-{zlib.crc32('/'.join(online).encode()):08x}"
        ask = StopAsk(robots=online, by="swiftbot", why="its certificate is revoked", act=act)
        try:
            answer = await self._plane.rpc.call(self._plane.gateway, keyspace.SOFT_STOP, ask)
        except SwiftbotError as error:
            log.warning("revoked robots are not stopped: use the switch at each", robots=online, reason=str(error))
            return
        for robot in online:
            if (problem := answer.problems.get(robot, "")) or robot not in answer.robots:
                problem = problem or "it does not answer"
                log.warning("a revoked robot may not hold: look at it, or use its switch", robot=robot, reason=problem)

    # --- questions ----------------------------------------------------------------------------------------------

    @property
    def active(self) -> tuple[SoftStop, ...]:
        """Soft stops in force."""
        return self._stopping.stops.active

    @property
    def leases(self) -> tuple[Lease, ...]:
        """Robots that operators have."""
        return self._leasing.leases.all

    def holds(self, stop: SoftStop, robot: str) -> bool:
        """Whether a soft stop is in force for a robot."""
        return self._stopping.stops.holds(stop, robot)

    def ended(self, stop: str, robots: Sequence[str]) -> bool:
        """Whether a soft stop is known to hold none of those robots any more."""
        return self._stopping.stops.ended(stop, robots)

    def hindrance(self, robot: str) -> str:
        """Why tasks may not command a robot just now; empty when they may."""
        stop = self._stopping.stops.of(robot)
        if stop is not None:
            return stop.text
        lease = self._leasing.leases.of(robot)
        if lease is not None:
            return lease.text
        if why := self._out_of_use(robot):
            return why
        info = self._plane.registry.robots.get(robot)
        # A pilot or a failsafe at the vehicle itself (`robots.mavlink.control`).
        return f"taken at the vehicle: {info.seized}" if info is not None and info.online and info.seized else ""

    def refuses(self, robot: str, command: RobotCommand) -> str:
        """Why a command is refused just now; empty when it may be carried out."""
        if command.verb in HARMLESS:
            return ""
        stop = self._stopping.stops.of(robot)
        if stop is not None:
            return stop.text
        lease = self._leasing.leases.of(robot)
        if lease is None or (lease.id == command.lease and self._leasing.leases.over(robot)):
            # Its operator does not have the robot any more: perhaps a task has.
            return "no longer under that lease" if command.lease else self._out_of_use(robot)
        return lease.text if command.lease != lease.id else ""

    # --- verbs --------------------------------------------------------------------------------------------------

    async def _resume(self, ask: ResumeRobotsAsk) -> StopAnswer:
        return await self._stopping.resume(ask, self._learn)

    async def _standing(self, ask: StandingAsk) -> Standing:
        """Answer `standing`: what is known here, with what the asker knows.

        Only gateways are believed, all are answered: an operator who lifts a stop says so by `soft_resume`.
        """
        sender = SENDER.get()
        if sender is None or sender.role is Role.GATEWAY:
            await self._stopping.merge(ask.stops, ask.lifted)
            self._leasing.merge(ask.leases)
        return self._all()

    def _all(self) -> Standing:
        stops = self._stopping.stops
        return Standing(stops=stops.stops, lifted=stops.lifted, leases=self.leases, active=stops.active)

    # --- meeting ------------------------------------------------------------------------------------------------

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, Joined | Relinked):
            self._met(event.gateway)

    def _met(self, member: str) -> None:
        if member == self._plane.gateway:
            return
        self._tasks.start(self._compare(member, MEET_S), f"soft stops of {member}")

    async def _compare(self, member: str, pause_s: float) -> None:
        """Tell another gateway all that is known here, and take in what it knows."""
        await asyncio.sleep(random.uniform(0.2, 1.0) * pause_s)  # noqa: S311 - spreads load
        mine = self._all()
        ask = StandingAsk(stops=mine.stops, lifted=mine.lifted, leases=mine.leases)
        for _ in range(3):
            try:
                found = await self._plane.rpc.call(member, keyspace.STANDING, ask, timeout_s=LEARN_S)
            except SwiftbotError as error:
                log.info("a gateway does not tell its soft stops", member=member, reason=str(error))
                if member not in self._plane.members():
                    return
                await asyncio.sleep(1.0)
                continue
            await self._stopping.merge(found.stops, found.lifted)
            self._leasing.merge(found.leases)
            return

    async def _learn(self) -> None:
        """Ask all who are there, once."""

        async def ask(member: str) -> None:
            try:
                found = await self._plane.rpc.call(member, keyspace.STANDING, StandingAsk(), timeout_s=LEARN_S)
            except SwiftbotError:
                return
            await self._stopping.merge(found.stops, found.lifted)

        await asyncio.gather(*(ask(each) for each in self._plane.members() - {self._plane.gateway}))

    def _changed(self) -> None:
        self._plane.events.publish(AuthorityChanged())
