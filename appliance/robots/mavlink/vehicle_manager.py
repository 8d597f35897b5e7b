"""A gateway's MAVLink vehicles on the plane: roster entries, commands, raw frames.

A vehicle becomes a robot of the fleet by its autopilot's heartbeat, under the name its link gives it. From then
on the manager speaks for it: it puts RobotInfo, holds its liveliness token while heartbeats come, answers
commands, and puts every frame of it on the plane for the recorder. It takes no name that another robot has.
Ground stations on any link are its guests: frames pass between them and the vehicles (`routing`).

Of its own accord a gateway says to vehicles that it is there (its heartbeat), and at which rates it wants to be told
what.
"""

import asyncio
from collections import Counter
from collections.abc import Callable

import structlog

from appliance.background import Background
from appliance.model import Failure, RobotCommand, Site, keyspace
from appliance.plane.session import Closer, Session
from appliance.robots.executor import CommandExecutor, IdempotencyLog, KeyValues
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.command_dispatcher import CommandDispatcher
from appliance.robots.mavlink.dialect import Frame, Message, make
from appliance.robots.mavlink.frame_router import FrameSender, FrameTap
from appliance.robots.mavlink.link_manager import LinkManager
from appliance.robots.mavlink.routing import End, RoutingTable
from appliance.robots.mavlink.vehicle import OVERRIDES, Vehicle, is_autopilot, moved
from appliance.robots.settings import RobotsConfig

STREAMS_HZ = {
    "GLOBAL_POSITION_INT": 5.0,
    "SYS_STATUS": 1.0,
    "MISSION_CURRENT": 2.0,
    "HOME_POSITION": 0.2,
    "BATTERY_STATUS": 0.5,
    "EKF_STATUS_REPORT": 1.0,
    "FENCE_STATUS": 1.0,
}
"""What is asked of a vehicle that has come online; ArduPilot sends little of it by itself."""


def heartbeat() -> Message:
    """Return the heartbeat of an onboard computer."""
    return make(
        "HEARTBEAT",
        type=dialect.TYPE_ONBOARD,
        autopilot=dialect.AUTOPILOT_NONE,
        base_mode=0,
        custom_mode=0,
        system_status=dialect.STATE_ACTIVE,
        mavlink_version=3,
    )


def ask_streams(vehicle: Vehicle) -> None:
    """Ask a vehicle for messages at their rates (MAV_CMD_SET_MESSAGE_INTERVAL); asked again when it is back online."""
    for stream, hz in STREAMS_HZ.items():
        fields = {f"param{number}": 0.0 for number in range(3, 8)}
        vehicle.send(
            make(
                "COMMAND_LONG",
                target_system=vehicle.system,
                target_component=vehicle.component,
                command=dialect.SET_INTERVAL,
                confirmation=0,
                param1=float(dialect.constant(f"MAVLINK_MSG_ID_{stream}")),
                param2=1e6 / hz,
                **fields,
            )
        )


log = structlog.get_logger(__name__)

_OFFLINE_INFO_S = 5.0
"""How often the roster is reminded of a vehicle that is offline."""


class _Attached:
    """A vehicle and all that serves it."""

    def __init__(self, vehicle: Vehicle, helm: CommandDispatcher, desk: CommandExecutor, end: End) -> None:
        self.vehicle = vehicle
        self.helm = helm
        self.desk = desk
        self.end = end
        self.told_at = 0.0
        self.tell = True
        self.token: Closer | None = None
        self.queryable: Closer | None = None


class VehicleManager:
    """All MAVLink vehicles of one gateway: an endpoint. `attached` names those heard so far; made on the event loop.

    Args:
        config: the robots room's settings.
        session: where robots are put, and their commands are heard.
        store: keeps what must outlive a restart.
        gateway: this one's name.
        site: where vehicles are.
        refused: counters of bad input.
        gate: says why a robot may not be given a command just now.
        links: whose settings name vehicles.
        routing: what was seen of frames.
        sender: the way out.
        tap: records frames by vehicle.
    """

    def __init__(
        self,
        config: RobotsConfig,
        *,
        session: Session,
        store: KeyValues,
        gateway: str,
        site: Site,
        refused: dict[str, int],
        gate: Callable[[str, RobotCommand], str],
        links: LinkManager,
        routing: RoutingTable,
        sender: FrameSender,
        tap: FrameTap,
    ) -> None:
        self._config = config
        self._gate = gate
        self._session = session
        self._store = store
        self._gateway = gateway
        self._site = site
        self.refused = refused
        self._links = links
        self._routing = routing
        self._sender = sender
        self._tap = tap
        self._vehicles: dict[str, _Attached] = {}
        self._early: Counter[tuple[int, int]] = Counter()
        """Frames by system before its heartbeat; there are 255 systems a link."""
        self._by_source: dict[tuple[int, int], _Attached] = {}
        self._guests: set[tuple[int, int]] = set()
        """Link and system of ground stations and the like."""
        self._turned_away: set[tuple[int, int, int]] = set()
        """Link, system and component of autopilots that may not be robots here."""
        self._others: set[str] = set()
        self._watch: Closer | None = None
        self._attaching = Background()
        self._beat_at = self._time_at = 0.0

    @property
    def attached(self) -> tuple[str, ...]:
        """Names of the MAVLink vehicles heard since start, online or not."""
        return tuple(sorted(self._vehicles))

    def start(self) -> None:
        """Begin to look for other robots, whose names are taken."""
        self._watch = self._session.watch_alive(self._session.keys(keyspace.ROBOT_ALIVE), self._robot_seen)

    async def stop(self) -> None:
        """End commands (they are resumed by the next process), take back what was declared."""
        await self._attaching.close()
        for each in self._vehicles.values():
            online = each.vehicle.online
            await self._end(each)
            if online:
                self._tell(each, "its gateway is stopping")
        self._vehicles.clear()
        self._by_source.clear()
        self._name_ends()
        if self._watch is not None:
            self._watch.close()
            self._watch = None

    # --- frames ------------------------------------------------------------------------------------------------

    def accept(self, frame: Frame, source: End, now: float) -> bool:
        """Take a frame in as its vehicle's, or as a guest's; False for a sender that is not believed."""
        each = self._by_source.get((source.link, frame.system))
        if frame.name in OVERRIDES and self._config.route:
            self._watch_sticks(frame, now)
        if each is None:
            if self._is_guest(frame, source):
                return True
            each = self._welcome(frame, source)
            sender = (source.link, frame.system, frame.component)
            if each is None:
                if is_autopilot(frame):
                    self._turned_away.add(sender)
                return self._turn_away(frame, source)
            self._turned_away.discard(sender)
        vehicle = each.vehicle
        if source != each.end:
            if not is_autopilot(frame) and frame.component != vehicle.component:
                return True  # a camera, companion computer or station with its system id and an address of its own
            if vehicle.online:
                self._count("address_conflict")
                return self._turn_away(frame, source)
            each.end = source  # restarted, or back over another way
            self._name_ends()
        if vehicle.hear(frame, now):
            each.tell = True
        if not vehicle.online:
            self._see(each, now)
        return True

    def _turn_away(self, frame: Frame, source: End) -> bool:
        """Record a frame that goes no further. A copy of it may come by the way that its sender is known by."""
        self._routing.unsee(frame.raw)
        self._tap.record(source, "", "rx", frame.raw)
        return False

    def at(self, end: End, system: int) -> Vehicle | None:
        """Return the vehicle of a system id that is at an end."""
        each = self._by_source.get((end.link, system))
        return each.vehicle if each is not None and each.end == end else None

    def of_system(self, system: int) -> list[Vehicle]:
        """Return the vehicles of a system id, on all links."""
        return [each.vehicle for each in self._vehicles.values() if each.vehicle.system == system]

    def _name_ends(self) -> None:
        """Have frames recorded by the names of the vehicles that are at their ends now."""
        self._tap.know({(each.end, system): each.vehicle.name for (_, system), each in self._by_source.items()})

    def _is_guest(self, frame: Frame, source: End) -> bool:
        """Whether the sender is no vehicle but may speak to ours: a ground station, or another onboard computer.

        Any frame tells that it is there: some stations never beat. A vehicle whose first heartbeat has not come yet is
        routed as a guest; one that may not be a robot here is none, nor is another with the address of one that is.
        """
        if not self._config.route or frame.system == self._config.system_id:
            return False
        guest, sender = (source.link, frame.system), (source.link, frame.system, frame.component)
        if is_autopilot(frame):
            self._guests.discard(guest)
            return False
        if sender in self._turned_away or self._is_address_of_ours(frame):
            return False
        if guest not in self._guests:
            self._guests.add(guest)
            entry = self._links.get(source.link)
            log.info("MAVLink guest", link="" if entry is None else str(entry.setting.remote), system=frame.system)
        return True

    def _is_address_of_ours(self, frame: Frame) -> bool:
        return any(
            (each.vehicle.system, each.vehicle.component) == (frame.system, frame.component)
            for each in self._by_source.values()
        )

    def _watch_sticks(self, frame: Frame, now: float) -> None:
        """Notice a person who takes a vehicle over the gateway."""
        target = frame.message.target if frame.name == "MANUAL_CONTROL" else frame.message.target_system
        for each in self._vehicles.values():
            if each.vehicle.system == target:
                each.tell |= each.vehicle.control.sticks(frame.system, moved(frame.name, frame.message), now)

    def _welcome(self, frame: Frame, source: End) -> _Attached | None:
        """Make a robot of a new system if its frame is an autopilot's heartbeat and it may have a name."""
        index, entry = source.link, self._links.get(source.link)
        name = None if entry is None else entry.setting.name_of(frame.system)
        known = sum(heard == index for heard, _ in self._by_source)
        if frame.system == self._config.system_id or name is None or known >= self._config.max_vehicles:
            self._count("unknown_system")
            return None
        if not is_autopilot(frame):
            self._count("unknown_system")
            self._early[index, frame.system] += 1
            return None
        same = self._vehicles.get(name)
        if same is not None and self._may_be_back(same, frame, source):
            return self._take_back(same, index)
        if same is not None or name in self._others:
            self._count("name_conflict")
            log.warning("vehicle refused: its name is taken", robot=name, system=frame.system)
            return None
        # What it sent before its first heartbeat was not a stranger's.
        if early := self._early.pop((index, frame.system), 0):
            self.refused["unknown_system"] -= early
        each = self._attach(name, source)
        self._by_source[index, frame.system] = each
        self._name_ends()
        return each

    def _may_be_back(self, each: _Attached, frame: Frame, source: End) -> bool:
        """Whether a silent vehicle may be followed to another link: not from a signed one to one without a key."""
        if each.vehicle.online or each.vehicle.system != frame.system:
            return False
        old, new = self._links.get(each.end.link), self._links.get(source.link)
        return old is None or old.link.codec.signer is None or (new is not None and new.link.codec.signer is not None)

    def _take_back(self, each: _Attached, link: int) -> _Attached:
        """Know a vehicle by another link, which it is heard on while it is silent on the one that it was known by."""
        for key in [key for key, other in self._by_source.items() if other is each]:
            del self._by_source[key]
        self._by_source[link, each.vehicle.system] = each
        self._name_ends()
        log.info("vehicle is back over another link", robot=each.vehicle.name, link=link)
        return each

    def _attach(self, name: str, source: End) -> _Attached:

        own = self._config.system_id
        vehicle = Vehicle(
            name,
            site=self._site,
            send=lambda message: self._send(name, message),
            announce=lambda message: self._announce(name, message),
            own=own,
            refused=self.refused,
        )
        helm = CommandDispatcher(vehicle, site=self._site, config=self._config)
        ledger = IdempotencyLog(name, self._store, limit=self._config.ledger)
        desk = CommandExecutor(
            name,
            session=self._session,
            ledger=ledger,
            verbs=helm.verbs(),
            ready=helm.ready,
            halt=helm.halt,
            refused=self.refused,
            gate=self._gate,
        )
        each = _Attached(vehicle, helm, desk, source)
        self._vehicles[name] = each

        async def serve() -> None:
            await ledger.load()
            desk.verbs = helm.verbs()  # its heartbeat has told by now what it is: it can be commanded at once
            each.queryable = self._session.serve(
                self._session.keys(keyspace.COMMAND, name), desk.handle, signers=keyspace.COMMAND.asks
            )
            self._see(each, asyncio.get_running_loop().time())
            log.info("vehicle attached", robot=name, address=source.address)

        self._attaching.start(serve(), f"attach {name}")
        return each

    def _send(self, name: str, message: Message) -> None:
        each = self._vehicles.get(name)
        if each is not None:
            self._sender.send(each.end, message, vehicle=name)

    def let_go_of(self, link: int) -> None:
        """Let the vehicles of a link that was removed go: they may come back over another."""
        self._guests = {guest for guest in self._guests if guest[0] != link}
        self._turned_away = {sender for sender in self._turned_away if sender[0] != link}
        for source in [source for source in self._early if source[0] == link]:
            del self._early[source]
        for source, each in list(self._by_source.items()):
            if source[0] == link:
                del self._by_source[source]
                self._vehicles.pop(each.vehicle.name, None)
                self._attaching.start(self._let_go(each), f"detach {each.vehicle.name}")
        self._name_ends()

    async def _let_go(self, each: _Attached) -> None:
        await self._end(each)
        self._tell(each, "its link was removed")
        if each.vehicle.name not in self._vehicles:
            self._tap.forget(each.vehicle.name)
        log.info("vehicle let go", robot=each.vehicle.name)

    async def _end(self, each: _Attached) -> None:
        await each.desk.close()
        for closer in (each.queryable, each.token):
            if closer is not None:
                closer.close()
        each.vehicle.online = False

    def online(self, name: str) -> bool:
        """Whether a vehicle of that name is online here."""
        each = self._vehicles.get(name)
        return each is not None and each.vehicle.online

    async def forget(self, name: str) -> None:
        """Forget a vehicle that is offline, if there is one of that name; heard again it is a new one."""
        each = self._vehicles.pop(name, None)
        if each is not None:
            self._by_source = {source: one for source, one in self._by_source.items() if one is not each}
            self._name_ends()
            await self._end(each)
            self._tap.forget(name)

    def _announce(self, name: str, message: Message) -> None:
        """Send a message to a vehicle and all others that listen: ground stations, other routers."""
        each = self._vehicles.get(name)
        if each is None:
            return
        each.vehicle.send(message)
        vehicles = {attached.end for attached in self._by_source.values()}
        self._sender.announce(message, vehicles, system=each.vehicle.system)

    # --- presence ----------------------------------------------------------------------------------------------

    def _see(self, each: _Attached, now: float) -> None:
        """Bring a vehicle online whose heartbeat is fresh and whose commands can be answered."""
        fresh = now - each.vehicle.heard_at <= self._config.heartbeat_lost_s
        if each.vehicle.online or not fresh or each.queryable is None:
            return
        each.vehicle.online = True
        each.tell = True
        each.token = self._session.declare_alive(self._session.keys(keyspace.ROBOT_ALIVE, each.vehicle.name))
        ask_streams(each.vehicle)
        log.info("vehicle online", robot=each.vehicle.name)

    async def _lost(self, each: _Attached) -> None:
        each.vehicle.online = False
        each.tell = True
        if each.token is not None:
            each.token.close()
            each.token = None
        log.warning("vehicle offline", robot=each.vehicle.name)
        self._tell(each, "no heartbeat")
        await each.desk.fail_all(
            Failure(
                code="robot",
                message=f"{each.vehicle.name} went offline: no heartbeat for {self._config.heartbeat_lost_s:g} s",
                remedy="check its power and its link",
                retryable=True,
            )
        )

    def _robot_seen(self, key: str, alive: bool) -> None:
        (name,) = keyspace.ROBOT_ALIVE.names(key)
        if not alive:
            self._others.discard(name)
        elif name not in self._vehicles:
            self._others.add(name)

    async def tick(self, now: float) -> None:
        """Send heartbeats, notice lost ones, put the roster; to be called some twenty times a second."""
        if now >= self._beat_at:
            self._beat_at = now + self._config.heartbeat_s
            self._beat()
        for each in list(self._vehicles.values()):
            if each.vehicle.online and now - each.vehicle.heard_at > self._config.heartbeat_lost_s:
                await self._lost(each)
            interval = 1.0 / self._config.state_hz if each.vehicle.online else _OFFLINE_INFO_S
            if each.queryable is not None and (each.tell or now - each.told_at >= interval):
                self._tell(each)
        if self._config.timesync_s and now >= self._time_at:
            self._time_at = now + self._config.timesync_s
            self._sender.ask_time({each.end for each in self._vehicles.values() if each.vehicle.online})

    def _beat(self) -> None:
        """Tell every vehicle, and every other end that may not have been heard yet, that the gateway is there."""
        beat = heartbeat()
        reached: set[End] = set()
        for each in self._by_source.values():
            each.vehicle.send(beat)
            reached.add(each.end)
        self._sender.greet(beat, reached)

    def _tell(self, each: _Attached, note: str = "") -> None:
        """Put the roster entry; the verbs follow from what the last heartbeat said it is."""
        each.tell = False
        each.told_at = asyncio.get_running_loop().time()
        each.desk.verbs = each.helm.verbs()
        if not note and not each.vehicle.online:
            note = "no heartbeat"
        elif not note and not each.vehicle.commandable:
            note = "watched, not commanded: only ArduPilot multirotors, rovers and boats are so far"
        elif not note and each.vehicle.control.seized is not None:
            note = f"taken: {each.vehicle.control.seized.why}"
        elif not note:
            note = ", ".join(each.desk.busy)
        verbs = (*each.desk.verbs, "stop") if each.vehicle.commandable else tuple(each.desk.verbs)
        info = each.vehicle.info(self._gateway, verbs, note)
        self._session.publish(keyspace.ROBOT, info, each.vehicle.name)

    def _count(self, what: str) -> None:
        self.refused[what] = self.refused.get(what, 0) + 1
