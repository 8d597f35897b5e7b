"""What a gateway says to vehicles of its own accord: that it is there, and what it wants to be told."""

from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message, make
from appliance.robots.mavlink.vehicle import Vehicle

STREAMS_HZ = {
    "GLOBAL_POSITION_INT": 5.0,
    "SYS_STATUS": 1.0,
    "MISSION_CURRENT": 2.0,
    "HOME_POSITION": 0.2,
    "BATTERY_STATUS": 0.5,
    "EKF_STATUS_REPORT": 1.0,
    "FENCE_STATUS": 1.0,
}
"""What is asked of a vehicle that has come online; ArduPilot sends little of it by itself."""


def heartbeat() -> Message:
    """Return the heartbeat of an onboard computer."""
    return make(
        "HEARTBEAT",
        type=dialect.TYPE_ONBOARD,
        autopilot=dialect.AUTOPILOT_NONE,
        base_mode=0,
        custom_mode=0,
        system_status=dialect.STATE_ACTIVE,
        mavlink_version=3,
    )


def ask_streams(vehicle: Vehicle) -> None:
    """Ask a vehicle for messages at their rates (MAV_CMD_SET_MESSAGE_INTERVAL); asked again when it is back online."""
    for stream, hz in STREAMS_HZ.items():
        fields = {f"param{number}": 0.0 for number in range(3, 8)}
        vehicle.send(
            make(
                "COMMAND_LONG",
                target_system=vehicle.system,
                target_component=vehicle.component,
                command=dialect.SET_INTERVAL,
                confirmation=0,
                param1=float(dialect.constant(f"MAVLINK_MSG_ID_{stream}")),
                param2=1e6 / hz,
                **fields,
            )
        )
