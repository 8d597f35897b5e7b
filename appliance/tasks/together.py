"""Commands that several robots carry out together, for the handlers of joint skills: all of them or none.

None is sent before every robot is there, may be commanded and is leased to this run: of two runs that want the same
robots one waits, at whatever gateway. Once they are sent all robots are watched. When one fails, is lost, stopped or
taken over, the others hold; when the run ends, or its gateway lets go, their commands end.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import TypeVar

import structlog

from appliance.background import Background
from appliance.errors import ConfigError, ConflictError, RobotError, SwiftbotError, UnreachableError
from appliance.plane.leases import Lease
from appliance.plane.node import Plane
from appliance.robots.sender import tell_to_hold
from appliance.tasks.placement import waits_for_lost

T = TypeVar("T")
log = structlog.get_logger(__name__)

LOOK_S = 0.1
"""How often all robots are looked at while they carry a command out."""
LEASE_S = 10.0
"""How long a robot stays leased when the gateway that leased it is gone."""


class Together:
    """What the runs of one gateway have several robots do.

    Args:
        plane: the fleet.
        hindrance: why a robot may not be commanded just now, "" when it may.
    """

    def __init__(self, plane: Plane, *, hindrance: Callable[[str], str]) -> None:
        self._plane = plane
        self._hindrance = hindrance
        self._releasing = Background()

    async def run(
        self,
        robots: Sequence[str],
        one: Callable[[str], Awaitable[T]],
        *,
        act: str,
        give_up: float,
        on_wait: Callable[[str], None],
    ) -> dict[str, T]:
        """Have `one` command each robot at the same time; returns what it returned, by robot.

        Args:
            robots: by name, each once.
            one: commands a robot until it has done its part; cancelled, it ends that command.
            act: id of what is done.
            give_up: until when it is waited for all of them, by the monotonic clock.
            on_wait: told what it waits for.

        Raises:
            SwiftbotError: the first failure of `one`, with what became of the others.
            RobotError: a robot was lost, stopped or taken over meanwhile, or not all were free in time.
        """
        leases: list[Lease] = []
        try:
            await self._until(lambda: self._ready(robots, leases), robots, give_up, on_wait)
            try:
                async with asyncio.TaskGroup() as group:
                    watching = group.create_task(self._watch(robots, leases))
                    parts = {robot: group.create_task(_part(robot, one)) for robot in robots}
                    await asyncio.wait(parts.values())
                    watching.cancel()
            except* SwiftbotError as failed:
                error = _first(failed)
            else:
                return {robot: part.result() for robot, part in parts.items()}
            await self._hold(error, robots, act)
            raise error
        finally:
            for lease in leases:
                self._releasing.start(self._plane.leases.release(lease), f"release {lease.key}")

    def against(self, robots: Sequence[str]) -> str:
        """Return why one of the robots cannot act with the others just now, in words; "" when all can."""
        for robot in robots:
            info = self._plane.registry.robots.get(robot)
            if info is None or not info.online:
                return waits_for_lost(robot, info, self._plane.registry.lost_ns.get(robot))
            if why := self._hindrance(robot):
                return f"waits for {robot}: {why}"
        return ""

    async def _until(
        self,
        look: Callable[[], Awaitable[str]],
        robots: Sequence[str],
        give_up: float,
        on_wait: Callable[[str], None],
    ) -> None:
        told = ""
        while why := await look():
            if time.monotonic() >= give_up:
                raise RobotError(f"{', '.join(robots)} cannot begin together: {why}", remedy="try again when all can")
            if why != told:
                on_wait(why)
            told = why
            await asyncio.sleep(LOOK_S)

    async def _ready(self, robots: Sequence[str], leases: list[Lease]) -> str:
        """Return why the robots cannot begin just now; those that are leased stay so while others are waited for."""
        if any(each.left_s < 2 * LEASE_S / 3 for each in leases):
            try:
                leases[:] = await asyncio.gather(*(self._renewed(each) for each in leases))
            except (ConflictError, RobotError) as error:
                # Another run may have them by now: none counts before all are leased again.
                for lease in leases:
                    self._releasing.start(self._plane.leases.release(lease), f"release {lease.key}")
                leases.clear()
                return error.message
        return await self._lease(robots, leases) or self.against(robots)

    async def _lease(self, robots: Sequence[str], leases: list[Lease]) -> str:
        """Lease what is not leased yet, in one order everywhere so that no two runs wait for each other."""
        for robot in sorted(robots)[len(leases) :]:
            try:
                leases.append(await self._plane.leases.acquire(f"joint/{robot}", ttl_s=LEASE_S))
            except ConfigError:
                return ""  # nobody grants leases in this fleet: a robot that another run has answers that it is busy
            except ConflictError:
                return f"waits for {robot}, which does something with other robots"
            except UnreachableError as error:
                return f"waits for the gateways that grant leases: {error.message}"
        return ""

    async def _watch(self, robots: Sequence[str], leases: list[Lease]) -> None:
        """Raise as soon as one of the robots is lost, stopped or taken over, whatever its own part has come to."""
        renewed = time.monotonic()
        while not (why := self.against(robots)):
            await asyncio.sleep(LOOK_S)
            if time.monotonic() - renewed >= LEASE_S / 3:
                renewed = time.monotonic()
                leases[:] = await asyncio.gather(*(self._renewed(each) for each in leases))
        raise RobotError(f"{', '.join(robots)} cannot go on together: {why}", remedy="it goes on when all can")

    async def _renewed(self, lease: Lease) -> Lease:
        try:
            return await self._plane.leases.renew(lease, ttl_s=LEASE_S)
        except UnreachableError as error:
            if lease.left_s > LEASE_S / 3:
                return lease
            raise RobotError(f"the lease on {lease.key} is lost: {error.message}", remedy="try again") from error

    async def _hold(self, error: SwiftbotError, robots: Sequence[str], act: str) -> None:
        """Have the robots that may still be commanded hold, and say in the error which did not confirm it."""
        others = [each for each in robots if not self.against([each])]
        held, silent = await tell_to_hold(self._plane.session, others, act=f"{act}~hold")
        log.warning("robots stop together", robots=robots, reason=error.message, held=held, silent=silent)
        error.message += f"; {', '.join(held) or 'no other'} holds"
        if silent:
            error.message += f"; not confirmed: {', '.join(f'{each} ({why})' for each, why in silent.items())}"


async def _part(robot: str, one: Callable[[str], Awaitable[T]]) -> T:
    try:
        return await one(robot)
    except SwiftbotError as error:
        error.message = f"{robot}: {error.message}"
        raise


def _first(failed: BaseExceptionGroup[SwiftbotError]) -> SwiftbotError:
    error = failed.exceptions[0]
    return _first(error) if isinstance(error, BaseExceptionGroup) else error
