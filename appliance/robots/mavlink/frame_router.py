"""Where each good frame of a gateway's links goes: to its endpoints, to the recorder, to other links.

Frames go one way: `Link` reads them out of bytes, `FrameRouter` drops repetitions and storms, offers each to the
endpoints of this gateway one after the other, and passes on what they let by (`routing` says where to). The router
knows nothing of vehicles: endpoints do. `FrameSender` is the way out, `FrameTap` shows the recorder both ways.
"""

import asyncio
import time
from collections.abc import Mapping, Sequence
from typing import Protocol

import structlog

from appliance.model import Notice, keyspace
from appliance.plane.session import Publisher, Session
from appliance.robots.mavlink.dialect import MARKER_V2, Frame, Message
from appliance.robots.mavlink.link_manager import LinkManager, OpenLink
from appliance.robots.mavlink.links import Address
from appliance.robots.mavlink.routing import BROADCAST, End, Kind, RoutingTable
from appliance.robots.mavlink.vehicle import is_autopilot
from appliance.robots.settings import RobotsConfig

log = structlog.get_logger(__name__)

OPERATORS = "operator"
"""Who gets notices of what goes wrong on links."""
FRAME_ENCODING = "application/mavlink"
_BUSY = 5000
"""Messages that wait to be sent by the plane, beyond which streams are not read: what comes in is to be recorded."""
SETUP_SIGNING = (256).to_bytes(3, "little")
"""The id of that message, as it stands in a frame."""
_NO_NAME = ("",)


class Endpoint(Protocol):
    """Takes frames on this gateway itself."""

    def accept(self, frame: Frame, source: End, now: float) -> bool:
        """Take a frame heard at an end; whether it goes on, to the next endpoint and to other links."""
        ...


class FrameTap:
    """Puts frames on the plane for the recorder: by the vehicle's name, else by the link's number. An endpoint, too.

    Vehicles' names are those that `know` gave it.
    """

    def __init__(self, session: Session, gateway: str) -> None:
        self._session = session
        self._gateway = gateway
        self._publishers: dict[tuple[str | int, str], Publisher] = {}
        """By vehicle, or number of a link, and direction."""
        self._names: dict[End, dict[int, str]] = {}
        self._names_at: dict[End, tuple[str, ...]] = {}

    @property
    def busy(self) -> bool:
        """Whether more waits to be put than should."""
        return self._session.unsent > _BUSY

    def know(self, names: Mapping[tuple[End, int], str]) -> None:
        """Know the vehicles by end and system id; all that were known before are forgotten."""
        self._names = {}
        for (end, system), name in names.items():
            self._names.setdefault(end, {})[system] = name
        self._names_at = {end: tuple(known.values()) for end, known in self._names.items()}

    def accept(self, frame: Frame, source: End, now: float) -> bool:
        """Record a frame that came in."""
        del now
        known = self._names.get(source)
        self.record(source, known.get(frame.system, "") if known else "", "rx", frame.raw)
        return True

    def sent(self, end: End, raw: bytes) -> None:
        """Record a frame that went to an end: for each vehicle that is there."""
        for name in self._names_at.get(end, _NO_NAME):
            self.record(end, name, "tx", raw)

    def record(self, end: End, vehicle: str, direction: str, raw: bytes) -> None:
        """Put a frame by its vehicle's name, or its link's number where it has none.

        One that sets a vehicle's signing key is not put: the key is in it (MAVLink, SETUP_SIGNING).
        """
        if not raw or (raw[0] == MARKER_V2 and raw[8] == 1 and raw[7:10] == SETUP_SIGNING):
            return
        whose = vehicle or end.link
        publisher = self._publishers.get((whose, direction))
        if publisher is None:
            keys, link = self._session.keys, str(end.link)
            key = (
                keys(keyspace.MAVLINK, vehicle, direction)
                if vehicle
                else keys(keyspace.LINK_FRAMES, self._gateway, link, direction)
            )
            publisher = self._publishers[whose, direction] = self._session.publisher(key, FRAME_ENCODING)
        publisher.put(raw)

    def forget(self, whose: str | int) -> None:
        """Record no more of a vehicle, or of a link by its number."""
        for way in [way for way in self._publishers if way[0] == whose]:
            self._publishers.pop(way).close()

    def storm(self, entry: OpenLink, kind: Kind) -> None:
        """Report a storm that is damped to the log and to operators."""
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
        self._session.publish(keyspace.NOTICE, notice, OPERATORS)


class FrameSender:
    """The way out: the gateway's own messages and what is passed on, each recorded once."""

    def __init__(self, config: RobotsConfig, *, links: LinkManager, routing: RoutingTable, tap: FrameTap) -> None:
        self._config = config
        self._links = links
        self._routing = routing
        self._tap = tap

    def pass_on(self, frame: Frame, ends: Sequence[End]) -> None:
        """Send a frame to other ends.

        What is meant for one is recorded there too. What is meant for all has been recorded as it was heard; where it
        went is counted (`LinkFacts.passed`): with a copy for each station the log would be mostly copies.
        """
        for end in ends:
            entry = self._links.get(end.link)
            if entry is not None:
                raw = entry.link.codec.pass_on(frame)
                entry.link.transmit(raw, end.address)
                if frame.target_system == BROADCAST:
                    entry.link.stats.passed_on(frame.system, frame.component)
                else:
                    self._tap.sent(end, raw)

    def send(self, end: End, message: Message, *, vehicle: str | None = None, system: int | None = None) -> None:
        """Send the gateway's own message.

        Args:
            end: where to.
            message: what.
            vehicle: by which name it is recorded; None: by those of all vehicles there.
            system: as that system's onboard computer; None: as the gateway.
        """
        entry = self._links.get(end.link)
        if entry is not None:
            raw = entry.link.send(message, end.address, system=system)
            if vehicle is None:
                self._tap.sent(end, raw)
            else:
                self._tap.record(end, vehicle, "tx", raw)

    def greet(self, message: Message, reached: set[End]) -> None:
        """Send a heartbeat to all other ends that are known before they were heard, so that they know us."""
        for entry in self._links:
            for other in entry.link.others:
                end = entry.end(other)
                if end not in reached:
                    self._tap.record(end, "", "tx", entry.link.send(message, other))

    def announce(self, message: Message, vehicles: set[End], *, system: int) -> None:
        """Send a message to all ends that have been heard, but those of vehicles: ground stations, other routers.

        It is about a vehicle and comes from its onboard computer: stations show texts by system, and MAVSDK those of
        its vehicle's system alone. Where a real companion computer has that address the gateway speaks as itself.
        """
        taken = self._routing.knows(system, self._config.component_id)
        for end in self._routing.ends:
            if end not in vehicles:
                self.send(end, message, vehicle="", system=None if taken else system)

    def ask_time(self, ends: set[End]) -> None:
        """Ask ends for their time, which tells the latency."""
        for end, raw in self._links.ask_time(ends):
            self._tap.sent(end, raw)


class FrameRouter:
    """Takes each good frame of all links.

    Args:
        config: the robots room's settings.
        links: all links.
        routing: where frames go, by what was heard.
        tap: shows frames to the recorder.
        sender: passes frames on.
        endpoints: take each frame that is new, in this order.
        refused: counters of bad input.
    """

    def __init__(
        self,
        config: RobotsConfig,
        *,
        links: LinkManager,
        routing: RoutingTable,
        tap: FrameTap,
        sender: FrameSender,
        endpoints: Sequence[Endpoint],
        refused: dict[str, int],
    ) -> None:
        self._routes = config.route
        self._links = links
        self._routing = routing
        self._tap = tap
        self._sender = sender
        self._accept = tuple(endpoint.accept for endpoint in endpoints)
        self._refused = refused
        self._now = asyncio.get_running_loop().time

    @property
    def busy(self) -> bool:
        """Whether no more can be recorded just now."""
        return self._tap.busy

    def receive(self, link: int, frame: Frame, address: Address) -> None:
        """Take a frame."""
        entry = self._links.get(link)
        if entry is None:
            return
        now = self._now()
        end = entry.end(address)
        if frame.system == 0:
            # An address for all and nobody's own: what was learned of it would draw everybody's frames to one end.
            self._refused["no_sender"] = self._refused.get("no_sender", 0) + 1
            self._tap.record(end, "", "rx", frame.raw)
            return
        source = (frame.system, frame.component)
        stats = entry.link.stats.sender(*source)
        if not entry.damper.passes(*source, frame.name, now):
            entry.link.count("damped")
            stats.hear(frame.sequence, now)
            kind = (*source, frame.name)
            if entry.damper.news(kind):
                self._tap.storm(entry, kind)
            return  # not recorded either: a storm must not fill the log
        if self._routing.repeated(frame.raw, now, sender=source):
            stats.repeated += 1
            self._refused["repeated"] = self._refused.get("repeated", 0) + 1
            self._tap.accept(frame, end, now)  # it goes no further, but it was heard
            return
        stats.hear(frame.sequence, now)
        for accept in self._accept:
            if not accept(frame, end, now):
                return
        if self._routes:
            self._routing.hear(frame, end, now, autopilot=is_autopilot(frame))
            ends = self._routing.destinations(frame, end)
            if ends:
                self._sender.pass_on(frame, ends)
