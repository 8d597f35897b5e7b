"""Missions: how ways, steps and circles become mission items, and how a mission is flown to its end.

A mission that was interrupted (by a pilot, a restart of the gateway, a hold) is gone on with: what is on board is read
back, and where it is the same mission it continues at the item it had come to. So the autopilot's own memory decides,
not the gateway's. ArduPilot keeps home in item 0 and goes from item 1.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import structlog

from appliance.robots.executor import Done, Terms, verb
from appliance.robots.limits import check_mission, check_orbit, check_points
from appliance.robots.mavlink import dialect, protocols
from appliance.robots.mavlink.controller import POLL_S, Point, VehicleController
from appliance.robots.mavlink.dialect import Message, make
from appliance.robots.mavlink.protocols import Item, RetryPolicy, accepted, ask, command, command_long, download, upload
from appliance.robots.verbs import MissionArgs, MissionStep, OrbitArgs, RobotFailure, Waypoint, cruise

log = structlog.get_logger(__name__)

_SETTLED_MPS = 0.5
_ASKED = 2
"""How often a parameter is asked for that not every autopilot has."""
_MISSION_CURRENT = dialect.constant("MAVLINK_MSG_ID_MISSION_CURRENT")
LOWEST_M = 1.0
ACTS = {
    "photo": Item(command=dialect.IMAGE_START, parameters=(0.0, 0.0, 1.0, 0.0)),
    "grab": Item(command=dialect.GRIPPER, parameters=(1.0, 1.0, 0.0, 0.0)),
    "release": Item(command=dialect.GRIPPER, parameters=(1.0, 0.0, 0.0, 0.0)),
}
"""What a step can do at its point, as mission items."""


class Missions:
    """Makes, uploads and flies missions of one craft."""

    def __init__(self, craft: VehicleController) -> None:
        self._craft = craft

    # --- verbs -------------------------------------------------------------------------------------------------

    @verb()
    async def mission(self, args: MissionArgs) -> Done:
        """Go through the steps; the same mission given again goes on where it was left."""
        craft = self._craft
        vehicle = craft.vehicle
        await craft.fix()
        points = check_mission(craft.site, None, args, flies=vehicle.flies)
        way = self.heights(points)
        items = [*self.beginning(way, args.speed_mps), *self._steps(way, args.steps), *self._end(args)]
        first, board = await self._left_at(items) if args.resume else (0, items)
        stations = self._stations(board)
        behind = sum(number < first for number in stations)
        if ahead := points[behind:]:
            # From where it is now: a pilot who had it meanwhile may have brought it anywhere.
            here = craft.position()
            check_points(craft.site, here, ahead, flies=vehicle.flies, verb="mission", behind=behind)
        if first == 0:
            await self._load(items)
        await self._go(first)
        last = len(board) - 1
        tail = self._tail(way, args)

        def done() -> bool:
            return vehicle.mission_complete or last in vehicle.reached or self._ended(args)

        def staying() -> bool:
            """Whether it is where it was told to stay for a while."""
            return (
                vehicle.speed_mps < _SETTLED_MPS and craft.distance(self._at(way, stations)) <= craft.config.arrival_m
            )

        def left() -> float:
            return self._left(way, stations, args) + (tail if vehicle.mission_at <= stations[-1] else 0.0)

        await craft.travel("mission", craft.modes.mission, done, left, steady=staying)
        return Done({"steps": len(args.steps), "items": len(board), "resumed_at": first} | craft.where())

    @verb(Terms(flying=True))
    async def orbit(self, args: OrbitArgs) -> Done:
        """Circle round a point, then stay on the circle."""
        craft = self._craft
        vehicle = craft.vehicle
        start = await craft.fix()
        check_orbit(craft.site, start, args, flies=vehicle.flies)
        (centre,) = self.heights((Waypoint(args.x, args.y, args.z),))
        latitude, longitude, _ = craft.globe_point(args.x, args.y)
        circle = Item(
            command=dialect.LOITER_TURNS,
            latitude_deg=latitude,
            longitude_deg=longitude,
            relative_m=centre[2] - self._ground_z(),
            parameters=(args.laps, 0.0, args.radius_m, 0.0),
        )
        items = [*self.beginning((centre,), args.speed_mps), circle]
        await self._load(items)
        await self._go(0)
        last = len(items) - 1
        radius = abs(args.radius_m)
        travelled = _Turning(lambda: self._bearing(centre))

        def left() -> float:
            on_it = abs(math.hypot(*self._offset(centre)) - radius) <= max(2.0, 0.2 * radius)
            turned = travelled.step() if on_it else travelled.total
            return max(0.0, math.tau * args.laps - turned) * radius + (0.0 if on_it else craft.distance(centre))

        await craft.travel(
            "orbit", craft.modes.mission, lambda: vehicle.mission_complete or last in vehicle.reached, left
        )
        return Done({"laps": args.laps, "radius_m": args.radius_m} | craft.where())

    # --- for goto ----------------------------------------------------------------------------------------------

    async def fly(self, verb: str, way: Sequence[Point], speed_mps: float | None) -> None:
        """Go through points and wait for arrival at the last."""
        craft = self._craft
        vehicle = craft.vehicle
        ground_z = self._ground_z()
        items = [*self.beginning(way, speed_mps), *(self._waypoint(point, ground_z) for point in way)]
        await self._load(items)
        await self._go(0)
        end, last = way[-1], len(items) - 1
        settled = 0

        def arrived() -> bool:
            nonlocal settled
            near = craft.distance(end) <= craft.config.arrival_m
            # The reports can be lost; standing at the end for two seconds says the same.
            settled = settled + 1 if near and vehicle.speed_mps < _SETTLED_MPS else 0
            return near and (last in vehicle.reached or vehicle.mission_complete or settled * POLL_S >= 2.0)

        await craft.travel(verb, craft.modes.mission, arrived, lambda: craft.left(way, last))

    def heights(self, points: Sequence[Waypoint]) -> tuple[Point, ...]:
        """Give each point its height: its own, else the present one, else that of a take-off."""
        craft = self._craft
        vehicle = craft.vehicle
        ground_z = self._ground_z()
        if not vehicle.flies:
            return tuple((point.x, point.y, ground_z) for point in points)
        here = craft.position().z
        altitude = (
            ground_z + craft.config.takeoff_altitude_m if not vehicle.airborne else max(here, ground_z + LOWEST_M)
        )
        return cruise(points, min(altitude, craft.site.altitude_limit_m))

    def beginning(self, way: Sequence[Point], speed_mps: float | None) -> list[Item]:
        """Return home, a take-off where it is needed, and the speed: as asked, else the usual within the limit."""
        craft = self._craft
        vehicle = craft.vehicle
        home = vehicle.home or (vehicle.latitude_deg, vehicle.longitude_deg, 0.0)
        items = [Item(command=dialect.WAYPOINT, latitude_deg=home[0], longitude_deg=home[1])]
        if vehicle.flies and not vehicle.airborne:
            items.append(
                Item(
                    command=dialect.TAKEOFF,
                    latitude_deg=vehicle.latitude_deg,
                    longitude_deg=vehicle.longitude_deg,
                    relative_m=way[0][2] - self._ground_z(),
                )
            )
        usual = craft.config.cruise_mps if vehicle.flies else craft.config.drive_mps
        speed = min(usual, craft.site.speed_limit_mps) if speed_mps is None else speed_mps
        items.append(Item(command=dialect.CHANGE_SPEED, parameters=(1.0, speed, -1.0, 0.0)))
        return items

    # --- pieces ------------------------------------------------------------------------------------------------

    def _ground_z(self) -> float:
        return self._craft.position().z - self._craft.vehicle.relative_m

    def _waypoint(self, point: Point, ground_z: float, hold_s: float = 0.0) -> Item:
        latitude, longitude, _ = self._craft.globe_point(*point)
        return Item(
            command=dialect.WAYPOINT,
            latitude_deg=latitude,
            longitude_deg=longitude,
            relative_m=point[2] - ground_z,
            parameters=(hold_s, 0.0, 0.0, 0.0),
        )

    def _steps(self, way: Sequence[Point], steps: Sequence[MissionStep]) -> list[Item]:
        ground_z = self._ground_z()
        items: list[Item] = []
        for point, step in zip(way, steps, strict=True):
            items.append(self._waypoint(point, ground_z, step.hold_s))
            if step.act:
                items.append(ACTS[step.act])
        return items

    def _end(self, args: MissionArgs) -> list[Item]:
        if args.end == "return":
            return [Item(command=dialect.RETURN)]
        if args.end == "land":
            if not self._craft.vehicle.flies:
                raise RobotFailure("refused", f"{self._craft.vehicle.name} does not fly", remedy="end with hold")
            return [Item(command=dialect.LAND)]
        return []

    def _ended(self, args: MissionArgs) -> bool:
        """Whether a mission that ends on the ground has: it disarms there before it reports its last item."""
        return args.end != "hold" and self._craft.vehicle.flies and not self._craft.vehicle.armed

    async def _left_at(self, items: Sequence[Item]) -> tuple[int, Sequence[Item]]:
        """Return the item at which this very mission was left and what is on board; 0: at the first."""
        vehicle = self._craft.vehicle
        if vehicle.mission_items < 2 or vehicle.mission_complete or vehicle.mission_at < 1 or not vehicle.armed:
            return 0, items
        board = await download(vehicle, patience=self._craft.patience)
        if not _same_way(board, items) or vehicle.mission_at >= len(board):
            return 0, items
        log.info("mission is gone on with", robot=vehicle.name, item=vehicle.mission_at, items=len(board))
        return vehicle.mission_at, board

    async def _load(self, items: Sequence[Item]) -> None:
        craft = self._craft
        if craft.vehicle.armed:
            # Held in place first: an autopilot does not take a new mission while it carries out the old one.
            await craft.mode(craft.modes.guided)
        await upload(craft.vehicle, items, patience=craft.patience)

    async def _go(self, first: int) -> None:
        """Arm if need be and begin, or go on at an item."""
        craft = self._craft
        vehicle = craft.vehicle
        if not vehicle.armed:
            await craft.mode(craft.modes.guided)
            await craft.arm()
        # A vehicle that flies this very mission gets no item: it may have passed it by the time it hears of it, and
        # would fly back and do a second time what is done there.
        flying = first > 0 and vehicle.custom_mode == craft.modes.numbers[craft.modes.mission]
        again = first > 0 and not flying and await self._begins_anew()
        if not flying:
            await self._set_current(max(1, first))
        if first == 0:
            vehicle.forget_mission()
        try:
            # Said again right behind the mode, where entering it restarts the mission: whatever is done at the items
            # before would be done twice until an answer came.
            behind = command_long(vehicle, dialect.SET_CURRENT, float(first)) if again else None
            await craft.mode(craft.modes.mission, behind=behind)
            # ArduPilot denies a first or last item here.
            await command(vehicle, dialect.MISSION_START, 0, 0, patience=craft.patience, check=craft.check_control)
            if first > 0 and not flying:
                await self._stay_at(first)
        except RobotFailure:
            # The mode may have been taken up all the same: it must not fly what nobody watches.
            with contextlib.suppress(RobotFailure):
                await craft.halt()
            raise

    async def _begins_anew(self) -> bool:
        """Whether entering the mode restarts the mission (ArduPilot's MIS_RESTART); False where that is not known."""
        patience = RetryPolicy(timeout_s=self._craft.patience.timeout_s, tries=_ASKED)
        try:
            return await protocols.read_parameter(self._craft.vehicle, "MIS_RESTART", patience=patience) != 0
        except RobotFailure:
            return False  # another autopilot, or a lossy link: `_stay_at` sees to it

    async def _stay_at(self, item: int) -> None:
        """Say the item again where the mission was restarted all the same.

        Where it has not, nothing is said: the item may be behind already, and what is done at it would be done twice.
        """
        craft = self._craft
        async with craft.vehicle.listening("MISSION_CURRENT") as told:
            await ask(
                craft.vehicle,
                dialect.REQUEST_MESSAGE,
                float(_MISSION_CURRENT),
                patience=craft.patience,
                check=craft.check_control,
            )
            # Where it does not send on request, it tells of itself once a second.
            at = await _told(told, craft.patience.timeout_s * craft.patience.tries, lambda _: True)
        if at is None or at < item:
            await self._set_current(item, flown=True)

    async def _set_current(self, item: int, *, flown: bool = False) -> None:
        """Say from which item a mission is flown, before it is: else it goes on at the old item, a new mission too.

        Args:
            item: its number.
            flown: the mission is being flown, and may be behind that item by the time it answers.

        Raises:
            RobotFailure: it declines, or, retryable, does not confirm it.
        """
        craft = self._craft
        vehicle, patience, check = craft.vehicle, craft.patience, craft.check_control
        outcome = await ask(vehicle, dialect.SET_CURRENT, float(item), patience=patience, check=check)
        if outcome.result != dialect.UNSUPPORTED:
            accepted(vehicle, dialect.SET_CURRENT, outcome)
            return
        # Older firmware knows the message alone. It answers with MISSION_CURRENT of that very number, nothing else.
        async with vehicle.listening("MISSION_CURRENT") as told:
            for _ in range(patience.tries):
                check()
                vehicle.send(
                    make(
                        "MISSION_SET_CURRENT",
                        target_system=vehicle.system,
                        target_component=vehicle.component,
                        seq=item,
                    )
                )
                at = await _told(told, patience.timeout_s, lambda at: at == item or (flown and at > item))
                if at is not None:
                    return
        raise RobotFailure(
            "robot",
            f"{vehicle.name} did not confirm mission item {item} in {patience.tries} tries: it is at "
            f"{vehicle.mission_at}",
            remedy="check its radio link",
            retryable=True,
        )

    def _stations(self, items: Sequence[Item]) -> list[int]:
        """Return the item numbers of the waypoints, in order."""
        return [number for number, item in enumerate(items) if number and item.command == dialect.WAYPOINT]

    def _at(self, way: Sequence[Point], stations: Sequence[int]) -> Point:
        """Return the point of the step it is at or on the way to."""
        now = self._craft.vehicle.mission_at
        behind = sum(number < now for number in stations)
        return way[min(behind, len(way) - 1)]

    def _left(self, way: Sequence[Point], stations: Sequence[int], args: MissionArgs) -> float:
        """Metres left of the way; behind its last point, metres left of the return or the landing."""
        craft = self._craft
        vehicle = craft.vehicle
        if vehicle.mission_at > stations[-1]:
            home = vehicle.home
            across = 0.0
            if args.end == "return" and home is not None:
                x, y, _ = craft.site_point(*home)
                pose = craft.position()
                across = math.hypot(pose.x - x, pose.y - y)
            return across + abs(vehicle.relative_m)
        behind = min(sum(number < vehicle.mission_at for number in stations), len(way) - 1)
        rest = way[behind:]
        return craft.distance(rest[0]) + sum(math.dist(one, other) for one, other in pairwise(rest))

    def _tail(self, way: Sequence[Point], args: MissionArgs) -> float:
        """Metres that come behind the last point, so that its end is progress as well."""
        home = self._craft.vehicle.home
        across = 0.0
        if args.end == "return" and home is not None:
            x, y, _ = self._craft.site_point(*home)
            across = math.hypot(way[-1][0] - x, way[-1][1] - y)
        return across + abs(way[-1][2] - self._ground_z()) + 2 * self._craft.config.takeoff_altitude_m

    def _offset(self, centre: Point) -> tuple[float, float]:
        pose = self._craft.position()
        return pose.x - centre[0], pose.y - centre[1]

    def _bearing(self, centre: Point) -> float:
        x, y = self._offset(centre)
        return math.atan2(y, x)


class _Turning:
    """Adds up how far something has gone round, radians, whichever way."""

    def __init__(self, bearing: Callable[[], float]) -> None:
        self._bearing = bearing
        self._last: float | None = None
        self.total = 0.0

    def step(self) -> float:
        now = self._bearing()
        if self._last is not None:
            self.total += abs(math.remainder(now - self._last, math.tau))
        self._last = now
        return self.total


async def _told(told: asyncio.Queue[Message], within_s: float, holds: Callable[[int], bool]) -> int | None:
    """Wait for a MISSION_CURRENT whose item holds, and return it; None when none came in time."""
    try:
        async with asyncio.timeout(within_s):
            while not holds(at := int((await told.get()).seq)):
                pass
            return at
    except TimeoutError:
        return None


def _same_way(board: Sequence[Item], items: Sequence[Item]) -> bool:
    """Whether two missions have the same steps: home may have moved, and who is in the air needs no take-off."""

    def steps(mission: Sequence[Item]) -> list[Item]:
        return [each for each in mission[1:] if each.command not in (dialect.TAKEOFF, dialect.CHANGE_SPEED)]

    one, other = steps(board), steps(items)
    return len(one) == len(other) > 0 and all(a.same(b) for a, b in zip(one, other, strict=True))
