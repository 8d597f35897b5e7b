"""What the simulated copter tells of itself: one MAVLink message by name, from its present state. Pure."""

import math
from typing import TYPE_CHECKING, Any

from appliance.robots.geo import to_globe
from appliance.robots.mavlink.dialect import Message, make

if TYPE_CHECKING:
    from appliance.robots.sim.copter import SimCopter

_CELLS = 4
_FULL_MV, _EMPTY_MV = 4200, 3300


def telemetry(copter: "SimCopter", name: str, boot_ms: int) -> Message:
    """Make the message of that name; KeyError for one that the copter does not send."""
    match name:
        case "HEARTBEAT":
            return copter.heartbeat()
        case "MISSION_CURRENT":
            return copter.mission_current()
        case _:
            return make(name, **_MAKERS[name](copter, boot_ms))


def _position(copter: "SimCopter", boot_ms: int) -> dict[str, Any]:
    latitude, longitude, altitude = copter.where()
    east, north, up = copter.flight.velocity
    return {
        "time_boot_ms": boot_ms,
        "lat": round(latitude * 1e7),
        "lon": round(longitude * 1e7),
        "alt": round(altitude * 1e3),
        "relative_alt": round(copter.flight.position.z * 1e3),
        "vx": round(north * 100),
        "vy": round(east * 100),
        "vz": round(-up * 100),
        "hdg": round(copter.flight.heading_deg * 100) % 36000,
    }


def _attitude(copter: "SimCopter", boot_ms: int) -> dict[str, Any]:
    return {
        "time_boot_ms": boot_ms,
        "roll": 0.0,
        "pitch": 0.0,
        "yaw": math.remainder(math.radians(copter.flight.heading_deg), math.tau),
        "rollspeed": 0.0,
        "pitchspeed": 0.0,
        "yawspeed": 0.0,
    }


def _cell_mv(copter: "SimCopter") -> int:
    return round(_EMPTY_MV + (_FULL_MV - _EMPTY_MV) * copter.flight.battery_percent / 100.0)


def _system(copter: "SimCopter", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    sensors = 0b1 | 0b10 | 0b100 | 0b1000 | 0b100000  # gyro, accelerometer, compass, barometer, GPS
    return {
        "onboard_control_sensors_present": sensors,
        "onboard_control_sensors_enabled": sensors,
        "onboard_control_sensors_health": sensors,
        "load": 250,
        "voltage_battery": _CELLS * _cell_mv(copter),
        "current_battery": 1500 if copter.flight.armed else 50,
        "battery_remaining": round(copter.flight.battery_percent),
        "drop_rate_comm": 0,
        "errors_comm": 0,
        "errors_count1": 0,
        "errors_count2": 0,
        "errors_count3": 0,
        "errors_count4": 0,
    }


def _battery(copter: "SimCopter", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    return {
        "id": 0,
        "battery_function": 1,
        "type": 1,
        "temperature": 2500,
        "voltages": [_cell_mv(copter)] * _CELLS + [65535] * (10 - _CELLS),
        "current_battery": 1500 if copter.flight.armed else 50,
        "current_consumed": -1,
        "energy_consumed": -1,
        "battery_remaining": round(copter.flight.battery_percent),
    }


def _gps(copter: "SimCopter", boot_ms: int) -> dict[str, Any]:
    latitude, longitude, altitude = copter.where()
    east, north, _ = copter.flight.velocity
    return {
        "time_usec": boot_ms * 1000,
        "fix_type": 3,
        "lat": round(latitude * 1e7),
        "lon": round(longitude * 1e7),
        "alt": round(altitude * 1e3),
        "eph": 80,
        "epv": 120,
        "vel": round(math.hypot(east, north) * 100),
        "cog": round(copter.flight.heading_deg * 100) % 36000,
        "satellites_visible": 14,
    }


def _hud(copter: "SimCopter", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    east, north, up = copter.flight.velocity
    speed = math.hypot(east, north)
    return {
        "airspeed": speed,
        "groundspeed": speed,
        "heading": round(copter.flight.heading_deg) % 360,
        "throttle": 50 if copter.flight.armed else 0,
        "alt": copter.where()[2],
        "climb": up,
    }


def _extended(copter: "SimCopter", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    return {"vtol_state": 0, "landed_state": 1 if copter.flight.landed else 2}


def _home(copter: "SimCopter", boot_ms: int) -> dict[str, Any]:
    latitude, longitude, altitude = to_globe(copter.site, *copter.home)
    return {
        "latitude": round(latitude * 1e7),
        "longitude": round(longitude * 1e7),
        "altitude": round(altitude * 1e3),
        "x": 0.0,
        "y": 0.0,
        "z": 0.0,
        "q": [1.0, 0.0, 0.0, 0.0],
        "approach_x": 0.0,
        "approach_y": 0.0,
        "approach_z": 0.0,
        "time_usec": boot_ms * 1000,
    }


_MAKERS = {
    "GLOBAL_POSITION_INT": _position,
    "ATTITUDE": _attitude,
    "SYS_STATUS": _system,
    "BATTERY_STATUS": _battery,
    "GPS_RAW_INT": _gps,
    "VFR_HUD": _hud,
    "EXTENDED_SYS_STATE": _extended,
    "HOME_POSITION": _home,
}
