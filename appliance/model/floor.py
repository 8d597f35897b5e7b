"""What gateways tell of the robots that they move: the way that each has reserved, or what it waits for."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

Point = tuple[float, float, float]
"""Site metres: east, north, up."""
MOST_POINTS = 512


class FloorState(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A robot that a run moves, or wants to move."""

    robot: str
    gateway: str = ""
    """The gateway of the run."""
    task: str = ""
    command: str = ""
    """Id of the robot's command."""
    state: Literal["waits", "moves", "stands"] = "stands"
    place: str = ""
    """The place that it goes to; empty: a coordinate."""
    way: Annotated[tuple[Point, ...], Meta(max_length=MOST_POINTS)] = ()
    """The way that it has reserved, or wants."""
    wants: Annotated[tuple[Point, ...], Meta(max_length=MOST_POINTS)] = ()
    """Where it goes on to from the end of the way, when that is one stretch only."""
    waits_for: str = ""
    """The robot that is in the way."""
    why: str = ""
    """What it waits for, in words."""
    ticket: Annotated[int, Meta(ge=0, le=2**53)] = 0
    """Drawn when it begins to wait, higher than any that is known: who has the lower one goes first."""
    waited_s: float = 0.0
    """How long it has waited when this was said."""
    in_line: bool = False
    """It waits for the place itself, and not for a way."""
    stuck: bool = False
    """It found no spot to give way to others."""
