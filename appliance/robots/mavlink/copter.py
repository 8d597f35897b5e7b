"""The verbs of an ArduPilot multirotor: how `goto` becomes a mission, and when it has arrived.

A verb ends when the vehicle says that it is where it should be, never when a command was acknowledged. Modes are
changed by DO_SET_MODE and verified by the heartbeat, since an acknowledgement can be lost or late.

`goto` on the ground arms, and its mission begins with a take-off: an operator who says "go to dock 3" does not
want to hear "not airborne". It lands only when told to.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable
from itertools import pairwise

import msgspec
import structlog

from appliance.model import Pose, Site
from appliance.robots.commands import Done, Verb
from appliance.robots.geo import to_globe, to_site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import make
from appliance.robots.mavlink.protocol import Item, Patience, command, upload
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.settings import RobotsConfig
from appliance.robots.verbs import (
    GotoArgs,
    HoldArgs,
    NoArgs,
    RobotFailure,
    TakeoffArgs,
    check_way,
    cruise,
    in_range,
)

log = structlog.get_logger(__name__)

_POLL_S = 0.1
_CONFIRM_S = 3.5
"""Three heartbeats: the mode is in each."""
_ROUNDS = 4
_NEARER_M = 0.5
"""Coming nearer by less than this is no progress."""
_SETTLED_MPS = 0.5
_MAX_HOLD_S = 86_400.0
_LOWEST_M = 1.0


class Copter:
    """Flies one vehicle."""

    def __init__(self, vehicle: Vehicle, *, site: Site, config: RobotsConfig) -> None:
        self._vehicle = vehicle
        self._site = site
        self._config = config
        self._patience = Patience(timeout_s=config.ack_timeout_s, tries=config.tries)

    def verbs(self) -> dict[str, Verb]:
        """Return what it can do; only `state` for vehicles whose flight modes are not known here."""
        state = Verb(run=self.state)
        if not self._vehicle.commandable:
            return {"state": state}

        def base(run: Callable[..., Awaitable[Done]], *, preempts: bool = False) -> Verb:
            return Verb(run=run, uses=("base",), resumable=True, preempts=preempts)

        return {
            "state": state,
            "goto": base(self.goto),
            "takeoff": base(self.takeoff),
            "land": base(self.land),
            "return_home": base(self.return_home),
            "hold": base(self.hold, preempts=True),
            "arm": base(self.arm),
            "disarm": base(self.disarm),
        }

    def ready(self) -> None:
        """Raise RobotFailure while it cannot be commanded."""
        if not self._vehicle.online:
            raise RobotFailure(
                "robot",
                f"{self._vehicle.name} is offline: no heartbeat for {self._config.heartbeat_lost_s:g} s",
                remedy="check its power and its link",
                retryable=True,
            )

    async def state(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Say what is known of it."""
        info = self._vehicle.info("", tuple(self.verbs()))
        return Done(
            {**msgspec.to_builtins(info), "flies": info.flies, "armed": info.armed, "online": info.online}
            | self._where()
        )

    async def goto(self, args: GotoArgs) -> Done:
        """Fly through the waypoints by an uploaded mission and wait for arrival at the last."""
        vehicle = self._vehicle
        start = await self._fix()
        points = check_way(self._site, start, args, flies=True)
        ground_z = start.z - vehicle.relative_m
        grounded = not vehicle.airborne
        altitude_z = ground_z + self._config.takeoff_altitude_m if grounded else max(start.z, ground_z + _LOWEST_M)
        way = cruise(points, min(altitude_z, self._site.altitude_limit_m))
        items = self._mission(way, ground_z, args.speed_mps, grounded=grounded)
        if vehicle.armed:
            # Held in place first: an autopilot does not take a new mission while it flies the old one.
            await self._mode("GUIDED")
        await upload(vehicle, items, patience=self._patience)
        if not vehicle.armed:
            await self._mode("GUIDED")
            await self._arm()
        vehicle.forget_mission()
        await self._mode("AUTO")
        await command(vehicle, dialect.MISSION_START, 0, 0, patience=self._patience)
        end, last = way[-1], len(items) - 1
        settled = 0

        def arrived() -> bool:
            nonlocal settled
            near = self._distance(*end) <= self._config.arrival_m
            # The reports can be lost; standing at the end for two seconds says the same.
            settled = settled + 1 if near and vehicle.speed_mps < _SETTLED_MPS else 0
            return near and (last in vehicle.reached or vehicle.mission_complete or settled * _POLL_S >= 2.0)

        await self._travel("goto", "AUTO", arrived, lambda: self._left(way, last))
        return Done({"waypoints": len(way), "distance_m": round(self._distance(*end), 2)} | self._where())

    async def takeoff(self, args: TakeoffArgs) -> Done:
        """Climb to an altitude above home; from the air: climb or sink there."""
        altitude = self._config.takeoff_altitude_m if args.altitude_m is None else args.altitude_m
        in_range("takeoff", "altitude_m", altitude, _LOWEST_M, max(self._site.altitude_limit_m, _LOWEST_M))
        vehicle = self._vehicle
        await self._fix()
        await self._mode("GUIDED")
        if not vehicle.airborne:
            await self._arm()
            await command(vehicle, dialect.TAKEOFF, 0, 0, 0, 0, 0, 0, altitude, patience=self._patience)
        tolerance = max(0.5, 0.05 * altitude)
        latitude, longitude = vehicle.latitude_deg, vehicle.longitude_deg
        rounds = 0

        def there() -> bool:
            nonlocal rounds
            rounds += 1
            # Position targets are not acknowledged, so they are repeated; an autopilot that climbs by NAV_TAKEOFF
            # gets none before it is up.
            if vehicle.airborne and abs(vehicle.relative_m - altitude) > tolerance and rounds % 20 == 0:
                self._target(latitude, longitude, altitude)
            return abs(vehicle.relative_m - altitude) <= tolerance

        await self._travel("takeoff", "GUIDED", there, lambda: abs(vehicle.relative_m - altitude))
        return Done({"altitude_m": round(vehicle.relative_m, 2)} | self._where())

    async def land(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Come down where it is, until it has disarmed."""
        if self._vehicle.armed:
            await self._mode("LAND")
            await self._travel("land", "LAND", self._landed, lambda: self._vehicle.relative_m)
        return Done({"landed": True} | self._where())

    async def return_home(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Fly home and land, until it has disarmed."""
        vehicle = self._vehicle
        if not vehicle.armed:
            return Done({"landed": True, "moved": False} | self._where())
        await self._mode("RTL")
        home = vehicle.home

        def left() -> float:
            if home is None:
                return vehicle.relative_m
            pose = self._position()
            x, y, _ = self._site_point(*home)
            # Coming down counts once it is over home; climbing to the return height before is progress too.
            return math.hypot(pose.x - x, pose.y - y) * 10.0 + abs(vehicle.relative_m)

        await self._travel("return_home", "RTL", self._landed, left)
        return Done({"landed": True, "moved": True} | self._where())

    async def hold(self, args: HoldArgs) -> Done:
        """Stop where it is; with a duration, stay that long."""
        in_range("hold", "duration_s", args.duration_s, 0.0, _MAX_HOLD_S)
        await self.halt()
        await asyncio.sleep(args.duration_s or 0.0)
        return Done({"held_s": args.duration_s or 0.0} | self._where())

    async def arm(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Arm the motors."""
        if not self._vehicle.armed:
            await self._mode("GUIDED")
            await self._arm()
        return Done(self._where())

    async def disarm(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Disarm; the autopilot refuses in the air."""
        if self._vehicle.armed:
            await command(self._vehicle, dialect.ARM, 0.0, patience=self._patience)
            await self._confirm(lambda: not self._vehicle.armed)
        return Done(self._where())

    async def halt(self) -> None:
        """Hold position if it is in the air; RobotFailure when it does not answer."""
        if self._vehicle.online and self._vehicle.commandable and self._vehicle.airborne:
            await self._mode("GUIDED")

    # --- pieces ------------------------------------------------------------------------------------------------

    def _mission(
        self, way: tuple[tuple[float, float, float], ...], ground_z: float, speed_mps: float | None, *, grounded: bool
    ) -> list[Item]:
        here = (self._vehicle.latitude_deg, self._vehicle.longitude_deg)
        # ArduPilot keeps home in item 0 and flies from item 1.
        items = [Item(command=dialect.WAYPOINT, latitude_deg=here[0], longitude_deg=here[1])]
        if grounded:
            items.append(
                Item(
                    command=dialect.TAKEOFF,
                    latitude_deg=here[0],
                    longitude_deg=here[1],
                    relative_m=way[0][2] - ground_z,
                )
            )
        if speed_mps is not None:
            items.append(Item(command=dialect.CHANGE_SPEED, parameters=(1.0, speed_mps, -1.0, 0.0)))
        for x, y, z in way:
            latitude, longitude, _ = to_globe(self._site, x, y, z)
            items.append(
                Item(
                    command=dialect.WAYPOINT,
                    latitude_deg=latitude,
                    longitude_deg=longitude,
                    relative_m=z - ground_z,
                )
            )
        return items

    async def _mode(self, name: str) -> None:
        wanted = dialect.COPTER_MODES[name]
        for _ in range(_ROUNDS):
            await command(self._vehicle, dialect.SET_MODE, dialect.CUSTOM_MODE_FLAG, wanted, patience=self._patience)
            if await self._confirm(lambda: self._vehicle.custom_mode == wanted):
                return
        raise RobotFailure(
            "robot", f"{self._vehicle.name} stays in {self._vehicle.mode} instead of {name}", retryable=True
        )

    async def _arm(self) -> None:
        if self._vehicle.armed:
            return
        await command(self._vehicle, dialect.ARM, 1.0, patience=self._patience)
        if not await self._confirm(lambda: self._vehicle.armed):
            raise RobotFailure("robot", f"{self._vehicle.name} acknowledged arming and is not armed", retryable=True)

    async def _confirm(self, holds: Callable[[], bool]) -> bool:
        """Wait for the vehicle to say so itself."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + _CONFIRM_S
        while not holds():
            if loop.time() >= deadline:
                return False
            await asyncio.sleep(_POLL_S / 2)
        return True

    async def _travel(self, verb: str, mode: str, there: Callable[[], bool], left: Callable[[], float]) -> None:
        """Wait until `there`; RobotFailure when it no longer comes nearer or somebody else has taken over."""
        vehicle = self._vehicle
        loop = asyncio.get_running_loop()
        best, since = left(), loop.time()
        while not there():
            await asyncio.sleep(_POLL_S)
            now, distance = loop.time(), left()
            if vehicle.custom_mode != dialect.COPTER_MODES[mode]:
                raise RobotFailure(
                    "robot",
                    f"{vehicle.name} left {mode} for {vehicle.mode} during {verb}: {vehicle.text or 'not by us'}",
                    remedy="a pilot or a failsafe has taken over; see to the vehicle",
                )
            if not vehicle.armed and verb in ("goto", "takeoff"):
                raise RobotFailure("robot", f"{vehicle.name} disarmed during {verb}: {vehicle.text}".rstrip(": "))
            if distance < best - _NEARER_M:
                best, since = distance, now
            elif now - since > self._config.stall_s and not there():
                await self.halt()
                raise RobotFailure(
                    "robot",
                    f"{vehicle.name} has not come nearer for {self._config.stall_s:g} s during {verb}, "
                    f"{distance:.1f} m were left",
                    remedy="look at the vehicle and its way",
                    retryable=True,
                )

    def _target(self, latitude_deg: float, longitude_deg: float, relative_m: float) -> None:
        self._vehicle.send(
            make(
                "SET_POSITION_TARGET_GLOBAL_INT",
                time_boot_ms=0,
                target_system=self._vehicle.system,
                target_component=self._vehicle.component,
                coordinate_frame=dialect.FRAME_RELATIVE,
                type_mask=0x0DF8,  # position alone counts
                lat_int=round(latitude_deg * 1e7),
                lon_int=round(longitude_deg * 1e7),
                alt=relative_m,
                vx=0.0,
                vy=0.0,
                vz=0.0,
                afx=0.0,
                afy=0.0,
                afz=0.0,
                yaw=0.0,
                yaw_rate=0.0,
            )
        )

    def _landed(self) -> bool:
        return not self._vehicle.armed

    async def _fix(self) -> Pose:
        """Wait a little for the position: a vehicle that has just come online has not told it yet."""
        await self._confirm(lambda: self._vehicle.fixed)
        return self._position()

    def _position(self) -> Pose:
        pose = self._vehicle.pose
        if pose is None:
            raise RobotFailure(
                "robot", f"{self._vehicle.name} does not know where it is", remedy="wait for its GPS", retryable=True
            )
        return pose

    def _site_point(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> tuple[float, float, float]:
        return to_site(self._site, latitude_deg, longitude_deg, altitude_m)

    def _distance(self, x: float, y: float, z: float) -> float:
        pose = self._position()
        return math.dist((pose.x, pose.y, pose.z), (x, y, z))

    def _left(self, way: tuple[tuple[float, float, float], ...], last: int) -> float:
        """Metres left to fly: to the next waypoint by the mission's own count (item `last`), and along the rest."""
        behind = max(0, min(len(way) - 1, last - self._vehicle.mission_at))
        rest = way[len(way) - 1 - behind :]
        return self._distance(*rest[0]) + sum(math.dist(one, other) for one, other in pairwise(rest))

    def _where(self) -> dict[str, object]:
        pose = self._vehicle.pose
        return {
            "pose": None if pose is None else {"x": pose.x, "y": pose.y, "z": pose.z, "heading_deg": pose.heading_deg},
            "battery_percent": self._vehicle.battery_percent,
            "mode": self._vehicle.mode,
        }
