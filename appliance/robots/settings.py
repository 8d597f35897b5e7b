"""What may be set about robots: where MAVLink vehicles are listened for, what they are called, how long to wait.

A gateway listens on UDP or TCP as ground stations do, and vehicles (or SITL's `--out`, or mavlink-router) send to it;
or it connects to what listens itself, or to a serial port.
Every figure that decides how long something is waited for is here and nowhere else.
"""

import math
import re

from msgspec import Struct

from appliance.errors import ConfigError
from appliance.model.robot_api import MAX_SYSTEM, MavlinkLink, Remote

MAX_TEMPLATE = 500
MAX_MISSION = 2000
_PLACEHOLDER = re.compile(r"\{(.*?)\}")
_KNOWN_PLACES = frozenset({"robot", *"234567"})


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
    vehicles_share: tuple[str, ...] = ("ADSB_VEHICLE", "COLLISION", "SYSTEM_TIME")
    """Messages for everybody that vehicles get of each other, by name: traffic, collision warnings, the time.
    FOLLOW_TARGET or GLOBAL_POSITION_INT let one vehicle follow another. Other telemetry goes to ground stations and
    onboard computers only: with N vehicles it would be N times N frames."""
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
