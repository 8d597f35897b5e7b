"""Moves a MAVLink vehicle by hand, for a moment at a time: velocities in its guided mode, then it holds by itself.

SET_POSITION_TARGET_LOCAL_NED with velocities in the body's frame (ArduPilot, "Copter Commands in Guided Mode" and
"Rover Commands in Guided Mode"). The autopilot stops by itself when none came for `GUID_TIMEOUT`, 3 s; the end is sent.
"""

import asyncio

from appliance.robots.commands import Done
from appliance.robots.mavlink.craft import Craft
from appliance.robots.policy import check_velocity
from appliance.robots.verbs import RobotFailure, VelocityArgs

_EVERY_S = 0.1


class ByHand:
    """Of one vehicle."""

    def __init__(self, craft: Craft) -> None:
        self._craft = craft

    async def velocity(self, args: VelocityArgs) -> Done:
        """Move for `for_s` seconds; RobotFailure where it may not, or is on the ground and flies."""
        craft, vehicle = self._craft, self._craft.vehicle
        check_velocity(craft.site, await craft.fix(), args, flies=vehicle.flies)
        if not vehicle.armed or (vehicle.flies and not vehicle.airborne):
            what = "is on the ground" if vehicle.flies else "is not armed"
            first = "takeoff" if vehicle.flies else "arm"
            raise RobotFailure("precondition", f"{vehicle.name} {what}", remedy=f"`{first}` first")
        if vehicle.mode != craft.modes.guided:
            await craft.mode(craft.modes.guided)
        loop = asyncio.get_running_loop()
        until = loop.time() + args.for_s
        try:
            while loop.time() < until:
                craft.check_control()
                craft.push(args)
                await asyncio.sleep(min(_EVERY_S, max(0.0, until - loop.time())))
        finally:
            craft.push(VelocityArgs())
        return Done({"moved_s": args.for_s} | craft.where())
