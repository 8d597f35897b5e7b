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
)
from appliance.plane.keys import Keys
from appliance.plane.node import Member, MemberAsk, PlaneClient
from appliance.plane.session import Closer
from appliance.plane.settings import PlaneConfig
from appliance.record.models import RecorderStatus
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Connection, Gateway, Store

Take = Callable[[str, Any], None]


class Door(Struct, frozen=True):
    """Keys of one kind: the expression that matches them, what they carry, and who takes it (None: deleted)."""

    expr: str
    kind: type[Any]
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
        keys = Keys(fleet)
        self.events: tuple[Door, ...] = (
            Door(keys.task(), TaskRecord, self._task),
            Door(keys.run(), RunEvent, self._run),
            Door(keys.notice(), Notice, self._notice),
            Door(keys.log(), LogLine, self._log),
            Door(keys.recorder_status(), RecorderStatus, self._recorder),
            Door(keys.act(), Act, self._act),
            Door(keys.enquiry(), Enquiry, self._enquiry),
            Door(keys.soft_stop(), SoftStop, self._stop),
            Door(keys.lifted(), Lifted, self._lift),
        )
        """What nobody but us keeps the latest of."""
        self.facts: tuple[Door, ...] = (
            Door(keys.status(), GatewayStatus, self._status),
            Door(keys.container(), ContainerInfo, self._container),
            Door(keys.robot(), RobotInfo, self._robot),
        )
        """What a live view takes from the plane's registry instead, which knows of membership too."""
        self._doors = [
            (door.expr.split("/"), door, msgspec.json.Decoder(door.kind)) for door in (*self.events, *self.facts)
        ]

    def hear(self, key: str, payload: bytes, at_ns: int, *, deleted: bool = False) -> bool:
        """Take one message; whether it was for the store. What cannot be decoded is counted in `refused`.

        Args:
            key: where it was put.
            payload: what was put.
            at_ns: when, Unix nanoseconds.
            deleted: whether the key was deleted instead.
        """
        parts = key.split("/")
        for pattern, door, decoder in self._doors:
            if len(pattern) != len(parts) or any(
                each not in ("*", part) for each, part in zip(pattern, parts, strict=True)
            ):
                continue
            self._at_ns = at_ns
            if deleted:
                door.take(key, None)
                return True
            try:
                value = decoder.decode(payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                name = door.kind.__name__
                self.refused[name] = self.refused.get(name, 0) + 1
                return False
            door.take(key, value)
            return True
        return False

    _at_ns = 0

    def _task(self, key: str, record: TaskRecord | None) -> None:
        if record is None:
            self._store.forget_task(key.split("/")[-2])
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
            self._store.take_log(structs.replace(line, source=key.split("/")[-2]))

    def _act(self, _key: str, act: Act | None) -> None:
        if act is not None:
            self._store.take_act(act)

    def _stop(self, _key: str, stop: SoftStop | None) -> None:
        if stop is not None:
            self._store.take_stops((stop,))

    def _lift(self, _key: str, lifted: Lifted | None) -> None:
        if lifted is not None:
            self._store.take_stops((), (lifted,))

    def _enquiry(self, key: str, enquiry: Enquiry | None) -> None:
        if enquiry is None:
            self._store.enquiries.drop(key.rsplit("/", maxsplit=1)[-1])
        else:
            self._store.enquiries.put(enquiry.id, enquiry)

    def _recorder(self, _key: str, status: RecorderStatus | None) -> None:
        if status is not None:
            self._store.take_recorder(status, time.monotonic())

    def _status(self, key: str, status: GatewayStatus | None) -> None:
        name = key.split("/")[-2]
        if status is None:
            self._store.gateways.drop(name)
            return
        known = self._store.gateways.get(name)
        fresh = Gateway(status=status) if known is None else structs.replace(known, status=status, lost_ns=0)
        self._store.gateways.put(name, fresh)

    def _container(self, key: str, info: ContainerInfo | None) -> None:
        name = "/".join(key.split("/")[-3::2])
        if info is None or info.state is ContainerState.DEAD:
            self._store.containers.drop(name)
        else:
            self._store.containers.put(name, info)

    def _robot(self, key: str, info: RobotInfo | None) -> None:
        name = key.split("/")[-2]
        if info is None:
            self._store.robots.drop(name)
        else:
            self._store.robots.put(name, info)


log = structlog.get_logger(__name__)

_WATCH_S = 0.5
_PING_TIMEOUT_S = 1.0
_PINGS = 10
"""Gateways whose latency is measured a second at most."""


class View(Protocol):
    """What the screens need: the seam at which tests, and recorded logs, put a fleet of their own."""

    fleet: str
    store: Store
    operator: str
    """Who gives the orders, for the audit."""
    steerable: bool
    """False where nothing can be ordered, as in a recorded log."""

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

    def __init__(self, plane_config: PlaneConfig, fleet: str, config: TuiConfig | None = None) -> None:
        self.fleet = fleet
        self.config = config or TuiConfig()
        self.operator = operator_name()
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
        endpoint = Endpoint(fleet=self.fleet, connect=self._plane_config.connect)
        client = FleetClient(endpoint, operator=self.operator, plane=self._plane_config)
        await client.open()
        try:
            self._listen(client.plane)
            self._client = client
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
        self._closers = [
            plane.session.subscribe_typed(door.expr, door.kind, door.take) for door in self._hearing.events
        ]
        plane.registry.on_change.append(self._dirty_now)

    def _dirty_now(self, what: str) -> None:
        self._dirty.add(what)

    async def _watch(self, plane: PlaneClient) -> None:
        """Watch over one connection; returns when it is to be made anew."""
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
        if answer.unreachable:
            self._say(f"task list is without {', '.join(answer.unreachable)}: no answer")

    async def _ask_standing(self) -> None:
        """Ask for soft stops, and the questions that wait; others were answered or closed unheard."""
        try:
            answer = await self.orders.enquiries()
            standing = await self.orders.standing()
        except SwiftbotError as error:
            self._say(f"what waits for operators: {error}")
            return
        self.store.take_stops(standing.stops, standing.lifted)
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
        return "start one with `swiftbot gateway`, or name its endpoint with --connect; trying again by itself"

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
                    await plane.rpc.call(name, "member", MemberAsk(gateway=name), Member, timeout_s=_PING_TIMEOUT_S)
                    self.store.measured(name, latency_ms=1e3 * (time.monotonic() - began))
                await asyncio.sleep(1 / _PINGS)
            await asyncio.sleep(self.config.ping_s)


def take_own_log(store: Store, _logger: Any, method: str, event: MutableMapping[str, Any]) -> NoReturn:
    """Take a log line of this process (a structlog processor): the terminal belongs to the screen."""
    fields = " ".join(f"{key}={value}" for key, value in event.items() if key not in ("event", "level"))
    store.add(time.time_ns(), kind="log", level=method, source="tui", text=f"{event.get('event', '')} {fields}")
    raise structlog.DropEvent
