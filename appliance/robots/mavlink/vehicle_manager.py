"""A gateway's MAVLink vehicles on the plane: roster entries, commands, raw frames.

A vehicle becomes a robot of the fleet by its autopilot's heartbeat, under the name its link gives it. From then
on the manager speaks for it: it puts RobotInfo, holds its liveliness token while heartbeats come, answers
commands, and puts every frame of it on the plane for the recorder. It takes no name that another robot has.
Ground stations on any link are its guests: frames pass between them and the vehicles (`routing`).

Of its own accord a gateway says to vehicles that it is there (its heartbeat), and at which rates it wants to be told
what.
"""

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable

import structlog

from appliance.errors import SwiftbotError
from appliance.model import Failure, RobotCommand, Site, encode
from appliance.plane.session import Closer, Session
from appliance.robots.api import LinkList
from appliance.robots.executor import CommandExecutor, IdempotencyLog, KeyValues
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.command_dispatcher import CommandDispatcher
from appliance.robots.mavlink.dialect import Frame, Message, make
from appliance.robots.mavlink.frame_router import FrameRouter
from appliance.robots.mavlink.link_manager import REMEMBER_S, LinkManager, OpenLink
from appliance.robots.mavlink.routing import End
from appliance.robots.mavlink.vehicle import OVERRIDES, Vehicle, is_autopilot, moved
from appliance.robots.settings import RobotsConfig
from appliance.robots.task_listener import Tasks

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

_TICK_S = 0.05
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
    """All MAVLink vehicles of one gateway. `attached` names those heard so far; made on the event loop."""

    def __init__(
        self,
        config: RobotsConfig,
        *,
        session: Session,
        store: KeyValues,
        gateway: str,
        site: Site,
        refused: dict[str, int],
        tasks: Tasks | None = None,
        gate: Callable[[str, RobotCommand], str] = lambda _, __: "",
    ) -> None:
        self._config = config
        self._gate = gate
        self._session = session
        self._store = store
        self._gateway = gateway
        self._site = site
        self.refused = refused
        self._vehicles: dict[str, _Attached] = {}
        self._early: Counter[tuple[int, int]] = Counter()
        """Frames by system before its heartbeat; there are 255 systems a link."""
        self._by_source: dict[tuple[int, int], _Attached] = {}
        self._guests: set[tuple[int, int]] = set()
        """Link and system of ground stations and the like."""
        self._turned_away: set[tuple[int, int, int]] = set()
        """Link, system and component of autopilots that may not be robots here."""
        self._names: dict[End, tuple[str, ...]] = {}
        """Vehicles at ends, worked out when first asked for."""
        self._switch = FrameRouter(
            config,
            session=session,
            store=store,
            gateway=gateway,
            site=site,
            refused=refused,
            tasks=tasks,
            on_frame=self._receive,
            on_gone=self._link_gone,
            vehicles_of=self._vehicles_of,
            names_at=self._names_at,
            name_of=self._name_of,
        )
        self._others: set[str] = set()
        self._watch: Closer | None = None
        self._ticking: asyncio.Task[None] | None = None
        self._attaching: set[asyncio.Task[None]] = set()

    @property
    def attached(self) -> tuple[str, ...]:
        """Names of the MAVLink vehicles heard since start, online or not."""
        return tuple(sorted(self._vehicles))

    @property
    def links(self) -> LinkManager:
        """The links, which may come and go at run time."""
        return self._switch.links

    def link_list(self) -> LinkList:
        """All links, what went over them, and where each sender is."""
        return self._switch.link_list()

    async def start(self) -> None:
        """Bind the ports and begin; ConfigError with the remedy when a port is taken."""
        try:
            await self._switch.open()
        except SwiftbotError:
            await self.stop()
            raise
        self._watch = self._session.watch_alive(self._session.keys.robot_alive(), self._robot_seen)
        self._ticking = asyncio.create_task(self._tick(), name="robot hub")

    async def stop(self) -> None:
        """End commands (they are resumed by the next process), take back what was declared, close the ports."""
        for task in (self._ticking, *self._attaching):
            if task is not None:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task
        self._ticking = None
        await self._switch.quiet()
        for each in self._vehicles.values():
            await each.desk.close()
            for closer in (each.queryable, each.token):
                if closer is not None:
                    closer.close()
            if each.vehicle.online:
                each.vehicle.online = False
                self._tell(each, "its gateway is stopping")
        self._vehicles.clear()
        self._by_source.clear()
        self._names.clear()
        await self.links.close()
        if self._watch is not None:
            self._watch.close()
            self._watch = None

    # --- frames ------------------------------------------------------------------------------------------------

    def _receive(self, entry: OpenLink, frame: Frame, source: End, now: float) -> None:
        each = self._by_source.get((entry.number, frame.system))
        if frame.name in OVERRIDES and self._config.route:
            self._watch_sticks(frame, now)
        if each is None and self._is_guest(entry, frame):
            self._switch.record(source, "", "rx", frame.raw)
            self._switch.hand_on(entry, frame, source, None, now)
            return
        if each is None:
            each = self._welcome(entry, frame, source)
            sender = (entry.number, frame.system, frame.component)
            if each is not None:
                self._turned_away.discard(sender)
            elif is_autopilot(frame):
                self._turned_away.add(sender)
            if each is None:
                self._turn_away(frame, source)
                return
        if source != each.end:
            if not is_autopilot(frame) and frame.component != each.vehicle.component:
                # A camera, a companion computer or a station with its system id and an address of its own.
                self._switch.record(source, "", "rx", frame.raw)
                self._switch.hand_on(entry, frame, source, None, now)
                return
            if each.vehicle.online:
                self._count("address_conflict")
                self._turn_away(frame, source)
                return
            each.end = source  # restarted, or back over another way
            self._names.clear()
        vehicle = each.vehicle
        if vehicle.hear(frame, now):
            each.tell = True
        self._switch.record(source, vehicle.name, "rx", frame.raw)
        self._see(each, now)
        self._switch.hand_on(entry, frame, source, vehicle, now)

    def _turn_away(self, frame: Frame, source: End) -> None:
        """Record a frame that is not taken. A copy of it may come by the way that its sender is known by."""
        self._switch.router.unsee(frame.raw)
        self._switch.record(source, "", "rx", frame.raw)

    def _vehicles_of(self, system: int) -> list[Vehicle]:
        return [each.vehicle for each in self._vehicles.values() if each.vehicle.system == system]

    def _names_at(self, end: End) -> tuple[str, ...]:
        found = self._names.get(end)
        if found is None:
            if len(self._names) > 4096:
                self._names.clear()
            found = tuple(each.vehicle.name for each in self._by_source.values() if each.end == end)
            self._names[end] = found
        return found

    def _name_of(self, frame: Frame, source: End) -> str:
        each = self._by_source.get((source.link, frame.system))
        return each.vehicle.name if each is not None and each.end == source else ""

    def _is_guest(self, entry: OpenLink, frame: Frame) -> bool:
        """Whether the sender is no vehicle but may speak to ours: a ground station, or another onboard computer.

        Any frame tells that it is there: some stations never beat. A vehicle whose first heartbeat has not come yet is
        routed as a guest; one that may not be a robot here is none, nor is another with the address of one that is.
        """
        if not self._config.route or frame.system == self._config.system_id:
            return False
        guest, sender = (entry.number, frame.system), (entry.number, frame.system, frame.component)
        if is_autopilot(frame):
            self._guests.discard(guest)
            return False
        if sender in self._turned_away or self._is_address_of_ours(frame):
            return False
        if guest not in self._guests:
            self._guests.add(guest)
            log.info("MAVLink guest", link=str(entry.setting.remote), system=frame.system)
        return True

    def _is_address_of_ours(self, frame: Frame) -> bool:
        return any(
            (each.vehicle.system, each.vehicle.component) == (frame.system, frame.component)
            for each in self._by_source.values()
        )

    def _watch_sticks(self, frame: Frame, now: float) -> None:
        """Notice a person who takes a vehicle over the gateway."""
        if frame.name in OVERRIDES:
            for each in self._vehicles.values():
                target = frame.message.target if frame.name == "MANUAL_CONTROL" else frame.message.target_system
                if each.vehicle.system == target:
                    each.tell |= each.vehicle.control.sticks(frame.system, moved(frame.name, frame.message), now)

    def _welcome(self, entry: OpenLink, frame: Frame, source: End) -> _Attached | None:
        """Make a robot of a new system if its frame is an autopilot's heartbeat and it may have a name."""
        index = entry.number
        name = entry.setting.name_of(frame.system)
        known = sum(heard == index for heard, _ in self._by_source)
        if frame.system == self._config.system_id or name is None or known >= self._config.max_vehicles:
            self._count("unknown_system")
            return None
        if not is_autopilot(frame):
            self._count("unknown_system")
            self._early[index, frame.system] += 1
            return None
        same = self._vehicles.get(name)
        if same is not None and self._may_be_back(same, entry, frame):
            return self._take_back(same, index)
        if same is not None or name in self._others:
            self._count("name_conflict")
            log.warning("vehicle refused: its name is taken", robot=name, system=frame.system)
            return None
        # What it sent before its first heartbeat was not a stranger's.
        if early := self._early.pop((index, frame.system), 0):
            self.refused["unknown_system"] -= early
        each = self._attach(name, source)
        self._names.clear()
        self._by_source[index, frame.system] = each
        return each

    def _may_be_back(self, each: _Attached, entry: OpenLink, frame: Frame) -> bool:
        """Whether a silent vehicle may be followed to another link: not from a signed one to one without a key."""
        if each.vehicle.online or each.vehicle.system != frame.system:
            return False
        old = self.links.get(each.end.link)
        return entry.link.codec.signer is not None or old is None or old.link.codec.signer is None

    def _take_back(self, each: _Attached, link: int) -> _Attached:
        """Know a vehicle by another link, which it is heard on while it is silent on the one that it was known by."""
        for key in [key for key, other in self._by_source.items() if other is each]:
            del self._by_source[key]
        self._by_source[link, each.vehicle.system] = each
        log.info("vehicle is back over another link", robot=each.vehicle.name, link=link)
        return each

    def _attach(self, name: str, source: End) -> _Attached:

        own = self._config.system_id
        vehicle = Vehicle(
            name,
            site=self._site,
            send=lambda message: self._send(name, message),
            own=own,
            implausible=lambda _: self._count("implausible"),
        )
        vehicle.announce = lambda message: self._announce(name, message)
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
            each.queryable = self._session.serve(self._session.keys.command(name), desk.handle)
            self._see(each, asyncio.get_running_loop().time())
            log.info("vehicle attached", robot=name, address=source.address)

        task = asyncio.create_task(serve(), name=f"attach {name}")
        self._attaching.add(task)
        task.add_done_callback(self._attaching.discard)
        return each

    def _send(self, name: str, message: Message) -> None:
        each = self._vehicles.get(name)
        if each is not None:
            self._switch.send(each.end, name, message)

    def _link_gone(self, entry: OpenLink) -> None:
        """Let the vehicles of a link that was removed go: they may come back over another."""
        self._guests = {(number, system) for number, system in self._guests if number != entry.number}
        self._turned_away = {each for each in self._turned_away if each[0] != entry.number}
        for number, system in [source for source in self._early if source[0] == entry.number]:
            del self._early[number, system]
        for (number, system), each in list(self._by_source.items()):
            if number == entry.number:
                del self._by_source[number, system]
                self._vehicles.pop(each.vehicle.name, None)
                task = asyncio.create_task(self._let_go(each), name=f"detach {each.vehicle.name}")
                self._attaching.add(task)
                task.add_done_callback(self._attaching.discard)
        self._names.clear()

    async def _let_go(self, each: _Attached) -> None:
        await self._end(each)
        self._tell(each, "its link was removed")
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
            self._names.clear()
            await self._end(each)

    def _announce(self, name: str, message: Message) -> None:
        """Send a message to a vehicle and to whoever else listens: ground stations, other routers."""
        each = self._vehicles.get(name)
        if each is None:
            return
        each.vehicle.send(message)
        vehicles = {attached.end for attached in self._by_source.values()}
        self._switch.announce(message, vehicles, system=each.vehicle.system)

    # --- presence ----------------------------------------------------------------------------------------------

    def _see(self, each: _Attached, now: float) -> None:
        """Bring a vehicle online whose heartbeat is fresh and whose commands can be answered."""
        fresh = now - each.vehicle.heard_at <= self._config.heartbeat_lost_s
        if each.vehicle.online or not fresh or each.queryable is None:
            return
        each.vehicle.online = True
        each.tell = True
        each.token = self._session.declare_alive(self._session.keys.robot_alive(each.vehicle.name))
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
        name = key.split("/")[-2]
        if not alive:
            self._others.discard(name)
        elif name not in self._vehicles:
            self._others.add(name)

    async def _tick(self) -> None:
        """Send heartbeats, notice lost ones, tell the roster."""
        loop = asyncio.get_running_loop()
        beat_at, time_at, remember_at = 0.0, 0.0, loop.time() + REMEMBER_S
        while True:
            now = loop.time()
            if now >= remember_at:
                remember_at = now + REMEMBER_S
                with contextlib.suppress(SwiftbotError):  # a disk that is full now may not be so the next time
                    await self.links.remember()
            if now >= beat_at:
                beat_at = now + self._config.heartbeat_s
                self._beat()
            for each in list(self._vehicles.values()):
                if each.vehicle.online and now - each.vehicle.heard_at > self._config.heartbeat_lost_s:
                    await self._lost(each)
                interval = 1.0 / self._config.state_hz if each.vehicle.online else _OFFLINE_INFO_S
                if each.queryable is not None and (each.tell or now - each.told_at >= interval):
                    self._tell(each)
            if self._config.timesync_s and now >= time_at:
                time_at = now + self._config.timesync_s
                self._switch.ask_time({each.end for each in self._vehicles.values() if each.vehicle.online})
            self._switch.tick(now)
            await asyncio.sleep(_TICK_S)

    def _beat(self) -> None:
        """Tell every vehicle, and every other end that may not have been heard yet, that the gateway is there."""
        beat = heartbeat()
        reached: set[End] = set()
        for each in self._by_source.values():
            each.vehicle.send(beat)
            reached.add(each.end)
        self._switch.greet(beat, reached)

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
        self._session.put(self._session.keys.robot(each.vehicle.name), encode(info))

    def _count(self, what: str) -> None:
        self.refused[what] = self.refused.get(what, 0) + 1
