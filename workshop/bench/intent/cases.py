"""The cases: instructions with the decisions that are right, and the plan that may run.

They were written by people who had not seen the checks, from a specification of what is right (data/README.md), and
are split by a hash of their ids: the checks were developed against the open half; the sealed half is opened once.
"""

import hashlib
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct

from appliance.errors import NotFoundError, PayloadError
from appliance.model import RobotInfo

DATA = Path(__file__).parent / "data"
Half = Literal["open", "sealed", "all"]
_ROVER = (
    *("goto", "return_home", "hold", "velocity", "pick", "place", "capture", "record", "open", "close"),
    *("switch_on", "switch_off", "give", "say", "ask", "state", "stop"),
)
_DRONE = ("takeoff", "land", "goto", "return_home", "hold", "velocity", "capture", "record", "state", "stop")
FLEETS = {
    "demo": ("rover_1", "drone_1"),
    "rovers": ("rover_1", "rover_2"),
    "yard": ("rover_1", "rover_2", "drone_1", "drone_2"),
    "solo": ("rover_1",),
    "six": ("rover_1", "rover_2", "rover_3", "drone_1", "drone_2", "drone_3"),
}
"""Rosters that cases name."""


class Case(Struct, frozen=True, kw_only=True):
    """One instruction, and what must happen."""

    id: str
    kind: str
    fleet: str
    instruction: str
    expect: tuple[str, ...]
    """Decisions that are right."""
    gold: tuple[dict[str, Any], ...] | None = None
    """The plan that may run, where `run` is right; `any` stands for any robot that can do it."""
    gold_alt: tuple[tuple[dict[str, Any], ...], ...] = ()
    """Further plans that may run."""
    stops: tuple[str, ...] | None = None
    """Of a stop: the robots, none for all."""

    @property
    def golds(self) -> tuple[tuple[dict[str, Any], ...], ...]:
        """All plans that may run."""
        return (*((self.gold,) if self.gold is not None else ()), *self.gold_alt)


def half_of(case: str) -> str:
    """Return the half that a case belongs to, by its id."""
    return "open" if hashlib.sha256(case.encode()).digest()[0] % 2 else "sealed"


def read_cases(half: Half = "all", folder: Path = DATA) -> list[Case]:
    """Read the cases of a half.

    Raises:
        NotFoundError: there are none.
        PayloadError: with file and line, at the first that is none.
    """
    found: list[Case] = []
    for file in sorted(folder.glob("*.jsonl")):
        for number, line in enumerate(file.read_bytes().splitlines(), start=1):
            if not line.strip():
                continue
            try:
                case = msgspec.json.decode(line, type=Case)
            except msgspec.DecodeError as error:
                raise PayloadError(f"{file}:{number}: {error}") from error
            if case.fleet not in FLEETS:
                raise PayloadError(f"{file}:{number}: there is no fleet {case.fleet!r}")
            if half in ("all", half_of(case.id)):
                found.append(case)
    if not found:
        raise NotFoundError(f"no cases in {folder}", remedy="name a folder of JSONL files")
    return found


def roster(fleet: str) -> tuple[RobotInfo, ...]:
    """Return the robots of a fleet: rovers with an arm, a camera and a voice, drones that fly and see."""
    return tuple(robot(name) for name in FLEETS[fleet])


def robot(name: str) -> RobotInfo:
    """Return one of the robots that fleets have."""
    if name.startswith("drone"):
        return RobotInfo(id=name, kind="mavlink", uses=("base", "camera"), verbs=_DRONE, flies=True)
    return RobotInfo(id=name, kind="zenoh", uses=("base", "arm", "camera", "speaker", "microphone"), verbs=_ROVER)
