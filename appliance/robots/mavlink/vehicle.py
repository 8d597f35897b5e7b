"""What a gateway knows of one MAVLink vehicle, and the way its messages reach whoever waits for them.

State is only ever what the vehicle has said of itself; nothing is assumed from a command having been sent.
`hear` takes a frame and the time and does no I/O, so that logs can be played through it.
"""

import asyncio
import math
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager

from appliance.model import Pose, RobotInfo, Site
from appliance.robots.geo import to_site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Frame, Message

Address = tuple[str, int]

_NO_HEADING = 65535
_NO_BATTERY = -1
MAX_WAITING = 256
"""Messages kept for one waiter; older ones are dropped, as on a radio link."""


def is_autopilot(frame: Frame) -> bool:
    """Tell whether a frame is the heartbeat of an autopilot: not of a camera, a gimbal or a ground station.

    Components share their vehicle's system id and beat too; the first one heard is often not the autopilot.
    """
    return (
        frame.name == "HEARTBEAT"
        and frame.message.autopilot != dialect.AUTOPILOT_NONE
        and frame.message.type != dialect.TYPE_GROUND_STATION
    )


class Vehicle:
    """One vehicle. `send` puts a message on its link; `now` of `hear` is monotonic seconds."""

    def __init__(self, name: str, *, site: Site, send: Callable[[Message], None]) -> None:
        self.name = name
        self.site = site
        self.send = send
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
        self.battery_percent: float | None = None
        self.home: tuple[float, float, float] | None = None
        """Latitude, longitude (degrees), altitude (metres)."""
        self.mission_at = 0
        self.mission_complete = False
        self.reached: set[int] = set()
        self.text = ""
        """Last warning that the vehicle gave."""
        self.exchange = asyncio.Lock()
        """COMMAND_ACK answers by command id alone and there is one mission transfer: one exchange at a time."""
        self._waiting: list[tuple[frozenset[str], asyncio.Queue[Message]]] = []

    @property
    def commandable(self) -> bool:
        """Whether its flight modes are known here: ArduPilot multirotors."""
        return self.autopilot == dialect.AUTOPILOT_ARDUPILOT and self.kind in dialect.MULTIROTORS

    @property
    def mode(self) -> str:
        """Flight mode by name; the number where the name is not known."""
        if self.commandable:
            return dialect.COPTER_MODE_NAMES.get(self.custom_mode, str(self.custom_mode))
        return str(self.custom_mode)

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

    def info(self, gateway: str, verbs: tuple[str, ...], note: str = "") -> RobotInfo:
        """Describe it for the roster."""
        return RobotInfo(
            id=self.name,
            kind="mavlink",
            gateway=gateway,
            uses=("base",) if self.commandable else (),
            verbs=verbs,
            flies=self.kind in dialect.MULTIROTORS,
            pose=self.pose,
            battery_percent=self.battery_percent,
            armed=self.armed,
            mode=self.mode,
            online=self.online,
            note=note,
        )

    def hear(self, frame: Frame, now: float) -> bool:
        """Take in a frame; return whether the roster should hear of it at once (mode, arming)."""
        if frame.component != self.component and frame.name != "HEARTBEAT":
            return False
        message = frame.message
        changed = False
        match frame.name:
            case "HEARTBEAT":
                changed = self._heartbeat(frame, now)
            case "GLOBAL_POSITION_INT":
                self._position(message)
            case "SYS_STATUS" | "BATTERY_STATUS":
                if message.battery_remaining != _NO_BATTERY:
                    self.battery_percent = float(message.battery_remaining)
            case "HOME_POSITION":
                self.home = (message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
            case "MISSION_CURRENT":
                self.mission_at = message.seq
                self.mission_complete = message.mission_state == 5
            case "MISSION_ITEM_REACHED":
                self.reached.add(message.seq)
            case "STATUSTEXT":
                if message.severity <= 4:
                    raw = message.text
                    self.text = raw.decode("utf-8", "replace") if isinstance(raw, bytes) else str(raw)
            case _:
                pass
        for names, queue in self._waiting:
            if frame.name in names:
                if queue.full():
                    queue.get_nowait()
                queue.put_nowait(message)
        return changed

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
            return False
        before = (self.custom_mode, self.armed, self.kind, self.autopilot)
        self.heard_at = now
        self.kind, self.autopilot = message.type, message.autopilot
        self.custom_mode = message.custom_mode
        self.armed = bool(message.base_mode & dialect.ARMED_FLAG)
        return before != (self.custom_mode, self.armed, self.kind, self.autopilot)

    def _position(self, message: Message) -> None:
        self.latitude_deg, self.longitude_deg = message.lat / 1e7, message.lon / 1e7
        self.altitude_m, self.relative_m = message.alt / 1e3, message.relative_alt / 1e3
        self.speed_mps = math.hypot(message.vx, message.vy, message.vz) / 100.0
        if message.hdg != _NO_HEADING:
            self.heading_deg = message.hdg / 100.0
        # 0, 0 is what autopilots send before they know: the sea off Ghana is no site.
        self.fixed = message.lat != 0 or message.lon != 0
