"""What robots can be told: the verbs of `robot/{id}/command` and their arguments.

One vocabulary for MAVLink vehicles and Zenoh robots, so that a skill handler need not know which it drives.
Arguments are checked here before anything moves; unknown ones are refused, since a misspelt `altitude` that is
silently ignored is an accident. Pure.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

import msgspec
from msgspec import Struct

from appliance.model import Failure

MAX_WAYPOINTS = 100
MAX_FRAMES = 240
MAX_SIDE = 1280
_GROUND_M = 0.5


class RobotFailure(Exception):  # noqa: N818 - not an error of the appliance: what a robot answers
    """Carries a `Failure` from where a robot gives up to where its reply is made."""

    def __init__(self, code: str, message: str, *, remedy: str = "", retryable: bool = False) -> None:
        super().__init__(message)
        self.failure = Failure(code=code, message=message, remedy=remedy, retryable=retryable)


A = TypeVar("A", bound=Struct)

_ARGS: dict[str, type[Struct]] = {}
"""Verb -> the struct of its arguments."""


def arguments_of(*verbs: str) -> Callable[[type[A]], type[A]]:
    """Make a struct the arguments of these verbs."""

    def register(kind: type[A]) -> type[A]:
        _ARGS.update(dict.fromkeys(verbs, kind))
        return kind

    return register


class Waypoint(Struct, frozen=True, forbid_unknown_fields=True):
    """A point of a way in site metres; a `z` of None or near the ground: a flying robot keeps its altitude."""

    x: float
    y: float
    z: float | None = None


@arguments_of("state", "land", "return_home", "arm", "disarm", "release", "scan")
class NoArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """Verbs that say all by their name."""


@arguments_of("goto")
class GotoArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`goto`: waypoints in order; the last is where it ends."""

    waypoints: tuple[Waypoint, ...]
    speed_mps: float | None = None


@arguments_of("takeoff")
class TakeoffArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`takeoff`: metres above home."""

    altitude_m: float | None = None


@arguments_of("hold")
class HoldArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`hold`: stop where it is; ends at once, or after `duration_s` of staying. The commands that it ends get `why`."""

    duration_s: float | None = None
    why: str = ""


@arguments_of("stop")
class StopArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`stop`: end the command of that id (none given: all) with failure `cancelled`, and hold position."""

    id: str | None = None
    why: str = ""


class MissionStep(Struct, frozen=True, forbid_unknown_fields=True):
    """A point of a mission: stay there `hold_s`, then take a picture, or shut or open the gripper."""

    x: float
    y: float
    z: float | None = None
    hold_s: float = 0.0
    act: Literal["", "photo", "grab", "release"] = ""


@arguments_of("mission")
class MissionArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`mission`: steps in order, then `end`. `resume`: go on with the same mission where it was left."""

    steps: tuple[MissionStep, ...]
    speed_mps: float | None = None
    end: Literal["hold", "return", "land"] = "hold"
    resume: bool = True


@arguments_of("orbit")
class OrbitArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`orbit`: circle round a point; a negative radius goes counter-clockwise."""

    x: float
    y: float
    z: float | None = None
    radius_m: float = 5.0
    laps: float = 1.0
    speed_mps: float | None = None


@arguments_of("set_mode")
class ModeArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`set_mode`: the autopilot's mode by name."""

    mode: str


@arguments_of("parameter")
class ParameterArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`parameter`: read one of the autopilot's parameters, or write it where a value is given."""

    name: str
    value: float | None = None


@arguments_of("trigger")
class TriggerArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`trigger`: take pictures with the camera on board, which keeps them."""

    count: int = 1
    interval_s: float = 1.0


@arguments_of("video")
class VideoArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`video`: start or stop the camera's recording on board."""

    action: Literal["start", "stop"]


@arguments_of("gripper")
class GripperArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`gripper`: grab or release; instances count from 1."""

    action: Literal["grab", "release"]
    instance: int = 1


@arguments_of("gimbal")
class GimbalArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`gimbal`: to angles in degrees (pitch up, yaw clockwise from the nose), or at a point of the site."""

    pitch_deg: float | None = None
    yaw_deg: float | None = None
    x: float | None = None
    y: float | None = None
    z: float = 0.0


@arguments_of("servo")
class ServoArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`servo`: an output of the autopilot (1 to 16) to a pulse width in microseconds."""

    output: int
    pwm_us: int


@arguments_of("say")
class SayArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`say`: words for people about, or a tune (MML, as PLAY_TUNE takes it), or both."""

    text: str = ""
    tune: str = ""


@arguments_of("ask")
class AskArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`ask`: a question to somebody near by; `to` is their name, empty for the person nearest."""

    question: str
    to: str = ""


@arguments_of("open", "close", "switch_on", "switch_off", "clean", "cut", "unfasten")
class NamedArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`open`, `close`, `switch_on`, `switch_off`, `clean`, `cut`, `unfasten`: what is meant, by name."""

    object: str


@arguments_of("fasten", "push")
class NamedToArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`fasten` a part, to something; `push` a thing to a place, or a step ahead."""

    object: str
    to: str = ""


@arguments_of("pour")
class PourArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`pour`: what is held, into a container within reach."""

    object: str
    into: str


@arguments_of("measure")
class MeasureArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`measure`: a quantity by name, of a target or where the robot is. Answered with `number` and `unit`."""

    quantity: str
    target: str = ""


@arguments_of("listen")
class ListenArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`listen`: sound for some seconds, as `sound.wav` of 16-bit samples."""

    duration_s: float
    target: str = ""


@arguments_of("thermal")
class ThermalArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`thermal`: a picture of temperatures, `thermal.png`: 16 bits a pixel, hundredths of a kelvin."""

    target: str


@arguments_of("follow")
class FollowArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`follow`: keep `distance_m` behind a robot or a person that the robot itself sees."""

    target: str
    duration_s: float
    distance_m: float = 2.0
    speed_mps: float | None = None


@arguments_of("give")
class GiveArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`give`: the held object to a person, or another robot, within reach."""

    object: str
    to: str


@arguments_of("velocity")
class VelocityArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`velocity`: move by hand for a moment, as seen from the robot; repeated, each takes the place of the last.

    After `for_s` it holds by itself: its pilot must go on saying so. `turn_dps` is to the right.
    """

    forward_mps: float = 0.0
    left_mps: float = 0.0
    up_mps: float = 0.0
    turn_dps: float = 0.0
    for_s: float = 0.5


@arguments_of("pick")
class PickArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`pick`: the object by name."""

    object: str


@arguments_of("place")
class PlaceArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`place`: the held object, at a place within reach."""

    object: str
    at: str


@arguments_of("capture")
class CaptureArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`capture`: one picture towards the target."""

    target: str
    width: int | None = None
    height: int | None = None


@arguments_of("record")
class RecordArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`record`: pictures at `fps` for `duration_s`."""

    target: str
    duration_s: float | None = None
    fps: float | None = None


def parse_args(verb: str, args: Mapping[str, Any], kind: type[A]) -> A:
    """Return checked arguments; RobotFailure `payload` that names the field otherwise."""
    try:
        return msgspec.convert(args, kind, strict=True)
    except msgspec.ValidationError as error:
        raise RobotFailure(
            "payload", f"{verb}: {error}", remedy=f"its arguments are: {', '.join(kind.__struct_fields__) or 'none'}"
        ) from error


def args_of(verb: str) -> type[Struct] | None:
    """Return the arguments' struct of a verb, None for a word that is no verb."""
    return _ARGS.get(verb)


def in_range(verb: str, name: str, value: float | None, low: float, high: float) -> None:
    """Raise RobotFailure `payload` unless `value` is None or a number from `low` to `high`."""
    if value is not None and not (math.isfinite(value) and low <= value <= high):
        raise RobotFailure("payload", f"{verb}: {name} {value:g} is not in {low:g} to {high:g}")


def cruise(points: Sequence[Waypoint], altitude_m: float) -> tuple[tuple[float, float, float], ...]:
    """Give each waypoint of a flight its altitude: its own, or the last flown where it is a point on the ground."""
    way: list[tuple[float, float, float]] = []
    for point in points:
        if point.z is not None and point.z > _GROUND_M:
            altitude_m = point.z
        way.append((point.x, point.y, altitude_m))
    return tuple(way)
