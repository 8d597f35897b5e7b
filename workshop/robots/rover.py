"""The simulated MAVLink rover: how ArduRover's modes drive."""

import math

from appliance.model import Site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message
from appliance.robots.mavlink.vehicle import ROVER
from workshop.robots import parameters
from workshop.robots.autopilot import Autopilot
from workshop.robots.flight import Point
from workshop.robots.ground import TURN_DPS, Ground

_HAND_MPS = 2.0


class SimRover(Autopilot[Ground]):
    """One vehicle. `handle` returns answers; `step` moves and returns what it says by itself."""

    modes = ROVER
    kind = dialect.TYPE_ROVER
    armable = frozenset({"MANUAL", "ACRO", "STEERING", "HOLD", "LOITER", "GUIDED"})

    def __init__(self, *, system: int, site: Site, home: tuple[float, float], battery_percent: float = 100.0) -> None:
        super().__init__(system=system, site=site, home=home, parameters=parameters.ROVER)
        self.flight = Ground(battery_percent=battery_percent, speed=self.parameters["WP_SPEED"])
        self.mode = ROVER.numbers["HOLD"]
        self._arrived_at: float | None = None

    def do(self, command: int, values: tuple[float, ...], at: tuple[int, int, float]) -> int:
        """Know nothing more: a rover neither takes off nor lands."""
        del command, values, at
        return dialect.UNSUPPORTED

    def enter(self, name: str) -> None:
        """Begin what the mode does; all but AUTO and RTL stand."""
        self.flight.target = Point(0.0, 0.0, 0.0) if name in ("RTL", "SMART_RTL") else None
        if name == "AUTO" and self.flight.armed:
            self.start_mission()

    def begin(self, number: int) -> None:
        """Begin an item that takes time."""
        item = self.board.items[number]
        self._arrived_at = None
        if item.command == dialect.RETURN:
            self.flight.target = Point(0.0, 0.0, 0.0)
        elif item.command in (dialect.TAKEOFF, dialect.LAND):
            self.flight.target = self.flight.position
        else:
            self.flight.target = item.point._replace(z=0.0)

    def move(self) -> None:
        """Do what the mode does next."""
        flight = self.flight
        if not (self.in_mode("AUTO") and self.running) or flight.target is None:
            return
        if flight.near(flight.target, within=max(0.2, self.parameters["WP_RADIUS"])):
            if self._arrived_at is None:
                self._arrived_at = self.clock
            item = self.board.items[self.at]
            stays = item.parameters[0] if item.command == dialect.WAYPOINT else 0.0
            if self.clock - self._arrived_at >= stays:
                self.reached()
                if not self.running:
                    flight.target = None

    def guided_velocity(self, message: Message) -> Point:
        """Return the speed ahead and the turn; a rover does not go sideways."""
        return Point(message.vx, math.degrees(message.yaw_rate), 0.0)

    def hand_velocity(self, held: list[float]) -> Point:
        """Return what sticks ask for: steering and throttle."""
        steering, _, throttle, _ = held
        return Point(throttle * _HAND_MPS, math.copysign(abs(steering) * TURN_DPS, steering), 0.0)
