"""Requests and replies of the robots' verbs (MAVLink links, soft stops, leases of operators), and what a link is."""

import ipaddress
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from msgspec import Meta, Struct, field

from appliance.errors import ConfigError, PayloadError
from appliance.model import Lease, Lifted, Signed, SoftStop
from appliance.model.keys import check_name
from appliance.model.steering import MAX_ACT

MAX_SYSTEM = 255

DEFAULT_LISTEN = "udp://127.0.0.1:14550"
"""14550 is where ground stations listen; loopback, since MAVLink frames are not authenticated."""


class Remote(Struct, frozen=True):
    """An address of MAVLink: listen there, or connect to it. Of a serial port `host` is its device, `port` its baud."""

    scheme: Literal["udp", "tcp", "serial"]
    host: str
    port: int
    listens: bool

    def __str__(self) -> str:
        if self.scheme == "serial":
            return f"serial:{self.host}:{self.port}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"


class MavlinkLink(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One link on which vehicles are heard. `names` maps MAVLink system ids (as text) to robot names."""

    listen: str = ""
    """`udp://host:port` or `tcp://host:port` to listen on. With neither `listen` nor `connect`: udp://127.0.0.1:14550."""
    connect: str = ""
    """The same to connect to, again and again while nobody is there: a vehicle, SITL or a router that listens. Or
    `serial:/dev/ttyUSB0:57600`, a serial port and its baud, which may be unplugged and plugged in again."""
    signing: str = ""
    """File with the link's MAVLink 2 signing key, readable by this user alone: a passphrase, or `hex:` and 64 digits;
    `credential:NAME` for one that systemd hands over. Set, every frame sent is signed and frames that are unsigned,
    wrongly signed or replayed are refused. Empty: no signing, and signed frames are refused."""
    mavlink1: bool = False
    """Send MAVLink 1 alone, to an old radio or autopilot that understands no other; both are always understood. What
    MAVLink 1 has no message for (TUNNEL, gimbal managers, ...) is then not sent, and counted. Not with `signing`."""
    only_in: tuple[str, ...] = ()
    """Messages by name (`ATTITUDE`, ...) or number heard here that may go on to other links; none: all."""
    not_in: tuple[str, ...] = ()
    """But not these."""
    only_out: tuple[str, ...] = ()
    """Messages of other links that may be sent here; none: all. A slow radio wants few."""
    not_out: tuple[str, ...] = ()
    """But not these."""
    names: dict[str, str] = field(default_factory=dict[str, str])
    prefix: str = "drone_"
    """Name of a vehicle not in `names`: prefix and system id. Empty: such vehicles are refused."""

    @property
    def remote(self) -> Remote:
        """Where the link is; ConfigError when it is not understood, or to be both listened on and connected to."""
        if self.listen and self.connect:
            raise ConfigError(
                f"robots.mavlink: a link both listens on {self.listen} and connects to {self.connect}",
                remedy="write two links",
            )
        return read_remote(self.connect or self.listen or DEFAULT_LISTEN, listens=not self.connect)

    def name_of(self, system: int) -> str | None:
        """Return the robot name of a system id, None when such a vehicle is not accepted."""
        named = self.names.get(str(system))
        if named is not None:
            return named
        return f"{self.prefix}{system}" if self.prefix else None

    def check_keyed(self) -> None:
        """Raise ConfigError for a link that others may reach, of a gateway with keys, and that is not signed.

        A serial port is a cable, and what is on the loopback is on the gateway.
        """
        remote = self.remote
        if self.signing or remote.scheme == "serial":
            return
        try:
            local = ipaddress.ip_address(remote.host.partition("%")[0]).is_loopback
        except ValueError:
            local = remote.host == "localhost"
        if not local:
            raise ConfigError(
                f"robots.mavlink {remote} is not signed, and plane.keys is set: "
                "anybody who reaches it could command vehicles",
                remedy="set `signing` (docs/robots.md), or use 127.0.0.1 or a serial port",
            )

    def check(self) -> None:
        """Raise ConfigError for an address, system id or name that cannot be."""
        _ = self.remote
        if self.mavlink1 and self.signing:
            raise ConfigError(
                f"robots.mavlink {self.remote}: MAVLink 1 has no signatures", remedy="leave out mavlink1 or signing"
            )
        for system, name in self.names.items():
            if not system.isdecimal() or not 1 <= int(system) <= MAX_SYSTEM:
                raise ConfigError(
                    f"robots.mavlink names: {system!r} is not a MAVLink system id", remedy="use 1 to 255 as keys"
                )
            _check_robot_name(name)
        if self.prefix:
            _check_robot_name(f"{self.prefix}{MAX_SYSTEM}")


def read_remote(url: str, *, listens: bool) -> Remote:
    """Split `udp://host:port`, `tcp://host:port` or `serial:/dev/name:baud`; ConfigError with the remedy otherwise."""
    problem = ConfigError(
        f"MAVLink address {url[:200]!r} is not understood",
        remedy="write udp://host:port or tcp://host:port, or serial:/dev/name:baud",
    )
    if url.startswith("serial:"):
        device, _, baud = url.removeprefix("serial:").rpartition(":")
        if not device.startswith("/") or not baud.isascii() or not baud.isdecimal():
            raise problem
        return Remote("serial", device, int(baud), False)
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise problem from None
    if parts.scheme not in ("udp", "tcp") or not parts.hostname or port is None or parts.path not in ("", "/"):
        raise problem
    return Remote("udp" if parts.scheme == "udp" else "tcp", parts.hostname, port, listens)


def _check_robot_name(name: str) -> None:
    try:
        check_name(name, "robot")
    except PayloadError as error:
        raise ConfigError(f"robots.mavlink: {error.message}", remedy=error.remedy) from error


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
    passed: dict[str, int] = field(default_factory=dict[str, int])
    """Frames for everybody that were passed on to it since it was opened, by their sender (`1/1`): in the log they
    stand once, as they were heard."""
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


class StandingAsk(Struct, frozen=True, kw_only=True):
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
