"""The verbs of an ArduPilot rover or boat that are its own: it drives by missions too, and home by RTL."""

import math

from appliance.robots.commands import Done
from appliance.robots.mavlink.craft import Craft
from appliance.robots.mavlink.missions import Missions
from appliance.robots.policy import check_way
from appliance.robots.verbs import GotoArgs, NoArgs, RobotFailure


class Rover:
    """Drives one vehicle."""

    def __init__(self, craft: Craft, missions: Missions) -> None:
        self._craft = craft
        self._missions = missions

    async def goto(self, args: GotoArgs) -> Done:
        """Drive through the waypoints and wait for arrival at the last."""
        craft = self._craft
        points = check_way(craft.site, await craft.fix(), args, flies=False)
        way = self._missions.heights(points)
        await self._missions.fly("goto", way, args.speed_mps)
        return Done({"waypoints": len(way), "distance_m": round(craft.distance(way[-1]), 2)} | craft.where())

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
