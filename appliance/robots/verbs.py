"""What robots can be told: the verbs of `robot/{id}/command`, their arguments, and what makes a way allowed.

One vocabulary for MAVLink vehicles and Zenoh robots, so that a skill handler need not know which it drives.
Arguments are checked here before anything moves; unknown ones are refused, since a misspelt `altitude` that is
silently ignored is an accident. Pure.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import msgspec
from msgspec import Struct

from appliance.model import Failure, Pose, Site
from appliance.robots.geo import MAX_EXTENT_M, blocked_leg

MAX_WAYPOINTS = 100
MAX_FRAMES = 240
MAX_SIDE = 1280
_GROUND_M = 0.5


class RobotFailure(Exception):  # noqa: N818 - not an error of the appliance: what a robot answers
    """Carries a `Failure` from where a robot gives up to where its reply is made."""

    def __init__(self, code: str, message: str, *, remedy: str = "", retryable: bool = False) -> None:
        super().__init__(message)
        self.failure = Failure(code=code, message=message, remedy=remedy, retryable=retryable)


class Waypoint(Struct, frozen=True, forbid_unknown_fields=True):
    """A point of a way in site metres; a `z` of None or near the ground: a flying robot keeps its altitude."""

    x: float
    y: float
    z: float | None = None


class NoArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`state`, `land`, `return_home`, `arm`, `disarm`."""


class GotoArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`goto`: waypoints in order; the last is where it ends."""

    waypoints: tuple[Waypoint, ...]
    speed_mps: float | None = None


class TakeoffArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`takeoff`: metres above home."""

    altitude_m: float | None = None


class HoldArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`hold`: stop where it is; ends at once, or after `duration_s` of staying."""

    duration_s: float | None = None


class StopArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`stop`: end the command of that id (none given: all) with failure `cancelled`, and hold position."""

    id: str | None = None


class PickArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`pick`: the object by name."""

    object: str


class PlaceArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`place`: the held object, at a place within reach."""

    object: str
    at: str


class CaptureArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`capture`: one picture towards the target."""

    target: str
    width: int | None = None
    height: int | None = None


class RecordArgs(Struct, frozen=True, forbid_unknown_fields=True):
    """`record`: pictures at `fps` for `duration_s`."""

    target: str
    duration_s: float | None = None
    fps: float | None = None


_ARGS: dict[str, type[Struct]] = {
    "state": NoArgs,
    "goto": GotoArgs,
    "takeoff": TakeoffArgs,
    "land": NoArgs,
    "hold": HoldArgs,
    "return_home": NoArgs,
    "arm": NoArgs,
    "disarm": NoArgs,
    "pick": PickArgs,
    "place": PlaceArgs,
    "capture": CaptureArgs,
    "record": RecordArgs,
    "stop": StopArgs,
}

A = TypeVar("A", bound=Struct)


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


def check_way(site: Site, start: Pose, goto: GotoArgs, *, flies: bool) -> tuple[Waypoint, ...]:
    """Return the waypoints of an allowed way; RobotFailure with the reason otherwise.

    Forbidden areas bind all robots, obstacles those on the ground: a planner has gone round them before, this is
    the last gate. Altitude and speed limits are the site's.
    """
    points = goto.waypoints
    if not 1 <= len(points) <= MAX_WAYPOINTS:
        raise RobotFailure("payload", f"goto: {len(points)} waypoints, 1 to {MAX_WAYPOINTS} are possible")
    for number, point in enumerate(points, start=1):
        for value in (point.x, point.y, point.z or 0.0):
            if not math.isfinite(value) or abs(value) > MAX_EXTENT_M:
                raise RobotFailure("payload", f"goto: waypoint {number} is not within {MAX_EXTENT_M:g} m of the origin")
        if (point.z or 0.0) > site.altitude_limit_m:
            raise RobotFailure(
                "refused",
                f"waypoint {number} is {point.z:g} m up, the site allows {site.altitude_limit_m:g} m",
                remedy="choose a lower altitude",
            )
    check_speed(site, goto.speed_mps)
    closed = site.forbidden if flies else (*site.forbidden, *site.obstacles)
    blocked = blocked_leg(closed, (start.x, start.y), [(point.x, point.y) for point in points])
    if blocked is not None:
        index, box = blocked
        raise RobotFailure(
            "refused", f"the leg to waypoint {index + 1} goes through {box.name}", remedy="plan a way round it"
        )
    return points


def check_speed(site: Site, speed_mps: float | None) -> None:
    """Raise RobotFailure unless the speed is None, or above 0 and within the site's limit."""
    if speed_mps is None:
        return
    if not math.isfinite(speed_mps) or speed_mps <= 0.0:
        raise RobotFailure("payload", f"goto: a speed of {speed_mps:g} m/s gets nowhere")
    if speed_mps > site.speed_limit_mps:
        raise RobotFailure(
            "refused",
            f"{speed_mps:g} m/s is above the site's limit of {site.speed_limit_mps:g} m/s",
            remedy="choose a lower speed",
        )


def cruise(points: Sequence[Waypoint], altitude_m: float) -> tuple[tuple[float, float, float], ...]:
    """Give each waypoint of a flight its altitude: its own, or the last flown where it is a point on the ground."""
    way: list[tuple[float, float, float]] = []
    for point in points:
        if point.z is not None and point.z > _GROUND_M:
            altitude_m = point.z
        way.append((point.x, point.y, altitude_m))
    return tuple(way)
