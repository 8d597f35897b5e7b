"""The simulated multirotor: how ArduCopter's modes fly.

Take-off in GUIDED alone or by a mission, landing and return until it has disarmed, circles by LOITER_TURNS.
"""

import math

from appliance.model import Site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import COPTER_MODES, Message
from appliance.robots.mavlink.vehicle import COPTER
from workshop.robots import parameters
from workshop.robots.autopilot import Autopilot
from workshop.robots.flight import CLIMB_MPS, Flight, Point

_HAND_MPS = 5.0
_AHEAD_RAD = 0.5
"""How far ahead on a circle it aims."""


class SimCopter(Autopilot[Flight]):
    """One vehicle. `handle` returns answers; `step` moves and returns what it says by itself."""

    modes = COPTER
    kind = dialect.TYPE_QUADROTOR
    armable = frozenset({"STABILIZE", "GUIDED", "LOITER", "ALT_HOLD", "POSHOLD"})

    def __init__(self, *, system: int, site: Site, home: tuple[float, float], battery_percent: float = 100.0) -> None:
        super().__init__(system=system, site=site, home=home, parameters=parameters.COPTER)
        self.flight = Flight(battery_percent=battery_percent, speed=self.parameters["WPNAV_SPEED"] / 100.0)
        self.mode = COPTER_MODES["STABILIZE"]
        self._loiter: Point | None = None
        self._arrived_at: float | None = None
        self._turned = 0.0
        self._angle: float | None = None

    def do(self, command: int, values: tuple[float, ...], at: tuple[int, int, float]) -> int:
        """Take off or land; MAV_RESULT."""
        del values
        flight = self.flight
        if command == dialect.TAKEOFF:
            if not flight.armed or not self.in_mode("GUIDED") or not flight.landed or at[2] <= 0:
                self.say(4, "takeoff needs GUIDED, armed, on the ground")
                return dialect.FAILED
            self.takeoffs += 1
            flight.target = flight.position._replace(z=at[2])
            return dialect.ACCEPTED
        if command == dialect.LAND:
            return dialect.ACCEPTED if self.set_mode(COPTER_MODES["LAND"]) else dialect.FAILED
        return dialect.UNSUPPORTED

    def enter(self, name: str) -> None:
        """Begin what the mode does; all but AUTO hold, descend or return."""
        flight = self.flight
        here = flight.position
        if name == "LAND":
            flight.target = here._replace(z=-1.0)
        elif name in ("RTL", "SMART_RTL"):
            self._begin_return()
        else:
            flight.target = here if flight.armed and not flight.landed else None
            if name == "AUTO" and flight.armed and not flight.landed:
                self.start_mission()

    def can_go(self) -> bool:
        """Whether it is in the air."""
        return not self.flight.landed

    def begin(self, number: int) -> None:
        """Begin an item that takes time."""
        item = self.board.items[number]
        here = self.flight.position
        self._arrived_at, self._turned, self._angle = None, 0.0, None
        match item.command:
            case dialect.TAKEOFF:
                self.takeoffs += 1
                self.flight.target = here._replace(z=item.point.z)
            case dialect.LAND:
                self.flight.target = here._replace(z=0.0)
            case dialect.RETURN:
                self._begin_return()
            case _:
                self.flight.target = item.point

    def move(self) -> None:
        """Do what the mode does next."""
        flight = self.flight
        if flight.battery_percent <= 0.0 and not flight.landed:
            self.say(0, "battery empty: motors stopped")
            self.disarm(force=True)
        elif self.in_mode("AUTO") and self.running:
            self._fly_item()
        elif (self.in_mode("LAND") and flight.landed) or (self.in_mode("RTL", "SMART_RTL") and self._returned()):
            self.disarm(force=False)

    def _fly_item(self) -> None:
        flight = self.flight
        item = self.board.items[self.at]
        if item.command == dialect.RETURN:
            if self._returned():
                self.reached()
                self.disarm(force=False)
        elif item.command == dialect.LOITER_TURNS:
            self._circle(item.point, item.parameters[2] or 10.0, max(item.parameters[0], 0.1))
        elif flight.target is not None and flight.near(flight.target):
            if self._arrived_at is None:
                self._arrived_at = self.clock
            stays = item.parameters[0] if item.command == dialect.WAYPOINT else 0.0
            if self.clock - self._arrived_at >= stays:
                self.reached()
                if item.command == dialect.LAND:
                    self.disarm(force=False)

    def _circle(self, centre: Point, radius: float, turns: float) -> None:
        """Fly round a point; a negative radius goes counter-clockwise."""
        x, y = self.flight.position.x - centre.x, self.flight.position.y - centre.y
        angle = math.atan2(x, y)  # clockwise from north
        on_it = abs(math.hypot(x, y) - abs(radius)) <= max(1.0, 0.15 * abs(radius))
        way = 1.0 if radius > 0 else -1.0
        if on_it:
            if self._angle is not None:
                self._turned += way * math.remainder(angle - self._angle, math.tau)
            self._angle = angle
        if self._turned >= math.tau * turns:
            self.reached()
            return
        aim = angle + way * (_AHEAD_RAD if on_it else 0.0)
        self.flight.target = Point(
            centre.x + abs(radius) * math.sin(aim), centre.y + abs(radius) * math.cos(aim), centre.z
        )

    def _begin_return(self) -> None:
        here = self.flight.position
        height = self.parameters["RTL_ALT"] / 100.0
        self._loiter = Point(here.x, here.y, max(here.z, height)) if not self.flight.landed else None
        self.flight.target = self._loiter

    def _returned(self) -> bool:
        """Go on with the return: up, over home, down; whether it stands."""
        flight = self.flight
        if self._loiter is None:
            return flight.landed
        if flight.near(self._loiter):
            over = Point(0.0, 0.0, self._loiter.z)
            if flight.near(over):
                self._loiter = None
                flight.target = Point(0.0, 0.0, -1.0)
            else:
                self._loiter = flight.target = over
        return False

    def guided_velocity(self, message: Message) -> Point:
        """Return velocities in the body's frame as east, north and up."""
        angle = math.radians(self.flight.heading_deg)
        east = message.vx * math.sin(angle) + message.vy * math.cos(angle)
        north = message.vx * math.cos(angle) - message.vy * math.sin(angle)
        return Point(east, north, -message.vz)

    def hand_velocity(self, held: list[float]) -> Point:
        """Return what sticks ask for: roll and pitch across, throttle up."""
        roll, pitch, throttle, _ = held
        angle = math.radians(self.flight.heading_deg)
        forward, right = -pitch * _HAND_MPS, roll * _HAND_MPS
        east = forward * math.sin(angle) + right * math.cos(angle)
        north = forward * math.cos(angle) - right * math.sin(angle)
        return Point(east, north, throttle * CLIMB_MPS)
