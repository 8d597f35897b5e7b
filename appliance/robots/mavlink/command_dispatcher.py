"""The verbs of one MAVLink vehicle, by what its heartbeat says it is: those of all kinds, of copters, of rovers.

An ArduPilot multirotor's own are `goto`, which becomes a mission, take-off, landing and return. `goto` on the ground
arms, and its mission begins with a take-off: an operator who says "go to dock 3" does not want to hear "not airborne".
It lands only when told to. A rover or boat drives by missions too, and home by RTL.
"""

import asyncio
import math

import msgspec
import structlog

from appliance.model import Site
from appliance.robots.executor import Done, Terms, Verb, verb
from appliance.robots.limits import check_way
from appliance.robots.mavlink import dialect, protocols
from appliance.robots.mavlink.controller import ManualControl, VehicleController
from appliance.robots.mavlink.missions import LOWEST_M, Missions
from appliance.robots.mavlink.payload import Payload
from appliance.robots.mavlink.protocols import command
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.settings import RobotsConfig
from appliance.robots.verbs import (
    GotoArgs,
    HoldArgs,
    ModeArgs,
    NoArgs,
    ParameterArgs,
    RobotFailure,
    TakeoffArgs,
    in_range,
)


class Copter:
    """Flies one vehicle."""

    def __init__(self, craft: VehicleController, missions: Missions) -> None:
        self._craft = craft
        self._missions = missions

    @verb()
    async def goto(self, args: GotoArgs) -> Done:
        """Fly through the waypoints by an uploaded mission and wait for arrival at the last."""
        craft = self._craft
        points = check_way(craft.site, await craft.fix(), args, flies=True)
        way = self._missions.heights(points)
        await self._missions.fly("goto", way, args.speed_mps)
        return Done({"waypoints": len(way), "distance_m": round(craft.distance(way[-1]), 2)} | craft.where())

    @verb()
    async def takeoff(self, args: TakeoffArgs) -> Done:
        """Climb to an altitude above home; from the air: climb or sink there."""
        craft = self._craft
        vehicle = craft.vehicle
        altitude = craft.config.takeoff_altitude_m if args.altitude_m is None else args.altitude_m
        in_range("takeoff", "altitude_m", altitude, LOWEST_M, max(craft.site.altitude_limit_m, LOWEST_M))
        await craft.fix()
        guided = craft.modes.guided
        await craft.mode(guided)
        if not vehicle.airborne:
            await craft.arm()
            patience, check = craft.patience, craft.check_control
            await command(vehicle, dialect.TAKEOFF, 0, 0, 0, 0, 0, 0, altitude, patience=patience, check=check)
        tolerance = max(0.5, 0.05 * altitude)
        latitude, longitude = vehicle.latitude_deg, vehicle.longitude_deg
        rounds = 0

        def there() -> bool:
            nonlocal rounds
            rounds += 1
            # Position targets are not acknowledged, so they are repeated; an autopilot that climbs by NAV_TAKEOFF
            # gets none before it is up.
            due = rounds % 20 == 0 and vehicle.control.seized is None
            if due and vehicle.airborne and abs(vehicle.relative_m - altitude) > tolerance:
                craft.target(latitude, longitude, altitude)
            return abs(vehicle.relative_m - altitude) <= tolerance

        await craft.travel("takeoff", guided, there, lambda: abs(vehicle.relative_m - altitude))
        return Done({"altitude_m": round(vehicle.relative_m, 2)} | craft.where())

    @verb(Terms(safe=True))
    async def land(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Come down where it is, until it has disarmed."""
        craft = self._craft
        vehicle = craft.vehicle
        if vehicle.armed:
            await craft.mode(craft.modes.land, safe=True)
            await craft.travel(
                "land", craft.modes.land, lambda: not vehicle.armed, lambda: vehicle.relative_m, safe=True
            )
        return Done({"landed": True} | craft.where())

    @verb(Terms(safe=True))
    async def return_home(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Fly home and land, until it has disarmed."""
        craft = self._craft
        vehicle = craft.vehicle
        if not vehicle.armed:
            return Done({"landed": True, "moved": False} | craft.where())
        await craft.mode(craft.modes.home, safe=True)
        home = vehicle.home

        def left() -> float:
            if home is None:
                return vehicle.relative_m
            pose = craft.position()
            x, y, _ = craft.site_point(*home)
            # Coming down counts once it is over home; climbing to the return height before is progress too.
            return math.hypot(pose.x - x, pose.y - y) * 10.0 + abs(vehicle.relative_m)

        await craft.travel("return_home", craft.modes.home, lambda: not vehicle.armed, left, safe=True)
        return Done({"landed": True, "moved": True} | craft.where())


class Rover:
    """Drives one vehicle."""

    def __init__(self, craft: VehicleController, missions: Missions) -> None:
        self._craft = craft
        self._missions = missions

    @verb()
    async def goto(self, args: GotoArgs) -> Done:
        """Drive through the waypoints and wait for arrival at the last."""
        craft = self._craft
        points = check_way(craft.site, await craft.fix(), args, flies=False)
        way = self._missions.heights(points)
        await self._missions.fly("goto", way, args.speed_mps)
        return Done({"waypoints": len(way), "distance_m": round(craft.distance(way[-1]), 2)} | craft.where())

    @verb(Terms(safe=True))
    async def return_home(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Drive home and stand there."""
        craft = self._craft
        vehicle = craft.vehicle
        home = vehicle.home
        if home is None:
            raise RobotFailure(
                "robot", f"{vehicle.name} has not told where its home is", remedy="wait a moment", retryable=True
            )
        if not vehicle.armed:
            await craft.mode(craft.modes.guided, safe=True)
            await craft.arm(safe=True)
        x, y, _ = craft.site_point(*home)

        def left() -> float:
            pose = craft.position()
            return math.hypot(pose.x - x, pose.y - y)

        await craft.mode(craft.modes.home, safe=True)
        await craft.travel(
            "return_home",
            craft.modes.home,
            lambda: left() <= craft.config.arrival_m and vehicle.speed_mps < 0.2,
            left,
            safe=True,
        )
        return Done({"moved": True} | craft.where())


log = structlog.get_logger(__name__)

_MAX_HOLD_S = 86_400.0
_LARGEST = 3.4e38
"""What a 32-bit float holds."""


class CommandDispatcher:
    """Of one vehicle. `verbs` may be asked again at any time: what a vehicle is is known by its heartbeat alone."""

    def __init__(self, vehicle: Vehicle, *, site: Site, config: RobotsConfig) -> None:
        self._vehicle = vehicle
        self._craft = VehicleController(vehicle, site=site, config=config)
        missions = Missions(self._craft)
        self._missions = missions
        self._copter = Copter(self._craft, missions)
        self._rover = Rover(self._craft, missions)
        self._manual = ManualControl(self._craft)
        self._payload = Payload(self._craft)

    def ready(self) -> None:
        """Raise RobotFailure while it cannot be reached."""
        self._craft.ready()

    async def halt(self) -> None:
        """Bring it to rest where it is; RobotFailure while a pilot or failsafe has it."""
        await self._craft.halt()

    def verbs(self) -> dict[str, Verb]:
        """Return what it can do; only `state` for vehicles whose modes are not known here."""
        found = self._craft.verbs_of(self, *self._parts())
        return found if self._vehicle.commandable else {"state": found["state"]}

    def _parts(self) -> tuple[object, ...]:
        return (self._copter if self._vehicle.flies else self._rover, self._missions, self._manual, self._payload)

    @verb(Terms(uses=(), guarded=False, resumable=False))
    async def state(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Say what is known of it."""
        info = self._vehicle.info("", tuple(self.verbs()))
        said = {"flies": info.flies, "armed": info.armed, "online": info.online}
        return Done({**msgspec.to_builtins(info), **said} | self._craft.where())

    @verb(Terms(preempts=True))
    async def hold(self, args: HoldArgs) -> Done:
        """Stop where it is; with a duration, stay that long."""
        in_range("hold", "duration_s", args.duration_s, 0.0, _MAX_HOLD_S)
        await self._craft.halt()
        await asyncio.sleep(args.duration_s or 0.0)
        return Done({"held_s": args.duration_s or 0.0} | self._craft.where())

    @verb()
    async def arm(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Arm the motors, when nothing speaks against it."""
        if not self._vehicle.armed:
            await self._craft.mode(self._craft.modes.guided)
            await self._craft.arm()
        return Done(self._craft.where())

    @verb(Terms(safe=True))
    async def disarm(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Disarm; the autopilot refuses in the air."""
        if self._vehicle.armed:
            await command(
                self._vehicle,
                dialect.ARM,
                0.0,
                patience=self._craft.patience,
                check=lambda: self._craft.check_control(safe=True),
            )
            await self._craft.confirm(lambda: not self._vehicle.armed)
        return Done(self._craft.where())

    @verb(Terms(preempts=True))
    async def set_mode(self, args: ModeArgs) -> Done:
        """Change the mode. It ends what the base does, and the mode counts as the gateway's own."""
        modes = self._craft.modes
        name = args.mode.strip().upper()
        if name not in modes.numbers:
            known = ", ".join(sorted(modes.numbers))
            raise RobotFailure("payload", f"set_mode: there is no mode {args.mode[:40]!r}", remedy=f"known: {known}")
        if name in modes.by_hand:
            raise RobotFailure(
                "refused",
                f"in {name} sticks move {self._vehicle.name}, and a gateway has none",
                remedy=f"use one of {', '.join(sorted(modes.plain))}",
            )
        if name not in modes.plain:
            raise RobotFailure(
                "refused",
                f"in {name} {self._vehicle.name} goes where nobody has checked that it may",
                remedy=f"give a mission by `mission`, which is checked, or use one of {', '.join(sorted(modes.plain))}",
            )
        await self._craft.mode(name)
        return Done(self._craft.where())

    @verb(Terms(uses=(), guarded=False))
    async def parameter(self, args: ParameterArgs) -> Done:
        """Read or write one of the autopilot's parameters; written only while it stands disarmed."""
        name = protocols.check_name(args.name)
        patience = self._craft.patience
        if args.value is None:
            return Done({"name": name, "value": await protocols.read_parameter(self._vehicle, name, patience=patience)})
        in_range("parameter", "value", args.value, -_LARGEST, _LARGEST)
        if self._vehicle.armed:
            raise RobotFailure("refused", f"{self._vehicle.name} is armed", remedy="write parameters while it stands")
        return Done(
            {"name": name, "value": await protocols.write_parameter(self._vehicle, name, args.value, patience=patience)}
        )

    @verb(Terms(uses=(), guarded=False))
    async def release(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Take the vehicle back from a pilot; a failsafe that is in force keeps it."""
        if self._vehicle.condition.failsafe and self._vehicle.armed:
            raise RobotFailure(
                "refused",
                f"{self._vehicle.name} is under a failsafe: {self._vehicle.condition.failsafe}",
                remedy="`land` and `return_home` are taken all the same",
            )
        before = self._vehicle.control.release()
        if before is not None:
            log.warning("vehicle taken back by an operator", robot=self._vehicle.name, from_=before.by, why=before.why)
        return Done({"was": "" if before is None else before.why} | self._craft.where())
