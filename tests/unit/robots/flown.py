"""A vehicle that is flown: the simulated autopilot on the other side of a link without a network."""

import asyncio

from appliance.model import Site
from appliance.model.site import to_globe
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.controller import VehicleController
from appliance.robots.mavlink.dialect import Codec, Frame, Message
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.settings import RobotsConfig
from workshop.robots.copter import SimCopter

EVERY_S = 0.02
"""How often it is flown on."""


class Flown:
    """A copter that time passes for, and the craft that commands it; what is sent to it is kept."""

    def __init__(self) -> None:
        self.sim = SimCopter(system=1, site=Site(), home=(0.0, 0.0))
        self.sent: list[Message] = []
        self.silent = False
        self.placed = False
        """Its positions come from the test alone (`tell`)."""
        self.standing = False
        """Whether time stands still for what flies; it answers and tells of itself all the same."""
        self._up, self._down = Codec(242, 191), Codec(1, 1)
        self.vehicle = Vehicle("drone_1", site=Site(), send=self._send, own=242)
        self.craft = VehicleController(self.vehicle, site=Site(), config=RobotsConfig(ack_timeout_s=0.2))
        self.vehicle.online = True

    def _send(self, message: Message) -> None:
        self.sent.append(message)
        asyncio.get_running_loop().call_soon(self._arrive, self._up.pack(message))

    def _arrive(self, raw: bytes) -> None:
        (frame,) = self._up.read(raw)
        assert isinstance(frame, Frame)
        self.say(self.sim.handle(frame, asyncio.get_running_loop().time()))

    def say(self, messages: list[Message]) -> None:
        """Let the vehicle say something, unless it is silent."""
        if not self.silent:
            self.hear(messages)

    def hear(self, messages: list[Message]) -> None:
        """Hear what it says, or said before."""
        for each in messages:
            (frame,) = self._down.read(self._down.pack(each))
            assert isinstance(frame, Frame)
            self.vehicle.hear(frame, asyncio.get_running_loop().time())

    async def live(self) -> None:
        """Let time pass, ten times as fast, with heartbeats and positions."""
        loop = asyncio.get_running_loop()
        while True:
            passed_s = 0.0 if self.standing else EVERY_S * 10
            self.say([*self.sim.step(passed_s, loop.time()), self.sim.heartbeat(), self.sim.mission_current()])
            if not self.placed:
                self.say([self.sim.requested(dialect.constant("MAVLINK_MSG_ID_GLOBAL_POSITION_INT"))])
            await asyncio.sleep(EVERY_S)

    def tell(self, x: float, y: float, at_s: float) -> None:
        """Say that it was there, five metres up, at that time of its own clock."""
        latitude, longitude, altitude = to_globe(Site(), x, y, 5.0)
        where = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7), "alt": round(altitude * 1e3)}
        moving = {"vx": 0, "vy": 0, "vz": 0, "hdg": 0}
        at_ms = round(at_s * 1000)
        self.hear([dialect.make("GLOBAL_POSITION_INT", time_boot_ms=at_ms, relative_alt=5000, **where, **moving)])

    def commands(self, number: int) -> list[Message]:
        """Return the commands of that number that were sent to it."""
        kinds = ("COMMAND_LONG", "COMMAND_INT")
        return [each for each in self.sent if each.get_type() in kinds and each.command == number]

    async def until_still(self) -> None:
        """Give it the time in which it would have gone on."""
        await asyncio.sleep(0.5)

    async def arm(self) -> None:
        """Arm it in GUIDED."""
        await self.craft.mode("GUIDED")
        await self.craft.arm()


class Endless:
    """A way that never ends by itself; how often it was looked at is counted."""

    def __init__(self) -> None:
        self.looks = 0
        self.over: int | None = None
        """It has arrived after so many looks."""

    def left(self) -> float:
        """Return what is left, as a look at the way asks for it."""
        self.looks += 1
        return 100.0

    async def travel(self, craft: VehicleController) -> None:
        """Be under way."""
        await craft.travel("goto", "GUIDED", lambda: self.over is not None and self.looks >= self.over, self.left)
