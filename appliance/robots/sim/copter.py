"""The simulated copter's autopilot: what it answers to MAVLink messages, and how its modes fly.

It behaves as ArduCopter does where the gateway could tell the difference: home in mission item 0, arming refused in
AUTO and with a low battery, take-off in GUIDED alone, unknown commands UNSUPPORTED, a mission transfer that asks
again for items that were lost. No I/O: messages in, messages out, time passed in.
"""

from typing import NamedTuple

from appliance.model import Site
from appliance.robots.geo import to_globe, to_site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import COPTER_MODES, Frame, Message, make
from appliance.robots.sim.flight import RTL_HEIGHT_M, Flight, Point
from appliance.robots.sim.telemetry import telemetry

LOW_BATTERY = 20.0
"""Percent; arming is refused below."""
FAILSAFE_BATTERY = 8.0
"""Percent; it returns home below."""
MAX_ITEMS = 700
_REQUEST_AGAIN_S = 0.4
_TRANSFER_S = 8.0
_CAN_ARM = frozenset(COPTER_MODES[name] for name in ("STABILIZE", "GUIDED", "LOITER", "ALT_HOLD", "POSHOLD"))
_RTL, _LAND, _AUTO, _GUIDED = (COPTER_MODES[name] for name in ("RTL", "LAND", "AUTO", "GUIDED"))


class MissionItem(NamedTuple):
    """One item as uploaded; `point` in metres of home where it has a position."""

    command: int
    parameters: tuple[float, float, float, float]
    point: Point


class Transfer:
    """A mission upload in progress."""

    def __init__(self, sender: tuple[int, int], count: int, now: float) -> None:
        self.sender = sender
        self.items: list[MissionItem] = []
        self.count = count
        self.asked_at = now
        self.began_at = now


class SimCopter:
    """One vehicle. `handle` returns answers; `step` moves and returns what it says by itself."""

    def __init__(self, *, system: int, site: Site, home: tuple[float, float], battery_percent: float = 100.0) -> None:
        self.system = system
        self.site = site
        self.home = home
        self.flight = Flight(battery_percent=battery_percent)
        self.mode = COPTER_MODES["STABILIZE"]
        self.mission: list[MissionItem] = []
        self.at = 0
        self.running = False
        self.complete = False
        self.takeoffs = 0
        """Take-offs begun, for tests."""
        self._transfer: Transfer | None = None
        self._taken: tuple[tuple[int, int], int] | None = None
        """Sender and length of the last mission taken, to acknowledge it again."""
        self._loiter: Point | None = None
        self._said: list[Message] = []

    # --- messages in -------------------------------------------------------------------------------------------

    def handle(self, frame: Frame, now: float) -> list[Message]:  # noqa: PLR0911 - one case a message
        """Take in a message that may be for this vehicle; return the answers."""
        message = frame.message
        if getattr(message, "target_system", self.system) not in (0, self.system):
            return []
        sender = (frame.system, frame.component)
        match frame.name:
            case "COMMAND_LONG" | "COMMAND_INT":
                return self._command(message, sender)
            case "SET_MODE":
                self._set_mode(message.custom_mode)
                return self._drain()
            case "MISSION_COUNT":
                return self._count(message, sender, now)
            case "MISSION_ITEM_INT":
                return self._item(message, sender, now)
            case "MISSION_CLEAR_ALL":
                self.mission, self.running, self.at = [], False, 0
                return [self._mission_ack(sender, dialect.MISSION_OK)]
            case "MISSION_SET_CURRENT":
                if 0 <= message.seq < len(self.mission):
                    self.at, self.complete = message.seq, False
                return [self.mission_current()]
            case "MISSION_REQUEST_LIST":
                return [
                    make(
                        "MISSION_COUNT",
                        target_system=sender[0],
                        target_component=sender[1],
                        count=len(self.mission),
                        mission_type=0,
                    )
                ]
            case "SET_POSITION_TARGET_GLOBAL_INT":
                self._guided_target(message)
                return []
            case _:
                return []

    def _command(self, message: Message, sender: tuple[int, int]) -> list[Message]:
        values = tuple(float(getattr(message, f"param{number}", 0.0)) for number in range(1, 5))
        height = float(message.z if hasattr(message, "z") else message.param7)
        result = self._do(int(message.command), values, height)
        ack = make(
            "COMMAND_ACK",
            command=message.command,
            result=result,
            progress=0,
            result_param2=0,
            target_system=sender[0],
            target_component=sender[1],
        )
        extra: list[Message] = []
        if message.command == dialect.REQUEST_MESSAGE and result == dialect.ACCEPTED:
            extra = [self.requested(int(values[0]))]
        # What explains a refusal comes before it, as ArduPilot does it.
        return [*self._drain(), ack, *extra]

    def _do(self, command: int, values: tuple[float, ...], height: float) -> int:  # noqa: PLR0911 - one case a command
        flight = self.flight
        match command:
            case dialect.ARM:
                return self._arm() if values[0] >= 0.5 else self._disarm(force=values[1] == 21196)
            case dialect.SET_MODE:
                return dialect.ACCEPTED if self._set_mode(int(values[1])) else dialect.FAILED
            case dialect.TAKEOFF:
                if not flight.armed or self.mode != _GUIDED or not flight.landed or height <= 0:
                    self._say(4, "takeoff needs GUIDED, armed, on the ground")
                    return dialect.FAILED
                self.takeoffs += 1
                flight.target = flight.position._replace(z=height)
                return dialect.ACCEPTED
            case dialect.LAND:
                return dialect.ACCEPTED if self._set_mode(_LAND) else dialect.FAILED
            case dialect.RETURN:
                return dialect.ACCEPTED if self._set_mode(_RTL) else dialect.FAILED
            case dialect.MISSION_START:
                if len(self.mission) < 2 or not flight.armed:
                    self._say(4, "mission needs items and armed motors")
                    return dialect.FAILED
                self._start_mission()
                return dialect.ACCEPTED
            case dialect.CHANGE_SPEED:
                if values[1] <= 0:
                    return dialect.DENIED
                flight.speed = values[1]
                return dialect.ACCEPTED
            case dialect.REQUEST_MESSAGE:
                return dialect.ACCEPTED if self.requestable(int(values[0])) else dialect.UNSUPPORTED
            case dialect.SET_INTERVAL:
                return dialect.ACCEPTED if self.requestable(int(values[0])) else dialect.UNSUPPORTED
            case _:
                return dialect.UNSUPPORTED

    def _arm(self) -> int:
        if self.flight.armed:
            return dialect.ACCEPTED
        if self.flight.battery_percent < LOW_BATTERY:
            self._say(3, f"PreArm: battery at {self.flight.battery_percent:.0f} %")
            return dialect.FAILED
        if self.mode not in _CAN_ARM:
            self._say(3, "PreArm: mode not armable")
            return dialect.FAILED
        self.flight.armed = True
        self.flight.target = None
        self._said.append(self.heartbeat())
        return dialect.ACCEPTED

    def _disarm(self, *, force: bool) -> int:
        if self.flight.armed and not self.flight.landed and not force:
            self._say(4, "disarm refused: in the air")
            return dialect.FAILED
        self.flight.armed = False
        self.running = False
        self._said.append(self.heartbeat())
        return dialect.ACCEPTED

    def _set_mode(self, mode: int) -> bool:
        if mode not in dialect.COPTER_MODE_NAMES:
            return False
        if mode == _AUTO and len(self.mission) < 2:
            self._say(4, "AUTO needs a mission")
            return False
        changed, self.mode = mode != self.mode, mode
        if changed:
            self._enter()
        self._said.append(self.heartbeat())
        return True

    def _enter(self) -> None:
        """Begin what the mode does; all but AUTO hold, descend or return."""
        flight = self.flight
        here = flight.position
        self.running = False
        if self.mode == _LAND:
            flight.target = here._replace(z=-1.0)
        elif self.mode == _RTL:
            self._loiter = Point(here.x, here.y, max(here.z, RTL_HEIGHT_M)) if not flight.landed else None
            flight.target = self._loiter
        else:
            flight.target = here if flight.armed and not flight.landed else None
            if self.mode == _AUTO and flight.armed and not flight.landed:
                self._start_mission()

    def _start_mission(self) -> None:
        if self.mode == _AUTO and not self.running and not self.complete:
            self.running = True
            self._next_item(max(1, self.at))

    def _guided_target(self, message: Message) -> None:
        if self.mode != _GUIDED or not self.flight.armed or self.flight.landed:
            return
        self.flight.target = self._point(message.lat_int, message.lon_int, message.alt, message.coordinate_frame)

    def _point(self, latitude: int, longitude: int, height: float, frame: int) -> Point:
        x, y, _ = to_site(self.site, latitude / 1e7, longitude / 1e7, self.site.altitude_m)
        if frame in (dialect.FRAME_GLOBAL, 0):
            height -= self.site.altitude_m
        return Point(x - self.home[0], y - self.home[1], height)

    # --- mission transfer --------------------------------------------------------------------------------------

    def _count(self, message: Message, sender: tuple[int, int], now: float) -> list[Message]:
        if getattr(message, "mission_type", 0) != 0:
            return [self._mission_ack(sender, dialect.MISSION_UNSUPPORTED)]
        if message.count > MAX_ITEMS:
            return [self._mission_ack(sender, dialect.MISSION_NO_SPACE)]
        if self.running:
            self._say(4, "mission refused while flying one")
            return [*self._drain(), self._mission_ack(sender, dialect.MISSION_ERROR)]
        if message.count == 0:
            self.mission = []
            return [self._mission_ack(sender, dialect.MISSION_OK)]
        self._transfer = Transfer(sender, message.count, now)
        self._taken = None
        return [self._request(self._transfer)]

    def _item(self, message: Message, sender: tuple[int, int], now: float) -> list[Message]:
        transfer = self._transfer
        if transfer is None or transfer.sender != sender:
            if self._taken == (sender, message.seq + 1):
                return [self._mission_ack(sender, dialect.MISSION_OK)]
            return [self._mission_ack(sender, dialect.MISSION_ERROR)]
        if message.seq != len(transfer.items):
            return []  # a repeat; what is missing is asked for again by the clock
        transfer.items.append(
            MissionItem(
                int(message.command),
                (message.param1, message.param2, message.param3, message.param4),
                self._point(message.x, message.y, message.z, message.frame),
            )
        )
        transfer.asked_at = transfer.began_at = now
        if len(transfer.items) < transfer.count:
            return [self._request(transfer)]
        unknown = [each.command for each in transfer.items if each.command not in _FLYABLE]
        self._transfer = None
        if unknown:
            self._say(4, f"mission item {dialect.label('MAV_CMD', unknown[0])} not supported")
            return [*self._drain(), self._mission_ack(sender, dialect.MISSION_UNSUPPORTED)]
        self.mission, self.at, self.complete, self.running = transfer.items, 0, False, False
        self._taken = (sender, transfer.count)
        return [self._mission_ack(sender, dialect.MISSION_OK), self.mission_current()]

    def _request(self, transfer: Transfer) -> Message:
        return make(
            "MISSION_REQUEST_INT",
            target_system=transfer.sender[0],
            target_component=transfer.sender[1],
            seq=len(transfer.items),
            mission_type=0,
        )

    def _mission_ack(self, sender: tuple[int, int], result: int) -> Message:
        return make("MISSION_ACK", target_system=sender[0], target_component=sender[1], type=result, mission_type=0)

    # --- flying ------------------------------------------------------------------------------------------------

    def step(self, dt: float, now: float) -> list[Message]:
        """Fly on by `dt` simulated seconds; `now` is real time, for the transfer's patience."""
        transfer = self._transfer
        if transfer is not None:
            if now - transfer.asked_at > _TRANSFER_S:
                self._transfer = None
                self._said.append(self._mission_ack(transfer.sender, dialect.MISSION_CANCELLED))
            elif now - transfer.began_at > _REQUEST_AGAIN_S:
                transfer.began_at = now
                self._said.append(self._request(transfer))
        self.flight.step(dt)
        if self.flight.armed:
            self._fly()
        return self._drain()

    def _fly(self) -> None:
        flight = self.flight
        if flight.battery_percent < FAILSAFE_BATTERY and self.mode not in (_RTL, _LAND) and not flight.landed:
            self._say(3, "battery failsafe: returning")
            self._set_mode(_RTL)
        if self.mode == _AUTO and self.running:
            item = self.mission[self.at]
            if flight.target is not None and flight.near(flight.target):
                self._said.append(make("MISSION_ITEM_REACHED", seq=self.at))
                if item.command == dialect.LAND:
                    self._disarm(force=False)
                self._next_item(self.at + 1)
        elif self.mode == _LAND and flight.landed:
            self._disarm(force=False)
        elif self.mode == _RTL:
            self._return()

    def _return(self) -> None:
        flight = self.flight
        if self._loiter is None:
            if flight.landed:
                self._disarm(force=False)
        elif flight.near(self._loiter):
            over = Point(0.0, 0.0, self._loiter.z)
            if flight.near(over):
                self._loiter = None
                flight.target = Point(0.0, 0.0, -1.0)
            else:
                self._loiter = flight.target = over

    def _next_item(self, number: int) -> None:
        """Begin the item of that number, doing on the way those that are done at once."""
        while number < len(self.mission):
            item = self.mission[number]
            self.at = number
            if item.command == dialect.CHANGE_SPEED:
                self.flight.speed = item.parameters[1] if item.parameters[1] > 0 else self.flight.speed
            else:
                here = self.flight.position
                if item.command == dialect.TAKEOFF:
                    self.takeoffs += 1
                    self.flight.target = here._replace(z=item.point.z)
                elif item.command == dialect.LAND:
                    self.flight.target = here._replace(z=0.0)
                else:
                    self.flight.target = item.point
                self._said.append(self.mission_current())
                return
            number += 1
        self.running, self.complete = False, True
        self._said.append(self.mission_current())

    # --- what it says ------------------------------------------------------------------------------------------

    def _say(self, severity: int, text: str) -> None:
        self._said.append(make("STATUSTEXT", severity=severity, text=text[:50].encode(), id=0, chunk_seq=0))

    def _drain(self) -> list[Message]:
        said, self._said = self._said, []
        return said

    def heartbeat(self) -> Message:
        """HEARTBEAT."""
        armed = dialect.ARMED_FLAG if self.flight.armed else 0
        return make(
            "HEARTBEAT",
            type=dialect.TYPE_QUADROTOR,
            autopilot=dialect.AUTOPILOT_ARDUPILOT,
            base_mode=dialect.CUSTOM_MODE_FLAG | armed,
            custom_mode=self.mode,
            system_status=dialect.STATE_ACTIVE if self.flight.armed else dialect.STATE_STANDBY,
            mavlink_version=3,
        )

    def mission_current(self) -> Message:
        """MISSION_CURRENT with the mission's state."""
        state = 1 if not self.mission else 5 if self.complete else 3 if self.running else 2
        return make(
            "MISSION_CURRENT",
            seq=self.at,
            total=len(self.mission),
            mission_state=state,
            mission_mode=1 if self.mode == _AUTO else 2,
        )

    def where(self) -> tuple[float, float, float]:
        """Latitude, longitude, altitude above sea level."""
        x, y, z = self.flight.position
        return to_globe(self.site, self.home[0] + x, self.home[1] + y, z)

    def requestable(self, number: int) -> bool:
        """Tell whether a message of that id can be asked for."""
        return number in _REQUESTABLE

    def requested(self, number: int) -> Message:
        """Make the message of that id."""
        return telemetry(self, _REQUESTABLE[number], 0)


_FLYABLE = frozenset({dialect.WAYPOINT, dialect.TAKEOFF, dialect.LAND, dialect.CHANGE_SPEED})
STREAMS_HZ: dict[str, float] = {
    "HEARTBEAT": 1.0,
    "SYS_STATUS": 1.0,
    "BATTERY_STATUS": 0.5,
    "GPS_RAW_INT": 2.0,
    "GLOBAL_POSITION_INT": 10.0,
    "ATTITUDE": 10.0,
    "VFR_HUD": 2.0,
    "MISSION_CURRENT": 1.0,
    "EXTENDED_SYS_STATE": 1.0,
    "HOME_POSITION": 0.2,
}
"""What is sent by itself, and how often before anybody asks otherwise."""
_REQUESTABLE = {dialect.constant(f"MAVLINK_MSG_ID_{name}"): name for name in STREAMS_HZ}
