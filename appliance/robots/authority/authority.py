"""Who may command robots, as one gateway knows it: asked before every command, and told alike to every gateway.

Gateways that meet tell each other all they know of soft stops and leases, so that one that was away, restarted, or cut
off learns what it missed before long; what it knew itself it has on disk.
"""

import asyncio
import random
from collections.abc import Callable, Sequence
from typing import Any

import structlog

from appliance.errors import SwiftbotError
from appliance.model import Lease, RobotCommand, SoftStop
from appliance.plane.node import Plane
from appliance.robots.api import (
    DriveAsk,
    GiveAsk,
    RenewAsk,
    ResumeRobotsAsk,
    Standing,
    StandingAsk,
    StopAnswer,
    StopAsk,
    TakeAsk,
)
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
    """One per gateway. `on_change` is called when a robot is stopped, freed, taken over or given back."""

    def __init__(
        self, plane: Plane, *, orders: Callable[[str, RobotCommand], RobotCommand] = lambda _, command: command
    ) -> None:
        """Make it.

        Args:
            plane: the fleet.
            orders: returns an operator's order as it may be sent to a robot; raises a SwiftbotError with the reason
                when it may not be.
        """
        self._plane = plane
        self.on_change: list[Callable[[], None]] = []
        self._stopping = Stopping(plane, changed=self._changed)
        self._leasing = Leasing(plane, changed=self._changed, refuses=self.refuses, orders=orders)
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self, signed: Callable[[str, Any], Any] = lambda _, handler: handler) -> None:
        """Take up what was kept, listen, answer the verbs, and ask those who are there for what they know.

        Args:
            signed: puts an audit around the handler of an operator's verb.
        """
        await self._stopping.start()
        self._leasing.start()
        rpc = self._plane.rpc
        rpc.register("soft_stop", StopAsk, signed("soft_stop", self._stopping.stop))
        rpc.register("soft_resume", ResumeRobotsAsk, signed("soft_resume", self._resume))
        rpc.register("standing", StandingAsk, self._standing)
        rpc.register("control_take", TakeAsk, signed("control_take", self._leasing.take))
        rpc.register("control_renew", RenewAsk, self._leasing.renew)
        rpc.register("control_move", DriveAsk, self._leasing.move)
        rpc.register("control_give", GiveAsk, signed("control_give", self._leasing.give))
        self._plane.on_member_joined.append(self._met)
        for member in self._plane.members() - {self._plane.gateway}:
            self._met(member)

    async def close(self) -> None:
        """Listen no more."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._leasing.close()
        await self._stopping.close()

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
            return "no longer under that lease" if command.lease else ""
        return lease.text if command.lease != lease.id else ""

    # --- verbs --------------------------------------------------------------------------------------------------

    async def _resume(self, ask: ResumeRobotsAsk) -> StopAnswer:
        return await self._stopping.resume(ask, self._learn)

    async def _standing(self, ask: StandingAsk) -> Standing:
        """Answer `standing`: what is known here, with what the asker knows."""
        await self._stopping.merge(ask.stops, ask.lifted)
        self._leasing.merge(ask.leases)
        return self._all()

    def _all(self) -> Standing:
        stops = self._stopping.stops
        return Standing(stops=stops.stops, lifted=stops.lifted, leases=self.leases, active=stops.active)

    # --- meeting ------------------------------------------------------------------------------------------------

    def _met(self, member: str) -> None:
        if member == self._plane.gateway:
            return
        task = asyncio.create_task(self._compare(member, MEET_S), name=f"soft stops of {member}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _compare(self, member: str, pause_s: float) -> None:
        """Tell another gateway all that is known here, and take in what it knows."""
        await asyncio.sleep(random.uniform(0.2, 1.0) * pause_s)  # noqa: S311 - spreads load
        mine = self._all()
        ask = StandingAsk(stops=mine.stops, lifted=mine.lifted, leases=mine.leases)
        for _ in range(3):
            try:
                found = await self._plane.rpc.call(member, "standing", ask, Standing, timeout_s=LEARN_S)
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
                found = await self._plane.rpc.call(member, "standing", StandingAsk(), Standing, timeout_s=LEARN_S)
            except SwiftbotError:
                return
            await self._stopping.merge(found.stops, found.lifted)

        await asyncio.gather(*(ask(each) for each in self._plane.members() - {self._plane.gateway}))

    def _changed(self) -> None:
        for callback in tuple(self.on_change):
            callback()
