"""How the simulated rover moves: it turns towards the next waypoint and drives there. Pure: `step(dt)`."""

import math
from collections.abc import Sequence

from appliance.model import Pose
from appliance.model.site import bearing_deg, turn_deg

ACCELERATION = 1.5
TURN_DPS = 120.0
USUAL_MPS = 1.5
"""A warehouse robot among people."""
TOP_MPS = 3.0
ARRIVED_M = 0.1
_DRIVES_WITHIN_DEG = 25.0
_STEP_S = 0.05
DRAIN_PER_M = 0.02
DRAIN_PER_S = 0.001
CHARGE_PER_S = 0.5


class Driving:
    """Where the rover is, how fast it goes, and the way it still has."""

    def __init__(self, x: float, y: float, *, battery_percent: float = 100.0) -> None:
        self.x: float = x
        self.y: float = y
        self.heading_deg = 0.0
        self.speed = 0.0
        self.battery_percent = battery_percent
        self.driven_m = 0.0
        self._way: list[tuple[float, float]] = []
        self._limit = USUAL_MPS
        self._by_hand: tuple[float, float, float] | None = None
        """Speeds east and north, and the turn in degrees a second, that a person asks for."""

    @property
    def pose(self) -> Pose:
        """Its pose, rounded to millimetres and tenths of a degree."""
        return Pose(x=round(self.x, 3), y=round(self.y, 3), z=0.0, heading_deg=round(self.heading_deg, 1) % 360.0)

    @property
    def moving(self) -> bool:
        """Whether it still has a way to go."""
        return bool(self._way)

    def go(self, way: Sequence[tuple[float, float]], speed: float | None) -> None:
        """Begin a way; m/s."""
        self._by_hand = None
        self._way = list(way)
        self._limit = min(speed or USUAL_MPS, TOP_MPS)

    def halt(self) -> None:
        """Stop here; at these speeds within centimetres."""
        self._by_hand = None
        self._way = []
        self.speed = 0.0

    def by_hand(self, east_mps: float, north_mps: float, turn_dps: float) -> None:
        """Move as a person asks, until the next order or a halt; a base with wheels for every direction."""
        self._way = []
        self._by_hand = (east_mps, north_mps, turn_dps)

    def step(self, dt: float) -> None:
        """Move on by `dt` seconds."""
        self.battery_percent = max(0.0, self.battery_percent - DRAIN_PER_S * dt)
        if self._by_hand is not None and self.battery_percent > 0.0:
            east, north, turn = self._by_hand
            self.x, self.y = self.x + east * dt, self.y + north * dt
            self.heading_deg = (self.heading_deg + turn * dt) % 360.0
            self.speed = math.hypot(east, north)
            self.driven_m += self.speed * dt
            self.battery_percent = max(0.0, self.battery_percent - DRAIN_PER_M * self.speed * dt)
            return
        while dt > 1e-9 and self._way and self.battery_percent > 0.0:
            piece = min(dt, _STEP_S)
            self._step(piece)
            dt -= piece

    def _step(self, dt: float) -> None:
        x, y = self._way[0]
        distance = math.hypot(x - self.x, y - self.y)
        if distance <= ARRIVED_M:
            self._way.pop(0)
            if not self._way:
                self.speed = 0.0
            return
        turn = turn_deg(self.heading_deg, bearing_deg(x - self.x, y - self.y))
        self.heading_deg = (self.heading_deg + max(-TURN_DPS * dt, min(TURN_DPS * dt, turn))) % 360.0
        if abs(turn) > _DRIVES_WITHIN_DEG:
            self.speed = 0.0
            return
        wanted = min(self._limit, math.sqrt(2 * ACCELERATION * distance))
        self.speed = min(wanted, self.speed + ACCELERATION * dt)
        step = min(self.speed * dt, distance)
        # Straight at the waypoint: the wheels' own small corrections are not modelled.
        self.x += (x - self.x) / distance * step
        self.y += (y - self.y) / distance * step
        self.driven_m += step
        self.battery_percent = max(0.0, self.battery_percent - DRAIN_PER_M * step)

    def charge(self, dt: float) -> None:
        """Take in charge for `dt` seconds."""
        self.battery_percent = min(100.0, self.battery_percent + CHARGE_PER_S * dt)
