"""Robots as their speakers describe them, orders to them, what came of these, and each number's plausible range.

Each number that is shown or decided by has a range in which it can be true. What is outside is left out, and the rest
of the message is kept: one broken sensor must not take a robot from the list, and its nonsense must not decide which
robot is sent. Pure.
"""

import json
import math
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec import Struct, field
from msgspec.structs import replace

from appliance.model.messages import Failure


class Pose(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where a robot is: metres east (x), north (y) and up (z) of the site's origin; heading in degrees from north."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    heading_deg: float = 0.0


class RobotLimits(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a robot says it can do at most; None where it does not say."""

    speed_mps: float | None = None
    altitude_m: float | None = None
    """Above home; for one that flies."""
    payload_kg: float | None = None
    range_m: float | None = None
    """How far it gets with a full battery."""


class RobotInfo(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A robot as its speaker (a MAVLink gateway, or the Zenoh robot itself) describes it."""

    id: str
    kind: str
    """`mavlink` or `zenoh`."""
    gateway: str = ""
    """The gateway it is attached to; empty for one that speaks Zenoh itself."""
    uses: tuple[str, ...] = ()
    """Actuators and sensors it has, in the catalogue's words: base, arm, camera, ..."""
    verbs: tuple[str, ...] = ()
    """Commands it answers on `robot/{id}/command`."""
    flies: bool = False
    pose: Pose | None = None
    home: Pose | None = None
    """Where `return_home` ends, as the robot has told it; None: it has not."""
    battery_percent: float | None = None
    armed: bool = False
    mode: str = ""
    holding: str = ""
    online: bool = True
    note: str = ""
    radius_m: float | None = None
    """Of the circle on the ground that holds it and what it carries; None: it does not say."""
    height_m: float | None = None
    limits: RobotLimits | None = None
    """As it has registered itself with."""
    speed_mps: float | None = None
    mission_item: int = 0
    """The item of its mission that it is at; 0 is home."""
    mission_items: int = 0
    """Items of the mission on board."""
    estimator: tuple[str, ...] = ()
    """What its position estimator says it does not know, in words; empty when all is well."""
    warnings: tuple[str, ...] = ()
    """What is not well and no failsafe: `battery low`."""
    failsafe: str = ""
    """Failsafes in force at the vehicle, in words."""
    speaker: str = ""
    """Which of those that go by this name speaks: made when it starts, in the order of those times. Of two the older is
    believed; empty: it does not say."""
    seized: str = ""
    """Why the gateway does not command it at present: a pilot or a failsafe has it. Empty when it does."""


class RobotCommand(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An order to a robot. Same `id`: same order, answered again with the same reply and not done twice.

    `attempt` fences: a robot that has seen a higher attempt of `task`/`subtask` refuses a lower one.
    """

    id: str
    verb: str
    args: dict[str, Any] = field(default_factory=dict[str, Any])
    task: str = ""
    subtask: str = ""
    attempt: int = 0
    lease: str = ""
    """Id of the operator's lease under which it is given; while there is one, no other command moves the robot."""


class RobotReply(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What came of a command: `result` or `failure`; `blobs` are files such as pictures (name -> bytes)."""

    id: str
    result: dict[str, Any] = field(default_factory=dict[str, Any])
    blobs: dict[str, bytes] = field(default_factory=dict[str, bytes])
    failure: Failure | None = None


MAX_METRES = 2.1e7
"""Half of the Earth's circumference: further away is nothing on it."""
LOWEST_M, HIGHEST_M = -12_000.0, 100_000.0
"""Of the deepest sea, and of where the atmosphere ends."""
MAX_MPS = 1000.0
MAX_SIZE_M = 20.0
"""Of a robot."""
MAX_ITEMS = 32_767
"""Of a mission."""
MAX_VERBS = 128
MAX_LIST = 32
"""Actuators, warnings."""
MAX_NAME, MAX_TEXT = 64, 500
_ABSURD = 1e300
"""In place of numbers that JSON does not have; in no range."""


def within(value: float, low: float, high: float) -> bool:
    """Whether a number is one, and in a range."""
    return math.isfinite(value) and low <= value <= high


def plausible_battery(percent: float) -> bool:
    """Whether it may be a battery's charge."""
    return within(percent, 0.0, 100.0)


def plausible_place(latitude_deg: float, longitude_deg: float) -> bool:
    """Whether it is a place on Earth."""
    return within(latitude_deg, -90.0, 90.0) and within(longitude_deg, -180.0, 180.0)


def plausible_altitude(metres: float) -> bool:
    """Whether a vehicle may be so high above the sea, or above where it started."""
    return within(metres, LOWEST_M, HIGHEST_M)


def plausible_speed(mps: float) -> bool:
    """Whether a robot may be so fast; backwards is slower than nothing."""
    return within(mps, -MAX_MPS, MAX_MPS)


def plausible_item(number: int) -> bool:
    """Whether it may be an item of a mission, or how many there are."""
    return 0 <= number <= MAX_ITEMS


def plausible_pose(pose: Pose) -> bool:
    """Whether a robot may be there; its heading is looked at by itself."""
    return (
        within(pose.x, -MAX_METRES, MAX_METRES)
        and within(pose.y, -MAX_METRES, MAX_METRES)
        and plausible_altitude(pose.z)
    )


def _heading(degrees: float) -> bool:
    return within(degrees, -360.0, 360.0)


def _texts(most: int, length: int) -> Callable[[tuple[str, ...]], bool]:
    return lambda given: len(given) <= most and all(len(each) <= length for each in given)


def _text(length: int) -> Callable[[str], bool]:
    return lambda given: len(given) <= length


_FIELDS: dict[str, tuple[Callable[[Any], bool], Any]] = {
    "kind": (_text(MAX_NAME), ""),
    "gateway": (_text(2 * MAX_NAME), ""),
    "uses": (_texts(MAX_LIST, MAX_NAME), ()),
    "verbs": (_texts(MAX_VERBS, MAX_NAME), ()),
    "pose": (plausible_pose, None),
    "home": (plausible_pose, None),
    "radius_m": (lambda metres: within(metres, 0.01, MAX_SIZE_M), None),
    "height_m": (lambda metres: within(metres, 0.01, MAX_SIZE_M), None),
    "battery_percent": (plausible_battery, None),
    "mode": (_text(MAX_NAME), ""),
    "holding": (_text(MAX_TEXT), ""),
    "note": (_text(MAX_TEXT), ""),
    "speed_mps": (plausible_speed, None),
    "mission_item": (plausible_item, 0),
    "mission_items": (plausible_item, 0),
    "estimator": (_texts(MAX_LIST, MAX_TEXT), ()),
    "warnings": (_texts(MAX_LIST, MAX_TEXT), ()),
    "failsafe": (_text(MAX_TEXT), ""),
    "seized": (_text(MAX_TEXT), ""),
    "speaker": (_text(MAX_NAME), ""),
}
"""What each field may be, and what stands in its place when it is not."""
_LIMITS: dict[str, float] = {"speed_mps": MAX_MPS, "altitude_m": HIGHEST_M, "payload_kg": 1e6, "range_m": 1e8}
"""The most that a robot may say it can."""


def plausible(info: RobotInfo) -> tuple[RobotInfo, tuple[str, ...]]:
    """Return a robot's state without what cannot be, and the names of the fields that were left out."""
    changed: dict[str, Any] = {}
    dropped: list[str] = []
    for name, (fits, instead) in _FIELDS.items():
        value = getattr(info, name)
        if value is not None and not fits(value):
            changed[name] = instead
            dropped.append(name)
    for name in ("pose", "home"):
        pose: Pose | None = changed.get(name, getattr(info, name))
        if pose is not None and not _heading(pose.heading_deg):
            changed[name] = replace(pose, heading_deg=0.0)
            dropped.append(f"{name}.heading_deg")
    if info.limits is not None:
        limits = _plausible_limits(info.limits, dropped)
        if limits is not info.limits:
            changed["limits"] = limits
    return (replace(info, **changed) if changed else info), tuple(dropped)


def _plausible_limits(limits: RobotLimits, dropped: list[str]) -> RobotLimits:
    wrong: list[str] = []
    for name, most in _LIMITS.items():
        value: float | None = getattr(limits, name)
        if value is not None and not within(value, 0.0, most):
            wrong.append(name)
    dropped += [f"limits.{name}" for name in wrong]
    return replace(limits, **dict.fromkeys(wrong)) if wrong else limits


_decoder = msgspec.json.Decoder(RobotInfo)


def read_robot(payload: bytes) -> RobotInfo:
    """Return a robot's state as it was put; msgspec.DecodeError when it is none.

    NaN and infinities are no JSON, yet Python and others write them: they are read as numbers that are in no range, so
    that the rest of the message counts.
    """
    try:
        return _decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        try:
            table = json.loads(payload, parse_constant=_constant, parse_float=_number, parse_int=_integer)
            return msgspec.convert(table, type=RobotInfo)
        except (ValueError, RecursionError, msgspec.ValidationError):
            raise msgspec.DecodeError(str(error)) from error


def _constant(_: str) -> float:
    return _ABSURD


def _number(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _ABSURD


def _integer(text: str) -> int:
    return int(text) if len(text) < 19 else 2**62  # further digits cost time, and are in no range either
