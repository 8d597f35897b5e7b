"""The parameter protocol: read and write one of an autopilot's parameters (mavlink.io: Parameter Protocol).

Values travel in a 32-bit float: ArduPilot casts whole numbers to it, PX4 puts their bytes there ("C-cast" and
"bytewise" of the guide). A write is answered by the value that holds afterwards, which need not be the one asked for.
"""

import asyncio
import math
import re
import struct

from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message, make
from appliance.robots.mavlink.frames import HEADER_V1, HEADER_V2, MARKER_V1
from appliance.robots.mavlink.protocol import Patience
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.verbs import RobotFailure

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


async def read(vehicle: Vehicle, name: str, *, patience: Patience) -> float:
    """Return a parameter's value; RobotFailure, retryable, when the vehicle does not tell it.

    A vehicle does not answer for a parameter that it does not have, which looks the same as a lost frame.
    """
    return (await _read(vehicle, name, patience))[0]


async def _read(vehicle: Vehicle, name: str, patience: Patience) -> tuple[float, int]:
    """Return a parameter's value and MAV_PARAM_TYPE."""
    request = make(
        "PARAM_REQUEST_READ",
        target_system=vehicle.system,
        target_component=vehicle.component,
        param_id=name.encode(),
        param_index=-1,
    )
    told = await _exchange(vehicle, name, request, patience)
    if told is None:
        raise RobotFailure(
            "robot",
            f"{vehicle.name} does not tell {name} in {patience.tries} tries",
            remedy="check the name: autopilots are silent about parameters they do not have",
            retryable=True,
        )
    return told


async def write(vehicle: Vehicle, name: str, value: float, *, patience: Patience) -> float:
    """Write a parameter and return the value that holds now.

    Raises:
        RobotFailure: `refused` for one that keeps the vehicle safe, `payload` for a fraction where the vehicle keeps
            whole numbers, `robot` when another value holds afterwards, or, retryable, when nothing was answered.
    """
    if name.startswith(SAFETY):
        raise RobotFailure("refused", f"{name} keeps the vehicle safe", remedy="set it from a ground station")
    # A type that is not the parameter's own is refused by PX4, so it is asked for first.
    kind = (await _read(vehicle, name, patience))[1] if vehicle.autopilot == _PX4 else _REAL32
    request = make(
        "PARAM_SET",
        target_system=vehicle.system,
        target_component=vehicle.component,
        param_id=name.encode(),
        param_value=_packed(name, value, kind),
        param_type=kind,  # ArduPilot goes by its own
    )
    told = await _exchange(vehicle, name, request, patience)
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


async def _exchange(vehicle: Vehicle, name: str, request: Message, patience: Patience) -> tuple[float, int] | None:
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
