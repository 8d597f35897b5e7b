"""The gateway as an onboard computer (component 191): what ground stations and robots ask of it over MAVLink.

Commands (`command_server`), missions (`mission_server`), tasks in words (`tunnel_rpc`), and the time.
"""

import time
from collections.abc import Callable

from appliance.model import Site, TaskRecord, keyspace
from appliance.plane.session import Closer, Session
from appliance.robots.executor import KeyValues
from appliance.robots.mavlink.command_server import COMMAND_MESSAGES, CommandServer
from appliance.robots.mavlink.dialect import Frame, Message, make
from appliance.robots.mavlink.frame_router import FrameSender
from appliance.robots.mavlink.link_manager import LinkManager
from appliance.robots.mavlink.mission_server import MISSION_MESSAGES, MissionServer
from appliance.robots.mavlink.routing import End, RoutingTable
from appliance.robots.mavlink.tunnel import PAYLOAD_TYPE
from appliance.robots.mavlink.tunnel_rpc import TunnelServer
from appliance.robots.mavlink.vehicle_manager import VehicleManager
from appliance.robots.settings import RobotsConfig
from appliance.robots.task_listener import Tasks

_ASKING = COMMAND_MESSAGES | MISSION_MESSAGES | {"TUNNEL"}
"""Messages by which the gateway itself may be asked for something."""


class Companion:
    """An endpoint.

    Args:
        config: the robots room's settings.
        session: where records of tasks are heard.
        store: keeps what must outlive a restart.
        site: where missions are.
        refused: counters of bad input.
        tasks: the fleet's tasks; None where this gateway takes none.
        links: whose latency answers for the time tell.
        routing: where senders are.
        sender: the way out.
        vehicles: whose frames are whose.
    """

    def __init__(
        self,
        config: RobotsConfig,
        *,
        session: Session,
        store: KeyValues,
        site: Site,
        refused: dict[str, int],
        tasks: Tasks | None,
        links: LinkManager,
        routing: RoutingTable,
        sender: FrameSender,
        vehicles: VehicleManager,
    ) -> None:
        self._config = config
        self._session = session
        self._links = links
        self._routing = routing
        self._sender = sender
        self._vehicles = vehicles
        self._missions = MissionServer(
            config,
            site=site,
            store=store,
            refused=refused,
            clock=time.monotonic,
            problems=(lambda _: ()) if tasks is None else tasks.problems,
        )
        self._commands = CommandServer(
            config.templates,
            tasks=tasks,
            store=store,
            refused=refused,
            mission=self._missions.request,
            reach=self._reach,
        )
        self._tunnel = TunnelServer(tasks=tasks, refused=refused, clock=time.monotonic)
        self._records: Closer | None = None

    async def open(self) -> None:
        """Load what was kept and begin."""
        await self._missions.load()
        await self._commands.load()
        self._records = self._session.subscribe_typed(keyspace.TASK_UPDATE, self._on_record, wanted=self._follows)

    async def close(self) -> None:
        """Take nothing more; what was under way is asked again by those who want it."""
        await self._commands.close()
        await self._tunnel.close()
        await self._missions.close()
        if self._records is not None:
            self._records.close()
            self._records = None

    def tick(self, now: float) -> None:
        """Send what is due; to be called some twenty times a second."""
        self._tunnel.tick()
        self._missions.tick()
        self._commands.tick(now)

    def accept(self, frame: Frame, source: End, now: float) -> bool:
        """Take what is for the gateway as an onboard computer: of its own system, or of a vehicle's."""
        del now
        if frame.target_component == self._config.component_id and frame.name in _ASKING and self._ask(frame, source):
            return False
        if frame.name == "TIMESYNC":
            entry = self._links.get(source.link)
            if entry is not None and self._links.timed(entry, frame, source.address):
                return False
            self._tell_time(frame, source)
        return True

    def _ask(self, frame: Frame, source: End) -> bool:
        """Take a question; whether it was one for the gateway.

        Ground stations know vehicles, not gateways: their buttons address component 191 of the vehicle's system. Where
        a real companion computer has that number, the command is its.
        """
        if frame.name == "TUNNEL" and frame.message.payload_type != PAYLOAD_TYPE:
            return False
        vehicle = self._vehicles.at(source, frame.system)
        mission = frame.name in MISSION_MESSAGES
        if mission and vehicle is not None and frame.component == vehicle.component:
            return False  # an autopilot's answer while a mission is uploaded to it
        system = frame.target_system
        robot = asker = "" if vehicle is None else vehicle.name
        if system != self._config.system_id:
            addressed = self._vehicles.of_system(system)
            if len(addressed) != 1 or self._routing.knows(system, self._config.component_id):
                return False
            robot = addressed[0].name

        def reply(message: Message) -> None:
            self._sender.send(source, message, vehicle=asker, system=system)

        if mission:
            self._missions.take(frame, robot=robot, reply=reply)
        elif frame.name == "TUNNEL":
            self._tunnel.take(frame, asker=asker, reply=reply)
        else:
            self._commands.take(frame, robot=robot, asker=asker, reply=reply)
        return True

    def _reach(self, sender: str, system: int) -> Callable[[Message], None] | None:
        """Return how a sender is sent something as the onboard computer of a system; None where it is not heard."""
        whose, _, component = sender.partition("-")
        known = whose.isdecimal() and component.isdecimal()
        end = self._routing.where(int(whose), int(component)) if known else None
        if end is None:
            return None
        return lambda message: self._sender.send(end, message, system=system or self._config.system_id)

    def _tell_time(self, frame: Frame, source: End) -> None:
        """Answer a question for the time with this gateway's own, the one that its questions carry.

        MAVLink guide, "Time Synchronization Protocol": a question has `tc1` 0; the answer has the answering side's time
        in it, and the asker's own `ts1`. A dialect that addresses it may mean somebody else.
        """
        message = frame.message
        if message.tc1 != 0 or frame.target_system not in (0, self._config.system_id):
            return
        vehicle = self._vehicles.at(source, frame.system)
        answer = make("TIMESYNC", tc1=time.monotonic_ns(), ts1=message.ts1)
        self._sender.send(source, answer, vehicle="" if vehicle is None else vehicle.name)

    def _follows(self, key: str) -> bool:
        """Whether a record is followed here: most are other gateways' business, and large."""
        (task,) = keyspace.TASK_UPDATE.names(key)
        return self._commands.follows(task) or self._tunnel.follows(task)

    def _on_record(self, key: str, record: TaskRecord | None) -> None:
        del key
        if record is not None:
            self._commands.news(record)
            self._tunnel.news(record)
