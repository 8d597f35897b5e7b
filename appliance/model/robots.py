"""Robots as their speakers describe them, orders to them, and what came of these."""

from typing import Any

from msgspec import Struct, field

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
