"""How the simulated MAVLink rover moves: it turns towards its target, speeds up, brakes in time. Pure: `step(dt)`.

It has the face of `flight.Flight`, so that one autopilot drives both.
"""

import math

from appliance.model.site import bearing_deg, turn_deg
from workshop.robots.flight import Point

ACCELERATION = 1.5
BRAKE = 2.5
TURN_DPS = 90.0
TOP_MPS = 4.0
DRAIN_PER_M = 0.02
DRAIN_PER_S = 0.002
_SLOW_TURN_DEG = 45.0
_CLOSE_M = 0.1
_STEP_S = 0.05


class Ground:
    """Kinematic state. `target` is driven to at `speed`; None stands."""

    def __init__(self, *, battery_percent: float = 100.0, speed: float = 2.0) -> None:
        self.position = Point(0.0, 0.0, 0.0)
        self.velocity = Point(0.0, 0.0, 0.0)
        self.heading_deg = 0.0
        self.battery_percent = battery_percent
        self.speed = speed
        self.armed = False
        self.target: Point | None = None
        self.hand: Point | None = None
        """Forward speed (x, m/s) and turn (y, degrees/s) that a person's sticks ask for."""
        self.wind = Point(0.0, 0.0, 0.0)
        """Without effect on the ground."""
        self._along = 0.0

    @property
    def landed(self) -> bool:
        """It always stands on the ground."""
        return True

    def near(self, point: Point, within: float = 0.5) -> bool:
        """Tell whether it is that near to a point."""
        return math.hypot(point.x - self.position.x, point.y - self.position.y) <= within

    def step(self, dt: float) -> None:
        """Move on by `dt` seconds."""
        while dt > 1e-9:
            piece = min(dt, _STEP_S)
            self._step(piece)
            dt -= piece

    def _step(self, dt: float) -> None:
        wanted, turn = self._wanted(dt)
        limit = (ACCELERATION if wanted > self._along else BRAKE) * dt
        self._along += max(-limit, min(limit, wanted - self._along))
        if not self.armed or self.battery_percent <= 0.0:
            self._along = 0.0
        self.heading_deg = (self.heading_deg + max(-TURN_DPS * dt, min(TURN_DPS * dt, turn))) % 360.0
        angle = math.radians(self.heading_deg)
        self.velocity = Point(self._along * math.sin(angle), self._along * math.cos(angle), 0.0)
        x, y = self.position.x + self.velocity.x * dt, self.position.y + self.velocity.y * dt
        self.position = Point(x, y, 0.0)
        drain = DRAIN_PER_S * dt + DRAIN_PER_M * abs(self._along) * dt
        self.battery_percent = max(0.0, self.battery_percent - drain)

    def _wanted(self, dt: float) -> tuple[float, float]:
        """Return the speed along its heading and the turn for this step, degrees."""
        if not self.armed:
            return 0.0, 0.0
        if self.hand is not None:
            return max(-TOP_MPS, min(TOP_MPS, self.hand.x)), self.hand.y * dt
        if self.target is None:
            return 0.0, 0.0
        east, north = self.target.x - self.position.x, self.target.y - self.position.y
        distance = math.hypot(east, north)
        if distance <= _CLOSE_M:
            return 0.0, 0.0
        turn = turn_deg(self.heading_deg, bearing_deg(east, north))
        if abs(turn) > _SLOW_TURN_DEG:
            return 0.0, turn  # turns on the spot, as tracked and four-wheel steered ones do
        top = min(self.speed, TOP_MPS, math.sqrt(1.4 * BRAKE * distance))
        return top * math.cos(math.radians(turn)), turn
