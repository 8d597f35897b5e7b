"""What an operator orders of robots over RPC: the request and reply structs of the verbs.

soft_stop       StopAsk -> StopAnswer       robots hold and are given no command, until
soft_resume     ResumeRobotsAsk -> StopAnswer   it is lifted
standing        StandingAsk -> Standing     all soft stops and leases known there; also takes in the asker's
control_take    TakeAsk -> Lease            take a robot over: `conflict` names who has it
control_renew   RenewAsk -> Lease           before the lease ends
control_move    DriveAsk -> RobotReply      a command under the lease
control_give    GiveAsk -> Lease            give it back; it holds
"""

from typing import Annotated, Any

from msgspec import Meta, Struct, field

from appliance.model import Lease, Lifted, Signed, SoftStop
from appliance.model.steering import MAX_ACT

LEASE_S = 10.0
"""Long enough for a link that blinks, short enough that nobody waits for an operator who is gone."""

Robots = Annotated[tuple[str, ...], Meta(max_length=256)]


class StopAsk(Signed, frozen=True, kw_only=True):
    """`soft_stop`: these robots; none: the whole fleet. `act` becomes the id of the stop."""

    robots: Robots = ()


class ResumeRobotsAsk(Signed, frozen=True, kw_only=True):
    """`soft_resume`: these robots, of the stops that the operator has seen; none: lift these stops for all."""

    robots: Robots = ()
    stops: Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=MAX_ACT)], ...], Meta(max_length=1024)] = ()
    """Those that the operator had before them, by id; none: those that the asked gateway knows."""


class StopAnswer(Struct, frozen=True, kw_only=True):
    """What a stop or its lifting came to by the time of the answer."""

    stops: tuple[SoftStop, ...]
    """Those in force now."""
    gateways: tuple[str, ...] = ()
    """Which have it on disk."""
    silent: tuple[str, ...] = ()
    """Which did not confirm yet; they hear it by the put, or when they come."""
    robots: tuple[str, ...] = ()
    """Which confirmed that they hold."""
    problems: dict[str, str] = {}
    """Robots that did not, and why."""


class StandingAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`standing`: with what the asker knows, so that both know the same afterwards."""

    stops: tuple[SoftStop, ...] = ()
    lifted: tuple[Lifted, ...] = ()
    leases: tuple[Lease, ...] = ()


class Standing(Struct, frozen=True, kw_only=True):
    """All that a gateway knows. `active`: the stops that are in force for some robot."""

    stops: tuple[SoftStop, ...] = ()
    lifted: tuple[Lifted, ...] = ()
    leases: tuple[Lease, ...] = ()
    active: tuple[SoftStop, ...] = ()


class TakeAsk(Signed, frozen=True, kw_only=True):
    """`control_take`: `act` becomes the lease's id."""

    robot: str
    lease_s: Annotated[float, Meta(ge=1, le=120)] = LEASE_S


class RenewAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`control_renew`."""

    robot: str
    lease: str


class DriveAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`control_move`: any verb of the robot; `velocity` moves for a moment only and must be repeated."""

    robot: str
    lease: str
    verb: str
    args: dict[str, Any] = field(default_factory=dict[str, Any])
    timeout_s: Annotated[float, Meta(gt=0, le=120)] = 5.0


class GiveAsk(Signed, frozen=True, kw_only=True):
    """`control_give`."""

    robot: str
    lease: str
