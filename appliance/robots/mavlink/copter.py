"""The verbs of an ArduPilot multirotor that are its own: how `goto` becomes a mission, take-off, landing, return.

`goto` on the ground arms, and its mission begins with a take-off: an operator who says "go to dock 3" does not
want to hear "not airborne". It lands only when told to.
"""

import math

from appliance.robots.commands import Done
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.craft import Craft
from appliance.robots.mavlink.missions import LOWEST_M, Missions
from appliance.robots.mavlink.protocol import command
from appliance.robots.policy import check_way
from appliance.robots.verbs import GotoArgs, NoArgs, TakeoffArgs, in_range


class Copter:
    """Flies one vehicle."""

    def __init__(self, craft: Craft, missions: Missions) -> None:
        self._craft = craft
        self._missions = missions

    async def goto(self, args: GotoArgs) -> Done:
        """Fly through the waypoints by an uploaded mission and wait for arrival at the last."""
        craft = self._craft
        points = check_way(craft.site, await craft.fix(), args, flies=True)
        way = self._missions.heights(points)
        await self._missions.fly("goto", way, args.speed_mps)
        return Done({"waypoints": len(way), "distance_m": round(craft.distance(way[-1]), 2)} | craft.where())

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
