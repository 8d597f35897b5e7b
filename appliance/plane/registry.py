"""The latest facts of the fleet: every gateway's status and containers, every robot. Each fact has one owner.

Owners put facts when they change (`Speaker`). What goes out says how old it is: a figure may have been read some time
ago, and containers may have changed since they were last told. A status that says nothing new is repeated now and then,
and says when it will be again at the latest: listeners can tell silence from loss.

A newcomer asks: each member of a small fleet; in a large one a neighbour for all that it knows, and then only
those it knew nothing of. A fact carries its age: since it was heard, on this machine's monotonic clock, and what its
speaker said it was old by then; what is older than its speaker promised is stale, counts less in decisions, and is
asked for again. What a gateway said goes with it. Robots describe themselves, or their gateways do; one that is gone is
shown offline for a while (`Roster`).

**How often a thing is published** (`Cadence`, pure) follows from how volatile it is and how much it is asked for. The
paper pushes every 500 ms: a container that was taken in between is missed, and one that never changes is published for
nothing. Here every change is published, and the interval between messages about one thing weighs what a message costs
against what it saves. With messages T apart a change is known T/2 late on average, so of `demand` decisions a second
about demand · volatility · T / 2 rest on a state that has passed, while listeners / T messages a second are delivered.
The sum, with `DELIVERY_PRICE` such decisions worth a delivery, is least at

    T = sqrt(2 · DELIVERY_PRICE · listeners / (volatility · demand))

the square-root law of keeping copies fresh (Cho and Garcia-Molina, "Synchronizing a database to improve freshness",
SIGMOD 2000). A thing that has been quiet for T is published at once.
"""

import asyncio
import math
import random
import time
from collections.abc import Callable, Iterable, Mapping

import msgspec
import structlog
from msgspec.structs import replace

from appliance.errors import PayloadError, SwiftbotError
from appliance.model import ContainerInfo, ContainerState, GatewayStatus, RobotInfo, encode, keyspace
from appliance.model.keys import check_name
from appliance.model.plane_api import Facts, FactsAsk, Known
from appliance.model.robots import plausible, read_robot
from appliance.plane.events import FactsChanged, FleetEvent, FleetEvents, Joined, Lost, Relinked, Stage
from appliance.plane.membership import Membership, Namesakes, Versions
from appliance.plane.rpc import Rpc
from appliance.plane.session import Closer, Message, Session
from appliance.plane.settings import PlaneConfig

DELIVERY_PRICE = 0.005
"""Decisions on a passed state that the delivery of one message is worth. With three listeners, a container that changes
twice a second and is asked for once a second is published at most every 120 ms; at ten times of both, every 20 ms."""
RATE_MEMORY_S = 10.0
"""Rates are averages over about so long."""
QUIET_DEMAND = 0.02
"""Decisions a second that a thing nobody asked for counts with: somebody may."""
_MOST_HEARD = 1000.0
"""Messages a second that a listener hears at most when everybody has news all the time."""
_MUCH_HEARD = 100.0
"""The same when everybody has news all the time and nobody asks for it."""
_HEARTBEATS = 10.0
"""Messages a second that a listener hears when nothing changes."""


class Rate:
    """Events a second, of late: each counts less and less, by exp(−age / MEMORY_S)."""

    def __init__(self) -> None:
        self._value = 0.0
        self._at = 0.0

    def add(self, now: float) -> None:
        """An event; `now` in seconds of a clock that never goes back."""
        self._value, self._at = self.read(now) + 1 / RATE_MEMORY_S, now

    def read(self, now: float) -> float:
        """Events a second."""
        return self._value * math.exp(-max(0.0, now - self._at) / RATE_MEMORY_S)


def interval_s(*, volatility: float, demand: float, listeners: int, least_s: float, most_s: float) -> float:
    """Seconds between two messages about a thing, within `bounds`.

    Args:
        volatility: changes a second.
        demand: decisions a second that rest on it.
        listeners: how many hear it.
        least_s: never less; what changes within this time is published together.
        most_s: never more.
    """
    least_s, most_s = bounds(listeners, least_s=least_s, most_s=most_s)
    weight = volatility * max(QUIET_DEMAND, demand)
    wanted = math.sqrt(2 * DELIVERY_PRICE * max(1, listeners) / weight) if weight > 0 else most_s
    return min(most_s, max(least_s, wanted))


def bounds(listeners: int, *, least_s: float, most_s: float) -> tuple[float, float]:
    """The shortest and the longest interval in a fleet of that size: each listener hears so many others."""
    least_s = max(least_s, listeners / _MOST_HEARD)
    return least_s, max(most_s, least_s, listeners / _MUCH_HEARD)


def heartbeat_s(listeners: int, least_s: float) -> float:
    """Seconds after which what has not changed is said again, so that silence means something."""
    return max(least_s, listeners / _HEARTBEATS)


class Cadence:
    """When one thing is published next."""

    def __init__(self, *, least_s: float, most_s: float) -> None:
        self._least_s, self._most_s = least_s, most_s
        self._changes = Rate()
        self._asked = Rate()
        self._told_at = -math.inf
        self._since: float | None = None

    @property
    def since(self) -> float | None:
        """Since when something is untold; None: nothing is."""
        return self._since

    def changed(self, now: float) -> None:
        """It has changed."""
        self._changes.add(now)
        if self._since is None:
            self._since = now

    def asked(self, now: float) -> None:
        """A decision rested on it."""
        self._asked.add(now)

    def demand(self, now: float) -> float:
        """Decisions a second."""
        return self._asked.read(now)

    def due(self, now: float, *, listeners: int, elsewhere: float = 0.0) -> float | None:
        """When it is to be told; None: there is nothing to tell. `elsewhere`: decisions a second on other gateways."""
        if self._since is None:
            return None
        least_s, most_s = bounds(listeners, least_s=self._least_s, most_s=self._most_s)
        apart_s = interval_s(
            volatility=self._changes.read(now),
            demand=self._asked.read(now) + elsewhere,
            listeners=listeners,
            least_s=self._least_s,
            most_s=self._most_s,
        )
        return min(max(self._since + least_s, self._told_at + apart_s), self._since + most_s)

    def told(self, now: float) -> None:
        """It has been told as it is."""
        self._told_at, self._since = now, None


STATUS_S = 2.0
"""A status that has not changed is repeated so often in a small fleet, which costs nothing."""
LOAD_STEP = 0.05
"""A load that moved by less is no news: it changes no placement."""
MOST_IMAGES = 64
"""Images whose demand is kept apart; the oldest go."""
_MOST_TOLD = 16
_LEAST_DEMAND = 0.05


class Speaker:
    """One gateway's own facts on their way out.

    Args:
        session: to put them.
        gateway: this one.
        least_s: what changes within this time goes out together.
        most_s: nothing waits longer in a small fleet.
        listeners: how many others listen just now.
        elsewhere: decisions a second on other gateways that rest on containers of an image.
    """

    def __init__(
        self,
        session: Session,
        gateway: str,
        *,
        least_s: float,
        most_s: float,
        listeners: Callable[[], int],
        elsewhere: Callable[[str], float],
    ) -> None:
        self._session = session
        self._gateway = gateway
        self._least_s, self._most_s = least_s, most_s
        self._listeners = listeners
        self._elsewhere = elsewhere
        self._status: GatewayStatus | None = None
        self._status_at = 0.0
        self._status_told: GatewayStatus | None = None
        self._status_told_at = 0.0
        self._of_status = Cadence(least_s=least_s, most_s=most_s)
        self._wanted: dict[str, ContainerInfo] = {}
        self._told: dict[str, ContainerInfo] = {}
        self._of_image: dict[str, Cadence] = {}
        self._decisions: dict[str, Rate] = {}
        self._timer: asyncio.TimerHandle | None = None

    def status(self, status: GatewayStatus) -> None:
        """This gateway's account of itself; its `age_ms` is how old its figures are already."""
        now = time.monotonic()
        before, told = self._status, self._status_told
        self._status, self._status_at = status, now
        news = before is None or tells_more(before, status) or (told is not None and tells_more(told, status))
        if news or now - self._status_told_at >= self._again_s() - self._least_s:
            self._of_status.changed(now)
        self._plan(now)

    def containers(self, containers: tuple[ContainerInfo, ...]) -> None:
        """All containers that this gateway holds; those left out are gone."""
        now = time.monotonic()
        before, self._wanted = self._wanted, {each.id: each for each in containers}
        changed = {each.image for each in self._wanted.values() if before.get(each.id) != each}
        changed |= {each.image for each in before.values() if each.id not in self._wanted}
        for image in changed:
            self._cadence(image).changed(now)
        self._plan(now)

    def asked(self, image: str, *, here: bool) -> None:
        """A decision rests on containers of an image; one made `here` is one that the others hear of."""
        now = time.monotonic()
        self._cadence(image).asked(now)
        self._of_status.asked(now)
        if here:
            if image not in self._decisions and len(self._decisions) >= MOST_IMAGES:
                del self._decisions[next(iter(self._decisions))]
            self._decisions.setdefault(image, Rate()).add(now)

    @property
    def untold_s(self) -> float:
        """For how long containers have changed without being told."""
        since = [each.since for each in self._of_image.values() if each.since is not None]
        return time.monotonic() - min(since) if since else 0.0

    def _cadence(self, image: str) -> Cadence:
        if image not in self._of_image and len(self._of_image) >= MOST_IMAGES:
            idle = next((each for each, cadence in self._of_image.items() if cadence.since is None), None)
            if idle is not None:
                del self._of_image[idle]
        return self._of_image.setdefault(image, Cadence(least_s=self._least_s, most_s=self._most_s))

    def _again_s(self) -> float:
        return heartbeat_s(self._listeners(), STATUS_S)

    # --- going out --------------------------------------------------------------------------------------------

    def _due(self, now: float) -> dict[str, float]:
        """When which images are due; the status under the empty name."""
        listeners = self._listeners()
        due = {
            image: cadence.due(now, listeners=listeners, elsewhere=self._elsewhere(image))
            for image, cadence in self._of_image.items()
        }
        if self._status is not None:
            due[""] = self._of_status.due(now, listeners=listeners, elsewhere=self._elsewhere(""))
        return {what: at for what, at in due.items() if at is not None}

    def _plan(self, now: float) -> None:
        at = min(self._due(now).values(), default=None)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if at is not None:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, at - now), self._go)

    def _go(self, *, all_of_it: bool = False) -> None:
        self._timer = None
        now = time.monotonic()
        due = {what for what, at in self._due(now).items() if all_of_it or at <= now + self._least_s / 2}
        for image in due - {""}:
            self._tell_image(image)
            self._of_image[image].told(now)
        if "" in due:
            self._tell_status(now)
            self._of_status.told(now)
        if not all_of_it:
            self._plan(now)

    def _tell_image(self, image: str) -> None:
        session, gateway = self._session, self._gateway
        for gone in [each.id for each in self._told.values() if each.image == image and each.id not in self._wanted]:
            session.delete(session.keys(keyspace.CONTAINER, gateway, gone))
            del self._told[gone]
        for each in self._wanted.values():
            if each.image == image and self._told.get(each.id) != each:
                session.publish(keyspace.CONTAINER, each, gateway, each.id)
                self._told[each.id] = each

    def _tell_status(self, now: float) -> None:
        if self._status is None:
            return
        self._status_told, self._status_told_at = self._status, now
        self._session.publish(keyspace.STATUS, self.now(self._status), self._gateway)

    def now(self, status: GatewayStatus) -> GatewayStatus:
        """A status as it is said at this moment: with its age, and what is asked for here."""
        now = time.monotonic()
        return replace(
            status,
            age_ms=status.age_ms + round((now - self._status_at) * 1e3),
            at_ns=time.time_ns(),
            untold_ms=round(self.untold_s * 1e3),
            again_ms=round(self._again_s() * 1e3),
            asked=told_demand({image: rate.read(now) for image, rate in self._decisions.items()}),
        )

    def close(self) -> None:
        """Tell what waits, and no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._go(all_of_it=True)


def tells_more(before: GatewayStatus, after: GatewayStatus) -> bool:
    """Whether a status says more than slightly other figures. Pure."""
    same = replace(
        after,
        cpu_percent=before.cpu_percent,
        memory_mb=before.memory_mb,
        load=before.load,
        age_ms=before.age_ms,
        planner=before.planner,
    )
    return same != before or abs(after.load - before.load) >= LOAD_STEP


def told_demand(rates: dict[str, float]) -> dict[str, float]:
    """What is asked for most, in decisions a second, coarse so that it seldom moves. Pure."""
    coarse: dict[str, float] = {}
    for image, rate in sorted(rates.items(), key=lambda each: (-each[1], each[0]))[:_MOST_TOLD]:
        step = _LEAST_DEMAND
        while step < rate:
            step *= 2
        if rate >= _LEAST_DEMAND:
            coarse[image] = step
    return coarse


ROBOT_KEPT_S = 300.0
"""How long a robot that went offline is still shown."""
MOST_ROBOTS = 10_000
"""Bound on what is believed."""
SPEAKER_S = 3.0
"""A robot that has said nothing for so long may be followed by another of its name, such as itself after a restart."""
RIVAL_S = 15.0
"""How long it is shown that a second one used the name."""
_ROSTER_TICK_S = 5.0


class Roster:
    """What is known of robots just now; `on_change` is called when it is something else than before."""

    def __init__(self, session: Session, *, on_change: Callable[[], None]) -> None:
        self.robots: dict[str, RobotInfo] = {}
        self._session = session
        self._on_change = on_change
        self.lost_ns: dict[str, int] = {}
        """When each robot that is offline was lost, Unix nanoseconds by this machine's clock, also without its row."""
        self._gone: dict[str, float] = {}
        self._speakers: dict[str, tuple[str, float]] = {}
        """Who speaks for each name, and when it did last."""
        self._rivals: dict[str, float] = {}
        """When another was last heard that uses the name."""
        self._closers: list[Closer] = []
        self._sweeping: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to listen."""
        session = self._session
        self._closers = [
            session.subscribe(session.keys(keyspace.ROBOT), self._heard),
            session.watch_alive(session.keys(keyspace.ROBOT_ALIVE), self._on_alive),
        ]
        self._sweeping = asyncio.create_task(self._keep_sweeping(), name="roster")

    def take(self, robots: Iterable[RobotInfo]) -> None:
        """Learn of robots from a gateway that knows them; what they said themselves is newer."""
        for robot in robots:
            if robot.id not in self.robots and len(self.robots) < MOST_ROBOTS and self._named(robot.id):
                self.robots[robot.id] = self._believed(robot)
                if not robot.online:
                    self._went(robot.id)
                self._on_change()

    def _heard(self, message: Message) -> None:
        info = None
        if not message.deleted:
            try:
                info = read_robot(message.payload)
            except msgspec.DecodeError as error:
                self._session.refuse("malformed robot/*/state", key=message.key, reason=str(error))
                return
        self._on_robot(message.key, info)

    def _believed(self, info: RobotInfo) -> RobotInfo:
        """Return a robot's state without numbers that cannot be, which are counted."""
        believed, dropped = plausible(info)
        if dropped:
            self._session.refuse("implausible robot/*/state", robot=info.id, left_out=", ".join(dropped))
        return believed

    def _named(self, robot: str) -> bool:
        """Whether it is a name that a robot may have: `*` on a key would be all of them, and so would its commands."""
        try:
            check_name(robot, "robot")
        except PayloadError as error:
            self._session.refuse("misnamed robot/*/state", reason=error.message)
            return False
        return True

    def doubtful(self, robot: str) -> bool:
        """Whether more than one may carry out what this robot is ordered: they have to be counted first."""
        info = self.robots.get(robot)
        if info is None or info.gateway:
            return False  # its gateway sees to it that it is one
        return not info.speaker or self._contested(robot)

    def _contested(self, robot: str) -> bool:
        return time.monotonic() - self._rivals.get(robot, -RIVAL_S) < RIVAL_S

    def _heeded(self, info: RobotInfo) -> bool:
        """Whether this one speaks for its name: the older one of two does, in every roster."""
        if not info.speaker:
            return True
        now = time.monotonic()
        speaker, heard_at = self._speakers.get(info.id, (info.speaker, now))
        if speaker != info.speaker and now - heard_at < SPEAKER_S:
            self._session.refuse("namesake robot/*/state", robot=info.id)
            self._rivals[info.id] = now
            if speaker < info.speaker:
                return False
        elif speaker != info.speaker:
            self._rivals.pop(info.id, None)
        self._speakers[info.id] = (info.speaker, now)
        return True

    def _on_robot(self, key: str, info: RobotInfo | None) -> None:
        (robot,) = keyspace.ROBOT.names(key)
        if info is None:
            # Somebody removed its row: a robot that is merely gone is put as offline, or its token ends.
            self._gone.pop(robot, None)
            self.lost_ns.pop(robot, None)
            self._speakers.pop(robot, None)
            self._rivals.pop(robot, None)
            if self.robots.pop(robot, None) is not None:
                self._on_change()
            return
        if info.id != robot:
            self._session.refuse("misplaced robot/*/state", key=key, says=info.id)
            return
        if not self._named(robot):
            return
        if robot not in self.robots and len(self.robots) >= MOST_ROBOTS:
            self._session.refuse("too many robot/*/state", key=key)
            return
        before, info = self.robots.get(robot), self._believed(info)
        if not self._heeded(info):
            return
        if self._contested(robot):
            note = f"another robot calls itself {robot}: give it a name of its own"
            info = replace(info, note=f"{note}; {info.note}" if info.note else note)
        self.robots[robot] = info
        if info.online:
            self._gone.pop(robot, None)
            self.lost_ns.pop(robot, None)
        else:
            self._went(robot)
        if before != info:
            self._on_change()

    def _on_alive(self, key: str, alive: bool) -> None:
        if not alive:
            self.lose(*keyspace.ROBOT_ALIVE.names(key))

    def lose(self, robot: str) -> None:
        """Count a robot as offline until it is heard again."""
        info = self.robots.get(robot)
        if info is not None and info.online:
            self.robots[robot] = replace(info, online=False)
            self._went(robot)
            self._on_change()

    def _went(self, robot: str) -> None:
        """Note that a robot is offline from now on, unless it was before."""
        self._gone.setdefault(robot, time.monotonic())
        self.lost_ns.setdefault(robot, time.time_ns())
        while len(self.lost_ns) > MOST_ROBOTS:
            del self.lost_ns[next(iter(self.lost_ns))]

    async def _keep_sweeping(self) -> None:
        while True:
            await asyncio.sleep(_ROSTER_TICK_S)
            before = time.monotonic() - ROBOT_KEPT_S
            for robot in [each for each, since in self._gone.items() if since < before]:
                del self._gone[robot]
                self._speakers.pop(robot, None)
                self._rivals.pop(robot, None)
                self.robots.pop(robot, None)
                self._on_change()

    async def close(self) -> None:
        """Listen no more."""
        for closer in self._closers:
            closer.close()
        if self._sweeping is not None:
            self._sweeping.cancel()
            await asyncio.gather(self._sweeping, return_exceptions=True)


log = structlog.get_logger(__name__)

MOST_CONTAINERS = 4096
"""Bound on what is believed of one gateway."""
FEW_MEMBERS = 8
"""Members that are each asked at once; with more the newcomer asks one for all, and the others wait for it to speak."""
LATE = 1.5
"""A status is overdue after so many of the intervals that its speaker promised."""
_FACTS_S = 2.0
_FACTS_TRIES = 3
_GATHER_S = 0.02
"""For so long a newcomer gathers members before it asks for their facts."""
_SPEAK_S = 0.2
"""For so long a newcomer is given to tell its own facts, and longer in a large fleet, at random."""
_SOON_S = (0.05, 0.15)
"""After so long a member of a small fleet asks another that has come, drawn, so that they do not all ask at once."""
_ASKED_AT_ONCE = 8
_PAGE_BYTES = 2**20
_DOUBT_S = 1.0
"""A gateway whose facts are stale is asked again at most so often."""


class Registry:
    """What is known of the fleet just now; publishes `FactsChanged`."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        session: Session,
        rpc: Rpc,
        membership: Membership,
        events: FleetEvents,
        gateway: str | None,
    ) -> None:
        self.gateways: dict[str, GatewayStatus] = {}
        self.containers: dict[str, dict[str, ContainerInfo]] = {}
        self._roster = Roster(session, on_change=lambda: events.publish(FactsChanged("robot")))
        self.robots: dict[str, RobotInfo] = self._roster.robots
        self.lose = self._roster.lose
        self.clock_s: dict[str, float] = {}
        """Gateway -> by how much its clock is ahead of this machine's, seconds, as its last status says it."""
        self._session = session
        self._rpc = rpc
        self._membership = membership
        self._events = events
        self._gateway = gateway
        self._closers: list[Closer] = []
        self._heard: dict[str, int] = {}
        self._as_of: dict[str, float] = {}
        """Gateway -> when, on this clock, its status was so; what is known of its containers held then."""
        self._container_as_of: dict[tuple[str, str], float] = {}
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._missing: set[str] = set()
        """Members whose facts are not known and will be asked for."""
        self._catching_up: asyncio.Task[None] | None = None
        self._asked_by: dict[str, dict[str, float]] = {}
        """What those gateways that decide anything say is asked for."""
        self._doubted: dict[str, float] = {}
        self._speaker: Speaker | None = None
        self.namesakes: Namesakes | None = None
        """Others that go by this gateway's id."""
        self.versions: Versions | None = None
        """Others that this gateway does not work beside."""
        if gateway is not None:
            self.versions = Versions(session, own=lambda: self.gateways.get(gateway))
            self.namesakes = Namesakes(session, gateway, own=lambda: self.gateways.get(gateway))
            rpc.register(keyspace.FACTS, self._on_facts)
            self._speaker = Speaker(
                session, gateway, least_s=config.coalesce_ms / 1e3, most_s=config.coalesce_most_ms / 1e3,
                listeners=lambda: len(membership.members) - 1, elsewhere=self._asked_elsewhere,
            )  # fmt: skip
        events.subscribe(Stage.FACTS, self._on_event)

    def start(self) -> None:
        """Begin to listen."""
        session = self._session
        self._roster.start()
        self._closers = [
            session.subscribe_typed(keyspace.STATUS, self._on_status),
            session.subscribe_typed(keyspace.CONTAINER, self._on_container),
        ]

    @property
    def lost_ns(self) -> Mapping[str, int]:
        """When each robot that is offline was lost, Unix nanoseconds by this machine's clock."""
        return self._roster.lost_ns

    def doubtful(self, robot: str) -> bool:
        """Whether more than one may carry out what this robot is ordered."""
        return self._roster.doubtful(robot)

    # --- our own facts ----------------------------------------------------------------------------------------

    def publish_status(self, status: GatewayStatus) -> None:
        """Tell the fleet about this gateway, as soon and as often as its news is worth it."""
        self.gateways[status.id] = status
        self._as_of[status.id] = time.monotonic() - status.age_ms / 1e3
        if self._speaker is not None:
            self._speaker.status(status)
        self._events.publish(FactsChanged("gateway"))

    def publish_containers(self, containers: tuple[ContainerInfo, ...]) -> None:
        """Tell the fleet which containers this gateway holds: all of them; those left out are gone."""
        if self._gateway is not None:
            self.containers[self._gateway] = {each.id: each for each in containers}
        if self._speaker is not None:
            self._speaker.containers(containers)
        self._events.publish(FactsChanged("container"))

    def asked(self, image: str, *, here: bool = True) -> None:
        """Note a decision that rests on containers of an image; `here`: made on this gateway, not for another."""
        if self._speaker is not None:
            self._speaker.asked(image, here=here)

    def _asked_elsewhere(self, image: str) -> float:
        """Decisions a second that other gateways say rest on containers of an image; of any for the empty name."""
        asked = self._asked_by.values()
        return sum(sum(each.values()) if not image else each.get(image, 0.0) for each in asked)

    async def _on_facts(self, asked: FactsAsk) -> Facts:
        gateway = self._gateway or ""
        own = self.gateways.get(gateway)
        others, more = self._page(asked.after) if asked.all else ((), False)
        return Facts(
            gateway=gateway,
            status=self._speaker.now(own) if own is not None and self._speaker is not None else own,
            containers=tuple(self.containers.get(gateway, {}).values()),
            robots=() if asked.after else tuple(self.robots.values()),
            others=others,
            more=more,
        )

    def _page(self, after: str) -> tuple[tuple[Known, ...], bool]:
        """What is known of others from an id on, as much as goes into an answer."""
        page: list[Known] = []
        size = 0
        for name in sorted(each for each in self.gateways if each > after and each != self._gateway):
            known = Known(
                gateway=name, status=self.gateways[name], containers=tuple(self.containers.get(name, {}).values()),
                age_ms=min(2**31, round(self.age_s(name) * 1e3)),
            )  # fmt: skip
            size += len(encode(known))
            if page and size > _PAGE_BYTES:
                return tuple(page), True
            page.append(known)
        return tuple(page), False

    # --- how old facts are --------------------------------------------------------------------------------------

    def age_s(self, gateway: str, container: str = "") -> float:
        """How old what is known of a gateway, or of one of its containers, is at least; endless when nothing is."""
        if gateway == self._gateway:
            return 0.0
        as_of = self._as_of.get(gateway, -math.inf)
        if container:
            status = self.gateways.get(gateway)
            as_of -= status.untold_ms / 1e3 if status is not None else 0.0
            as_of = max(as_of, self._container_as_of.get((gateway, container), -math.inf))
        return time.monotonic() - as_of

    def stale_s(self, gateway: str) -> float:
        """For how long a gateway has been silent beyond what it promised; 0: what is known of it counts in full."""
        status = self.gateways.get(gateway)
        if gateway == self._gateway or status is None:
            return 0.0
        promised_s = status.again_ms / 1e3 if status.again_ms else STATUS_S
        return max(0.0, self.age_s(gateway) - LATE * promised_s)

    def keeps_promise(self, gateway: str) -> bool:
        """Whether a gateway has said when it will speak again, and is not late."""
        status = self.gateways.get(gateway)
        return status is not None and status.again_ms > 0 and self.stale_s(gateway) == 0

    def doubt(self, gateway: str) -> None:
        """Ask a gateway whose facts are stale for them, unless that was done a moment ago; returns at once."""
        now = time.monotonic()
        if gateway in self._asking or now - self._doubted.get(gateway, -math.inf) < _DOUBT_S:
            return
        self._doubted[gateway] = now
        if self._is_member(gateway):
            self._ask(gateway)

    # --- others' facts ----------------------------------------------------------------------------------------

    async def wait_for_facts(self) -> None:
        """Wait until every member that is known has told its facts, or could not within a few seconds."""
        while self._catching_up is not None or self._asking:
            tasks = [*self._asking.values(), *([self._catching_up] if self._catching_up is not None else [])]
            await asyncio.wait(tasks)

    def _on_status(self, key: str, status: GatewayStatus | None) -> None:
        (gateway,) = keyspace.STATUS.names(key)
        if gateway == self._gateway and status is not None and self.namesakes is not None:
            self.namesakes.heard(status)
        if gateway == self._gateway or status is None or not self._is_member(gateway):
            return
        if status.id != gateway:
            self._session.refuse("misplaced gw/*/status", key=key, says=status.id)
            return
        self._count(gateway)
        if status.at_ns:
            self.clock_s[gateway] = (status.at_ns - time.time_ns()) / 1e9
        self._learn_status(gateway, status, age_s=status.age_ms / 1e3)

    def _learn_status(self, gateway: str, status: GatewayStatus, *, age_s: float) -> None:
        if self.versions is not None and gateway != self._gateway:
            self.versions.heard(status)
        self.gateways[gateway] = status
        if status.asked:
            self._asked_by[gateway] = status.asked
        else:
            self._asked_by.pop(gateway, None)
        # A speaker's clock may be off, and it may lie: no fact is from the future.
        self._as_of[gateway] = time.monotonic() - max(0.0, age_s)
        if status.containers <= len(self.containers.get(gateway, ())):
            self._missing.discard(gateway)  # otherwise it has put some of its containers before we listened
        self._events.publish(FactsChanged("gateway"))

    def _on_container(self, key: str, info: ContainerInfo | None) -> None:
        gateway, container = keyspace.CONTAINER.names(key)
        if gateway == self._gateway or not self._is_member(gateway):
            return
        held = self.containers.setdefault(gateway, {})
        if info is None or info.state is ContainerState.DEAD:
            held.pop(container, None)
            self._container_as_of.pop((gateway, container), None)
        elif info.id != container or info.gateway != gateway:
            self._session.refuse("misplaced gw/*/pool/*", key=key, says=f"{info.gateway}/{info.id}")
            return
        elif len(held) >= MOST_CONTAINERS and container not in held:
            self._session.refuse("too many gw/*/pool/*", key=key)
            return
        else:
            held[container] = info
            self._container_as_of[gateway, container] = time.monotonic()
        self._count(gateway)
        self._events.publish(FactsChanged("container"))

    def _is_member(self, gateway: str) -> bool:
        """Facts of those whose token is not seen are left: they are asked for when it comes."""
        return gateway in self._membership.members

    def _count(self, gateway: str) -> None:
        self._heard[gateway] = self._heard.get(gateway, 0) + 1

    def _on_event(self, event: FleetEvent) -> None:
        match event:
            case Joined(gateway) | Relinked(gateway):
                self._on_joined(gateway)
            case Lost(gateway):
                self._forget(gateway)
            case _:
                pass

    def _on_joined(self, gateway: str) -> None:
        """A member has come: what it put before we listened must be asked for, of it or of one that has heard it."""
        if gateway == self._gateway:
            return
        if len(self._membership.members) <= FEW_MEMBERS:
            # One that has only just come has better to do, and tells its own facts besides.
            self._ask(gateway, after_s=0.0 if self._gateway is None else random.uniform(*_SOON_S))  # noqa: S311
            return
        self._missing.add(gateway)
        if self._catching_up is None:
            self._catching_up = asyncio.create_task(self._catch_up(), name="facts of the fleet")
            self._catching_up.add_done_callback(self._caught_up)

    def _caught_up(self, _: asyncio.Task[None]) -> None:
        self._catching_up = None

    async def _catch_up(self) -> None:
        """Learn the facts of those that are missing: from one member for all, then from each that it did not know."""
        await asyncio.sleep(_GATHER_S)
        members = self._membership.members
        if len(self._missing) > max(FEW_MEMBERS, len(members) // 2):
            await self._ask_for_all()
        while self._missing:
            # One that has just come tells its facts by itself; so does each to all, whom all would ask at once.
            await asyncio.sleep(random.uniform(_SPEAK_S, _SPEAK_S + len(members) / 100))  # noqa: S311 - spreads load
            for gateway in list(self._missing)[:_ASKED_AT_ONCE]:
                self._missing.discard(gateway)
                if self._is_member(gateway):
                    self._ask(gateway)
            if self._asking:
                await asyncio.wait(self._asking.values())

    async def _ask_for_all(self) -> None:
        others = sorted(self._membership.members - {self._gateway})
        for neighbour in random.sample(others, min(_FACTS_TRIES, len(others))):
            after = ""
            try:
                while True:
                    ask = FactsAsk(all=True, after=after)
                    facts = await self._rpc.call(neighbour, keyspace.FACTS, ask, timeout_s=_FACTS_S)
                    self._roster.take(facts.robots)
                    if not after and self._is_member(neighbour):
                        self._take(neighbour, facts)
                    self._take_others(facts.others)
                    if not facts.more or not facts.others or facts.others[-1].gateway <= after:
                        return
                    after = facts.others[-1].gateway
            except SwiftbotError as error:
                log.info("the facts of all could not be had", member=neighbour, reason=str(error))

    def _take_others(self, others: Iterable[Known]) -> None:
        for known in others:
            gateway, status = known.gateway, known.status
            if gateway == self._gateway or status is None or status.id != gateway or not self._is_member(gateway):
                continue
            if known.age_ms / 1e3 >= self.age_s(gateway):
                continue  # what was heard directly is newer
            self._take_containers(gateway, known.containers)
            self._learn_status(gateway, status, age_s=known.age_ms / 1e3)
            self._missing.discard(gateway)

    def _ask(self, gateway: str, *, after_s: float = 0.0) -> None:
        task = asyncio.create_task(self._ask_facts(gateway, after_s), name=f"facts of {gateway}")
        self._asking[gateway] = task
        task.add_done_callback(lambda done: self._asked(gateway, done))

    def _asked(self, gateway: str, done: asyncio.Task[None]) -> None:
        if self._asking.get(gateway) is done:
            del self._asking[gateway]

    async def _ask_facts(self, gateway: str, after_s: float) -> None:
        await asyncio.sleep(after_s)
        for attempt in range(_FACTS_TRIES):
            heard = self._heard.get(gateway, 0)
            try:
                facts = await self._rpc.call(gateway, keyspace.FACTS, FactsAsk(), timeout_s=_FACTS_S)
            except SwiftbotError as error:
                log.info("facts could not be had", member=gateway, reason=str(error))
                await asyncio.sleep(0.1)
                continue
            if not self._is_member(gateway):
                return
            self._roster.take(facts.robots)
            # What was put while the answer was on its way is newer than the answer: ask again.
            if self._heard.get(gateway, 0) == heard or attempt == _FACTS_TRIES - 1:
                self._take(gateway, facts)
                return

    def _take(self, gateway: str, facts: Facts) -> None:
        self._take_containers(gateway, facts.containers)
        if facts.status is not None and facts.status.id == gateway:
            # All that it holds was in the answer, told before or not.
            status = replace(facts.status, untold_ms=0)
            self._learn_status(gateway, status, age_s=status.age_ms / 1e3)
        self._missing.discard(gateway)

    def _take_containers(self, gateway: str, containers: tuple[ContainerInfo, ...]) -> None:
        self._drop_ages(gateway)
        self.containers[gateway] = {
            each.id: each
            for each in containers[:MOST_CONTAINERS]
            if each.gateway == gateway and each.state is not ContainerState.DEAD
        }
        self._events.publish(FactsChanged("container"))

    def _drop_ages(self, gateway: str) -> None:
        for container in self.containers.get(gateway, {}):
            self._container_as_of.pop((gateway, container), None)

    def _forget(self, gateway: str) -> None:
        """A gateway is lost: what it said goes with it, what it said of itself no longer holds."""
        if task := self._asking.pop(gateway, None):
            task.cancel()
        self._drop_ages(gateway)
        self._missing.discard(gateway)
        for noted in (self._heard, self._as_of, self._doubted, self._asked_by, self.clock_s):
            noted.pop(gateway, None)
        if self.gateways.pop(gateway, None) is not None:
            self._events.publish(FactsChanged("gateway"))
        if self.containers.pop(gateway, None) is not None:
            self._events.publish(FactsChanged("container"))

    async def close(self) -> None:
        """Publish what waits, listen no more."""
        if self._speaker is not None:
            self._speaker.close()
        for closer in self._closers:
            closer.close()
        await self._roster.close()
        if self.namesakes is not None:
            await self.namesakes.close()
        tasks = [each for each in (self._catching_up, *self._asking.values()) if each is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
