"""A gateway's MAVLink vehicles on the plane: roster entries, commands, raw frames.

A vehicle becomes a robot of the fleet by its autopilot's heartbeat, under the name its link gives it. From then
on the station speaks for it: it puts RobotInfo, holds its liveliness token while heartbeats come, answers
commands, and puts every frame of it on the plane for the recorder. It takes no name that another robot has.
Ground stations on any link are its guests: frames pass between them and the vehicles (`routing`).
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable

import structlog

from appliance.errors import SwiftbotError
from appliance.model import Failure, Site, TaskRecord, encode
from appliance.plane.session import Closer, Session
from appliance.robots.commands import CommandDesk
from appliance.robots.doors import Tasks
from appliance.robots.ledger import KeyValues, Ledger
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.copter import Copter
from appliance.robots.mavlink.dialect import Codec, Frame, Message
from appliance.robots.mavlink.keeping import REMEMBER_S, load_signer, remember
from appliance.robots.mavlink.letters import LetterDesk
from appliance.robots.mavlink.links import Address, Link, open_link
from appliance.robots.mavlink.requests import RequestDesk
from appliance.robots.mavlink.routing import BROADCAST, End, Passage, Router, Rules
from appliance.robots.mavlink.tunnel import PAYLOAD_TYPE
from appliance.robots.mavlink.vehicle import Vehicle, is_autopilot
from appliance.robots.settings import MavlinkLink, RobotsConfig

log = structlog.get_logger(__name__)

FRAME_ENCODING = "application/mavlink"
_TICK_S = 0.05
_OFFLINE_INFO_S = 5.0
"""How often the roster is reminded of a vehicle that is offline."""
_STREAMS_HZ = {"GLOBAL_POSITION_INT": 5.0, "SYS_STATUS": 1.0, "MISSION_CURRENT": 2.0, "HOME_POSITION": 0.2}
"""What is asked of a vehicle that has come online; ArduPilot sends little of it by itself."""


class _Attached:
    """A vehicle and all that serves it."""

    def __init__(self, vehicle: Vehicle, copter: Copter, desk: CommandDesk, address: Address) -> None:
        self.vehicle = vehicle
        self.copter = copter
        self.desk = desk
        self.address = address
        self.told_at = 0.0
        self.tell = True
        self.token: Closer | None = None
        self.queryable: Closer | None = None


class Station:
    """All MAVLink links of one gateway. `attached` names the vehicles heard so far."""

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
    ) -> None:
        self._config = config
        self._session = session
        self._store = store
        self._gateway = gateway
        self._site = site
        self.refused = refused
        self._links: list[Link] = []
        self._vehicles: dict[str, _Attached] = {}
        self._early: Counter[tuple[int, int]] = Counter()
        """Frames by system before its heartbeat; there are 255 systems a link."""
        self._by_source: dict[tuple[int, int], _Attached] = {}
        self._guests: set[tuple[int, int]] = set()
        """Link and system of ground stations and the like."""
        rules = [
            Rules(
                only_in=frozenset(link.only_in),
                not_in=frozenset(link.not_in),
                only_out=frozenset(link.only_out),
                not_out=frozenset(link.not_out),
            )
            for link in config.mavlink
        ]
        self._router = Router(rules, own_system=config.system_id)
        self._requests = RequestDesk(config.templates, tasks=tasks, store=store, refused=refused)
        self._letters = LetterDesk(tasks=tasks, refused=refused, clock=time.monotonic)
        self._records: Closer | None = None
        self._others: set[str] = set()
        self._watch: Closer | None = None
        self._ticking: asyncio.Task[None] | None = None
        self._attaching: set[asyncio.Task[None]] = set()

    @property
    def attached(self) -> tuple[str, ...]:
        """Names of the MAVLink vehicles heard since start, online or not."""
        return tuple(sorted(self._vehicles))

    async def start(self) -> None:
        """Bind the ports and begin; ConfigError with the remedy when a port is taken."""
        try:
            for index, link in enumerate(self._config.mavlink):
                signer = await load_signer(link, index, self._store)
                codec = Codec(self._config.system_id, self._config.component_id, signer=signer)
                self._links.append(await open_link(link.remote, codec, self._receiver(index, link), self.refused))
                log.info("MAVLink link open", link=str(link.remote), listens=link.remote.listens)
        except SwiftbotError:
            await self.stop()
            raise
        await self._requests.load()
        self._records = self._session.subscribe_typed(
            self._session.keys.task(), TaskRecord, self._on_record, wanted=self._follows
        )
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
        await self._requests.close()
        await self._letters.close()
        if self._records is not None:
            self._records.close()
            self._records = None
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
        for link in self._links:
            await link.close()
        await remember(self._links, self._config.mavlink, self._store)
        self._links.clear()
        if self._watch is not None:
            self._watch.close()
            self._watch = None

    # --- frames ------------------------------------------------------------------------------------------------

    def _receiver(self, index: int, link: MavlinkLink) -> Callable[[Frame, Address], None]:
        def receive(frame: Frame, address: Address) -> None:
            self._receive(index, link, frame, address)

        return receive

    def _receive(self, index: int, link: MavlinkLink, frame: Frame, address: Address) -> None:
        now = asyncio.get_running_loop().time()
        if self._router.repeated(frame.raw, now):
            self._count("repeated")
            return
        each = self._by_source.get((index, frame.system))
        if each is None and self._is_guest(index, frame):
            if not self._ask(frame, End(index, address), None):
                self._route(frame, End(index, address), now)
            return
        if each is None:
            each = self._welcome(index, link, frame, address)
            if each is None:
                return
        if address != each.address:
            if each.vehicle.online:
                self._count("address_conflict")
                return
            each.address = address  # restarted, or back over another way
        vehicle = each.vehicle
        if vehicle.hear(frame, now):
            each.tell = True
        self._session.put(self._session.keys.mavlink(vehicle.name, "rx"), frame.raw, encoding=FRAME_ENCODING)
        self._see(each, now)
        if not self._ask(frame, End(index, address), each):
            self._route(frame, End(index, address), now)

    def _ask(self, frame: Frame, source: End, sender: _Attached | None) -> bool:
        """Take a command or message for the gateway as an onboard computer: of its own system, or of a vehicle's.

        Ground stations know vehicles, not gateways: their buttons address component 191 of the vehicle's system. Where
        a real companion computer has that number, the command is its.
        """
        tunnel = frame.name == "TUNNEL" and frame.message.payload_type == PAYLOAD_TYPE
        if not tunnel and frame.name not in ("COMMAND_LONG", "COMMAND_INT"):
            return False
        system, component = frame.message.target_system, frame.message.target_component
        if component != self._config.component_id:
            return False
        robot = "" if sender is None else sender.vehicle.name
        if system != self._config.system_id:
            addressed = [each for each in self._vehicles.values() if each.vehicle.system == system]
            if len(addressed) != 1 or self._router.knows(system, component):
                return False
            robot = addressed[0].vehicle.name

        def reply(message: Message) -> None:
            if source.link < len(self._links):
                raw = self._links[source.link].send(message, source.address, system=system)
                if sender is not None:
                    name = sender.vehicle.name
                    self._session.put(self._session.keys.mavlink(name, "tx"), raw, encoding=FRAME_ENCODING)

        (self._letters if tunnel else self._requests).take(frame, robot=robot, reply=reply)
        return True

    def _follows(self, key: str) -> bool:
        """Whether anybody here is told of a record: most are of other gateways' business, and large."""
        task = key.split("/")[-2]
        return self._requests.follows(task) or self._letters.follows(task)

    def _on_record(self, key: str, record: TaskRecord | None) -> None:
        del key
        if record is not None:
            self._requests.news(record)
            self._letters.news(record)

    def _is_guest(self, index: int, frame: Frame) -> bool:
        """Whether the sender is no vehicle but may speak to ours: a ground station, or another onboard computer."""
        if not self._config.route or frame.system == self._config.system_id:
            return False
        if frame.name == "HEARTBEAT" and frame.message.autopilot == dialect.AUTOPILOT_NONE:
            if (index, frame.system) not in self._guests:
                self._guests.add((index, frame.system))
                log.info("MAVLink guest", link=str(self._links[index].remote), system=frame.system)
            return True
        if is_autopilot(frame):
            self._guests.discard((index, frame.system))  # a vehicle whose camera or radio was heard first
        return (index, frame.system) in self._guests

    def _route(self, frame: Frame, source: End, now: float) -> None:
        """Pass a frame on to where it is meant for."""
        if not self._config.route:
            return
        passage = Passage(
            system=frame.system,
            component=frame.component,
            name=frame.name,
            raw=frame.raw,
            target_system=getattr(frame.message, "target_system", BROADCAST),
            target_component=getattr(frame.message, "target_component", BROADCAST),
        )
        self._router.hear(passage, source, now)
        for end in self._router.destinations(passage, source):
            raw = self._links[end.link].codec.pass_on(frame)
            self._links[end.link].transmit(raw, end.address)
            for (index, _), each in self._by_source.items():
                if index == end.link and each.address == end.address:
                    self._session.put(self._session.keys.mavlink(each.vehicle.name, "tx"), raw, encoding=FRAME_ENCODING)

    def _welcome(self, index: int, link: MavlinkLink, frame: Frame, address: Address) -> _Attached | None:
        """Make a robot of a new system if its frame is an autopilot's heartbeat and it may have a name."""
        name = link.name_of(frame.system)
        known = sum(source == index for source, _ in self._by_source)
        if frame.system == self._config.system_id or name is None or known >= self._config.max_vehicles:
            self._count("unknown_system")
            return None
        if not is_autopilot(frame):
            self._count("unknown_system")
            self._early[index, frame.system] += 1
            return None
        if name in self._vehicles or name in self._others:
            self._count("name_conflict")
            log.warning("vehicle refused: its name is taken", robot=name, system=frame.system)
            return None
        # What it sent before its first heartbeat was not a stranger's.
        if early := self._early.pop((index, frame.system), 0):
            self.refused["unknown_system"] -= early
        each = self._attach(index, name, address)
        self._by_source[index, frame.system] = each
        return each

    def _attach(self, index: int, name: str, address: Address) -> _Attached:

        vehicle = Vehicle(name, site=self._site, send=lambda message: self._send(index, name, message))
        copter = Copter(vehicle, site=self._site, config=self._config)
        ledger = Ledger(name, self._store, limit=self._config.ledger)
        desk = CommandDesk(
            name,
            session=self._session,
            ledger=ledger,
            verbs=copter.verbs(),
            ready=copter.ready,
            halt=copter.halt,
            refused=self.refused,
        )
        each = _Attached(vehicle, copter, desk, address)
        self._vehicles[name] = each

        async def serve() -> None:
            await ledger.load()
            desk.verbs = copter.verbs()  # its heartbeat has told by now what it is: it can be commanded at once
            each.queryable = self._session.serve(self._session.keys.command(name), desk.handle)
            self._see(each, asyncio.get_running_loop().time())
            log.info("vehicle attached", robot=name, address=address)

        task = asyncio.create_task(serve(), name=f"attach {name}")
        self._attaching.add(task)
        task.add_done_callback(self._attaching.discard)
        return each

    def _send(self, index: int, name: str, message: Message) -> None:
        each = self._vehicles.get(name)
        if each is None or index >= len(self._links):
            return
        raw = self._links[index].send(message, each.address)
        self._session.put(self._session.keys.mavlink(name, "tx"), raw, encoding=FRAME_ENCODING)

    # --- presence ----------------------------------------------------------------------------------------------

    def _see(self, each: _Attached, now: float) -> None:
        """Bring a vehicle online whose heartbeat is fresh and whose commands can be answered."""
        fresh = now - each.vehicle.heard_at <= self._config.heartbeat_lost_s
        if each.vehicle.online or not fresh or each.queryable is None:
            return
        each.vehicle.online = True
        each.tell = True
        each.token = self._session.declare_alive(self._session.keys.robot_alive(each.vehicle.name))
        self._ask_streams(each)
        log.info("vehicle online", robot=each.vehicle.name)

    def _ask_streams(self, each: _Attached) -> None:

        for stream, hz in _STREAMS_HZ.items():
            fields = {f"param{number}": 0.0 for number in range(3, 8)}
            each.vehicle.send(
                dialect.make(
                    "COMMAND_LONG",
                    target_system=each.vehicle.system,
                    target_component=each.vehicle.component,
                    command=dialect.SET_INTERVAL,
                    confirmation=0,
                    param1=float(dialect.constant(f"MAVLINK_MSG_ID_{stream}")),
                    param2=1e6 / hz,
                    **fields,
                )
            )

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
        beat_at, remember_at = 0.0, loop.time() + REMEMBER_S
        while True:
            now = loop.time()
            if now >= remember_at:
                remember_at = now + REMEMBER_S
                with contextlib.suppress(SwiftbotError):  # a disk that is full now may not be so the next time
                    await remember(self._links, self._config.mavlink, self._store)
            if now >= beat_at:
                beat_at = now + self._config.heartbeat_s
                self._beat()
            for each in list(self._vehicles.values()):
                if each.vehicle.online and now - each.vehicle.heard_at > self._config.heartbeat_lost_s:
                    await self._lost(each)
                interval = 1.0 / self._config.state_hz if each.vehicle.online else _OFFLINE_INFO_S
                if each.queryable is not None and (each.tell or now - each.told_at >= interval):
                    self._tell(each)
            self._letters.tick()
            await asyncio.sleep(_TICK_S)

    def _beat(self) -> None:
        """Tell every vehicle, and every other end that may not have been heard yet, that the gateway is there."""
        beat = dialect.make(
            "HEARTBEAT",
            type=dialect.TYPE_ONBOARD,
            autopilot=dialect.AUTOPILOT_NONE,
            base_mode=0,
            custom_mode=0,
            system_status=dialect.STATE_ACTIVE,
            mavlink_version=3,
        )
        reached: set[tuple[int, Address]] = set()
        for (index, _), each in self._by_source.items():
            each.vehicle.send(beat)
            reached.add((index, each.address))
        for index, link in enumerate(self._links):
            for other in link.others:
                if (index, other) not in reached:
                    link.send(beat, other)

    def _tell(self, each: _Attached, note: str = "") -> None:
        """Put the roster entry; the verbs follow from what the last heartbeat said it is."""
        each.tell = False
        each.told_at = asyncio.get_running_loop().time()
        each.desk.verbs = each.copter.verbs()
        if not note and not each.vehicle.online:
            note = "no heartbeat"
        elif not note and not each.vehicle.commandable:
            note = "watched, not commanded: only ArduPilot multirotors are so far"
        elif not note:
            note = ", ".join(each.desk.busy)
        verbs = (*each.desk.verbs, "stop") if each.vehicle.commandable else tuple(each.desk.verbs)
        info = each.vehicle.info(self._gateway, verbs, note)
        self._session.put(self._session.keys.robot(each.vehicle.name), encode(info))

    def _count(self, what: str) -> None:
        self.refused[what] = self.refused.get(what, 0) + 1
