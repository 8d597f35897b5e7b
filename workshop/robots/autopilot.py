"""The simulated autopilots' common part: what they answer to MAVLink messages, how they arm, what makes them fail safe.

They behave as ArduPilot does where a ground station could tell the difference: home in mission item 0, arming refused
with PreArm texts, failsafes that change the mode and show in HEARTBEAT.system_status, unknown commands UNSUPPORTED.
No I/O: messages in, messages out, time passed in. `flight` is the body that moves.
"""

import abc
import math
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from appliance.model import Site
from appliance.model.site import to_globe, to_site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Frame, Message, make
from appliance.robots.mavlink.statustext import statustext
from appliance.robots.mavlink.vehicle import Modes
from workshop.robots import orders
from workshop.robots.board import Board, Sender
from workshop.robots.flight import Flight, Point
from workshop.robots.ground import Ground
from workshop.robots.parameters import REQUESTS as PARAMETER_REQUESTS
from workshop.robots.parameters import Parameters
from workshop.robots.safety import Failsafes, arming_problems
from workshop.robots.telemetry import telemetry

FLYABLE = frozenset(
    {
        dialect.WAYPOINT,
        dialect.TAKEOFF,
        dialect.LAND,
        dialect.RETURN,
        dialect.LOITER_TURNS,
        dialect.CHANGE_SPEED,
        dialect.IMAGE_START,
        dialect.GRIPPER,
        dialect.SERVO,
        dialect.LOOK_AT,
    }
)
"""Commands that a mission item may have."""
_STICKS_S = 3.0
_GUIDED_S = 3.0
"""GUID_TIMEOUT: velocities of the guided mode count for so long."""


Body = TypeVar("Body", Flight, Ground)


class Autopilot(abc.ABC, Generic[Body]):
    """One vehicle. `handle` returns answers; `step` moves and returns what it says by itself."""

    modes: Modes
    kind: int
    """MAV_TYPE."""
    armable: frozenset[str]
    flight: Body

    def __init__(self, *, system: int, site: Site, home: tuple[float, float], parameters: Mapping[str, float]) -> None:
        self.system = system
        self.site = site
        self.home = home
        self.parameters = Parameters(parameters, system=system)
        self.failsafes = Failsafes()
        self.board = Board(self._point, self._no_mission, FLYABLE)
        self.at = 0
        self.running = False
        self.complete = False
        self.takeoffs = 0
        """Take-offs begun, for tests."""
        self.pictures = 0
        """Pictures that missions and commands asked of the autopilot."""
        self.gripper = ""
        self.servos: dict[int, int] = {}
        self.tunes: list[str] = []
        """Tunes played, the last ten."""
        self.clock = 0.0
        """Simulated seconds."""
        self._mode = 0
        self._sticks: tuple[float, Message] | None = None
        self._moves: tuple[float, Point] | None = None
        self._said: list[Message] = []

    @property
    def mode(self) -> int:
        """Custom mode."""
        return self._mode

    @mode.setter
    def mode(self, number: int) -> None:
        self._mode = number

    @property
    def mission(self) -> list[object]:
        """Items on board."""
        return list(self.board.items)

    def in_mode(self, *names: str) -> bool:
        """Whether it is in one of these modes."""
        return self.modes.name(self._mode) in names

    # --- messages in -------------------------------------------------------------------------------------------

    def handle(self, frame: Frame, now: float) -> list[Message]:
        """Take in a message that may be for this vehicle; return the answers."""
        message = frame.message
        if not self._meant(frame):
            return []
        sender = (frame.system, frame.component)
        if frame.name.startswith("MISSION_"):
            return self._mission_message(frame.name, message, sender, now)
        if frame.name in PARAMETER_REQUESTS:
            return self.parameters.handle(frame.name, message)
        match frame.name:
            case "COMMAND_LONG" | "COMMAND_INT":
                return [*orders.answer(self, message, sender)]
            case "SET_MODE":
                self.set_mode(message.custom_mode)
            case "SET_POSITION_TARGET_GLOBAL_INT" | "SET_POSITION_TARGET_LOCAL_NED":
                self._guided_target(frame.name, message, now)
            case "HEARTBEAT":
                if frame.system == int(self.parameters["SYSID_MYGCS"]):
                    self.failsafes.ground_station(now)
            case "RC_CHANNELS_OVERRIDE":
                self._sticks = (now, message)
            case "PLAY_TUNE":
                self.tunes = [*self.tunes, f"{_text(message.tune)}{_text(message.tune2)}"][-10:]
            case "TIMESYNC":
                if message.tc1 == 0:
                    return [make("TIMESYNC", tc1=round(now * 1e9), ts1=message.ts1)]
            case "AUTOPILOT_VERSION_REQUEST":
                return [telemetry(self, "AUTOPILOT_VERSION", 0)]
            case _:
                pass
        return self.drain()

    def _meant(self, frame: Frame) -> bool:
        """Whether a message is for this autopilot, and not from itself or another with its id."""
        message = frame.message
        return (
            (frame.system, frame.component) != (self.system, dialect.COMPONENT_AUTOPILOT)
            and getattr(message, "target_system", self.system) in (0, self.system)
            and getattr(message, "target_component", 0) in (0, dialect.COMPONENT_AUTOPILOT)
        )

    def _mission_message(self, name: str, message: Message, sender: Sender, now: float) -> list[Message]:
        board = self.board
        match name:
            case "MISSION_COUNT":
                answers = board.count(message, sender, now)
            case "MISSION_ITEM_INT" | "MISSION_ITEM":
                answers = board.item(message, sender, now)
            case "MISSION_CLEAR_ALL":
                answers = board.clear(sender)
            case "MISSION_REQUEST_LIST" | "MISSION_REQUEST_INT" | "MISSION_REQUEST":
                answers = board.tell(name, message, sender)
            case "MISSION_SET_CURRENT":
                self.set_current(message.seq)
                answers = [self.mission_current()]
            case _:
                return []
        if board.fresh:
            board.fresh = False
            # As ArduPilot: a mission that was stopped keeps its item over an upload.
            self.at = 0 if self.complete or self.at >= len(board.items) else self.at
            self.running, self.complete = False, False
            answers.append(self.mission_current())
        for words in board.says:
            self.say(4, words)
        board.says.clear()
        return [*self.drain(), *answers]

    @abc.abstractmethod
    def do(self, command: int, values: tuple[float, ...], at: tuple[int, int, float]) -> int:
        """Do a command that only this kind of vehicle knows; MAV_RESULT."""

    # --- arming and modes --------------------------------------------------------------------------------------

    def prearm(self) -> int:
        """Check what arming would; MAV_RESULT."""
        if self.flight.armed:
            return dialect.TEMPORARILY_REJECTED
        for words in arming_problems(self):
            self.say(3, f"PreArm: {words}")
        return dialect.ACCEPTED

    def arm(self, *, force: bool = False) -> int:
        """Switch the motors on, unless something speaks against it; MAV_RESULT."""
        if self.flight.armed:
            return dialect.ACCEPTED
        problems = [] if force else list(arming_problems(self))
        if not problems and self.modes.name(self._mode) not in self.armable:
            problems = ["mode not armable"]
        for words in problems:
            self.say(3, f"PreArm: {words}")
        if problems:
            return dialect.FAILED
        self.flight.armed = True
        self.flight.target = None
        self._said.append(self.heartbeat())
        return dialect.ACCEPTED

    def disarm(self, *, force: bool) -> int:
        """Switch the motors off; refused in the air unless forced. MAV_RESULT."""
        if self.flight.armed and not self.flight.landed and not force:
            self.say(4, "disarm refused: in the air")
            return dialect.FAILED
        self.flight.armed = False
        self.running = False
        self.failsafes.disarmed()
        self._said.append(self.heartbeat())
        return dialect.ACCEPTED

    def set_mode(self, mode: int) -> bool:
        """Change the mode; False when that is not possible."""
        name = self.modes.name(mode)
        if name not in self.modes.numbers:
            return False
        if name == "AUTO" and len(self.board.items) < 2:
            self.say(4, "AUTO needs a mission")
            return False
        if self.failsafes.blind and name in ("AUTO", "GUIDED", "RTL", "LOITER", "POSHOLD"):
            self.say(4, f"Mode change to {name} failed: requires position")
            return False
        changed, self._mode = mode != self._mode, mode
        if changed:
            self.running = False
            self.flight.hand = None
            self.enter(name)
        self._said.append(self.heartbeat())
        return True

    def change_mode(self, name: str) -> None:
        """Change the mode of its own accord, if it is not in it already."""
        if not self.in_mode(name):
            self.set_mode(self.modes.numbers[name])

    @abc.abstractmethod
    def enter(self, name: str) -> None:
        """Begin what a mode does."""

    # --- missions ----------------------------------------------------------------------------------------------

    def _no_mission(self) -> str:
        return "mission refused while flying one" if self.running else ""

    def set_current(self, number: int) -> bool:
        """Go on with the mission at an item; False when there is none of that number."""
        if not 0 <= number < len(self.board.items):
            return False
        self.at, self.complete = number, False
        if self.running:
            self.next_item(max(1, number))
        return True

    def start_mission(self) -> None:
        """Begin the mission, or go on with it unless MIS_RESTART says otherwise, if the mode is AUTO."""
        if self.in_mode("AUTO") and not self.running and not self.complete:
            self.running = True
            self.next_item(1 if self.parameters["MIS_RESTART"] else max(1, self.at))

    def next_item(self, number: int) -> None:
        """Begin the item of that number, doing on the way those that are done at once."""
        while number < len(self.board.items):
            item = self.board.items[number]
            self.at = number
            if item.command == dialect.CHANGE_SPEED:
                self.flight.speed = item.parameters[1] if item.parameters[1] > 0 else self.flight.speed
            elif item.command in (dialect.GRIPPER, dialect.SERVO, dialect.IMAGE_START):
                orders.carry_out(self, item.command, item.parameters)
            elif item.command != dialect.LOOK_AT:
                self.begin(number)
                self._said.append(self.mission_current())
                return
            number += 1
        self.running, self.complete = False, True
        self._said.append(self.mission_current())

    @abc.abstractmethod
    def begin(self, number: int) -> None:
        """Begin an item that takes time."""

    def reached(self) -> None:
        """Tell that the item it is at has been reached, and go on to the next."""
        self._said.append(make("MISSION_ITEM_REACHED", seq=self.at))
        self.next_item(self.at + 1)

    def _guided_target(self, name: str, message: Message, now: float) -> None:
        if not (self.in_mode("GUIDED") and self.flight.armed):
            return
        self._moves = None
        if not self.can_go():
            if name == "SET_POSITION_TARGET_LOCAL_NED":
                self.flight.target = None  # a velocity ends a take-off that has not left the ground, and moves nothing
            return
        if name == "SET_POSITION_TARGET_LOCAL_NED":
            moving = any((message.vx, message.vy, message.vz, message.yaw_rate))
            self._moves = (now, self.guided_velocity(message)) if moving else None
            self.flight.target = self.flight.position
        else:
            self.flight.target = self._point(message.lat_int, message.lon_int, message.alt, message.coordinate_frame)

    def can_go(self) -> bool:
        """Whether a target of the guided mode is taken."""
        return True

    def _point(self, latitude: int, longitude: int, height: float, frame: int) -> Point:
        x, y, _ = to_site(self.site, latitude / 1e7, longitude / 1e7, self.site.altitude_m)
        if frame in (dialect.FRAME_GLOBAL, 0):
            height -= self.site.altitude_m
        return Point(x - self.home[0], y - self.home[1], height)

    # --- moving ------------------------------------------------------------------------------------------------

    def step(self, dt: float, now: float) -> list[Message]:
        """Move on by `dt` simulated seconds; `now` is real time, for the patience with others."""
        self.clock += dt
        self._said += self.board.step(now)
        self._said += self.parameters.step()
        bearing = math.radians(self.parameters["SIM_WIND_DIR"])
        speed = self.parameters["SIM_WIND_SPD"]
        # A wind's direction is where it comes from.
        self.flight.wind = Point(-speed * math.sin(bearing), -speed * math.cos(bearing), 0.0)
        self._by_hand(now)
        self.flight.step(dt)
        self.failsafes.step(self, now)
        if self.flight.armed:
            self.move()
        return self.drain()

    @abc.abstractmethod
    def move(self) -> None:
        """Do what the mode does next."""

    def _by_hand(self, now: float) -> None:
        """Let overridden sticks move it in modes that a person flies or drives."""
        moves = self._moves
        if moves is not None and now - moves[0] <= _GUIDED_S and self.in_mode("GUIDED") and self.flight.armed:
            self.flight.hand, self.flight.target = moves[1], self.flight.position
            return
        sticks = self._sticks
        if sticks is None or now - sticks[0] > _STICKS_S or not self.in_mode(*self.modes.by_hand):
            self.flight.hand = None
            return
        held = [_deflection(getattr(sticks[1], f"chan{number}_raw")) for number in (1, 2, 3, 4)]
        self.flight.hand = self.hand_velocity(held) if any(held) else None

    @abc.abstractmethod
    def guided_velocity(self, message: Message) -> Point:
        """Return what velocities of the guided mode ask for, as `flight.hand` has it."""

    @abc.abstractmethod
    def hand_velocity(self, held: list[float]) -> Point:
        """Return what sticks ask for: channels 1 to 4, each from -1 to 1."""

    # --- what it says ------------------------------------------------------------------------------------------

    def say(self, severity: int, text: str) -> None:
        """Say something by STATUSTEXT."""
        self._said += statustext(text, severity)

    def drain(self) -> list[Message]:
        """Return what it has to say, once."""
        said, self._said = self._said, []
        return said

    def heartbeat(self) -> Message:
        """HEARTBEAT."""
        armed = dialect.ARMED_FLAG if self.flight.armed else 0
        usual = dialect.STATE_ACTIVE if self.flight.armed else dialect.STATE_STANDBY
        return make(
            "HEARTBEAT",
            type=self.kind,
            autopilot=dialect.AUTOPILOT_ARDUPILOT,
            base_mode=dialect.CUSTOM_MODE_FLAG | armed,
            custom_mode=self._mode,
            system_status=dialect.STATE_CRITICAL if self.failsafes.active else usual,
            mavlink_version=3,
        )

    def mission_current(self) -> Message:
        """MISSION_CURRENT with the mission's state."""
        items = self.board.items
        state = 1 if not items else 5 if self.complete else 3 if self.running else 2
        return make(
            "MISSION_CURRENT",
            seq=self.at,
            total=len(items),
            mission_state=state,
            mission_mode=1 if self.in_mode("AUTO") else 2,
        )

    def where(self) -> tuple[float, float, float]:
        """Latitude, longitude, altitude above sea level."""
        x, y, z = self.flight.position
        return to_globe(self.site, self.home[0] + x, self.home[1] + y, z)

    def requested(self, number: int) -> Message:
        """Make the message of that id."""
        return telemetry(self, orders.REQUESTABLE[number], round(self.clock * 1000))


AnyAutopilot = Autopilot[Any]


def _deflection(pulse: int) -> float:
    """Return how far a stick is from its middle, -1 to 1; released channels are in the middle."""
    return 0.0 if pulse in (0, 65535) or abs(pulse - 1500) < 30 else max(-1.0, min(1.0, (pulse - 1500) / 500.0))


def _text(raw: str | bytes) -> str:
    return (raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw).split("\0")[0]
