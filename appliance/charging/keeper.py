"""The shell around `decide`: looks at the robots now and then, and submits what is to be done as tasks.

They are tasks like any other: shown, logged, held where `tasks.approval` says so, cancelled by whoever may cancel. The
way and the charger are reserved by the floor, as for every robot that a task moves.
"""

import asyncio
import time
import zlib
from collections.abc import Awaitable, Callable, Collection, Iterable

import structlog

from appliance.charging.decide import Seen, Trip, decide
from appliance.errors import NotFoundError, SwiftbotError
from appliance.floor.keeper import FloorKeeper
from appliance.model import Plan, RobotWork, Site, Subtask, TaskRecord, TaskRequest, TaskState
from appliance.model.task_api import TaskAsk
from appliance.plane.node import Plane
from appliance.tasks.settings import BatteryConfig

log = structlog.get_logger(__name__)

KEY = "charging"
"""Its owner on the ring sends the robots of the fleet."""
SUBMITTER = "swiftbot"
LOOK_S = 2.0
AGAIN_S = 600
"""A robot is sent at most once in so long, and not within it after its task was cancelled or failed."""


class Charging:
    """Sends the robots of a fleet to charge, while this gateway owns the key.

    Args:
        plane: the fleet.
        site: the map.
        battery: the reserve, and when a robot has charged enough.
        floor: where robots are, and what they have reserved.
        work: what tasks have for robots, of the whole fleet.
        hindrance: why tasks may not command a robot just now; "" when they may.
        closed: places that are closed.
        submit: submits a task wherever it belongs; the same id again is the same task.
        task: returns a task's record; NotFoundError where there is none.
        now_s: the wall clock, Unix seconds.
    """

    def __init__(
        self,
        plane: Plane,
        site: Site,
        battery: BatteryConfig,
        *,
        floor: FloorKeeper,
        work: Callable[[], Iterable[RobotWork]],
        hindrance: Callable[[str], str],
        closed: Callable[[], Collection[str]],
        submit: Callable[[TaskRequest], Awaitable[TaskRecord]],
        task: Callable[[TaskAsk], Awaitable[TaskRecord]],
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._plane = plane
        self._site = site
        self._battery = battery
        self._floor = floor
        self._work_of_fleet = work
        self._hindrance = hindrance
        self._closed = closed
        self._submit = submit
        self._task = task
        self._now_s = now_s
        self._chargers = site.chargers
        self._sent: dict[str, tuple[str, str]] = {}
        """Robot -> its task, which has not ended, and the charger."""
        self._not_before: dict[str, float] = {}
        """Robot -> when it may be sent again."""
        self._loop: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to look, where it is switched on."""
        if not self._battery.auto_charge:
            return
        if not self._chargers:
            log.warning("no robot can go to charge", reason="the site has no place with `charg` in its name")
            return
        self._loop = asyncio.create_task(self._keep(), name="charging")

    async def stop(self) -> None:
        """Send nobody any more; the tasks stay."""
        if self._loop is not None:
            self._loop.cancel()
            await asyncio.gather(self._loop, return_exceptions=True)

    async def _keep(self) -> None:
        while True:
            await asyncio.sleep(LOOK_S)
            try:
                await self.look()
            except Exception:  # supervision boundary: robots must go on being looked at
                log.exception("robots could not be sent to charge")

    async def look(self) -> None:
        """Submit the trips that are to be made now, if that is this gateway's to do."""
        await self._settle()
        if await self._plane.owner_of(KEY) != self._plane.gateway:
            return
        closed = self._closed()
        takes = self._floor.floor.capacity
        chargers = {name: (place, takes[name]) for name, place in self._chargers.items() if name not in closed}
        others = {
            name: place for name, place in self._site.places.items()
            if takes[name] > 1 and name not in closed and name not in self._chargers
        }  # fmt: skip
        for trip in decide(self._seen(), chargers=chargers, others=others, battery=self._battery):
            if self._not_before.get(trip.robot, 0.0) <= self._now_s():
                await self._send(trip)

    def _seen(self) -> list[Seen]:
        busy = {each.robot for each in self._work_of_fleet() if each.state != "later"} | set(self._sent)
        bodies, found = self._floor.bodies(), list[Seen]()
        for name, info in self._plane.registry.robots.items():
            body = bodies.get(name)
            if body is None or not info.online:
                continue
            state = body.state
            goes_to = state.place if state is not None and state.state != "stands" else ""
            bound_for = self._sent[name][1] if name in self._sent else goes_to
            free = name not in busy and not goes_to and not body.moved and not self._hindrance(name)
            found.append(
                Seen(
                    info=info,
                    idle=free and body.stands and body.fresh,
                    at=next((each for each in self._chargers if self._floor.floor.is_at(body, each)), ""),
                    bound_for=bound_for if bound_for in self._chargers else "",
                )
            )
        return found

    async def _settle(self) -> None:
        """Forget the tasks that have ended; after one that did not succeed its robot is left alone for a while."""
        for robot, (task, _) in list(self._sent.items()):
            try:
                state = (await self._task(TaskAsk(id=task))).state
            except NotFoundError:
                state = TaskState.FAILED
            except SwiftbotError:
                continue  # asked again at the next look
            if state.final:
                del self._sent[robot]
                if state is not TaskState.SUCCEEDED:
                    self._not_before[robot] = self._now_s() + AGAIN_S

    async def _send(self, trip: Trip) -> None:
        skill, param = ("dock", "station") if trip.charges else ("goto", "place")
        goes = Subtask(id="s1", skill=skill, robot=trip.robot, params={param: trip.place})
        # The same within a period: two gateways that both take the key for theirs send the robot once.
        request = TaskRequest(
            id=f"{'charge' if trip.charges else 'leave'}-{_short(trip.robot)}-{int(self._now_s() // AGAIN_S)}",
            instruction=f"{trip.robot} {trip.why}: {'charge at' if trip.charges else 'go to'} {trip.place}",
            submitter=SUBMITTER,
            plan=Plan(domain="navigation", subtasks=(goes,)),
        )  # fmt: skip
        try:
            record = await self._submit(request)
        except SwiftbotError as error:
            log.warning("a robot is not sent to charge", robot=trip.robot, place=trip.place, reason=str(error))
            self._not_before[trip.robot] = self._now_s() + LOOK_S
            return
        log.info("robot sent by itself", robot=trip.robot, place=trip.place, task=record.id, why=trip.why)
        self._sent[trip.robot] = record.id, trip.place
        self._not_before[trip.robot] = self._now_s() + LOOK_S


def _short(robot: str) -> str:
    """Return a name that fits into a task's, which has 63 characters at most."""
    return robot if len(robot) <= 40 else f"{robot[:31]}-{zlib.crc32(robot.encode()):08x}"
