"""What keeps the simulated vehicles safe: the checks before arming, and the failsafes, as ArduPilot words them.

A failsafe that is in force shows in `active`, and changes the mode once, when it begins: a pilot may take the vehicle
over afterwards.
"""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from workshop.robots.autopilot import AnyAutopilot

_GONE = ("RTL", "SMART_RTL", "LAND")
"""Modes in which a vehicle is on its way out already."""


class Failsafes:
    """Of one vehicle; real seconds for the ground station's heartbeats, since those come in real time."""

    def __init__(self) -> None:
        self.active: tuple[str, ...] = ()
        self.blind = False
        """It does not know where it is."""
        self.breach = 0
        """FENCE_BREACH: 0 none, 2 too high, 3 too far."""
        self.breaches = 0
        self._station_at: float | None = None

    def ground_station(self, now: float) -> None:
        """Note a heartbeat of the ground station that the vehicle belongs to."""
        self._station_at = now

    def disarmed(self) -> None:
        """Forget what only counts while it moves."""
        self.breach = 0

    def step(self, vehicle: "AnyAutopilot", now: float) -> None:
        """Look at everything; say and do what follows from what has begun or ended."""
        found = tuple(self._found(vehicle, now)) if vehicle.flight.armed else ()
        self.blind = bool(vehicle.parameters["SIM_GPS_DISABLE"])
        for name in found:
            if name not in self.active:
                self._begin(vehicle, name)
        for name in self.active:
            if name not in found and vehicle.flight.armed:
                vehicle.say(5, f"{_WORDS[name]} cleared")
        self.active = found

    def _found(self, vehicle: "AnyAutopilot", now: float) -> Iterator[str]:
        parameters, flight = vehicle.parameters, vehicle.flight
        if flight.battery_percent < parameters["BATT_CRT_PCT"]:
            yield "battery-critical"
        elif flight.battery_percent < parameters["BATT_LOW_PCT"]:
            yield "battery"
        heard = self._station_at
        if parameters["FS_GCS_ENABLE"] and heard is not None and now - heard > parameters["FS_GCS_TIMEOUT"]:
            yield "gcs"
        if parameters["FS_THR_ENABLE"] and parameters["SIM_RC_FAIL"]:
            yield "radio"
        if parameters["SIM_GPS_DISABLE"]:
            yield "ekf"
        self.breach = _breach(vehicle)
        if self.breach:
            yield "fence"

    def _begin(self, vehicle: "AnyAutopilot", name: str) -> None:
        flight = vehicle.flight
        flies = bool(vehicle.modes.land)
        if name == "fence":
            self.breaches += 1
            if not vehicle.parameters["FENCE_ACTION"]:
                vehicle.say(4, "Fence breached")
                return
        leaves = name in ("battery-critical", "ekf")
        mode = (vehicle.modes.land if leaves else vehicle.modes.home) if flies else "HOLD"
        if flies and flight.landed:
            vehicle.say(2, f"{_WORDS[name]}: disarming")
            vehicle.disarm(force=True)
            return
        if vehicle.in_mode(*_GONE) and not leaves:
            vehicle.say(3, _WORDS[name])
            return
        doing = "returning" if mode == vehicle.modes.home else "landing" if flies else "stopping"
        vehicle.say(3, f"{_WORDS[name]}: {doing}")
        vehicle.change_mode(mode)


_WORDS = {
    "battery": "battery failsafe",
    "battery-critical": "critical battery failsafe",
    "gcs": "GCS failsafe",
    "radio": "radio failsafe",
    "ekf": "EKF failsafe",
    "fence": "fence breached",
}


def arming_problems(vehicle: "AnyAutopilot") -> Iterator[str]:
    """Yield what speaks against arming, in words."""
    parameters, flight = vehicle.parameters, vehicle.flight
    if not parameters["ARMING_CHECK"]:
        return
    if flight.battery_percent < parameters["BATT_ARM_PCT"]:
        yield f"battery at {flight.battery_percent:.0f} %"
    if parameters["SIM_GPS_DISABLE"]:
        yield "Need Position Estimate"
    if parameters["FS_THR_ENABLE"] and parameters["SIM_RC_FAIL"]:
        yield "Radio failsafe on"
    if _breach(vehicle):
        yield "vehicle outside fence"


def _breach(vehicle: "AnyAutopilot") -> int:
    """Return FENCE_BREACH: 3 outside the circle round home, 2 above the ceiling, 0 none."""
    parameters, position = vehicle.parameters, vehicle.flight.position
    if not parameters["FENCE_ENABLE"]:
        return 0
    if math.hypot(position.x, position.y) > parameters["FENCE_RADIUS"]:
        return 3
    return 2 if vehicle.modes.land and position.z > parameters["FENCE_ALT_MAX"] else 0
