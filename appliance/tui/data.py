"""The terminal UI's line to the fleet: hears what is put, asks the gateways, connects again when it breaks.

It knows nothing of Textual. It never raises for the network's sake while it listens: `snapshot().connection` says
what is wrong and what to do. Questions (`plan`, `submit`, `cancel`) raise `SwiftbotError`.
"""

import asyncio
import contextlib
import time
from collections.abc import MutableMapping
from typing import Any, NoReturn, Protocol, TypeVar

import structlog
from msgspec import Struct

from appliance.errors import SwiftbotError, UnreachableError
from appliance.model import LogLine, Notice, Plan, RunEvent, TaskRecord, TaskRequest
from appliance.plane.node import PlaneClient
from appliance.plane.session import Closer
from appliance.plane.settings import PlaneConfig
from appliance.record.facts import RecorderStatus
from appliance.tasks.api import PlanAnswer, PlanAsk, TaskAsk, TaskList, TasksAsk
from appliance.tui.board import SILENT, Board, Connection, Snapshot
from appliance.tui.settings import TuiConfig

log = structlog.get_logger(__name__)

R = TypeVar("R", bound=Struct)
_WATCH_S = 0.5


class View(Protocol):
    """What the screens need: the seam at which tests put a fleet of their own."""

    fleet: str

    async def start(self) -> None:
        """Begin to listen, and keep connected; returns at once."""
        ...

    async def close(self) -> None:
        """End listening."""
        ...

    @property
    def revision(self) -> int:
        """Rises when `snapshot` would show something new."""
        ...

    def snapshot(self) -> Snapshot:
        """Return the fleet as it is known just now."""
        ...

    async def plan(self, instruction: str) -> PlanAnswer:
        """Ask for a plan; nothing is run."""
        ...

    async def submit(self, instruction: str, *, plan: Plan, task_id: str) -> TaskRecord:
        """Submit that plan; the same `task_id` again is the same task."""
        ...

    async def cancel(self, task_id: str) -> TaskRecord:
        """Ask for a task to stop."""
        ...


class FleetView:
    """A live view of a fleet over Zenoh.

    Args:
        plane_config: How to reach it.
        fleet: Its name.
        config: Bounds and times.
    """

    def __init__(self, plane_config: PlaneConfig, fleet: str, config: TuiConfig | None = None) -> None:
        self.fleet = fleet
        self.config = config or TuiConfig()
        self.board = Board(tasks=self.config.tasks, entries=self.config.entries)
        self._plane_config = plane_config
        self._client: PlaneClient | None = None
        self._connection = Connection(problem="connecting", remedy="one moment")
        self._keeper: asyncio.Task[None] | None = None
        self._closers: list[Closer] = []
        self._changes = 0

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
    def revision(self) -> int:
        """Rises with every change."""
        return self.board.revision + self._changes

    def snapshot(self) -> Snapshot:
        """Return the fleet as it is known just now."""
        client = self._client
        if client is None:
            return Snapshot(
                fleet=self.fleet, connection=self._connection, tasks=self.board.tasks, entries=self.board.entries
            )
        registry = client.registry
        return Snapshot(
            fleet=self.fleet,
            connection=self._connection,
            gateways=tuple(registry.gateways[name] for name in sorted(registry.gateways)),
            containers=tuple(held[name] for _, held in sorted(registry.containers.items()) for name in sorted(held)),
            robots=tuple(registry.robots[name] for name in sorted(registry.robots)),
            tasks=self.board.tasks,
            entries=self.board.entries,
            recorders=self.board.recorders(time.monotonic()),
        )

    async def plan(self, instruction: str) -> PlanAnswer:
        """Ask any gateway for a plan."""
        return await self._ask("plan", PlanAsk(instruction=instruction), PlanAnswer, self.config.plan_timeout_s)

    async def submit(self, instruction: str, *, plan: Plan, task_id: str) -> TaskRecord:
        """Submit that plan; durable when this returns."""
        request = TaskRequest(instruction=instruction, id=task_id, submitter="tui", plan=plan)
        record = await self._ask("submit", request, TaskRecord, self.config.call_timeout_s)
        self.board.take_task(record)
        return record

    async def cancel(self, task_id: str) -> TaskRecord:
        """Ask for a task to stop."""
        record = await self._ask("cancel", TaskAsk(id=task_id), TaskRecord, self.config.call_timeout_s)
        self.board.take_task(record)
        return record

    async def _ask(self, verb: str, request: Struct, reply: type[R], timeout_s: float) -> R:
        client = self._client
        if client is None:
            raise UnreachableError(
                f"not connected: {self._connection.problem}", remedy=self._connection.remedy or "wait, then try again"
            )
        gateway = await client.any_gateway()
        return await client.rpc.call(gateway, verb, request, reply, timeout_s=timeout_s)

    def take_own_log(self, _logger: Any, method: str, event: MutableMapping[str, Any]) -> NoReturn:
        """Take a log line of this process (a structlog processor): the terminal belongs to the screen."""
        fields = " ".join(f"{key}={value}" for key, value in event.items() if key not in ("event", "level"))
        text = f"{event.get('event', '')} {fields}"
        self.board.add(time.time_ns(), kind="log", level=method, source="tui", text=text)
        raise structlog.DropEvent

    # --- keeping connected -------------------------------------------------------------------------------

    async def _keep(self) -> None:
        while True:
            try:
                await self._keep_once()
            except SwiftbotError as error:
                self._tell(Connection(problem=error.message, remedy=error.remedy or self._remedy()))
            except Exception as error:  # supervision boundary: the view must say that it no longer hears anything
                log.exception("the view of the fleet failed")
                self._tell(Connection(problem=f"internal error: {error!r}", remedy="trying again; see the log screen"))
            await asyncio.sleep(self.config.reconnect_s)

    async def _keep_once(self) -> None:
        """One connection from its opening to its end."""
        client = await PlaneClient.open(self._plane_config, fleet=self.fleet)
        try:
            self._listen(client)
            self._client = client
            await self._watch(client)
        finally:
            self._client = None
            await client.close()

    def _listen(self, client: PlaneClient) -> None:
        keys, session = client.keys, client.session
        self._closers = [  # they end with the session; kept because a token or subscription may end with its handle
            session.subscribe_typed(keys.task(), TaskRecord, self._on_task),
            session.subscribe_typed(keys.run(), RunEvent, self._on_run),
            session.subscribe_typed(keys.notice(), Notice, self._on_notice),
            session.subscribe_typed(keys.log(), LogLine, self._on_log),
            session.subscribe_typed(keys.recorder_status(), RecorderStatus, self._on_recorder),
        ]
        client.registry.on_change.append(self._on_registry)

    async def _watch(self, client: PlaneClient) -> None:
        """Watch over one connection; returns when it is to be made anew."""
        silent_since = time.monotonic()
        asked_at = float("-inf")
        silent: set[str] = set()
        members: frozenset[str] = frozenset()
        while True:
            now = time.monotonic()
            fell_silent = {status.id for status in self.board.recorders(now) if status.state == SILENT}
            if fell_silent != silent:  # nothing was heard, so nothing else would have it drawn
                silent = fell_silent
                self._changes += 1
            if client.members() != members:
                # Gateways came or went, perhaps the one that this connection hung on: pushes may have been missed.
                members = client.members()
                asked_at = float("-inf")
            if members:
                silent_since = now
                self._tell(Connection(connected=True))
                if now - asked_at >= self.config.resync_s:
                    asked_at = now
                    await self._resync()
            else:
                where = ", ".join(self._plane_config.connect) or "this network"
                self._tell(Connection(problem=f"no gateway of fleet {self.fleet} at {where}", remedy=self._remedy()))
                if now - silent_since >= self.config.silence_s:
                    return
            await asyncio.sleep(_WATCH_S)

    async def _resync(self) -> None:
        try:
            ask = TasksAsk(limit=min(100, self.config.tasks))
            answer = await self._ask("tasks", ask, TaskList, self.config.call_timeout_s)
        except SwiftbotError as error:
            # The pushes still come; the next round asks again, of another gateway if this one is gone.
            self.board.add(time.time_ns(), kind="log", level="warning", source="tui", text=f"task list: {error}")
            return
        self.board.take_tasks(answer.tasks)
        if answer.unreachable:
            text = f"task list is without {', '.join(answer.unreachable)}: no answer"
            self.board.add(time.time_ns(), kind="log", level="warning", source="tui", text=text)

    def _tell(self, connection: Connection) -> None:
        if connection != self._connection:
            self._connection = connection
            self._changes += 1

    def _remedy(self) -> str:
        return "start one with `swiftbot up` or name its endpoint with --connect; trying again by itself"

    # --- what is heard -----------------------------------------------------------------------------------

    def _on_task(self, key: str, record: TaskRecord | None) -> None:
        if record is None:
            self.board.forget_task(key.split("/")[-2])
        else:
            self.board.take_task(record)

    def _on_run(self, _key: str, event: RunEvent | None) -> None:
        if event is not None:
            self.board.take_run(event, time.time_ns())

    def _on_notice(self, _key: str, notice: Notice | None) -> None:
        if notice is not None:
            self.board.take_notice(notice)

    def _on_log(self, _key: str, line: LogLine | None) -> None:
        if line is not None:
            self.board.take_log(line)

    def _on_recorder(self, _key: str, status: RecorderStatus | None) -> None:
        if status is not None:
            self.board.take_recorder(status, time.monotonic())

    def _on_registry(self, _what: str) -> None:
        self._changes += 1
