"""What becomes of each good frame on a gateway's links: recorded, taken by the gateway itself, or passed on.

The vehicle manager decides whose frames are believed and which senders are vehicles; here they only come in and go out.
"""

import asyncio
import time
from collections.abc import Callable, Sequence

import structlog

from appliance.model import Notice, Site, TaskRecord, encode
from appliance.plane.session import Closer, Session
from appliance.robots.api import LinkList
from appliance.robots.executor import KeyValues
from appliance.robots.mavlink.command_server import COMMAND_MESSAGES, CommandServer
from appliance.robots.mavlink.dialect import MARKER_V2, Frame, Message, make
from appliance.robots.mavlink.link_manager import LinkManager, OpenLink
from appliance.robots.mavlink.links import Address
from appliance.robots.mavlink.mission_server import MISSION_MESSAGES, MissionServer
from appliance.robots.mavlink.routing import End, Kind, RoutingTable
from appliance.robots.mavlink.tunnel import PAYLOAD_TYPE
from appliance.robots.mavlink.tunnel_rpc import TunnelServer
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.settings import RobotsConfig
from appliance.robots.task_listener import Tasks

log = structlog.get_logger(__name__)

OPERATORS = "operator"
"""Who gets notices of what goes wrong on links."""
FRAME_ENCODING = "application/mavlink"
_LINKS_S = 1.0
"""How often the links are told about."""
_BUSY = 5000
"""Messages that wait to be sent by the plane, beyond which streams are not read: what comes in is to be recorded."""
_ASKING = COMMAND_MESSAGES | MISSION_MESSAGES | {"TUNNEL"}
"""Messages by which the gateway itself may be asked for something."""
SETUP_SIGNING = (256).to_bytes(3, "little")
"""The id of that message, as it stands in a frame."""


class FrameRouter:
    """All links of one gateway, and the ways between them.

    Args:
        config: the robots room's settings.
        session: where frames are put, and records of tasks are heard.
        store: keeps what must outlive a restart.
        gateway: this one's name.
        site: where missions are.
        refused: counters of bad input.
        tasks: the fleet's tasks; None where this gateway takes none.
        on_frame: told each good frame that is no repetition, of which link and from which end.
        on_gone: told each link that was removed.
        vehicles_of: the vehicles of a system id.
        names_at: names of the vehicles at an end.
        name_of: the vehicle whose frame it is, when it comes from that end; "" for none.
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
        tasks: Tasks | None,
        on_frame: Callable[[OpenLink, Frame, End, float], None],
        on_gone: Callable[[OpenLink], None],
        vehicles_of: Callable[[int], Sequence[Vehicle]],
        names_at: Callable[[End], Sequence[str]],
        name_of: Callable[[Frame, End], str],
    ) -> None:
        self._config = config
        self._session = session
        self._gateway = gateway
        self._refused = refused
        self._on_frame = on_frame
        self._vehicles_of = vehicles_of
        self._names_at = names_at
        self._name_of = name_of
        self._loop = asyncio.get_running_loop()
        self.router = RoutingTable(own_system=config.system_id, repeat_s=config.repeat_s)
        self.links = LinkManager(
            config,
            store=store,
            router=self.router,
            on_frame=self._receive,
            on_gone=on_gone,
            refused=refused,
            busy=lambda: session.unsent > _BUSY,
        )
        self._missions = MissionServer(
            config,
            site=site,
            store=store,
            refused=refused,
            clock=time.monotonic,
            problems=(lambda _: ()) if tasks is None else tasks.problems,
        )
        self._requests = CommandServer(
            config.templates,
            tasks=tasks,
            store=store,
            refused=refused,
            mission=self._missions.request,
            reach=self._reach,
        )
        self._letters = TunnelServer(tasks=tasks, refused=refused, clock=time.monotonic)
        self._records: Closer | None = None
        self._tell_at = 0.0

    async def open(self) -> None:
        """Open the links and begin; ConfigError with the remedy when a setting is wrong or a port taken."""
        await self._missions.load()
        await self._requests.load()
        self._records = self._session.subscribe_typed(
            self._session.keys.task(), TaskRecord, self._on_record, wanted=self._follows
        )
        await self.links.open()

    async def quiet(self) -> None:
        """Take nothing more from anybody; what was under way is asked again by whoever wanted it."""
        await self._requests.close()
        await self._letters.close()
        await self._missions.close()
        if self._records is not None:
            self._records.close()
            self._records = None

    # --- in ----------------------------------------------------------------------------------------------------

    def _receive(self, entry: OpenLink, frame: Frame, address: Address) -> None:
        now = self._loop.time()
        source = (frame.system, frame.component)
        end = entry.end(address)
        if frame.system == 0:
            # An address for all and nobody's own: what was learned of it would draw everybody's frames to one end.
            self._refused["no_sender"] = self._refused.get("no_sender", 0) + 1
            self.record(end, "", "rx", frame.raw)
            return
        kind = (*source, frame.name)
        if not entry.damper.passes(kind, now):
            entry.link.count("damped")
            entry.link.stats.sender(*source).hear(frame.sequence, now)
            if entry.damper.news(kind):
                self._report_storm(entry, kind)
            return  # not recorded either: a storm must not fill the log
        if self.router.repeated(frame.raw, now, sender=source):
            entry.link.stats.sender(*source).repeated += 1
            self._refused["repeated"] = self._refused.get("repeated", 0) + 1
            self.record(end, self._name_of(frame, end), "rx", frame.raw)  # it goes no further, but it was heard
            return
        entry.link.stats.sender(*source).hear(frame.sequence, now)
        self._on_frame(entry, frame, end, now)

    def _report_storm(self, entry: OpenLink, kind: Kind) -> None:
        system, component, name = kind
        link = str(entry.setting.remote)
        log.warning("a MAVLink message comes in a storm and is damped", link=link, message=name, system=system)
        text = f"MAVLink: a storm of {name} from {system}/{component} on {link} is damped; see what answers it"
        notice = Notice(
            id=f"{self._gateway}/storm/{entry.number}/{system}-{component}/{name}/{time.time_ns()}",
            to=OPERATORS,
            text=text,
            gateway=self._gateway,
            at_ns=time.time_ns(),
        )
        self._session.put(self._session.keys.notice(OPERATORS), encode(notice))

    def hand_on(self, entry: OpenLink, frame: Frame, source: End, sender: Vehicle | None, now: float) -> None:
        """Take what is for the gateway, pass on the rest. `sender`: the vehicle whose system's frame it is."""
        if self._ask(frame, source, sender):
            return
        if frame.name == "TIMESYNC":
            if self.links.timed(entry, frame, source.address):
                return
            self._tell_time(entry, frame, source, sender)
        if not self._config.route:
            return
        self.router.hear(frame, source, now)
        for end in self.router.destinations(frame, source):
            other = self.links.get(end.link)
            if other is not None:
                raw = other.link.codec.pass_on(frame)
                other.link.transmit(raw, end.address)
                for name in self._names_at(end) or ("",):
                    self.record(end, name, "tx", raw)

    def _ask(self, frame: Frame, source: End, sender: Vehicle | None) -> bool:
        """Take what is for the gateway as an onboard computer: of its own system, or of a vehicle's.

        Ground stations know vehicles, not gateways: their buttons address component 191 of the vehicle's system. Where
        a real companion computer has that number, the command is its.
        """
        if frame.target_component != self._config.component_id or frame.name not in _ASKING:
            return False
        if frame.name == "TUNNEL" and frame.message.payload_type != PAYLOAD_TYPE:
            return False
        mission = frame.name in MISSION_MESSAGES
        if mission and sender is not None and frame.component == sender.component:
            return False  # an autopilot's answer while a mission is uploaded to it
        system = frame.target_system
        robot = asker = "" if sender is None else sender.name
        if system != self._config.system_id:
            addressed = self._vehicles_of(system)
            if len(addressed) != 1 or self.router.knows(system, self._config.component_id):
                return False
            robot = addressed[0].name

        def reply(message: Message) -> None:
            entry = self.links.get(source.link)
            if entry is not None:
                raw = entry.link.send(message, source.address, system=system)
                self.record(source, "" if sender is None else sender.name, "tx", raw)

        if mission:
            self._missions.take(frame, robot=robot, reply=reply)
        elif frame.name == "TUNNEL":
            self._letters.take(frame, asker=asker, reply=reply)
        else:
            self._requests.take(frame, robot=robot, asker=asker, reply=reply)
        return True

    def _reach(self, sender: str, system: int) -> Callable[[Message], None] | None:
        """Return how a sender is told something as the onboard computer of a system; None where it is not heard."""
        whose, _, component = sender.partition("-")
        known = whose.isdecimal() and component.isdecimal()
        end = self.router.where(int(whose), int(component)) if known else None
        if end is None:
            return None

        def reply(message: Message) -> None:
            entry = self.links.get(end.link)
            if entry is not None:
                raw = entry.link.send(message, end.address, system=system or self._config.system_id)
                for name in self._names_at(end) or ("",):
                    self.record(end, name, "tx", raw)

        return reply

    def _tell_time(self, entry: OpenLink, frame: Frame, source: End, sender: Vehicle | None) -> None:
        """Answer a question for the time with this gateway's own, the one that its questions carry.

        MAVLink guide, "Time Synchronization Protocol": a question has `tc1` 0; the answer has the time of whoever
        answers in it, and the asker's own `ts1`. A dialect that addresses it may mean somebody else.
        """
        message = frame.message
        if message.tc1 != 0 or frame.target_system not in (0, self._config.system_id):
            return
        raw = entry.link.send(make("TIMESYNC", tc1=time.monotonic_ns(), ts1=message.ts1), source.address)
        self.record(source, "" if sender is None else sender.name, "tx", raw)

    # --- out ---------------------------------------------------------------------------------------------------

    def record(self, end: End, vehicle: str, direction: str, raw: bytes) -> None:
        """Put a frame on the plane, for the recorder: by its vehicle's name, or its link's number where it has none.

        One that sets a vehicle's signing key is routed and not told: the key is in it (MAVLink, SETUP_SIGNING).
        """
        if not raw or (raw[0] == MARKER_V2 and raw[7:10] == SETUP_SIGNING):
            return
        keys = self._session.keys
        key = keys.mavlink(vehicle, direction) if vehicle else keys.link_frames(self._gateway, str(end.link), direction)
        self._session.put(key, raw, encoding=FRAME_ENCODING)

    def send(self, end: End, vehicle: str, message: Message, *, system: int | None = None) -> None:
        """Send the gateway's own message to a vehicle; `system`: as that system's onboard computer."""
        entry = self.links.get(end.link)
        if entry is not None:
            self.record(end, vehicle, "tx", entry.link.send(message, end.address, system=system))

    def greet(self, message: Message, reached: set[End]) -> None:
        """Send a heartbeat to all other ends that are known before they were heard, so that they know us."""
        for entry in self.links:
            for other in entry.link.others:
                end = entry.end(other)
                if end not in reached:
                    self.record(end, "", "tx", entry.link.send(message, other))

    def announce(self, message: Message, vehicles: set[End], *, system: int) -> None:
        """Send a message to all ends that have been heard, but those of vehicles: ground stations, other routers.

        It is about a vehicle and comes from its onboard computer: stations show texts by system, and MAVSDK those of
        its vehicle's system alone. Where a real companion computer has that address the gateway speaks as itself.
        """
        taken = self.router.knows(system, self._config.component_id)
        for end in self.router.ends:
            if end not in vehicles:
                self.send(end, "", message, system=None if taken else system)

    def link_list(self) -> LinkList:
        """All links, what went over them, and where each sender is."""
        return LinkList(gateway=self._gateway, links=self.links.all_facts(), routes=self.links.routes())

    def ask_time(self, ends: set[End]) -> None:
        """Ask ends for their time, which tells the latency."""
        for end, raw in self.links.ask_time(ends):
            for name in self._names_at(end) or ("",):
                self.record(end, name, "tx", raw)

    def tick(self, now: float) -> None:
        """Send what is due; to be called some twenty times a second."""
        if now >= self._tell_at:
            self._tell_at = now + _LINKS_S
            self._session.put(self._session.keys.links(self._gateway), encode(self.link_list()))
        self._letters.tick()
        self._missions.tick()
        self._requests.tick(now)

    def _follows(self, key: str) -> bool:
        """Whether anybody here is told of a record: most are of other gateways' business, and large."""
        task = key.split("/")[-2]
        return self._requests.follows(task) or self._letters.follows(task)

    def _on_record(self, key: str, record: TaskRecord | None) -> None:
        del key
        if record is not None:
            self._requests.news(record)
            self._letters.news(record)
