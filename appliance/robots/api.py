"""Requests and replies of the robots' RPC methods: links and vehicles of a gateway, soft stops, and operators' leases.

robot_links     LinksAsk -> LinkList        the gateway's MAVLink links, and what is counted of each
robot_link_add      LinkAdd -> LinkFacts    open a link and keep it over restarts
robot_link_remove   LinkRemove -> LinkFacts     close a link for good
robot_forget    RobotForget -> Forgotten    remove the row of a robot that is offline
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
from appliance.robots.settings import MavlinkLink


class LinksAsk(Struct, frozen=True, kw_only=True):
    """Verb `robot_links`: which MAVLink links are there, and how are they?"""


class LinkAdd(Struct, frozen=True, kw_only=True):
    """Verb `robot_link_add`: open a link and keep it over restarts; the same again changes nothing."""

    link: MavlinkLink
    by: str = ""
    """Who wants it, for the log."""


class LinkRemove(Struct, frozen=True, kw_only=True):
    """Verb `robot_link_remove`: close a link for good, also one of the configuration."""

    url: str
    """As the list shows it."""
    by: str = ""


class RobotForget(Struct, frozen=True, kw_only=True):
    """Verb `robot_forget`: remove the row of a robot that is offline; it comes back when it is heard again."""

    robot: str
    by: str = ""
    """Who wants it, for the log."""


class Forgotten(Struct, frozen=True, kw_only=True):
    """A robot whose row was removed."""

    robot: str
    gateway: str
    """Which did it."""


class SenderFacts(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One MAVLink sender as heard on one link."""

    system: int
    component: int
    received: int = 0
    lost: int = 0
    """By gaps in its sequence numbers."""
    loss: float = 0.0
    """Share of its frames that did not arrive, 0 to 1."""
    late: int = 0
    """Frames that came after later ones."""
    repeated: int = 0
    """Frames that had come before, on this link or another; dropped."""
    silent_s: float = 0.0


class LatencyFacts(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Round trips of TIMESYNC to one other end, milliseconds."""

    end: str
    last_ms: float
    least_ms: float
    mean_ms: float
    count: int


class LinkFacts(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One link and what went over it since it was opened."""

    number: int
    """The link's number, which is also that of its signatures."""
    url: str
    listens: bool = False
    signed: bool = False
    added: bool = False
    """At run time, not by the configuration."""
    ends: tuple[str, ...] = ()
    """Other ends heard lately."""
    frames_in: int = 0
    frames_out: int = 0
    bytes_in: int = 0
    bytes_out: int = 0
    in_hz: float = 0.0
    """Frames a second, over the last second or so; likewise the following."""
    out_hz: float = 0.0
    in_bytes_s: float = 0.0
    out_bytes_s: float = 0.0
    refused: dict[str, int] = field(default_factory=dict[str, int])
    """Damaged and unbelieved frames, floods, and what could not be sent, by kind."""
    damped: tuple[str, ...] = ()
    """Messages that come in a storm just now and are cut, with their senders: `PARAM_VALUE of 1/1`."""
    senders: tuple[SenderFacts, ...] = ()
    latency: tuple[LatencyFacts, ...] = ()
    problem: str = ""
    """Why it is not connected, where it is not."""


class LinkList(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All MAVLink links of a gateway; put every second on `gw/{gateway}/mavlink/links` where it has any."""

    gateway: str
    links: tuple[LinkFacts, ...] = ()
    routes: dict[str, str] = field(default_factory=dict[str, str])
    """Where each `system/component` was heard last: the link's URL and the end."""


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
