"""How the simulated copter moves: a point with limited speed and acceleration, a battery, and flight modes.

It is no model of aerodynamics. It exists so that missions take time, end where they should, and can go wrong in
the ways that matter here: not armed, battery low, mode changed, more wind than it can fly against. Pure: `step(dt)`,
metres, seconds.
"""

import math
from typing import NamedTuple

from appliance.model.site import bearing_deg, turn_deg

ACCELERATION = 2.5
"""m/s²; a brisk multirotor."""
CLIMB_MPS = 2.5
DESCENT_MPS = 1.5
TURN_DPS = 120.0
RTL_HEIGHT_M = 8.0
_CLOSE_M = 0.15
_STEP_S = 0.05
DRAIN_PER_S = 0.03
"""Percent of battery per second in the air: some 55 minutes."""
IDLE_DRAIN_PER_S = 0.001
TOP_AIR_MPS = 12.0
"""Fastest through the air: against more wind than that it is blown away."""
_GRAVITY = 9.81


class Point(NamedTuple):
    """Metres east, north and up of home."""

    x: float
    y: float
    z: float


class Flight:
    """Kinematic state. `target` is flown to at `speed`; None holds position."""

    def __init__(self, *, battery_percent: float = 100.0, speed: float = 5.0) -> None:
        self.position = Point(0.0, 0.0, 0.0)
        self.velocity = Point(0.0, 0.0, 0.0)
        self.heading_deg = 0.0
        self.battery_percent = battery_percent
        self.speed = speed
        self.armed = False
        self.target: Point | None = None
        self.hand: Point | None = None
        """Velocity that a person's sticks ask for; it counts before `target`."""
        self.wind = Point(0.0, 0.0, 0.0)
        """Where the air goes to, m/s."""

    @property
    def landed(self) -> bool:
        """On the ground."""
        return self.position.z <= 0.02

    def near(self, point: Point, within: float = 0.5) -> bool:
        """Tell whether it is that near to a point."""
        return math.dist(self.position, point) <= within

    def step(self, dt: float) -> None:
        """Move on by `dt` seconds, in steps short enough for the braking to be right."""
        while dt > 1e-9:
            piece = min(dt, _STEP_S)
            self._step(piece)
            dt -= piece

    def _step(self, dt: float) -> None:
        flying = self.armed and not self.landed
        air = math.dist(self.velocity, self.wind) / TOP_AIR_MPS if flying else 0.0
        drain = DRAIN_PER_S * (1.0 + air * air) if flying else IDLE_DRAIN_PER_S
        self.battery_percent = max(0.0, self.battery_percent - drain * dt)
        if not self.armed:
            self._fall(dt)
            return
        wanted = self._within_the_air(self._wanted_velocity())
        change = [new - old for new, old in zip(wanted, self.velocity, strict=True)]
        size = math.hypot(*change)
        share = 1.0 if size <= ACCELERATION * dt else ACCELERATION * dt / size
        moved = [old + part * share for old, part in zip(self.velocity, change, strict=True)]
        self.velocity = Point(*moved)
        x, y, z = (place + speed * dt for place, speed in zip(self.position, self.velocity, strict=True))
        if z <= 0.0:
            z = 0.0
            self.velocity = self.velocity._replace(z=max(0.0, self.velocity.z))
        self.position = Point(x, y, z)
        if math.hypot(self.velocity.x, self.velocity.y) > 0.3:
            turn = turn_deg(self.heading_deg, bearing_deg(self.velocity.x, self.velocity.y))
            self.heading_deg = (self.heading_deg + max(-TURN_DPS * dt, min(TURN_DPS * dt, turn))) % 360.0

    def _fall(self, dt: float) -> None:
        if self.landed:
            self.velocity, self.position = Point(0.0, 0.0, 0.0), self.position._replace(z=0.0)
            return
        self.velocity = self.velocity._replace(z=self.velocity.z - _GRAVITY * dt)
        x, y, z = (place + speed * dt for place, speed in zip(self.position, self.velocity, strict=True))
        self.position = Point(x, y, max(0.0, z))

    def _within_the_air(self, wanted: Point) -> Point:
        """Hold a wanted velocity to what can be flown in this wind."""
        if self.landed:
            return wanted
        through = math.hypot(wanted.x - self.wind.x, wanted.y - self.wind.y)
        if through <= TOP_AIR_MPS:
            return wanted
        share = TOP_AIR_MPS / through
        x = self.wind.x + (wanted.x - self.wind.x) * share
        y = self.wind.y + (wanted.y - self.wind.y) * share
        return Point(x, y, wanted.z)

    def _wanted_velocity(self) -> Point:
        if self.hand is not None:
            return self.hand
        if self.target is None:
            return Point(0.0, 0.0, 0.0)
        away = Point(*(there - here for there, here in zip(self.target, self.position, strict=True)))
        across = math.hypot(away.x, away.y)
        # What can still be braked in the distance left, a little less so that it does not overshoot.
        along = 0.0 if across < _CLOSE_M / 3 else min(self.speed, math.sqrt(1.2 * ACCELERATION * across), across * 2.0)
        limit = CLIMB_MPS if away.z > 0 else DESCENT_MPS
        up = math.copysign(min(limit, math.sqrt(1.2 * ACCELERATION * abs(away.z)), abs(away.z) * 2.0), away.z)
        if across < 1e-9:
            return Point(0.0, 0.0, up)
        return Point(away.x / across * along, away.y / across * along, up)
