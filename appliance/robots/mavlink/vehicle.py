"""What a gateway knows of one MAVLink vehicle, and the way its messages reach whoever waits for them.

State is only ever what the vehicle has said of itself; nothing is assumed from a command having been sent.
`hear` takes a frame and the time and does no I/O, so that logs can be played through it.
"""

import asyncio
import math
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager

from appliance.model import Pose, RobotInfo, Site
from appliance.model.geo import to_site
from appliance.model.plausible import plausible_altitude, plausible_battery, plausible_item, plausible_place
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.condition import Condition
from appliance.robots.mavlink.control import Control
from appliance.robots.mavlink.dialect import Frame, Message
from appliance.robots.mavlink.modes import Modes, modes_of
from appliance.robots.mavlink.said import WARNING, Said, Texts
from appliance.robots.mavlink.track import Report, Track

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
        own: int = 0,
        implausible: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.name = name
        self._implausible = implausible
        """Called with the name of each field whose value cannot be."""
        self.own = own
        """System id that the gateway speaks as, so that answers to others are told from those to it; 0: not told."""
        self.site = site
        self.send = send
        self.announce: Callable[[Message], None] = send
        """Puts a message on all links, for whoever listens: ground stations show STATUSTEXTs."""
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
    def home_altitude_m(self) -> float:
        """Altitude of home above mean sea level, by what the vehicle says of both heights."""
        return self.altitude_m - self.relative_m

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
            self._implausible(field)
        return fits

    def _said(self, said: Said) -> None:
        if said.severity <= WARNING:
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
