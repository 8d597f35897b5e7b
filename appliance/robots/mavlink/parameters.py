"""The parameter protocol: read and write one of an autopilot's parameters (mavlink.io: Parameter Protocol).

Values travel as 32-bit floats whatever their type (ArduPilot's cast encoding). A write is answered by the value that
holds afterwards, which need not be the one asked for.
"""

import asyncio
import math
import re
import struct

from appliance.robots.mavlink.dialect import Message, make
from appliance.robots.mavlink.protocol import Patience
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.verbs import RobotFailure

_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")
SAFETY = ("FENCE_", "FS_", "ARMING_", "BRD_SAFETY", "BATT_FS", "MAV_GCS", "SYSID_", "RTL_ALT", "SIM_")
"""What a gateway does not write: with these an autopilot keeps itself safe when all else has failed."""


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
    request = make(
        "PARAM_REQUEST_READ",
        target_system=vehicle.system,
        target_component=vehicle.component,
        param_id=name.encode(),
        param_index=-1,
    )
    value = await _exchange(vehicle, name, request, patience)
    if value is None:
        raise RobotFailure(
            "robot",
            f"{vehicle.name} does not tell {name} in {patience.tries} tries",
            remedy="check the name: autopilots are silent about parameters they do not have",
            retryable=True,
        )
    return value


async def write(vehicle: Vehicle, name: str, value: float, *, patience: Patience) -> float:
    """Write a parameter and return the value that holds now.

    Raises:
        RobotFailure: `refused` for one that keeps the vehicle safe, `robot` when another value holds afterwards, or,
            retryable, when nothing was answered.
    """
    if name.startswith(SAFETY):
        raise RobotFailure("refused", f"{name} keeps the vehicle safe", remedy="set it from a ground station")
    request = make(
        "PARAM_SET",
        target_system=vehicle.system,
        target_component=vehicle.component,
        param_id=name.encode(),
        param_value=value,
        param_type=9,  # MAV_PARAM_TYPE_REAL32; ArduPilot goes by its own
    )
    holds = await _exchange(vehicle, name, request, patience)
    if holds is None:
        raise RobotFailure(
            "robot",
            f"{vehicle.name} does not answer the write of {name} in {patience.tries} tries",
            remedy="check the name and the radio link",
            retryable=True,
        )
    if abs(holds - _single(value)) > 1e-6 * max(1.0, abs(value)):
        raise RobotFailure("robot", f"{vehicle.name} keeps {name} at {holds:g} instead of {value:g}")
    return holds


async def _exchange(vehicle: Vehicle, name: str, request: Message, patience: Patience) -> float | None:
    async with vehicle.exchange, vehicle.listening("PARAM_VALUE") as answers:
        for _ in range(patience.tries):
            vehicle.send(request)
            try:
                async with asyncio.timeout(patience.timeout_s):
                    while True:
                        answer = await answers.get()
                        if _text(answer.param_id) == name and math.isfinite(answer.param_value):
                            return float(answer.param_value)
            except TimeoutError:
                continue
    return None


def _text(raw: str | bytes) -> str:
    return (raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw).split("\0")[0]


def _single(value: float) -> float:
    """Round to what a 32-bit float holds."""
    (single,) = struct.unpack("<f", struct.pack("<f", value))
    return float(single)
