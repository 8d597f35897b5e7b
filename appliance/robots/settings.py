"""What may be set about robots: where MAVLink vehicles are listened for, what they are called, how long to wait.

A gateway listens on UDP or TCP as ground stations do, and vehicles (or SITL's `--out`, or mavlink-router) send to it;
or it connects to what listens itself, or to a serial port.
Every figure that decides how long something is waited for is here and nowhere else.
"""

import math
import re
from typing import Literal
from urllib.parse import urlsplit

from msgspec import Struct, field

from appliance.errors import ConfigError, PayloadError
from appliance.plane.keys import check_name

MAX_SYSTEM = 255
MAX_TEMPLATE = 500
MAX_MISSION = 2000
_PLACEHOLDER = re.compile(r"\{(.*?)\}")
_KNOWN_PLACES = frozenset({"robot", *"234567"})


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


class Template(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A task that a MAVLink command asks for by number (MAV_CMD_USER_1, param1)."""

    id: int
    """1 to 65535."""
    instruction: str
    """What to do; `{robot}` is the vehicle that asks or is addressed, `{2}` to `{7}` are the command's parameters."""
    label: str = ""
    """What a ground station's button says; the instruction where empty."""

    def check(self) -> None:
        """Raise ConfigError for what cannot be asked for."""
        if not 1 <= self.id <= 65_535:
            raise ConfigError(f"robots.templates: id {self.id}", remedy="use 1 to 65535")
        if not self.instruction.strip() or len(self.instruction) > MAX_TEMPLATE:
            raise ConfigError(
                f"robots.templates {self.id}: an instruction of {len(self.instruction)} characters",
                remedy=f"write 1 to {MAX_TEMPLATE}",
            )
        unknown = [each for each in _PLACEHOLDER.findall(self.instruction) if each not in _KNOWN_PLACES]
        if unknown:
            raise ConfigError(
                f"robots.templates {self.id}: {{{unknown[0]}}} stands for nothing", remedy="use {robot}, {2} to {7}"
            )


class RobotsConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the robots room; times in seconds."""

    mavlink: tuple[MavlinkLink, ...] = ()
    """None: this gateway has no MAVLink vehicles of its own."""
    templates: tuple[Template, ...] = ()
    """Tasks that MAVLink commands may ask for; `swiftbot robots qgc-actions` makes QGroundControl's buttons of them."""
    route: bool = True
    """Pass frames on between links and ends, as MAVLink routers do: a ground station on one link then sees and
    commands the vehicles of the others. Off: the gateway alone speaks to its vehicles."""
    sender_hz: float = 5000.0
    """Most frames a second from one other end of a link, with a burst of as many: a vehicle sends 50 to 500, a router
    with ten vehicles behind it ten times that. What more comes in datagrams is dropped and counted as `flood`, a
    stream is read more slowly; the other ends do not notice. 0: no limit."""
    message_hz: float = 500.0
    """Most frames a second of one message from one sender (system and component), with a burst of four seconds' worth:
    what more comes is a storm, as of two programs that answer each other's answers. It is let through in a trickle
    (4 %) until it is over, counted as `damped`, and reported once. Messages that carry files are excepted.
    0: no limit."""
    repeat_s: float = 0.5
    """The same bytes within so long are a repetition, which came by two ways or round a ring of routers, and go no
    further. Such copies come within tenths of a second; some senders do say the same again after seconds."""
    timesync_s: float = 5.0
    """How often each end with a vehicle is asked for its time (TIMESYNC), which tells the latency. 0: never."""
    mission_items: int = 200
    """Most items of a mission uploaded to the gateway: a plan of as many steps is more than anybody reads."""
    system_id: int = 242
    """Of the gateway as a MAVLink system. Vehicles count from 1 up; ground stations have 255 and 254, MAVSDK 245."""
    component_id: int = 191
    """MAV_COMP_ID_ONBOARD_COMPUTER: autopilots leave commands to it alone."""
    heartbeat_s: float = 1.0
    heartbeat_lost_s: float = 3.0
    """Three missed heartbeats: what ground stations call lost."""
    state_hz: float = 5.0
    """Most RobotInfo per second and vehicle, beside changes of mode, arming and connection."""
    ack_timeout_s: float = 0.7
    """Before a command or mission message is sent again; radio links answer within 0.5 s."""
    tries: int = 8
    """At 20 % loss each way one exchange fails with 0.36; eight in a row with 0.0003."""
    takeoff_altitude_m: float = 10.0
    """Where a flight begins when no altitude is given."""
    cruise_mps: float = 5.0
    """Speed of a flight when none is given, within the site's limit: ArduCopter's own."""
    drive_mps: float = 2.0
    """The same of vehicles on the ground: ArduRover's own."""
    servos: tuple[int, ...] = ()
    """Servo outputs (1 to 16) that commands may set. None: among them are motors and rudders, which nothing else
    tells from a lamp or a latch."""
    arrival_m: float = 1.5
    """Nearer than this to the last waypoint is there: GPS is no better."""
    stall_s: float = 45.0
    """A movement that has not come nearer to its end for so long has failed."""
    ledger: int = 1000
    """Command ids remembered per robot."""
    max_vehicles: int = 32
    """Per link; heartbeats of further systems are refused."""

    def check(self) -> None:
        """Raise ConfigError for values that cannot work together."""
        remotes: set[Remote] = set()
        for link in self.mavlink:
            link.check()
            if link.remote in remotes:
                raise ConfigError(f"robots.mavlink: {link.remote} is given twice", remedy="one link per address")
            remotes.add(link.remote)
        for template in self.templates:
            template.check()
        if any(not 1 <= each <= 16 for each in self.servos):
            raise ConfigError("robots.servos: outputs count from 1 to 16", remedy="name those that are free")
        for name, speed in (("cruise_mps", self.cruise_mps), ("drive_mps", self.drive_mps)):
            if not 0.0 < speed <= 100.0:
                raise ConfigError(f"robots.{name}: {speed:g} m/s", remedy="use more than 0, at most 100")
        numbers = [each.id for each in self.templates]
        if len(set(numbers)) < len(numbers):
            raise ConfigError("robots.templates: an id is given twice", remedy="give each its own")
        for name, value in (
            ("sender_hz", self.sender_hz),
            ("message_hz", self.message_hz),
            ("repeat_s", self.repeat_s),
            ("timesync_s", self.timesync_s),
        ):
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"robots.{name} {value:g}", remedy="use 0 or more")
        if not 1 <= self.mission_items <= MAX_MISSION:
            raise ConfigError(f"robots.mission_items {self.mission_items}", remedy=f"use 1 to {MAX_MISSION}")
        if not 1 <= self.system_id <= MAX_SYSTEM:
            raise ConfigError(f"robots.system_id {self.system_id} is not a MAVLink system id", remedy="use 1 to 255")


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
