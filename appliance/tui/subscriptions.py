"""The terminal UI's line to the fleet: puts what is heard into the store, carries orders, reconnects when it breaks.

`Hearing` is the same for a live fleet and for a recorded one: a live view lets the plane decode, and count what is
malformed (`events`); a recorded log comes as keys and bytes (`hear`). `FleetView` is the live one. It knows nothing of
Textual and never raises for the network's sake while it listens: `store.connection` says what is wrong, since when, and
what to do. Its `orders` raises `SwiftbotError`.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, MutableMapping
from typing import Any, NoReturn, Protocol

import msgspec
import structlog
from msgspec import Struct, structs

from appliance.client import Endpoint, FleetClient
from appliance.connection import operator_name
from appliance.errors import SwiftbotError, UnreachableError
from appliance.model import (
    Act,
    ContainerInfo,
    ContainerState,
    Enquiry,
    GatewayStatus,
    Lifted,
    LogLine,
    Notice,
    RobotInfo,
    RunEvent,
    SoftStop,
    TaskRecord,
    keyspace,
)
from appliance.model.alerts import Alert
from appliance.model.closures import Closure
from appliance.model.keys import Keys, Topic
from appliance.model.learning import ClientStatus, RoundRecord, RunRecord
from appliance.model.plane_api import MemberAsk
from appliance.model.recorder_api import RecorderStatus
from appliance.model.roles import Role
from appliance.plane.client import PlaneClient
from appliance.plane.events import FactsChanged, FleetEvent, Stage
from appliance.plane.session import Closer
from appliance.plane.settings import PlaneConfig
from appliance.tui.settings import TuiConfig
from appliance.tui.store import RUNS, Connection, Gateway, Store

Take = Callable[[str, Any], None]


class Door(Struct, frozen=True):
    """A topic, and who takes what is put there (None: deleted)."""

    topic: Topic[Any]
    take: Take


class Hearing:
    """Puts what is heard into a store.

    Args:
        store: where it is kept.
        fleet: whose keys they are.
    """

    def __init__(self, store: Store, fleet: str) -> None:
        self.refused: dict[str, int] = {}
        """Messages that could not be decoded, by kind."""
        self._store = store
        self._root = f"{Keys(fleet).root}/"
        self.events: tuple[Door, ...] = (
            Door(keyspace.TASK_UPDATE, self._task),
            Door(keyspace.RUN_EVENT, self._run),
            Door(keyspace.NOTICE, self._notice),
            Door(keyspace.LOG, self._log),
            Door(keyspace.RECORDER_STATUS, self._recorder),
            Door(keyspace.ACT, self._act),
            Door(keyspace.ENQUIRY, self._enquiry),
            Door(keyspace.STOP, self._stop),
            Door(keyspace.LIFTED, self._lift),
            Door(keyspace.ALERT, self._alert),
            Door(keyspace.CLOSURE, self._closure),
            Door(keyspace.LEARN_RUN, self._learn_run),
            Door(keyspace.LEARN_ROUND, self._round),
            Door(keyspace.LEARN_CLIENT, self._client),
        )
        """Keys whose latest value is kept here only."""
        self.facts: tuple[Door, ...] = (
            Door(keyspace.STATUS, self._status),
            Door(keyspace.CONTAINER, self._container),
            Door(keyspace.ROBOT, self._robot),
        )
        """What a live view takes from the plane's registry instead, which knows of membership too."""
        self._doors = {
            door.topic: (door.take, msgspec.json.Decoder(door.topic.payload)) for door in (*self.events, *self.facts)
        }

    def hear(self, key: str, payload: bytes, at_ns: int, *, deleted: bool = False) -> bool:
        """Take one message; whether it was for the store. What cannot be decoded is counted in `refused`.

        Args:
            key: where it was put.
            payload: what was put.
            at_ns: when, Unix nanoseconds.
            deleted: whether the key was deleted instead.
        """
        topic = keyspace.topic_of(key)
        if topic is None or not key.startswith(self._root) or (found := self._doors.get(topic)) is None:
            return False
        take, decoder = found
        self._at_ns = at_ns
        if deleted:
            take(key, None)
            return True
        try:
            value = decoder.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            name = topic.payload.__name__
            self.refused[name] = self.refused.get(name, 0) + 1
            return False
        take(key, value)
        return True

    _at_ns = 0

    def _task(self, key: str, record: TaskRecord | None) -> None:
        if record is None:
            self._store.forget_task(*keyspace.TASK_UPDATE.names(key))
        else:
            self._store.take_task(record)

    def _run(self, _key: str, event: RunEvent | None) -> None:
        if event is not None:
            self._store.take_run(event, event.at_ns or self._at_ns or time.time_ns())

    def _notice(self, _key: str, notice: Notice | None) -> None:
        if notice is not None:
            self._store.take_notice(notice)

    def _log(self, key: str, line: LogLine | None) -> None:
        if line is not None:
            # Whose log it is the key says; a line's own source may be another gateway that it is about, or nobody.
            self._store.take_log(structs.replace(line, source=keyspace.LOG.names(key)[0]))

    def _act(self, _key: str, act: Act | None) -> None:
        if act is not None:
            self._store.take_act(act)

    def _stop(self, _key: str, stop: SoftStop | None) -> None:
        if stop is not None:
            self._store.take_stops((stop,))

    def _lift(self, _key: str, lifted: Lifted | None) -> None:
        if lifted is not None:
            self._store.take_stops((), (lifted,))

    def _alert(self, _key: str, alert: Alert | None) -> None:
        if alert is not None:
            self._store.take_alert(alert)

    def _closure(self, _key: str, closure: Closure | None) -> None:
        if closure is not None:
            self._store.take_closure(closure)

    def _learn_run(self, _key: str, run: RunRecord | None) -> None:
        if run is not None:
            self._store.take_learn_run(run)

    def _round(self, _key: str, record: RoundRecord | None) -> None:
        if record is not None:
            self._store.take_round(record)

    def _client(self, _key: str, status: ClientStatus | None) -> None:
        if status is not None:
            self._store.take_client(status)

    def _enquiry(self, key: str, enquiry: Enquiry | None) -> None:
        if enquiry is None:
            self._store.enquiries.drop(*keyspace.ENQUIRY.names(key))
        else:
            self._store.enquiries.put(enquiry.id, enquiry)

    def _recorder(self, _key: str, status: RecorderStatus | None) -> None:
        if status is not None:
            self._store.take_recorder(status, time.monotonic())

    def _status(self, key: str, status: GatewayStatus | None) -> None:
        (name,) = keyspace.STATUS.names(key)
        if status is None:
            self._store.gateways.drop(name)
            return
        known = self._store.gateways.get(name)
        fresh = Gateway(status=status) if known is None else structs.replace(known, status=status, lost_ns=0)
        self._store.gateways.put(name, fresh)

    def _container(self, key: str, info: ContainerInfo | None) -> None:
        name = "/".join(keyspace.CONTAINER.names(key))
        if info is None or info.state is ContainerState.DEAD:
            self._store.containers.drop(name)
        else:
            self._store.containers.put(name, info)

    def _robot(self, key: str, info: RobotInfo | None) -> None:
        (name,) = keyspace.ROBOT.names(key)
        if info is None:
            self._store.robots.drop(name)
        else:
            self._store.robots.put(name, info)


log = structlog.get_logger(__name__)

_WATCH_S = 0.5
_PING_TIMEOUT_S = 1.0
MOST_ASKED_RUNS = 8
"""Of those that go on: so many are asked for whole each time."""
_PINGS = 10
"""Gateways whose latency is measured a second at most."""


class View(Protocol):
    """What the screens need: the seam at which tests, and recorded logs, put a fleet of their own."""

    fleet: str
    store: Store
    operator: str
    """Who gives the orders, for the audit."""
    role: Role | None
    """What the operator's certificate allows; None without keys."""
    steerable: bool
    """False where nothing can be ordered, as in a recorded log."""

    @property
    def moment(self) -> str:
        """Where in a recorded log it is, in words; empty for a fleet as it is now."""
        ...

    async def start(self) -> None:
        """Begin to listen, and keep connected; returns at once."""
        ...

    async def close(self) -> None:
        """End listening."""
        ...

    def sync(self) -> None:
        """Bring the store up to date; called before each drawing."""
        ...

    @property
    def orders(self) -> FleetClient:
        """What carries orders; UnreachableError while there is no connection."""
        ...


class FleetView:
    """A live view of a fleet over Zenoh.

    Args:
        plane_config: How to reach it.
        fleet: Its name.
        config: Bounds and times.
    """

    steerable = True
    moment = ""

    def __init__(self, plane_config: PlaneConfig, fleet: str, config: TuiConfig | None = None) -> None:
        self.fleet = fleet
        self.config = config or TuiConfig()
        self.operator = operator_name()
        self.role: Role | None = None
        self.store = Store(tasks=self.config.tasks, entries=self.config.entries)
        self._hearing = Hearing(self.store, fleet)
        self._plane_config = plane_config
        self._client: FleetClient | None = None
        self._keeper: asyncio.Task[None] | None = None
        self._closers: list[Closer] = []
        self._dirty: set[str] = set()

    async def start(self) -> None:
        """Begin to listen, and keep connected."""
        self._keeper = asyncio.create_task(self._keep(), name="fleet view")

    async def close(self) -> None:
        """End listening and close the session."""
        if self._keeper is not None:
            self._keeper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._keeper
            self._keeper = None

    @property
    def orders(self) -> FleetClient:
        """What carries orders; UnreachableError while there is no connection."""
        if self._client is None:
            connection = self.store.connection
            raise UnreachableError(
                f"not connected: {connection.problem}", remedy=connection.remedy or "wait, then try again"
            )
        return self._client

    def sync(self) -> None:
        """Take from the registry what has changed there."""
        if self._client is None or not self._dirty:
            return
        registry, dirty = self._client.plane.registry, self._dirty
        self._dirty = set()
        if "gateway" in dirty:
            self.store.take_gateways(registry.gateways, time.time_ns())
        if "container" in dirty:
            self.store.take_containers(registry.containers)
        if "robot" in dirty:
            self.store.take_robots(registry.robots)

    def take_own_log(self, logger: Any, method: str, event: MutableMapping[str, Any]) -> NoReturn:
        """Take a log line of this process (a structlog processor)."""
        take_own_log(self.store, logger, method, event)

    # --- keeping connected -------------------------------------------------------------------------------

    async def _keep(self) -> None:
        while True:
            try:
                await self._keep_once()
            except SwiftbotError as error:
                self.store.tell(Connection(problem=error.message, remedy=error.remedy or self._remedy()))
            except Exception as error:  # supervision boundary: the view must say that it no longer hears anything
                log.exception("the view of the fleet failed")
                self.store.tell(Connection(problem=f"internal error: {error!r}", remedy="trying again; see the log"))
            await asyncio.sleep(self.config.reconnect_s)

    async def _keep_once(self) -> None:
        """One connection from its opening to its end."""
        endpoint = Endpoint(fleet=self.fleet, connect=self._plane_config.connect, keys=self._plane_config.keys)
        client = FleetClient(endpoint, operator=self.operator, plane=self._plane_config)
        await client.open()
        try:
            self._listen(client.plane)
            self._client = client
            self.role = client.role
            self._dirty |= {"gateway", "container", "robot"}
            pinging = asyncio.create_task(self._keep_pinging(client.plane), name="latencies")
            try:
                await self._watch(client.plane)
            finally:
                pinging.cancel()
        finally:
            self._client = None
            self.store.take_gateways({}, time.time_ns())
            await client.close()

    def _listen(self, plane: PlaneClient) -> None:
        # They end with the session; kept because a subscription may end with its handle.
        self._closers = [plane.session.subscribe_typed(door.topic, door.take) for door in self._hearing.events]
        plane.events.subscribe(Stage.WATCHERS, self._on_event)

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, FactsChanged):
            self._dirty.add(event.kind)

    async def _watch(self, plane: PlaneClient) -> None:
        """Watch over one connection; returns when it must be opened again."""
        silent_since = time.monotonic()
        asked_at = float("-inf")
        members: frozenset[str] = frozenset()
        while True:
            now = time.monotonic()
            self.store.listen_for_silence(now)
            if plane.members() != members:
                # Gateways came or went, perhaps the one that this connection hung on: pushes may have been missed.
                members = plane.members()
                asked_at = float("-inf")
                self._take_arcs(plane)
            elif any(each.arc is None and not each.lost_ns for each in self.store.gateways.values()):
                # A gateway that has come back: its token was seen before its account of itself.
                self._take_arcs(plane)
            if members:
                silent_since = now
                self.store.tell(Connection(connected=True))
                if now - asked_at >= self.config.resync_s:
                    asked_at = now
                    await self._resync()
            else:
                where = ", ".join(self._plane_config.connect) or "this network"
                problem = f"no gateway of fleet {self.fleet} at {where}"
                self.store.tell(Connection(problem=problem, remedy=self._remedy()))
                if now - silent_since >= self.config.silence_s:
                    return
            await asyncio.sleep(_WATCH_S)

    async def _resync(self) -> None:
        try:
            answer = await self.orders.tasks(min(100, self.config.tasks))
        except SwiftbotError as error:
            # The pushes still come; the next round asks again, of another gateway if this one is gone.
            self._say(f"task list: {error}")
            return
        self.store.take_tasks(answer.tasks)
        await self._ask_standing()
        try:
            await self._ask_runs()
        except SwiftbotError as error:
            self._say(f"runs of federated learning: {error}")
        if answer.unreachable:
            self._say(f"task list is without {', '.join(answer.unreachable)}: no answer")

    async def _ask_standing(self) -> None:
        """Ask for soft stops, alerts, what is out of use, and questions: one that is not answered hides no other."""
        for ask in (self._ask_stops, self._ask_alerts, self._ask_questions, self._ask_closures):
            try:
                await ask()
            except SwiftbotError as error:
                self._say(f"what waits for operators: {error}")

    async def _ask_stops(self) -> None:
        standing = await self.orders.standing()
        self.store.take_stops(standing.stops, standing.lifted)

    async def _ask_alerts(self) -> None:
        known = tuple(self.store.alerts)
        answer = await self.orders.alerts()
        # Of gateways that did not answer nothing is known to be over.
        self.store.take_alerts(answer.alerts, known=() if answer.unreachable else known)

    async def _ask_closures(self) -> None:
        known = tuple(self.store.closures)
        found = await self.orders.closures()
        self.store.take_closures((*found.closures, *found.rules), known=known)

    async def _ask_runs(self) -> None:
        """Ask for the runs of federated learning, and for what the clients of those that go on are at."""
        known = tuple(self.store.runs)
        runs, failed = await self.orders.learn_runs()
        for name in known:
            if not failed and name not in {run.id for run in runs}:
                self.store.forget_learn_run(name)
        for run in runs[:RUNS]:
            self.store.take_learn_run(run)
        for run in [run for run in runs if not run.state.final][:MOST_ASKED_RUNS]:
            self.store.take_shown(await self.orders.learn_show(run.id))

    async def _ask_questions(self) -> None:
        """Others were answered or closed unheard."""
        answer = await self.orders.enquiries()
        waiting = {each.id for each in answer.enquiries}
        for name in [name for name, each in self.store.enquiries.items() if each.open and name not in waiting]:
            self.store.enquiries.drop(name)
        for each in answer.enquiries:
            self.store.enquiries.put(each.id, each)

    def _say(self, text: str) -> None:
        self.store.add(time.time_ns(), kind="log", level="warning", source="tui", text=text)

    def note(self, record: TaskRecord) -> None:
        """Take a record that an order was answered with, which is heard a moment later anyway."""
        self.store.take_task(record)

    def _remedy(self) -> str:
        return "start one with `swiftbot gateway`, or name its endpoint with --connect; reconnecting automatically"

    # --- what is measured from here ------------------------------------------------------------------------

    def _take_arcs(self, plane: PlaneClient) -> None:
        self.sync()
        for name, share in plane.ring.shares().items():
            self.store.measured(name, arc=share)

    async def _keep_pinging(self, plane: PlaneClient) -> None:
        """Measure how long a question to each gateway takes, one after the other."""
        while True:
            for name in sorted(plane.members()):
                began = time.monotonic()
                with contextlib.suppress(SwiftbotError):
                    await plane.rpc.call(name, keyspace.MEMBER, MemberAsk(gateway=name), timeout_s=_PING_TIMEOUT_S)
                    self.store.measured(name, latency_ms=1e3 * (time.monotonic() - began))
                await asyncio.sleep(1 / _PINGS)
            await asyncio.sleep(self.config.ping_s)


def take_own_log(store: Store, _logger: Any, method: str, event: MutableMapping[str, Any]) -> NoReturn:
    """Take a log line of this process (a structlog processor): the terminal belongs to the screen."""
    fields = " ".join(f"{key}={value}" for key, value in event.items() if key not in ("event", "level"))
    store.add(time.time_ns(), kind="log", level=method, source="tui", text=f"{event.get('event', '')} {fields}")
    raise structlog.DropEvent
