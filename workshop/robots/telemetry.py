"""What the simulated vehicles tell of themselves: one MAVLink message by name, from their present state. Pure."""

import math
from typing import TYPE_CHECKING, Any

from appliance.model.site import to_globe
from appliance.robots.mavlink.dialect import Message, constant, make
from appliance.robots.mavlink.vehicle import PREARM_CHECK
from workshop.robots.safety import arming_problems

if TYPE_CHECKING:
    from workshop.robots.autopilot import AnyAutopilot

_CELLS = 4
_GPS_SENSOR, _RADIO = constant("MAV_SYS_STATUS_SENSOR_GPS"), constant("MAV_SYS_STATUS_SENSOR_RC_RECEIVER")
_SENSORS = sum(
    constant(f"MAV_SYS_STATUS_{name}")
    for name in (
        "SENSOR_3D_GYRO",
        "SENSOR_3D_ACCEL",
        "SENSOR_3D_MAG",
        "SENSOR_ABSOLUTE_PRESSURE",
        "SENSOR_ANGULAR_RATE_CONTROL",
        "SENSOR_ATTITUDE_STABILIZATION",
        "SENSOR_YAW_POSITION",
        "SENSOR_Z_ALTITUDE_CONTROL",
        "SENSOR_XY_POSITION_CONTROL",
        "SENSOR_MOTOR_OUTPUTS",
        "AHRS",
        "SENSOR_BATTERY",
    )
)
_WELL_FLAGS = 0b11_0011_1111
"""EKF_STATUS_FLAGS: attitude, velocities, positions, and that they are predicted to stay so."""
_BLIND_FLAGS = 0b00_1010_0101 | 0x80
"""The same without GPS: attitude, vertical velocity, height, constant position."""
_FULL_MV, _EMPTY_MV = 4200, 3300


def telemetry(vehicle: "AnyAutopilot", name: str, boot_ms: int) -> Message:
    """Make the message of that name; KeyError for one that it does not send."""
    match name:
        case "HEARTBEAT":
            return vehicle.heartbeat()
        case "MISSION_CURRENT":
            return vehicle.mission_current()
        case _:
            return make(name, **_MAKERS[name](vehicle, boot_ms))


def _position(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    latitude, longitude, altitude = vehicle.where()
    east, north, up = vehicle.flight.velocity
    return {
        "time_boot_ms": boot_ms,
        "lat": round(latitude * 1e7),
        "lon": round(longitude * 1e7),
        "alt": round(altitude * 1e3),
        "relative_alt": round(vehicle.flight.position.z * 1e3),
        "vx": round(north * 100),
        "vy": round(east * 100),
        "vz": round(-up * 100),
        "hdg": round(vehicle.flight.heading_deg * 100) % 36000,
    }


def _attitude(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    return {
        "time_boot_ms": boot_ms,
        "roll": 0.0,
        "pitch": 0.0,
        "yaw": math.remainder(math.radians(vehicle.flight.heading_deg), math.tau),
        "rollspeed": 0.0,
        "pitchspeed": 0.0,
        "yawspeed": 0.0,
    }


def _cell_mv(vehicle: "AnyAutopilot") -> int:
    return round(_EMPTY_MV + (_FULL_MV - _EMPTY_MV) * vehicle.flight.battery_percent / 100.0)


def _system(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    # Attitude, yaw, altitude and position controllers, motors, RC, estimator, battery, arming checks.
    sensors = _SENSORS | _GPS_SENSOR | _RADIO | PREARM_CHECK
    healthy = sensors
    if vehicle.failsafes.blind:
        healthy &= ~_GPS_SENSOR
    if vehicle.parameters["SIM_RC_FAIL"]:
        healthy &= ~_RADIO
    if next(arming_problems(vehicle), ""):
        healthy &= ~PREARM_CHECK
    return {
        "onboard_control_sensors_present": sensors,
        "onboard_control_sensors_enabled": sensors,
        "onboard_control_sensors_health": healthy,
        "load": 250,
        "voltage_battery": _CELLS * _cell_mv(vehicle),
        "current_battery": 1500 if vehicle.flight.armed else 50,
        "battery_remaining": round(vehicle.flight.battery_percent),
        "drop_rate_comm": 0,
        "errors_comm": 0,
        "errors_count1": 0,
        "errors_count2": 0,
        "errors_count3": 0,
        "errors_count4": 0,
    }


def _battery(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    return {
        "id": 0,
        "battery_function": 1,
        "type": 1,
        "temperature": 2500,
        "voltages": [_cell_mv(vehicle)] * _CELLS + [65535] * (10 - _CELLS),
        "current_battery": 1500 if vehicle.flight.armed else 50,
        "current_consumed": -1,
        "energy_consumed": -1,
        "battery_remaining": round(vehicle.flight.battery_percent),
        "charge_state": _charge_state(vehicle),
    }


def _charge_state(vehicle: "AnyAutopilot") -> int:
    """MAV_BATTERY_CHARGE_STATE: 1 ok, 2 low, 3 critical."""
    percent = vehicle.flight.battery_percent
    if percent < vehicle.parameters["BATT_CRT_PCT"]:
        return 3
    return 2 if percent < vehicle.parameters["BATT_LOW_PCT"] else 1


def _estimator(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    return {
        "flags": _BLIND_FLAGS if vehicle.failsafes.blind else _WELL_FLAGS,
        "velocity_variance": 0.05,
        "pos_horiz_variance": 1.2 if vehicle.failsafes.blind else 0.05,
        "pos_vert_variance": 0.05,
        "compass_variance": 0.02,
        "terrain_alt_variance": 0.0,
        "airspeed_variance": 0.0,
    }


def _fence(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    failsafes = vehicle.failsafes
    return {
        "breach_status": 1 if failsafes.breach else 0,
        "breach_count": failsafes.breaches,
        "breach_type": failsafes.breach,
        "breach_time": boot_ms if failsafes.breach else 0,
        "breach_mitigation": 0,
    }


def _version(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    capabilities = sum(
        constant(f"MAV_PROTOCOL_CAPABILITY_{name}")
        for name in (
            "MISSION_FLOAT",
            "PARAM_FLOAT",
            "MISSION_INT",
            "COMMAND_INT",
            "SET_POSITION_TARGET_GLOBAL_INT",
            "MAVLINK2",
        )
    )
    return {
        "capabilities": capabilities,
        "flight_sw_version": 0x04_05_00_FF,
        "middleware_sw_version": 0,
        "os_sw_version": 0,
        "board_version": 0,
        "flight_custom_version": [0] * 8,
        "middleware_custom_version": [0] * 8,
        "os_custom_version": [0] * 8,
        "vendor_id": 0,
        "product_id": 0,
        "uid": vehicle.system,
    }


def _local(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    x, y, z = vehicle.flight.position
    east, north, up = vehicle.flight.velocity
    return {"time_boot_ms": boot_ms, "x": y, "y": x, "z": -z, "vx": north, "vy": east, "vz": -up}


def _origin(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    latitude, longitude, altitude = to_globe(vehicle.site, *vehicle.home)
    return {
        "latitude": round(latitude * 1e7),
        "longitude": round(longitude * 1e7),
        "altitude": round(altitude * 1e3),
        "time_usec": boot_ms * 1000,
    }


def _channels(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    lost = bool(vehicle.parameters["SIM_RC_FAIL"])
    pulses = {f"chan{number}_raw": 65535 for number in range(1, 19)}
    if not lost:
        pulses |= {"chan1_raw": 1500, "chan2_raw": 1500, "chan3_raw": 1500 if vehicle.flight.armed else 1000}
        pulses |= {"chan4_raw": 1500}
    return {"time_boot_ms": boot_ms, "chancount": 0 if lost else 4, "rssi": 0 if lost else 200, **pulses}


def _gps(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    latitude, longitude, altitude = vehicle.where()
    east, north, _ = vehicle.flight.velocity
    return {
        "time_usec": boot_ms * 1000,
        "fix_type": 0 if vehicle.failsafes.blind else 3,
        "lat": round(latitude * 1e7),
        "lon": round(longitude * 1e7),
        "alt": round(altitude * 1e3),
        "eph": 80,
        "epv": 120,
        "vel": round(math.hypot(east, north) * 100),
        "cog": round(vehicle.flight.heading_deg * 100) % 36000,
        "satellites_visible": 0 if vehicle.failsafes.blind else 14,
    }


def _hud(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    east, north, up = vehicle.flight.velocity
    speed = math.hypot(east, north)
    return {
        "airspeed": speed,
        "groundspeed": speed,
        "heading": round(vehicle.flight.heading_deg) % 360,
        "throttle": 50 if vehicle.flight.armed else 0,
        "alt": vehicle.where()[2],
        "climb": up,
    }


def _extended(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    del boot_ms
    flight = vehicle.flight
    if flight.landed:
        return {"vtol_state": 0, "landed_state": 1}
    coming_down = vehicle.in_mode("LAND") or (flight.target is not None and flight.target.z <= 0.0)
    return {"vtol_state": 0, "landed_state": 4 if coming_down else 2}


def _home(vehicle: "AnyAutopilot", boot_ms: int) -> dict[str, Any]:
    latitude, longitude, altitude = to_globe(vehicle.site, *vehicle.home)
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
    "EKF_STATUS_REPORT": _estimator,
    "FENCE_STATUS": _fence,
    "AUTOPILOT_VERSION": _version,
    "LOCAL_POSITION_NED": _local,
    "GPS_GLOBAL_ORIGIN": _origin,
    "RC_CHANNELS": _channels,
}
AUTOPILOT_NAMES = ("HEARTBEAT", "MISSION_CURRENT", *_MAKERS)
"""Messages that can be asked for."""
STREAMS_HZ: dict[str, float] = {
    "HEARTBEAT": 1.0,
    "SYS_STATUS": 1.0,
    "BATTERY_STATUS": 0.5,
    "GPS_RAW_INT": 2.0,
    "GLOBAL_POSITION_INT": 10.0,
    "LOCAL_POSITION_NED": 4.0,
    "ATTITUDE": 10.0,
    "VFR_HUD": 2.0,
    "MISSION_CURRENT": 1.0,
    "EXTENDED_SYS_STATE": 1.0,
    "HOME_POSITION": 0.2,
    "EKF_STATUS_REPORT": 1.0,
    "FENCE_STATUS": 1.0,
    "RC_CHANNELS": 1.0,
}
"""What it sends unasked."""
