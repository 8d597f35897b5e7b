"""Which frames go on to which other ends: MAVLink routing and storm damping as pure deciders, the clock passed in.

Source: MAVLink guide, "Routing": a frame for everybody goes to all other ends; a frame for a system goes where that
system (or its component) has been heard, and nowhere when it was heard nowhere; nothing goes back to where it came
from. Ends are (link, address): two vehicles on one listening port are two ends. What a vehicle sends for everybody is
not for other vehicles: each of N would get the telemetry of all others, N·N frames. They get the messages that are
named as shared (`robots.vehicles_share`), all that stations and onboard computers send, and what is addressed to them.
An end is passed over so only where nobody but other vehicles has been heard. A ring of routers would send a frame
round for ever, so a frame that was seen just before is dropped, and a sender is believed on the end it was heard on
last. What was learned ages, ends and senders alike.

Storms of one message are found by its rate, let through in a trickle, and reported once (`Damper`). Two programs that
answer each other's answers never end, and each further one doubles what is sent: three vehicles that took PARAM_VALUE
for a question sent 45,000 a second. A gateway cannot tell such a message from one that is wanted, but no message is
wanted at such a rate, so what it passes on is cut until nearly nothing more comes.
"""

from collections import OrderedDict
from collections.abc import Collection, Sequence
from typing import Protocol

from msgspec import Struct

from appliance.robots.mavlink.links import Address

BROADCAST = 0
WRAP = 128
"""So many frames of one sender later the same bytes are news: sequence numbers begin again after 256."""
MAX_SEEN = 8192
MAX_PLANNED = 16384
"""Destinations remembered by sender and target, so that they are worked out once for each way."""
COMPANIONS = range(191, 195)
"""Components of onboard computers (MAV_COMP_ID_ONBOARD_COMPUTER to 4): what they send for all is for vehicles too."""


class End(Struct, frozen=True):
    """The other end of a link, or one of several on a link that listens."""

    link: int
    address: Address


class Rules(Struct, frozen=True, kw_only=True):
    """Which messages may pass between a link and the others, by name; an empty set of `only` lets all pass."""

    only_in: frozenset[str] = frozenset()
    not_in: frozenset[str] = frozenset()
    only_out: frozenset[str] = frozenset()
    not_out: frozenset[str] = frozenset()

    def lets_in(self, name: str) -> bool:
        """Whether a message heard on the link may go on to others."""
        return name not in self.not_in and (not self.only_in or name in self.only_in)

    def lets_out(self, name: str) -> bool:
        """Whether a message of another link may be sent on this one."""
        return name not in self.not_out and (not self.only_out or name in self.only_out)


class Routed(Protocol):
    """What routing looks at of a frame."""

    @property
    def system(self) -> int:
        """Whose it is."""
        ...

    @property
    def component(self) -> int:
        """Of which component."""
        ...

    @property
    def name(self) -> str:
        """Which message."""
        ...

    @property
    def target_system(self) -> int:
        """Whom it is for; 0 for everybody."""
        ...

    @property
    def target_component(self) -> int:
        """And for which component."""
        ...


class RoutingTable:
    """Routes of one gateway, learned from what is heard.

    Args:
        rules: of the links with the numbers 0, 1, ...; `add` and `remove` change them later.
        own_system: the gateway's system id: what is meant for it goes nowhere else.
        shared: messages for everybody that vehicles get of each other, by name.
        forget_s: an end, or a sender at one, that was silent for so long is forgotten, with all that was learned of it.
        repeat_s: the same bytes within so long are a repetition, however they came.
        max_ends: most ends known at once; the longest silent is forgotten first.
        max_routes: the same of senders: what invents system ids by the thousand costs no memory.
    """

    def __init__(
        self,
        rules: Sequence[Rules] = (),
        *,
        own_system: int,
        shared: Collection[str] = (),
        forget_s: float = 60.0,
        repeat_s: float = 0.5,
        max_ends: int = 256,
        max_routes: int = 2048,
    ) -> None:
        self._rules = dict(enumerate(rules))
        self._own = own_system
        self._shared = frozenset(shared)
        self._forget_s = forget_s
        self._repeat_s = repeat_s
        self._max_ends = max_ends
        self._max_routes = max_routes
        self._ends: OrderedDict[End, float] = OrderedDict()
        """When each was heard last, the longest silent first."""
        self._routes: OrderedDict[tuple[int, int], tuple[End, float]] = OrderedDict()
        """Where each (system, component) was heard last and when, the longest silent first."""
        self._seen: OrderedDict[bytes, tuple[float, int]] = OrderedDict()
        """When bytes were let through, and which frame of their sender they were."""
        self._turns: dict[tuple[int, int], int] = {}
        """Frames let through of each sender; there are 65,280."""
        self._planned: dict[tuple[End, str, int, int, int], tuple[End, ...]] = {}
        self._vehicles: set[int] = set()
        """Systems of which an autopilot has been heard."""
        self._systems: dict[End, set[int]] = {}
        """Systems that have been heard at each end, also those that are believed to be at another one now."""

    def add(self, link: int, rules: Rules) -> None:
        """Know a link by its number."""
        self._rules[link] = rules
        self._planned.clear()

    def remove(self, link: int) -> None:
        """Forget a link and all its ends."""
        self._rules.pop(link, None)
        for end in [end for end in self._ends if end.link == link]:
            self._forget(end)

    @property
    def ends(self) -> tuple[End, ...]:
        """Ends heard lately."""
        return tuple(self._ends)

    @property
    def routes(self) -> dict[tuple[int, int], End]:
        """Where each (system, component) is."""
        return {sender: end for sender, (end, _) in self._routes.items()}

    def where(self, system: int, component: int) -> End | None:
        """Return where that very component was heard last."""
        found = self._routes.get((system, component))
        return None if found is None else found[0]

    def knows(self, system: int, component: int) -> bool:
        """Whether that very component has been heard."""
        return (system, component) in self._routes

    def repeated(self, raw: bytes, now: float, *, sender: tuple[int, int] | None = None) -> bool:
        """Whether these bytes came just before; notes that they came now. Bounded by the time, and by 8192 frames.

        Args:
            raw: the frame.
            now: monotonic seconds.
            sender: whose it is; one that is so fast that its sequence numbers begin again within the time may say the
                same again. None: no such allowance.
        """
        while self._seen:
            oldest, (at, _) = next(iter(self._seen.items()))
            if now - at <= self._repeat_s and len(self._seen) <= MAX_SEEN:
                break
            del self._seen[oldest]
        turn = self._turns.get(sender, 0) if sender is not None else 0
        before = self._seen.get(raw)
        if before is not None:
            if turn - before[1] < WRAP:
                return True
            self._seen.move_to_end(raw)
        self._seen[raw] = (now, turn)
        if sender is not None:
            self._turns[sender] = turn + 1
        return False

    def unsee(self, raw: bytes) -> None:
        """Forget that these bytes came: where they came from they were not taken, and a copy by another way may be."""
        self._seen.pop(raw, None)

    def hear(self, passage: Routed, source: End, now: float, *, autopilot: bool = False) -> None:
        """Learn that a sender is at an end, and whether this frame shows that it is a vehicle's autopilot."""
        sender = (passage.system, passage.component)
        if autopilot and passage.system not in self._vehicles:
            self._vehicles.add(passage.system)
            self._planned.clear()
        known = self._routes.get(sender)
        if known is None or known[0] != source or source not in self._ends:
            self._systems.setdefault(source, set()).add(passage.system)
            self._planned.clear()
        self._ends[source] = now
        self._ends.move_to_end(source)
        self._routes[sender] = (source, now)
        self._routes.move_to_end(sender)
        while self._ends:
            silent, at = next(iter(self._ends.items()))
            if now - at <= self._forget_s and len(self._ends) <= self._max_ends:
                break
            self._forget(silent)
        while self._routes:
            oldest, (_, at) = next(iter(self._routes.items()))
            if now - at <= self._forget_s and len(self._routes) <= self._max_routes:
                break
            self._lose(oldest)

    def _forget(self, end: End) -> None:
        del self._ends[end]
        del self._systems[end]
        for sender in [sender for sender, (where, _) in self._routes.items() if where == end]:
            self._lose(sender)
        self._planned.clear()

    def _lose(self, sender: tuple[int, int]) -> None:
        """Forget where a sender is; a system of which nobody is left is no vehicle any more."""
        del self._routes[sender]
        if all(system != sender[0] for system, _ in self._routes):
            self._vehicles.discard(sender[0])
            for systems in self._systems.values():
                systems.discard(sender[0])
        self._planned.clear()

    def destinations(self, passage: Routed, source: End) -> tuple[End, ...]:
        """Return the ends a frame heard at `source` goes on to."""
        # Whose telemetry it is decides who does not get it; of all others only the way does.
        of_vehicle = passage.system if self._is_telemetry(passage) else BROADCAST
        way = (source, passage.name, passage.target_system, passage.target_component, of_vehicle)
        planned = self._planned.get(way)
        if planned is None:
            if len(self._planned) >= MAX_PLANNED:
                self._planned.clear()
            planned = self._planned[way] = self._destinations(passage, source)
        return planned

    def _destinations(self, passage: Routed, source: End) -> tuple[End, ...]:
        rules = self._rules.get(source.link)
        if rules is None or not rules.lets_in(passage.name) or passage.target_system == self._own:
            return ()
        if passage.target_system == BROADCAST:
            found = set(self._ends)
            if self._is_telemetry(passage):
                found -= self._only_vehicles(besides=passage.system)
        else:
            found = self._where(passage.target_system, passage.target_component)
        return tuple(
            sorted(
                (end for end in found if end != source and self._rules[end.link].lets_out(passage.name)),
                key=lambda end: (end.link, end.address),
            )
        )

    def _is_telemetry(self, passage: Routed) -> bool:
        """Whether a frame is a vehicle's own word to everybody, which is not for other vehicles."""
        return (
            passage.target_system == BROADCAST
            and passage.system in self._vehicles
            and passage.component not in COMPANIONS
            and passage.name not in self._shared
        )

    def _only_vehicles(self, *, besides: int) -> set[End]:
        """Ends where nobody but other vehicles has been heard: no station, no component of the system itself.

        A station with two links has one where it is not believed to be just now: it gets telemetry there all the same.
        """
        return {end for end, systems in self._systems.items() if systems <= self._vehicles - {besides}}

    def _where(self, system: int, component: int) -> set[End]:
        """Ends of a component; of its whole system where the component is not meant, or was never heard."""
        exact = self._routes.get((system, component)) if component != BROADCAST else None
        if exact is not None:
            return {exact[0]}
        return {end for (heard, _), (end, _) in self._routes.items() if heard == system}


BULK = frozenset(
    (
        "FILE_TRANSFER_PROTOCOL",
        "LOG_DATA",
        "REMOTE_LOG_DATA_BLOCK",
        "ENCAPSULATED_DATA",
        "TUNNEL",
        "SERIAL_CONTROL",
        "GPS_RTCM_DATA",
    )
)
"""Messages that carry files and streams as fast as the link does; the limit of all frames of an end holds for them."""
BURST_S = 4.0
"""So many seconds' worth may come at once: a list of 1,500 parameters does over a fast link."""
TRICKLE = 0.04
"""Share of the limit that a storm is cut to."""
WINDOW_S = 5.0
"""A storm is over when for so long less came than the trickle lets through."""
MAX_KINDS = 4096
"""Senders' messages that are followed; the longest silent is forgotten first."""

Kind = tuple[int, int, str]
"""System, component, message."""


class _Flow(Struct):
    level: float
    at: float
    damped: bool = False
    reported: bool = False
    since: float = 0.0
    came: int = 0


class Damper:
    """Damps storms of one link.

    Args:
        per_s: most frames a second of one message from one sender; 0 for no limit.
    """

    def __init__(self, per_s: float) -> None:
        self._per_s = per_s
        self._flows: OrderedDict[Kind, _Flow] = OrderedDict()
        self.damped: dict[Kind, None] = {}
        """What is being damped."""

    def passes(self, system: int, component: int, name: str, now: float) -> bool:
        """Count a frame; whether it may go on."""
        if not self._per_s or name in BULK:
            return True
        kind = (system, component, name)
        flow = self._flows.get(kind)
        if flow is None:
            flow = self._flows[kind] = _Flow(self._per_s * BURST_S, now)
            while len(self._flows) > MAX_KINDS:
                gone, _ = self._flows.popitem(last=False)
                self.damped.pop(gone, None)
        else:
            self._flows.move_to_end(kind)
        if flow.damped:
            self._look(kind, flow, now)
        rate = self._per_s * (TRICKLE if flow.damped else 1.0)
        flow.level = min(rate * (1.0 if flow.damped else BURST_S), flow.level + (now - flow.at) * rate)
        flow.at = now
        flow.came += 1
        if flow.level >= 1.0:
            flow.level -= 1.0
            return True
        if not flow.damped:
            flow.damped, flow.since, flow.came = True, now, 0
            self.damped[kind] = None
        return False

    def _look(self, kind: Kind, flow: _Flow, now: float) -> None:
        """End the damping of what has become quiet."""
        passed = now - flow.since
        if passed < WINDOW_S:
            return
        if flow.came / passed < self._per_s * TRICKLE:
            flow.damped, flow.reported = False, False
            flow.level = self._per_s * BURST_S
            self.damped.pop(kind, None)
        flow.since, flow.came = now, 0

    def news(self, kind: Kind) -> bool:
        """Whether a storm is one that was not reported; notes that it is now."""
        flow = self._flows.get(kind)
        if flow is None or flow.reported:
            return False
        flow.reported = True
        return True

    def look(self, now: float) -> None:
        """End the damping of what has become silent altogether."""
        for kind in list(self.damped):
            flow = self._flows.get(kind)
            if flow is not None:
                self._look(kind, flow, now)
