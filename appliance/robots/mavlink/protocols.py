"""MAVLink's acknowledged exchanges with a vehicle: commands, missions up and down, parameters.

They are made for links that lose a fifth of what is sent: whatever is not answered in time is sent again, a
bounded number of times, and what arrives late or twice is recognised (mavlink.io: Command Protocol, Mission
Protocol, Parameter Protocol).

Values of parameters travel in a 32-bit float: ArduPilot casts whole numbers to it, PX4 puts their bytes there ("C-cast"
and "bytewise" of the guide). A write is answered by the value that holds afterwards, which need not be the one asked
for.
"""

import asyncio
import math
import re
import struct
from collections.abc import Callable, Sequence

import structlog
from msgspec import Struct

from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import HEADER_V1, HEADER_V2, MARKER_V1, Message, label, make
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.verbs import RobotFailure

log = structlog.get_logger(__name__)

MAX_ITEMS = 1000
"""Of a mission that is read."""
_PROGRESS_S = 30.0
"""How long a command may stay IN_PROGRESS without a word."""
_WORDS_S = 0.3
"""How long to wait for the words that explain a refusal, where none came before it."""


class RetryPolicy(Struct, frozen=True, kw_only=True):
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

    def same(self, other: "Item") -> bool:
        """Whether an autopilot that keeps positions to 1e-7 degrees and the rest as floats holds this item."""
        return (
            self.command == other.command
            and abs(self.latitude_deg - other.latitude_deg) < 2e-7
            and abs(self.longitude_deg - other.longitude_deg) < 2e-7
            and abs(self.relative_m - other.relative_m) < 0.02
            and all(abs(one - two) < 0.01 for one, two in zip(self.parameters, other.parameters, strict=True))
        )


class Outcome(Struct, frozen=True, kw_only=True):
    """How a command was answered: MAV_RESULT, COMMAND_ACK.result_param2, and what the vehicle said meanwhile."""

    result: int
    number: int = 0
    said: tuple[str, ...] = ()


def _always() -> None:
    pass


async def command(
    vehicle: Vehicle,
    number: int,
    *parameters: float,
    patience: RetryPolicy,
    component: int | None = None,
    check: Callable[[], None] = _always,
    behind: Message | None = None,
) -> Outcome:
    """Send COMMAND_LONG until it is acknowledged.

    Args:
        vehicle: whose.
        number: MAV_CMD.
        parameters: up to seven.
        patience: how long and how often.
        component: another than the autopilot.
        check: called right before each sending, repeats too; raises RobotFailure when it may not be sent any more.
        behind: sent right behind the first sending, for what may not wait for the answer; not repeated.

    Raises:
        RobotFailure: `robot` when the vehicle declines (with its own words where it gave some), or, retryable,
            when no acknowledgement came after all tries; what `check` raises.
    """
    outcome = await ask(
        vehicle, number, *parameters, patience=patience, component=component, check=check, behind=behind
    )
    return accepted(vehicle, number, outcome)


async def ask(
    vehicle: Vehicle,
    number: int,
    *parameters: float,
    patience: RetryPolicy,
    component: int | None = None,
    check: Callable[[], None] = _always,
    behind: Message | None = None,
) -> Outcome:
    """Send COMMAND_LONG as `command` does, and return whatever it is answered with."""
    target = vehicle.component if component is None else component

    def build(confirmation: int) -> Message:
        return command_long(vehicle, number, *parameters, component=target, confirmation=confirmation)

    return await _exchange(vehicle, build, number, target, patience, check, behind)


def command_long(
    vehicle: Vehicle, number: int, *parameters: float, component: int | None = None, confirmation: int = 0
) -> Message:
    """Make a COMMAND_LONG: MAV_CMD, up to seven parameters, and how often it was sent before."""
    values = (*parameters, *([0.0] * 7))[:7]
    return make(
        "COMMAND_LONG",
        target_system=vehicle.system,
        target_component=vehicle.component if component is None else component,
        command=number,
        confirmation=min(confirmation, 255),
        **{f"param{index + 1}": value for index, value in enumerate(values)},
    )


async def command_at(
    vehicle: Vehicle,
    number: int,
    *parameters: float,
    at: tuple[float, float, float],
    patience: RetryPolicy,
    component: int | None = None,
    frame: int = dialect.FRAME_RELATIVE,
    check: Callable[[], None] = _always,
) -> Outcome:
    """Send COMMAND_INT, which carries a position without the rounding of COMMAND_LONG's floats.

    Args:
        vehicle: whose.
        number: MAV_CMD.
        parameters: the first four.
        at: latitude and longitude in degrees, altitude in metres in `frame`.
        patience: how long and how often.
        component: another than the autopilot.
        frame: MAV_FRAME.
        check: called right before each sending, as of `command`.

    Raises:
        RobotFailure: as `command`.
    """
    one, two, three, four = (*parameters, *([0.0] * 4))[:4]
    target = vehicle.component if component is None else component
    latitude, longitude, altitude = at

    def build(_: int) -> Message:
        return make(
            "COMMAND_INT",
            target_system=vehicle.system,
            target_component=target,
            frame=frame,
            command=number,
            current=0,
            autocontinue=0,
            param1=one,
            param2=two,
            param3=three,
            param4=four,
            x=round(latitude * 1e7),
            y=round(longitude * 1e7),
            z=altitude,
        )

    return accepted(vehicle, number, await _exchange(vehicle, build, number, target, patience, check))


async def _exchange(
    vehicle: Vehicle,
    build: Callable[[int], Message],
    number: int,
    component: int,
    patience: RetryPolicy,
    check: Callable[[], None] = _always,
    behind: Message | None = None,
) -> Outcome:
    """Send a command until it is answered; RobotFailure, retryable, when it never is."""
    loop = asyncio.get_running_loop()
    async with vehicle.exchange, vehicle.listening("COMMAND_ACK") as answers:
        vehicle.text = ""
        began = loop.time()
        for attempt in range(patience.tries):
            check()
            vehicle.send(build(attempt))
            if behind is not None and attempt == 0:
                vehicle.send(behind)
            answer = await _acknowledgement(vehicle, answers, number, component, patience.timeout_s)
            if answer is None:
                continue
            result = int(answer.result)
            if result != dialect.ACCEPTED and not vehicle.texts.since(began, loop.time()):
                # Some autopilots give the reason after the refusal.
                await asyncio.sleep(_WORDS_S)
            said = vehicle.texts.since(began, loop.time())
            return Outcome(result=result, number=int(getattr(answer, "result_param2", 0)), said=said)
    raise RobotFailure(
        "robot",
        f"{vehicle.name} did not acknowledge {label('MAV_CMD', number)} in {patience.tries} tries",
        remedy="check its radio link",
        retryable=True,
    )


def accepted(vehicle: Vehicle, number: int, outcome: Outcome) -> Outcome:
    """Return an outcome whose result is MAV_RESULT_ACCEPTED.

    Args:
        vehicle: who answered, for the message.
        number: MAV_CMD that was answered.
        outcome: how.

    Raises:
        RobotFailure: `robot`, any other result, with the vehicle's words where it gave some; retryable when it was
            TEMPORARILY_REJECTED.
    """
    if outcome.result == dialect.ACCEPTED:
        return outcome
    said = f": {'; '.join(outcome.said)}" if outcome.said else ""
    name = label("MAV_CMD", number)
    raise RobotFailure(
        "robot",
        f"{vehicle.name} answered {name} with {label('MAV_RESULT', outcome.result).removeprefix('MAV_RESULT_')}{said}",
        remedy="look at the vehicle's messages",
        retryable=outcome.result == dialect.TEMPORARILY_REJECTED,
    )


async def _acknowledgement(
    vehicle: Vehicle, answers: asyncio.Queue[Message], number: int, component: int, timeout_s: float
) -> Message | None:
    """Wait for the answer to a command of ours; IN_PROGRESS extends the wait."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout_s
    while True:
        try:
            async with asyncio.timeout(max(deadline - loop.time(), 0.0)):
                answer = await answers.get()
        except TimeoutError:
            return None
        if answer.command != number or answer.get_srcComponent() != component:
            continue
        if vehicle.own and answer.target_system not in (0, vehicle.own):
            continue  # the answer to a ground station's command of the same number
        if answer.result == dialect.IN_PROGRESS:
            deadline = loop.time() + _PROGRESS_S
            continue
        return answer


async def upload(vehicle: Vehicle, items: Sequence[Item], *, patience: RetryPolicy) -> None:
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
            if getattr(answer, "mission_type", 0) != 0 or (
                vehicle.own and answer.target_system not in (0, vehicle.own)
            ):
                continue
            if answer.get_type() != "MISSION_ACK":
                if 0 <= answer.seq < len(items):
                    # A request for what was sent already is a repeat, not progress.
                    silent = 0 if answer.seq not in sent else silent + 1
                    last = int(answer.seq)
                    sent.add(last)
                    _send_item(vehicle, items, last)
                else:
                    silent += 1  # it asks for what there is not: that goes on no longer than silence
                continue
            if answer.type == dialect.MISSION_OK:
                if len(sent) == len(items):
                    vehicle.forget_mission()
                    return
                silent += 1
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


async def download(vehicle: Vehicle, *, patience: RetryPolicy) -> tuple[Item, ...]:
    """Return the mission that is on board, its home included.

    Raises:
        RobotFailure: retryable, when the vehicle does not answer.
    """
    items: dict[int, Item] = {}
    async with vehicle.exchange, vehicle.listening("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ACK") as answers:
        target = {"target_system": vehicle.system, "target_component": vehicle.component, "mission_type": 0}
        count: int | None = None
        silent = 0
        while silent < patience.tries and (count is None or len(items) < count):
            if count is None:
                vehicle.send(make("MISSION_REQUEST_LIST", **target))
            else:
                vehicle.send(make("MISSION_REQUEST_INT", seq=len(items), **target))
            answer = await _next(vehicle, answers, patience.timeout_s)
            silent += 1
            if answer is None:
                continue
            if answer.get_type() == "MISSION_COUNT" and count is None:
                count, silent = min(int(answer.count), MAX_ITEMS), 0
            elif answer.get_type() == "MISSION_ITEM_INT" and answer.seq == len(items):
                items[answer.seq] = _item(answer)
                silent = 0
        if count is not None and len(items) == count:
            vehicle.send(make("MISSION_ACK", type=dialect.MISSION_OK, **target))
            return tuple(items[number] for number in range(count))
    raise RobotFailure(
        "robot",
        f"{vehicle.name} did not tell its mission in {patience.tries} tries",
        remedy="check its radio link",
        retryable=True,
    )


async def _next(vehicle: Vehicle, answers: asyncio.Queue[Message], timeout_s: float) -> Message | None:
    """Wait for a message of a mission transfer that is ours."""
    try:
        async with asyncio.timeout(timeout_s):
            while True:
                answer = await answers.get()
                ours = not vehicle.own or answer.target_system in (0, vehicle.own)
                if ours and getattr(answer, "mission_type", 0) == 0:
                    return answer
    except TimeoutError:
        return None


def _item(message: Message) -> Item:
    return Item(
        command=int(message.command),
        latitude_deg=message.x / 1e7,
        longitude_deg=message.y / 1e7,
        relative_m=float(message.z),
        parameters=(message.param1, message.param2, message.param3, message.param4),
    )


# --- parameters ------------------------------------------------------------------------------------------------------

_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")
SAFETY = ("FENCE_", "FS_", "ARMING_", "BRD_SAFETY", "BATT_FS", "MAV_GCS", "SYSID_", "RTL_ALT", "SIM_")
"""What a gateway does not write: with these an autopilot keeps itself safe when all else has failed."""

_REAL32 = dialect.constant("MAV_PARAM_TYPE_REAL32")
_PX4 = dialect.constant("MAV_AUTOPILOT_PX4")
_WHOLE = {
    dialect.constant(f"MAV_PARAM_TYPE_{name}"): form
    for name, form in (
        ("UINT8", "<B3x"), ("INT8", "<b3x"), ("UINT16", "<H2x"), ("INT16", "<h2x"), ("UINT32", "<I"), ("INT32", "<i"),
    )
}  # fmt: skip
"""How the bytes of a whole number lie in the float where they are not cast."""


def check_name(name: str) -> str:
    """Return the name of a parameter as autopilots write it; RobotFailure for what can be none."""
    wanted = name.upper()
    if not _NAME.fullmatch(wanted):
        raise RobotFailure("payload", f"parameter: {name[:40]!r} is no name", remedy="1 to 16 of A-Z, 0-9 and _")
    return wanted


async def read_parameter(vehicle: Vehicle, name: str, *, patience: RetryPolicy) -> float:
    """Return a parameter's value; RobotFailure, retryable, when the vehicle does not tell it.

    A vehicle does not answer for a parameter that it does not have, which looks the same as a lost frame.
    """
    return (await _read_parameter(vehicle, name, patience))[0]


async def _read_parameter(vehicle: Vehicle, name: str, patience: RetryPolicy) -> tuple[float, int]:
    """Return a parameter's value and MAV_PARAM_TYPE."""
    request = make(
        "PARAM_REQUEST_READ",
        target_system=vehicle.system,
        target_component=vehicle.component,
        param_id=name.encode(),
        param_index=-1,
    )
    told = await _exchange_parameter(vehicle, name, request, patience)
    if told is None:
        raise RobotFailure(
            "robot",
            f"{vehicle.name} does not tell {name} in {patience.tries} tries",
            remedy="check the name: autopilots are silent about parameters they do not have",
            retryable=True,
        )
    return told


async def write_parameter(vehicle: Vehicle, name: str, value: float, *, patience: RetryPolicy) -> float:
    """Write a parameter and return the value that holds now.

    Raises:
        RobotFailure: `refused` for one that keeps the vehicle safe, `payload` for a fraction where the vehicle keeps
            whole numbers, `robot` when another value holds afterwards, or, retryable, when nothing was answered.
    """
    if name.startswith(SAFETY):
        raise RobotFailure("refused", f"{name} keeps the vehicle safe", remedy="set it from a ground station")
    # A type that is not the parameter's own is refused by PX4, so it is asked for first.
    kind = (await _read_parameter(vehicle, name, patience))[1] if vehicle.autopilot == _PX4 else _REAL32
    request = make(
        "PARAM_SET",
        target_system=vehicle.system,
        target_component=vehicle.component,
        param_id=name.encode(),
        param_value=_packed(name, value, kind),
        param_type=kind,  # ArduPilot goes by its own
    )
    told = await _exchange_parameter(vehicle, name, request, patience)
    if told is None:
        raise RobotFailure(
            "robot",
            f"{vehicle.name} does not answer the write of {name} in {patience.tries} tries",
            remedy="check the name and the radio link",
            retryable=True,
        )
    holds, _ = told
    if abs(holds - (value if kind in _WHOLE else _single(value))) > 1e-6 * max(1.0, abs(value)):
        raise RobotFailure("robot", f"{vehicle.name} keeps {name} at {holds:g} instead of {value:g}")
    return holds


async def _exchange_parameter(
    vehicle: Vehicle, name: str, request: Message, patience: RetryPolicy
) -> tuple[float, int] | None:
    async with vehicle.exchange, vehicle.listening("PARAM_VALUE") as answers:
        for _ in range(patience.tries):
            vehicle.send(request)
            try:
                async with asyncio.timeout(patience.timeout_s):
                    while True:
                        answer = await answers.get()
                        value = _value(answer, bytewise=vehicle.autopilot == _PX4)
                        if _text(answer.param_id) == name and math.isfinite(value):
                            return value, int(answer.param_type)
            except TimeoutError:
                continue
    return None


def _value(answer: Message, *, bytewise: bool) -> float:
    """Return the value of a PARAM_VALUE; NaN where it is none."""
    form = _WHOLE.get(answer.param_type) if bytewise else None
    if form is None:
        return float(answer.param_value)
    # From the frame, where it comes first: the bytes of some whole numbers are a NaN, which no float carries unchanged.
    raw = bytes(answer.get_msgbuf())
    return float(struct.unpack_from(form, raw, HEADER_V1 if raw[0] == MARKER_V1 else HEADER_V2)[0])


def _packed(name: str, value: float, kind: int) -> float:
    """Return what stands for a value in the float of a PARAM_SET; RobotFailure where its type has no such value."""
    form = _WHOLE.get(kind)
    if form is None:
        return value
    try:
        (packed,) = struct.unpack("<f", struct.pack(form, int(value) if value.is_integer() else value))
    except struct.error as error:
        raise RobotFailure(
            "payload", f"{name} cannot be {value:g}: the vehicle keeps a whole number", remedy="give one in its range"
        ) from error
    return float(packed)


def _text(raw: str | bytes) -> str:
    return (raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw).split("\0")[0]


def _single(value: float) -> float:
    """Round to what a 32-bit float holds."""
    (single,) = struct.unpack("<f", struct.pack("<f", value))
    return float(single)
