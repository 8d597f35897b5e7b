"""MAVLink's two acknowledged exchanges: commands, and the upload of a mission.

Both are made for links that lose a fifth of what is sent: whatever is not answered in time is sent again, a
bounded number of times, and what arrives late or twice is recognised (mavlink.io: Command Protocol, Mission
Protocol).
"""

import asyncio
from collections.abc import Sequence

import structlog
from msgspec import Struct

from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message, label, make
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.verbs import RobotFailure

log = structlog.get_logger(__name__)

_PROGRESS_S = 30.0
"""How long a command may stay IN_PROGRESS without a word."""


class Patience(Struct, frozen=True, kw_only=True):
    """How long to wait for an answer (seconds) and how often to ask."""

    timeout_s: float
    tries: int


class Item(Struct, frozen=True, kw_only=True):
    """A mission item: command, position (degrees; metres above home) and the command's four parameters."""

    command: int
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    relative_m: float = 0.0
    parameters: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


async def command(vehicle: Vehicle, number: int, *parameters: float, patience: Patience) -> None:
    """Send COMMAND_LONG until it is acknowledged.

    Raises:
        RobotFailure: `robot` when the vehicle declines (with its own words where it gave some), or, retryable,
            when no acknowledgement came after all tries.
    """
    values = (*parameters, *([0.0] * 7))[:7]
    name = label("MAV_CMD", number)
    async with vehicle.exchange, vehicle.listening("COMMAND_ACK") as answers:
        vehicle.text = ""
        for attempt in range(patience.tries):
            vehicle.send(_long(vehicle, number, values, confirmation=attempt))
            result = await _acknowledgement(answers, number, patience.timeout_s)
            if result is None:
                continue
            if result == dialect.ACCEPTED:
                return
            said = f": {vehicle.text}" if vehicle.text else ""
            raise RobotFailure(
                "robot",
                f"{vehicle.name} answered {name} with {label('MAV_RESULT', result).removeprefix('MAV_RESULT_')}{said}",
                remedy="look at the vehicle's messages",
                retryable=result == dialect.TEMPORARILY_REJECTED,
            )
    raise RobotFailure(
        "robot",
        f"{vehicle.name} did not acknowledge {name} in {patience.tries} tries",
        remedy="check its radio link",
        retryable=True,
    )


async def _acknowledgement(answers: asyncio.Queue[Message], number: int, timeout_s: float) -> int | None:
    """Wait for the result of a command; IN_PROGRESS extends the wait."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout_s
    while True:
        try:
            async with asyncio.timeout(max(deadline - loop.time(), 0.0)):
                answer = await answers.get()
        except TimeoutError:
            return None
        if answer.command != number:
            continue
        if answer.result == dialect.IN_PROGRESS:
            deadline = loop.time() + _PROGRESS_S
            continue
        return int(answer.result)


def _long(vehicle: Vehicle, number: int, values: tuple[float, ...], *, confirmation: int) -> Message:
    return make(
        "COMMAND_LONG",
        target_system=vehicle.system,
        target_component=vehicle.component,
        command=number,
        confirmation=confirmation,
        **{f"param{index + 1}": value for index, value in enumerate(values)},
    )


async def upload(vehicle: Vehicle, items: Sequence[Item], *, patience: Patience) -> None:
    """Upload a mission; returns when the vehicle has acknowledged it whole.

    Raises:
        RobotFailure: the vehicle refuses an item, or, retryable, does not answer.
    """
    async with vehicle.exchange, vehicle.listening("MISSION_REQUEST_INT", "MISSION_REQUEST", "MISSION_ACK") as answers:
        vehicle.text = ""
        last: int | None = None
        sent: set[int] = set()
        silent = 0
        _send_count(vehicle, items)
        while silent < patience.tries:
            try:
                async with asyncio.timeout(patience.timeout_s):
                    answer = await answers.get()
            except TimeoutError:
                silent += 1
                if last is None:
                    _send_count(vehicle, items)
                else:
                    _send_item(vehicle, items, last)
                continue
            if getattr(answer, "mission_type", 0) != 0:
                continue
            if answer.get_type() != "MISSION_ACK":
                if 0 <= answer.seq < len(items):
                    # A request for what was sent already is a repeat, not progress.
                    silent = 0 if answer.seq not in sent else silent + 1
                    last = int(answer.seq)
                    sent.add(last)
                    _send_item(vehicle, items, last)
                continue
            if answer.type == dialect.MISSION_OK:
                if len(sent) == len(items):
                    vehicle.forget_mission()
                    return
                continue  # late answer to an earlier upload
            if answer.type in (dialect.MISSION_SEQUENCE, dialect.MISSION_ERROR):
                # It lost count, or had closed the transfer when a repeat came: begin again.
                silent += 1
                last = None
                sent.clear()
                await asyncio.sleep(patience.timeout_s)
                _send_count(vehicle, items)
                continue
            reason = f"{label('MAV_MISSION_RESULT', answer.type)} {vehicle.text}".strip()
            raise RobotFailure(
                "robot",
                f"{vehicle.name} refuses the mission: {reason}",
                remedy="look at the waypoints and the vehicle's fence",
            )
    said = f": {vehicle.text}" if vehicle.text else ""
    raise RobotFailure(
        "robot",
        f"{vehicle.name} did not take its mission in {patience.tries} tries{said}",
        remedy="check its radio link, and that nobody else is uploading",
        retryable=True,
    )


def _send_count(vehicle: Vehicle, items: Sequence[Item]) -> None:
    vehicle.send(
        make(
            "MISSION_COUNT",
            target_system=vehicle.system,
            target_component=vehicle.component,
            count=len(items),
            mission_type=0,
        )
    )


def _send_item(vehicle: Vehicle, items: Sequence[Item], number: int) -> None:
    item = items[number]
    one, two, three, four = item.parameters
    vehicle.send(
        make(
            "MISSION_ITEM_INT",
            target_system=vehicle.system,
            target_component=vehicle.component,
            seq=number,
            frame=dialect.FRAME_RELATIVE,
            command=item.command,
            current=0,
            autocontinue=1,
            param1=one,
            param2=two,
            param3=three,
            param4=four,
            x=round(item.latitude_deg * 1e7),
            y=round(item.longitude_deg * 1e7),
            z=item.relative_m,
            mission_type=0,
        )
    )
