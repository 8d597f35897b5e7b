"""How a simulated autopilot answers COMMAND_LONG and COMMAND_INT: what it does, and the acknowledgement."""

from typing import TYPE_CHECKING

from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message, make
from workshop.robots.board import Sender
from workshop.robots.telemetry import AUTOPILOT_NAMES, telemetry

if TYPE_CHECKING:
    from workshop.robots.autopilot import AnyAutopilot

_FORCE = 21196
"""The magic number of a forced disarm."""
REQUESTABLE = {dialect.constant(f"MAVLINK_MSG_ID_{name}"): name for name in AUTOPILOT_NAMES}
"""Messages that can be asked for, by id."""
_TELLS = {dialect.GET_HOME: "HOME_POSITION", dialect.CAPABILITIES: "AUTOPILOT_VERSION"}
"""Commands that are answered by a message."""


def answer(vehicle: "AnyAutopilot", message: Message, sender: Sender) -> list[Message]:
    """Do a command and return the answers: its texts, the acknowledgement, what was asked for."""
    values = tuple(float(getattr(message, f"param{number}", 0.0)) for number in range(1, 5))
    whole = hasattr(message, "z")
    height = float(message.z if whole else message.param7)
    x, y = (message.x, message.y) if whole else (round(message.param5 * 1e7), round(message.param6 * 1e7))
    result = _do(vehicle, int(message.command), values, (x, y, height))
    ack = make(
        "COMMAND_ACK",
        command=message.command,
        result=result,
        progress=0,
        result_param2=0,
        target_system=sender[0],
        target_component=sender[1],
    )
    told: list[Message] = []
    if result == dialect.ACCEPTED and message.command == dialect.REQUEST_MESSAGE:
        told = [vehicle.requested(int(values[0]))]
    elif result == dialect.ACCEPTED and message.command in _TELLS:
        told = [telemetry(vehicle, _TELLS[message.command], 0)]
    # What explains a refusal comes before it, as ArduPilot does it.
    return [*vehicle.drain(), ack, *told]


def _do(vehicle: "AnyAutopilot", command: int, values: tuple[float, ...], at: tuple[int, int, float]) -> int:  # noqa: PLR0911 - one case a command
    match command:
        case dialect.ARM:
            forced = values[1] == _FORCE
            return vehicle.arm(force=forced) if values[0] >= 0.5 else vehicle.disarm(force=forced)
        case dialect.RUN_PREARM:
            return vehicle.prearm()
        case dialect.SET_MODE:
            return _done(vehicle.set_mode(int(values[1])))
        case dialect.RETURN:
            return _done(vehicle.set_mode(vehicle.modes.numbers[vehicle.modes.home]))
        case dialect.MISSION_START:
            return _start(vehicle, values)
        case dialect.SET_CURRENT:
            return dialect.ACCEPTED if vehicle.set_current(int(values[0])) else dialect.DENIED
        case dialect.CHANGE_SPEED:
            if values[1] <= 0:
                return dialect.DENIED
            vehicle.flight.speed = values[1]
            return dialect.ACCEPTED
        case dialect.REQUEST_MESSAGE | dialect.SET_INTERVAL:
            return dialect.ACCEPTED if int(values[0]) in REQUESTABLE else dialect.UNSUPPORTED
        case dialect.GET_HOME | dialect.CAPABILITIES:
            return dialect.ACCEPTED
        case dialect.GRIPPER | dialect.SERVO | dialect.IMAGE_START:
            return carry_out(vehicle, command, values)
        case _:
            return vehicle.do(command, values, at)


def carry_out(vehicle: "AnyAutopilot", command: int, values: tuple[float, ...]) -> int:
    """Do a command to what it carries, from a message or a mission; MAV_RESULT."""
    if command == dialect.GRIPPER:
        if not vehicle.parameters["GRIP_ENABLE"]:
            return dialect.UNSUPPORTED
        if values[0] != 1 or values[1] not in (0, 1):
            return dialect.DENIED
        vehicle.gripper = "grab" if values[1] else "release"
    elif command == dialect.SERVO:
        if not 1 <= values[0] <= 16:
            return dialect.DENIED
        vehicle.servos[int(values[0])] = int(values[1])
    else:
        vehicle.pictures += 1
    return dialect.ACCEPTED


def _start(vehicle: "AnyAutopilot", values: tuple[float, ...]) -> int:
    if values[0] or values[1]:  # as ArduPilot: it knows no first and last item here
        return dialect.DENIED
    if len(vehicle.board.items) < 2 or not vehicle.flight.armed:
        vehicle.say(4, "mission needs items and armed motors")
        return dialect.FAILED
    if not vehicle.in_mode("AUTO"):
        vehicle.set_mode(vehicle.modes.numbers["AUTO"])
    vehicle.start_mission()
    return dialect.ACCEPTED


def _done(changed: bool) -> int:
    return dialect.ACCEPTED if changed else dialect.FAILED
