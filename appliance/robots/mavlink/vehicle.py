"""What a gateway knows of one MAVLink vehicle: its mode, condition and track, and who commands it.

Its messages reach from here whatever waits for them. State is only ever what the vehicle has said of itself; nothing
is assumed from a command having been sent, and nothing concluded from silence. `hear` takes a frame and the time and
does no I/O, so that logs can be played through it.

Modes: MAVLink tells them as a number that means something else for each kind of vehicle (ArduCopter/mode.h,
Rover/mode.h). A vehicle of a kind that is not here is watched and not commanded: an order to a mode that means
something else there is an accident.

Condition: what estimator, battery, fence and failsafes say, as flags in words (EKF_STATUS_REPORT, ESTIMATOR_STATUS,
FENCE_STATUS, BATTERY_STATUS, HEARTBEAT.system_status, SYS_STATUS).

Track: positions told of late, each with the time at which the vehicle says that it was there. A gateway may look seldom
and a radio may hold reports back, so neither the time of looking nor that of hearing tells how far a vehicle went
between two positions.

Control authority: the gateway, a person at the vehicle, or its own failsafes. A gateway that goes on commanding while a
pilot has taken the sticks fights with them. So it notices: a mode that it did not order, sticks moved over the gateway
(RC_CHANNELS_OVERRIDE, MANUAL_CONTROL), a failsafe in force. The vehicle is then *seized*: the command in progress fails
with the reason, further ones are refused, and nothing that the gateway does of its own accord changes the mode. It is
given back by the one who took it (the mode that the gateway had ordered, or the guided mode, is chosen again; the
motors are off; the failsafe is over), or taken back by an operator (`release`). A gateway that has just started, or a
vehicle that has just been armed, has no order yet that a mode could be measured by; but a gateway never orders a mode
in which sticks move a vehicle, so the one who chose it has the vehicle. On the ground with the motors off nothing is
seized: there a mode is a setting.
"""

import asyncio
import math
from collections import Counter, deque
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from msgspec import Struct

from appliance.model import Pose, RobotInfo, Site
from appliance.model.robots import plausible_altitude, plausible_battery, plausible_item, plausible_place
from appliance.model.site import to_site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Frame, Message
from appliance.robots.mavlink.statustext import REFUSAL_SEVERITY, Said, Texts

# --- modes -----------------------------------------------------------------------------------------------------------


class Modes(Struct, frozen=True, kw_only=True):
    """The modes of a kind of vehicle, and which of them the gateway uses for what."""

    numbers: dict[str, int]
    guided: str = "GUIDED"
    """Goes where it is sent, and stays where it is without an order."""
    mission: str = "AUTO"
    home: str = "RTL"
    land: str = ""
    """Empty: it does not fly."""
    follows: dict[str, frozenset[str]] = {}
    """Modes that the autopilot itself goes on to from another, without anybody having taken over."""
    by_hand: frozenset[str] = frozenset()
    """Modes in which a person's sticks, or hands, move it. GUIDED_NOGPS and FOLLOW are not: a computer does."""
    plain: frozenset[str] = frozenset()
    """Modes that anybody who commands it may choose: it stays, goes home, comes down, or waits for orders. In others it
    goes where nobody has checked that it may (AUTO flies whatever mission is on board), or does tricks."""

    def name(self, number: int) -> str:
        """Return a mode's name, its number where it has none."""
        return next((name for name, each in self.numbers.items() if each == number), str(number))


COPTER = Modes(
    numbers={
        **dialect.COPTER_MODES,
        "ACRO": 1,
        "CIRCLE": 7,
        "DRIFT": 11,
        "SPORT": 13,
        "FLIP": 14,
        "AUTOTUNE": 15,
        "THROW": 18,
        "GUIDED_NOGPS": 20,
        "FLOWHOLD": 22,
        "FOLLOW": 23,
        "ZIGZAG": 24,
        "AUTO_RTL": 27,
    },
    land="LAND",
    follows={"RTL": frozenset({"LAND"}), "SMART_RTL": frozenset({"RTL", "LAND"}), "BRAKE": frozenset({"LOITER"})},
    by_hand=frozenset(
        {
            "STABILIZE",
            "ACRO",
            "ALT_HOLD",
            "LOITER",
            "POSHOLD",
            "DRIFT",
            "SPORT",
            "FLOWHOLD",
            "FLIP",  # out of a mode flown by hand, and back to it
            "AUTOTUNE",
            "ZIGZAG",
            "CIRCLE",  # sticks change radius, speed and height; a circle that the gateway flies is a mission
            "THROW",  # armed in somebody's hand
        }
    ),
    plain=frozenset({"GUIDED", "BRAKE", "LAND", "RTL", "SMART_RTL"}),
)
ROVER = Modes(
    numbers={
        "MANUAL": 0,
        "ACRO": 1,
        "STEERING": 3,
        "HOLD": 4,
        "LOITER": 5,
        "FOLLOW": 6,
        "SIMPLE": 7,
        "AUTO": 10,
        "RTL": 11,
        "SMART_RTL": 12,
        "GUIDED": 15,
    },
    follows={"RTL": frozenset({"HOLD"}), "SMART_RTL": frozenset({"RTL", "HOLD"})},
    by_hand=frozenset({"MANUAL", "ACRO", "STEERING", "SIMPLE"}),
    plain=frozenset({"GUIDED", "HOLD", "LOITER", "RTL", "SMART_RTL"}),
)
GROUND = frozenset({dialect.constant("MAV_TYPE_GROUND_ROVER"), dialect.constant("MAV_TYPE_SURFACE_BOAT")})
"""What ArduRover drives."""


def modes_of(autopilot: int, kind: int) -> Modes | None:
    """Return the modes of a vehicle by its heartbeat (MAV_AUTOPILOT, MAV_TYPE), None when they are not known here."""
    if autopilot != dialect.AUTOPILOT_ARDUPILOT:
        return None
    if kind in dialect.MULTIROTORS:
        return COPTER
    return ROVER if kind in GROUND else None


# --- condition -------------------------------------------------------------------------------------------------------

_ESTIMATOR = {
    0x01: "no attitude",
    0x02: "no horizontal velocity",
    0x04: "no vertical velocity",
    0x10: "no position",
    0x20: "no height",
}
"""Bits of EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS, which agree on them, and what it means that one is missing."""
_RELATIVE = 0x08
"""A position relative to the start stands in for an absolute one."""
_CONST_POSITION = 0x80
_GLITCH = 0x400
_CRITICAL, _EMERGENCY, _TERMINATING = (
    dialect.constant(f"MAV_STATE_{name}") for name in ("CRITICAL", "EMERGENCY", "FLIGHT_TERMINATION")
)
_CHARGE = {2: "battery low", 3: "battery critical", 4: "battery emergency", 5: "battery failed", 6: "battery unhealthy"}
"""MAV_BATTERY_CHARGE_STATE."""
_LOW_IS_NO_FAILSAFE = frozenset({"battery low"})
_FENCE = {1: "below the fence's floor", 2: "above the fence's ceiling", 3: "outside the fence"}
"""FENCE_BREACH."""
PREARM_CHECK = dialect.constant("MAV_SYS_STATUS_PREARM_CHECK")


class Condition:
    """Flags of one vehicle. `hear` returns whether any of them changed."""

    def __init__(self) -> None:
        self.estimator: tuple[str, ...] = ()
        """What the estimator does not know, empty when it is well or has said nothing."""
        self.estimating = False
        """It has said something."""
        self.prearm: bool | None = None
        """Whether the autopilot would arm; None when it does not say."""
        self._state = ""
        self._charge = ""
        self._fence = ""

    @property
    def failsafe(self) -> str:
        """The failsafes in force in words, empty when there is none."""
        charge = "" if self._charge in _LOW_IS_NO_FAILSAFE else self._charge
        return ", ".join(each for each in (self._state, charge, self._fence) if each)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is not well and no failsafe."""
        return (self._charge,) if self._charge in _LOW_IS_NO_FAILSAFE else ()

    def hear(self, name: str, message: Message) -> bool:
        """Take in a message of the autopilot."""
        before = (self.estimator, self.failsafe, self.warnings, self.prearm)
        match name:
            case "HEARTBEAT":
                self._state = _STATES.get(int(message.system_status), "")
            case "EKF_STATUS_REPORT" | "ESTIMATOR_STATUS":
                self.estimating = True
                self.estimator = estimator(int(message.flags))
            case "BATTERY_STATUS":
                if message.id == 0:
                    self._charge = _CHARGE.get(int(getattr(message, "charge_state", 0)), "")
            case "FENCE_STATUS":
                self._fence = _FENCE.get(int(message.breach_type), "fence breached") if message.breach_status else ""
            case "SYS_STATUS":
                if message.onboard_control_sensors_enabled & PREARM_CHECK:
                    self.prearm = bool(message.onboard_control_sensors_health & PREARM_CHECK)
            case _:
                return False
        return before != (self.estimator, self.failsafe, self.warnings, self.prearm)


_STATES = {_CRITICAL: "failsafe", _EMERGENCY: "emergency", _TERMINATING: "flight termination"}


class Summary(Struct, frozen=True):
    """What of it goes into the roster."""

    estimator: tuple[str, ...]
    failsafe: str


def estimator(flags: int) -> tuple[str, ...]:
    """Return in words what an estimator's flags say is missing or wrong."""
    missing = [
        words
        for bit, words in _ESTIMATOR.items()
        if not flags & bit and not (bit == 0x10 and flags & _RELATIVE and not flags & _CONST_POSITION)
    ]
    if flags & _CONST_POSITION and "no position" not in missing:
        missing.append("no position")
    if flags & _GLITCH:
        missing.append("GPS glitch")
    return tuple(missing)


# --- control authority -----------------------------------------------------------------------------------------------

OVERRIDES = frozenset({"RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL"})
"""Messages by which a ground station moves a vehicle's sticks."""

STICKS_S = 3.0
"""Overrides come several times a second; after so long without one the sticks are let go."""
_REST = 60
"""Sticks are never quite in the middle: microseconds, or thousandths."""
_MIDDLE_US = 1500
_NO_CHANNEL = frozenset({0, 65535})
_NO_AXIS = 32767
CHANGE_S = 15.0
"""A mode that was ordered is to be taken up within so long; before, the old one is no takeover."""


class PilotOverride(Struct, frozen=True):
    """Who has the vehicle, and why, in words."""

    by: str
    """`pilot` or `failsafe`."""
    why: str


class Control:
    """Of one vehicle; times are monotonic seconds."""

    def __init__(self) -> None:
        self.seized: PilotOverride | None = None
        self._own: int | None = None
        """The mode in which it is the gateway's: ordered and taken up, or what it was taken back in; None: none yet."""
        self._wanted: int | None = None
        """The mode of a change in flight."""
        self._wanted_at = 0.0
        self._passing: frozenset[int] = frozenset()
        """Modes that may show until the change has been taken up: the one before, and changes ordered before it."""
        self._sticks_at: float | None = None
        self._failsafe = ""
        self._mode: int | None = None
        self._armed = False

    def order(self, mode: int, now: float) -> None:
        """Note that the gateway asks for a mode."""
        if self._wanted is None and mode in (self._own, self._mode):
            self._own = mode
            return
        # While another change is in flight the mode heard last says nothing: it may still be taken up.
        before = {each for each in (self._own, self._mode, self._wanted) if each is not None}
        self._passing = frozenset(before) | (self._passing if self._wanted is not None else frozenset())
        self._wanted, self._wanted_at = mode, now

    def hear(self, mode: int, armed: bool, failsafe: str, modes: Modes | None, now: float) -> bool:
        """Take in what a heartbeat says; returns whether the seizure changed.

        Args:
            mode: custom mode.
            armed: whether the motors are on.
            failsafe: failsafes in force in words.
            modes: of this kind of vehicle; None: they are not known, and nothing is decided.
            now: monotonic seconds.
        """
        before = self.seized
        landed = self._armed and not armed
        self._mode, self._armed, self._failsafe = mode, armed, failsafe
        if modes is None:
            return False
        if not armed:
            self._rest(mode, landed=landed)
            return before is not None
        if self._sticks_at is not None and now - self._sticks_at > STICKS_S:
            self._sticks_at = None
        given_back = mode in (self._own, self._wanted, modes.numbers[modes.guided])
        if self.seized is not None and given_back and not failsafe and self._sticks_at is None:
            self.seized = None
            # Where nothing was ordered yet there is still nothing that a mode could be measured by.
            ordered = self._own is not None or self._wanted is not None
            self._settle(mode if ordered else None)
        elif self.seized is None:
            self.seized = self._look(mode, modes, now)
        elif self.seized.by == "pilot" and failsafe:
            self.seized = PilotOverride("failsafe", _failsafe(failsafe, modes.name(mode)))
        return before != self.seized

    def _rest(self, mode: int, *, landed: bool) -> None:
        """Nobody has it while its motors are off; what the gateway orders for the next flight counts."""
        self.seized, self._sticks_at = None, None
        if landed:
            self._own, self._wanted = None, None
        elif mode == self._wanted:
            self._settle(mode)
        elif mode != self._own:
            self._own = None

    def _settle(self, mode: int | None) -> None:
        self._own, self._wanted, self._passing = mode, None, frozenset()

    def sticks(self, system: int, moved: bool, now: float) -> bool:
        """Take in an override that passed the gateway on its way to the vehicle; returns whether it is a seizure."""
        if not moved:
            return False
        self._sticks_at = now
        if not self._armed or self.seized is not None:
            return False
        self.seized = PilotOverride("pilot", f"somebody moves its sticks from system {system}")
        return True

    def release(self) -> PilotOverride | None:
        """Let an operator take it back; returns who had it. A failsafe in force seizes it again at once."""
        before, self.seized, self._sticks_at = self.seized, None, None
        # The mode it is in is not the one ordered before: it is the starting point of what comes next.
        self._settle(self._mode)
        return before

    def _look(self, mode: int, modes: Modes, now: float) -> PilotOverride | None:
        name = modes.name(mode)
        if self._failsafe:
            return PilotOverride("failsafe", _failsafe(self._failsafe, name))
        if self._wanted is not None:
            wanted = modes.name(self._wanted)
            if mode == self._wanted or name in modes.follows.get(wanted, frozenset()):
                self._settle(self._wanted)
            elif not self._may_show(mode, name, modes):
                return _changed(wanted, name)
            elif now - self._wanted_at <= CHANGE_S:
                return None
            else:
                # It was not taken up: what it stays in is the starting point of what comes next.
                self._settle(self._own if name in modes.by_hand else mode)
        if self._own is None:
            why = f"it is armed in {name}, where sticks move it, and this gateway did not choose that"
            return PilotOverride("pilot", why) if name in modes.by_hand else None
        own = modes.name(self._own)
        follows = mode == self._own or name in modes.follows.get(own, frozenset())
        return None if follows else _changed(own, name)

    def _may_show(self, mode: int, name: str, modes: Modes) -> bool:
        """Whether a mode may show while a change is in flight, without anybody but the gateway having chosen it.

        What was in force or ordered before may, with what the autopilot goes on to from its own mode by itself; the
        guided mode may, in which a pilot hands over.
        """
        before = "" if self._own is None else modes.name(self._own)
        return mode in self._passing or name == modes.guided or name in modes.follows.get(before, frozenset())


def _changed(before: str, now: str) -> PilotOverride:
    return PilotOverride("pilot", f"its mode was changed from {before} to {now}, not by this gateway")


def moved(name: str, message: Message) -> bool:
    """Whether an override holds a stick away from its middle; joysticks at rest are sent all the time."""
    if name == "MANUAL_CONTROL":
        return any(abs(value) > _REST for value in (message.x, message.y, message.r) if value != _NO_AXIS)
    channels = (message.chan1_raw, message.chan2_raw, message.chan4_raw)
    return any(abs(value - _MIDDLE_US) > _REST for value in channels if value not in _NO_CHANNEL)


def _failsafe(words: str, mode: str) -> str:
    return f"{words}: it is in {mode}" if words == "failsafe" else f"failsafe: {words}, it is in {mode}"


# --- track -----------------------------------------------------------------------------------------------------------

_KEPT = 64
"""Reports: six seconds at 10 Hz, far more than passes between two looks."""
_CLOCK_MS = 2**32
"""`time_boot_ms` has 32 bits and wraps after 49.7 days."""


@dataclass(frozen=True, slots=True)
class Report:
    """A position, in site metres, as the vehicle told it."""

    pose: Pose
    boot_ms: int
    """Milliseconds of the vehicle's own clock, which begins when it starts."""
    heard_at: float
    """Monotonic seconds."""


def apart_s(one: Report, other: Report) -> float:
    """Return the seconds from one report to a later one by the vehicle's clock; by ours where its clock stands.

    A clock that went back (a restart, or a report that was overtaken) gives weeks: what was between is not known.
    """
    passed_ms = (other.boot_ms - one.boot_ms) % _CLOCK_MS
    return passed_ms / 1000.0 if passed_ms else other.heard_at - one.heard_at


class Track:
    """The last reports of one vehicle, in the order in which they came."""

    def __init__(self) -> None:
        self.count = 0
        """Reports so far, those that are no longer kept too."""
        self._reports: deque[Report] = deque(maxlen=_KEPT)

    def take(self, report: Report) -> None:
        """Add a report."""
        self._reports.append(report)
        self.count += 1

    def since(self, count: int) -> list[Report]:
        """Return the reports that came after so many, behind the last one before them."""
        return list(self._reports)[-(self.count - count + 1) :]


# --- vehicle ---------------------------------------------------------------------------------------------------------

Address = tuple[str, int]

_NO_HEADING = 65535
_FULL_TURN = 36_000
_NO_BATTERY = -1
_UNKNOWN_TOTAL = 65535
MAX_COMPONENTS = 16
"""Components of one vehicle that are remembered."""
_OF_COMPONENTS = frozenset(
    {
        "COMMAND_ACK",
        "CAMERA_INFORMATION",
        "CAMERA_CAPTURE_STATUS",
        "CAMERA_IMAGE_CAPTURED",
        "GIMBAL_MANAGER_INFORMATION",
        "GIMBAL_DEVICE_ATTITUDE_STATUS",
    }
)
"""Messages that cameras and gimbals send themselves, which somebody here may wait for."""
MAX_WAITING = 256
"""Messages kept for one waiter; older ones are dropped, as on a radio link."""
_HEARD = frozenset(
    (
        "HEARTBEAT",
        "GLOBAL_POSITION_INT",
        "SYS_STATUS",
        "BATTERY_STATUS",
        "HOME_POSITION",
        "MISSION_CURRENT",
        "MISSION_ITEM_REACHED",
        "STATUSTEXT",
        "EKF_STATUS_REPORT",
        "ESTIMATOR_STATUS",
        "FENCE_STATUS",
    )
)
"""Messages that tell the vehicle's state."""


_PERIPHERALS = 100
"""Component ids from here on are those of cameras, gimbals, onboard computers and ground stations (MAV_COMPONENT)."""


def is_autopilot(frame: Frame) -> bool:
    """Tell whether a frame is the heartbeat of a vehicle's autopilot: not of a camera, a gimbal or a ground station.

    Some components and stations name an autopilot too, so the type is looked at as well.

    Components share their vehicle's system id and beat too; the first one heard is often not the autopilot. System and
    component 0 are addresses for all, and no sender's own (MAVLink guide, "Routing").
    """
    return (
        frame.name == "HEARTBEAT"
        and frame.system != 0
        and 0 < frame.component < _PERIPHERALS
        and frame.message.autopilot != dialect.AUTOPILOT_NONE
        and frame.message.type in dialect.VEHICLES
    )


class Vehicle:
    """One vehicle. `send` puts a message on its link; `now` of `hear` is monotonic seconds."""

    def __init__(
        self,
        name: str,
        *,
        site: Site,
        send: Callable[[Message], None],
        announce: Callable[[Message], None] | None = None,
        own: int = 0,
        refused: dict[str, int] | None = None,
    ) -> None:
        self.name = name
        self._refused: dict[str, int] = {} if refused is None else refused
        self.implausible = Counter[str]()
        """How often a field's value could not be, by name."""
        self.own = own
        """System id that the gateway speaks as, to know answers to it from those to others; 0: not known."""
        self.site = site
        self.send = send
        self.announce = announce or send
        """Puts a message on all links, for all who listen: ground stations show STATUSTEXTs."""
        self.system = 0
        self.component = 0
        self.kind = 0
        self.autopilot = 0
        self.custom_mode = 0
        self.armed = False
        self.online = False
        self.heard_at = -math.inf
        self.latitude_deg = 0.0
        self.longitude_deg = 0.0
        self.altitude_m = 0.0
        self.relative_m = 0.0
        self.heading_deg = 0.0
        self.speed_mps = 0.0
        self.fixed = False
        """A position has been told."""
        self.track = Track()
        self.battery_percent: float | None = None
        self.home: tuple[float, float, float] | None = None
        """Latitude, longitude (degrees), altitude (metres)."""
        self.mission_at = 0
        self.mission_complete = False
        self.reached: set[int] = set()
        self.mission_items = 0
        """Items of the mission that is on board, its home included."""
        self.text = ""
        """Last warning that the vehicle gave."""
        self.texts = Texts()
        self.condition = Condition()
        self.control = Control()
        self.components: dict[int, int] = {}
        """Component id -> MAV_TYPE of what else beats under its system id: cameras, gimbals, companion computers."""
        self.exchange = asyncio.Lock()
        """COMMAND_ACK answers by command id alone and there is one mission transfer: one exchange at a time."""
        self._waiting: list[tuple[frozenset[str], asyncio.Queue[Message]]] = []

    @property
    def commandable(self) -> bool:
        """Whether its modes are known here: ArduPilot multirotors, rovers and boats."""
        return self.modes is not None

    @property
    def modes(self) -> Modes | None:
        """Its modes, None when they are not known here."""
        return modes_of(self.autopilot, self.kind)

    @property
    def flies(self) -> bool:
        """Whether it is a multirotor."""
        return self.kind in dialect.MULTIROTORS

    @property
    def mode(self) -> str:
        """Flight mode by name; the number where the name is not known."""
        modes = self.modes
        return str(self.custom_mode) if modes is None else modes.name(self.custom_mode)

    @property
    def airborne(self) -> bool:
        """Armed and clear of the ground."""
        return self.armed and self.relative_m > 0.7

    @property
    def pose(self) -> Pose | None:
        """Position in site metres, None before the first fix."""
        if not self.fixed:
            return None
        x, y, z = to_site(self.site, self.latitude_deg, self.longitude_deg, self.altitude_m)
        return Pose(x=round(x, 3), y=round(y, 3), z=round(z, 3), heading_deg=round(self.heading_deg, 1))

    @property
    def home_pose(self) -> Pose | None:
        """Home in site metres, None before it was told."""
        if self.home is None:
            return None
        x, y, z = to_site(self.site, *self.home)
        return Pose(x=round(x, 2), y=round(y, 2), z=round(z, 2))

    def info(self, gateway: str, verbs: tuple[str, ...], note: str = "") -> RobotInfo:
        """Describe it for the roster."""
        return RobotInfo(
            id=self.name,
            kind="mavlink",
            gateway=gateway,
            uses=("base", "speaker") if self.commandable else (),
            verbs=verbs,
            flies=self.flies,
            pose=self.pose,
            home=self.home_pose,
            battery_percent=self.battery_percent,
            armed=self.armed,
            mode=self.mode,
            online=self.online,
            note=note,
            speed_mps=round(self.speed_mps, 1),
            mission_item=self.mission_at,
            mission_items=self.mission_items,
            estimator=self.condition.estimator,
            warnings=self.condition.warnings,
            failsafe=self.condition.failsafe,
            seized="" if self.control.seized is None else self.control.seized.why,
        )

    def component_of(self, kind: int) -> int | None:
        """Return the id of a component of that MAV_TYPE, None when none has been heard."""
        return min((number for number, each in self.components.items() if each == kind), default=None)

    def hear(self, frame: Frame, now: float) -> bool:
        """Take in a frame; return whether the roster should hear of it at once (mode, arming, failsafes, control)."""
        if frame.component != self.component and frame.name != "HEARTBEAT":
            if frame.name in _OF_COMPONENTS:
                self._pass_on(frame)
            return False
        if frame.name not in _HEARD:
            self._pass_on(frame)
            return False  # most are for others: they are not even decoded
        message = frame.message
        changed = frame.component == self.component and self.condition.hear(frame.name, message)
        match frame.name:
            case "HEARTBEAT":
                changed = self._heartbeat(frame, now) or changed
                for said in self.texts.tick(now):
                    self._said(said)
            case "GLOBAL_POSITION_INT":
                self._position(message, now)
            case "SYS_STATUS" | "BATTERY_STATUS":
                self._battery(float(message.battery_remaining))
            case "HOME_POSITION":
                self._home((message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3))
            case "MISSION_CURRENT":
                self._mission(message)
            case "MISSION_ITEM_REACHED":
                if self._fits("mission item", plausible_item(message.seq)):
                    self.reached.add(message.seq)
            case "STATUSTEXT":
                said = self.texts.take(message.severity, message.text, message.id, message.chunk_seq, now)
                if said is not None:
                    self._said(said)
            case _:
                pass
        self._pass_on(frame)
        return changed

    def _fits(self, field: str, fits: bool) -> bool:
        """Return whether a value can be; one that cannot is counted, and what was known before stays."""
        if not fits:
            self.implausible[field] += 1
            self._refused["implausible"] = self._refused.get("implausible", 0) + 1
        return fits

    def _said(self, said: Said) -> None:
        if said.severity <= REFUSAL_SEVERITY:
            self.text = said.text

    def _pass_on(self, frame: Frame) -> None:
        """Hand a message to those who wait for it."""
        for names, queue in self._waiting:
            if frame.name in names:
                message = frame.message
                if queue.full():
                    queue.get_nowait()
                queue.put_nowait(message)

    @asynccontextmanager
    async def listening(self, *names: str) -> AsyncGenerator[asyncio.Queue[Message]]:
        """Collect messages of those names while the block runs; begin before sending what they answer."""
        queue: asyncio.Queue[Message] = asyncio.Queue(MAX_WAITING)
        entry = (frozenset(names), queue)
        self._waiting.append(entry)
        try:
            yield queue
        finally:
            self._waiting.remove(entry)

    def forget_mission(self) -> None:
        """Forget what was reached: a new mission begins."""
        self.reached = set()
        self.mission_complete = False
        self.mission_at = 0

    def _heartbeat(self, frame: Frame, now: float) -> bool:
        message = frame.message
        if self.component == 0 and is_autopilot(frame):
            self.system, self.component = frame.system, frame.component
        if frame.component != self.component:
            if frame.component in self.components or len(self.components) < MAX_COMPONENTS:
                self.components[frame.component] = message.type
            return False
        if not is_autopilot(frame):
            return False  # somebody else with its address, or not a vehicle any more: what it was is not changed
        before = (self.custom_mode, self.armed, self.kind, self.autopilot)
        self.heard_at = now
        self.kind, self.autopilot = message.type, message.autopilot
        self.custom_mode = message.custom_mode
        self.armed = bool(message.base_mode & dialect.ARMED_FLAG)
        changed = before != (self.custom_mode, self.armed, self.kind, self.autopilot)
        failsafe = self.condition.failsafe
        return self.control.hear(self.custom_mode, self.armed, failsafe, self.modes, now) or changed

    def _battery(self, percent: float) -> None:
        if percent != _NO_BATTERY and self._fits("battery", plausible_battery(percent)):
            self.battery_percent = percent

    def _home(self, home: tuple[float, float, float]) -> None:
        if self._fits("home", plausible_place(*home[:2]) and plausible_altitude(home[2])):
            self.home = home

    def _mission(self, message: Message) -> None:
        if self._fits("mission item", plausible_item(message.seq)):
            self.mission_at = message.seq
        self.mission_complete = message.mission_state == 5
        if message.total != _UNKNOWN_TOTAL and self._fits("mission items", plausible_item(message.total)):
            self.mission_items = message.total

    def _position(self, message: Message, now: float) -> None:
        self.speed_mps = math.hypot(message.vx, message.vy, message.vz) / 100.0  # 16 bits: at most 567 m/s
        if message.hdg != _NO_HEADING and self._fits("heading", message.hdg <= _FULL_TURN):
            self.heading_deg = message.hdg / 100.0
        altitude, relative = message.alt / 1e3, message.relative_alt / 1e3
        place = (message.lat / 1e7, message.lon / 1e7)
        heights = plausible_altitude(altitude) and plausible_altitude(relative)
        # A position counts whole or not at all: a new place at an old height is none where the vehicle has been.
        if not self._fits("position", plausible_place(*place) and heights):
            return
        self.latitude_deg, self.longitude_deg = place
        self.altitude_m, self.relative_m = altitude, relative
        # 0, 0 is what autopilots send before they know: the sea off Ghana is no site.
        self.fixed = message.lat != 0 or message.lon != 0
        if (pose := self.pose) is not None:
            self.track.take(Report(pose, message.time_boot_ms, now))
