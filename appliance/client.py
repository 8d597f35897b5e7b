"""What a person's command does over Zenoh: one small client for the command line, the demo and the benchmarks.

It sits anywhere on the Zenoh network, asks any gateway, and knows nothing of a gateway's inside.
"""

import asyncio
import contextlib
import time
import uuid
from collections.abc import AsyncGenerator
from types import TracebackType
from typing import Self, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import DeadlineError, NotFoundError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import Notice, RunEvent, TaskRecord, TaskRequest, TaskState
from appliance.plane.node import PlaneClient
from appliance.plane.settings import PlaneConfig
from appliance.pool.api import (
    DecisionList,
    DecisionsAsk,
    EvictAsk,
    Evicted,
    ReleaseAsk,
    Released,
    WarmAsk,
    Warmed,
)
from appliance.pool.transfer.api import Brought, FetchAsk
from appliance.tasks.api import AgreeAsk, PlanAnswer, PlanAsk, TaskAsk, TaskList, TasksAsk, WhyAsk
from appliance.tasks.migration.api import (
    DrainAsk,
    DrainState,
    DrainStateAsk,
    MigrateAsk,
    Migrated,
    MoveAsk,
    MoveCancelled,
)
from appliance.tasks.migration.moving import MOVE_S
from appliance.tasks.watch.lines import Line
from appliance.tasks.watch.stream import Stream
from appliance.tasks.why import TaskWhy

R = TypeVar("R", bound=Struct)

PATIENCE_S = 6.0
"""How long another gateway is looked for when the one that was asked is gone: detection takes a second."""


class Endpoint(Struct, frozen=True, kw_only=True):
    """Where a fleet is: its name, and endpoints of gateways or routers (`tcp/host:port`)."""

    fleet: str
    connect: tuple[str, ...]


def _news(last: TaskRecord, record: TaskRecord) -> bool:
    """Whether a record tells more than the last one shown.

    A coordinator that comes later, be it the same gateway after a restart, goes on from the last *written* record,
    so that its transitions may be numbered lower than what was pushed before. Within one coordinator its own clock
    orders; an end is always news.
    """
    if record.state.final or record.coordinator != last.coordinator:
        return True
    return record.sequence > last.sequence or record.updated_ns > last.updated_ns


class FleetClient:
    """A connection to a fleet; use it as an async context manager."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self._plane: PlaneClient | None = None

    async def open(self) -> Self:
        """Connect, unless that was done; UnreachableError when nothing answers."""
        if self._plane is not None:
            return self
        self._plane = await PlaneClient.open(
            PlaneConfig(mode="client", connect=self.endpoint.connect), fleet=self.endpoint.fleet
        )
        return self

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._plane is not None:
            await self._plane.close()
            self._plane = None

    @property
    def plane(self) -> PlaneClient:
        """The open connection."""
        if self._plane is None:
            raise UnreachableError("the connection to the fleet is not open")
        return self._plane

    async def gateway(self) -> str:
        """Any gateway that is present; UnreachableError when there is none."""
        return await self.plane.any_gateway()

    async def _ask(
        self, verb: str, request: Struct, reply: type[R], *, timeout_s: float = 5.0, patience_s: float = PATIENCE_S
    ) -> R:
        """Ask any gateway, and another one when it is gone or silent: every verb used here may be repeated."""
        give_up = time.monotonic() + patience_s
        silent: set[str] = set()
        while True:
            gateway = await self.plane.any_gateway(avoid=silent)
            try:
                return await self.plane.rpc.call(gateway, verb, request, reply, timeout_s=timeout_s)
            except UnreachableError:
                if time.monotonic() > give_up:
                    raise
                await asyncio.sleep(0.1)
            except DeadlineError:
                # It may be frozen, which is only noticed when its lease ends.
                silent.add(gateway)
                if time.monotonic() > give_up or silent >= self.plane.members():
                    raise

    async def plan(self, instruction: str) -> PlanAnswer:
        """Decompose, run nothing."""
        return await self._ask("plan", PlanAsk(instruction=instruction), PlanAnswer, timeout_s=60.0)

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Hand in a task; durable when this returns. It gets its id here, so that asking twice is one task."""
        if not request.id:
            request = replace(request, id=f"t-{uuid.uuid4().hex[:10]}")
        return await self._ask("submit", request, TaskRecord, timeout_s=6.0, patience_s=15.0)

    async def task(self, task: str) -> TaskRecord:
        """One task's record."""
        return await self._ask("task", TaskAsk(id=task), TaskRecord)

    async def tasks(self, limit: int) -> TaskList:
        """The newest tasks of the fleet."""
        return await self._ask("tasks", TasksAsk(limit=limit), TaskList)

    async def agree(self, task: str, *, agree: bool = True, by: str = "") -> TaskRecord:
        """Say yes or no to the plan that is proposed for a task after a failure."""
        return await self._ask("agree", AgreeAsk(id=task, agree=agree, by=by), TaskRecord)

    async def why(self, task: str, subtask: str = "") -> TaskWhy:
        """Why a task waits, or was served where it was; NotFoundError when there is no such task or subtask."""
        return await self._ask("why", WhyAsk(id=task, subtask=subtask), TaskWhy)

    async def cancel(self, task: str) -> TaskRecord:
        """Stop a task."""
        return await self._ask("cancel", TaskAsk(id=task), TaskRecord)

    # --- moving runs --------------------------------------------------------------------------------------------

    async def migrate(self, ask: MigrateAsk) -> Migrated:
        """Move a subtask's run to another gateway; returns when it has started there.

        Raises:
            NotFoundError, RefusedError: it cannot be moved, with the reason; it goes on where it is.
            CancelledByOperatorError: somebody called it off.
        """
        return await self.plane.rpc.call(await self.gateway(), "migrate", ask, Migrated, timeout_s=MOVE_S)

    async def migrate_cancel(self, task: str, subtask: str) -> bool:
        """Call off a move that is under way; False when it is too late, or there is none."""
        ask = MoveAsk(task=task, subtask=subtask)
        return (await self._ask("migrate_cancel", ask, MoveCancelled)).cancelled

    async def drain(self, gateway: str, deadline_s: float) -> DrainState:
        """Have a gateway give all its runs away and take no more; returns at once."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "drain", DrainAsk(deadline_s=deadline_s), DrainState)

    async def undrain(self, gateway: str) -> DrainState:
        """Have a gateway take runs again."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "undrain", DrainStateAsk(), DrainState)

    async def drain_state(self, gateway: str) -> DrainState:
        """How far a gateway is with giving its runs away."""
        return await self.plane.rpc.call(gateway, "drain_state", DrainStateAsk(), DrainState)

    # --- pools ------------------------------------------------------------------------------------------------

    async def pool_warm(self, gateway: str, ask: WarmAsk) -> Warmed:
        """Have a gateway keep containers of an image ready."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "pool_warm", ask, Warmed, timeout_s=ask.wait_s + 5.0)

    async def image_fetch(self, gateway: str, reference: str, source: str = "", *, timeout_s: float = 900.0) -> Brought:
        """Have a gateway bring an image to itself, from `source` first; returns when it is there.

        Raises:
            NotFoundError: no gateway that answers has it.
        """
        await self._known(gateway)
        ask = FetchAsk(reference=reference, gateway=source)
        return await self.plane.rpc.call(gateway, "image_fetch", ask, Brought, timeout_s=timeout_s)

    def image_holders(self, reference: str) -> tuple[str, ...]:
        """Gateways whose status lists an image, by its full reference."""
        known = self.plane.registry.gateways
        return tuple(sorted(each for each, status in known.items() if reference in status.images))

    async def pool_evict(self, name: str, gateway: str = "") -> dict[str, Evicted]:
        """Give up a container, by its id or the beginning of it, or all idle ones of an image; answers by gateway.

        Raises:
            NotFoundError: no gateway has such a container, or image.
            RefusedError: several containers begin so, or it is not idle.
        """
        await self._known(gateway)
        held = [
            (each, container)
            for each, containers in self.plane.registry.containers.items()
            for container in containers
            if container.startswith(name) and gateway in ("", each)
        ]
        if len(held) > 1 and name not in (container for _, container in held):
            ids = ", ".join(sorted(container for _, container in held))
            raise RefusedError(f"several containers begin with {name}: {ids}", remedy="write more of it")
        if held:
            where, container = min(held, key=lambda each: (each[1] != name, each))
            ask = EvictAsk(container=container)
            return {where: await self.plane.rpc.call(where, "pool_evict", ask, Evicted)}
        return await self._all_of(gateway, "pool_evict", EvictAsk(image=name), Evicted)

    async def pool_release(self, image: str, gateway: str = "") -> dict[str, Released]:
        """Have an image started again that is in quarantine, on one gateway or wherever it is."""
        return await self._all_of(gateway, "pool_release_quarantine", ReleaseAsk(image=image), Released)

    async def pool_decisions(
        self, limit: int, gateway: str = ""
    ) -> tuple[dict[str, DecisionList], dict[str, SwiftbotError]]:
        """What pools started and gave up lately, by gateway; and why the others did not tell."""
        await self._known(gateway)
        return await self._each(gateway, "pool_decisions", DecisionsAsk(limit=limit), DecisionList)

    async def _known(self, gateway: str) -> None:
        """Raise when there is no such gateway, or none at all."""
        await self.gateway()
        if gateway and gateway not in self.plane.members():
            known = ", ".join(sorted(self.plane.members()))
            raise NotFoundError(f"no gateway {gateway[:60]!r} is there", remedy=f"there are: {known}")

    async def _each(
        self, gateway: str, verb: str, request: Struct, reply: type[R]
    ) -> tuple[dict[str, R], dict[str, SwiftbotError]]:
        """Ask one gateway, or all; what they answered, and why some did not."""
        names = [gateway] if gateway else sorted(self.plane.members())
        calls = (self.plane.rpc.call(name, verb, request, reply) for name in names)
        found: dict[str, R] = {}
        failed: dict[str, SwiftbotError] = {}
        for name, answer in zip(names, await asyncio.gather(*calls, return_exceptions=True), strict=True):
            if isinstance(answer, SwiftbotError):
                failed[name] = answer
            elif isinstance(answer, BaseException):
                raise answer
            else:
                found[name] = answer
        return found, failed

    async def _all_of(self, gateway: str, verb: str, request: Struct, reply: type[R]) -> dict[str, R]:
        """The same, but when none did what was asked, the reason of the first is raised."""
        await self._known(gateway)
        found, failed = await self._each(gateway, verb, request, reply)
        if not found:
            raise failed[min(failed)]
        return found

    # --- watching ---------------------------------------------------------------------------------------------

    async def watch(self, task: str, *, poll_s: float = 1.0) -> AsyncGenerator[TaskRecord]:
        """Yield a task's record whenever it changes, until it has ended; survives the loss of gateways.

        Changes are pushed; every `poll_s` the record is asked for as well, in case a push was missed.
        """
        queue: asyncio.Queue[TaskRecord] = asyncio.Queue()

        def take(key: str, record: TaskRecord | None) -> None:  # noqa: ARG001 - the record names its task
            if record is not None:
                queue.put_nowait(record)

        closer = self.plane.session.subscribe_typed(self.plane.keys.task(task), TaskRecord, take)
        try:
            last: TaskRecord | None = None
            silent = 0
            queue.put_nowait(await self.task(task))
            while last is None or not last.state.final:
                try:
                    async with asyncio.timeout(poll_s):
                        record = await queue.get()
                except TimeoutError:
                    try:
                        record = await self.task(task)
                        silent = 0
                    except SwiftbotError:
                        silent += 1
                        if silent > 30:
                            raise
                        continue
                if last is None or _news(last, record):
                    last = record
                    yield record
        finally:
            closer.close()

    async def stream(self, task: str, *, since_s: float | None = None) -> AsyncGenerator[Line]:
        """Yield what happens to a task, from all gateways in one order, until it has ended.

        Progress, log lines of handlers and of gateways, figures, what the monitor finds and does. What is still known
        of the past comes first; the queue is bounded, and what it drops is told in the stream.

        Args:
            task: its id.
            since_s: leave out what was said longer ago than so many seconds; None: all that is still known.

        Raises:
            NotFoundError: there is no such task.
        """
        follow = Stream(self.plane, task, lambda: self.task(task)).follow(since_s=since_s)
        async with contextlib.aclosing(follow) as lines:
            async for line in lines:
                yield line

    async def planned(self, task: str, *, timeout_s: float = 60.0) -> TaskRecord:
        """Wait until a task has a plan or has ended."""

        async def wait() -> TaskRecord:
            async with contextlib.aclosing(self.watch(task, poll_s=0.2)) as changes:
                async for record in changes:
                    if record.state is not TaskState.ACCEPTED:
                        return record
            raise DeadlineError(f"task {task} has no plan yet")

        try:
            async with asyncio.timeout(timeout_s):
                return await wait()
        except TimeoutError:
            raise DeadlineError(
                f"task {task} has no plan after {timeout_s:.0f} s", remedy=f"see `swiftbot task show {task}`"
            ) from None

    def on_notice(self, take: "asyncio.Queue[Notice]") -> None:
        """Have notices to people put into a queue."""
        self.plane.session.subscribe_typed(
            self.plane.keys.notice(), Notice, lambda _, notice: take.put_nowait(notice) if notice else None
        )

    def on_run(self, task: str, take: "asyncio.Queue[RunEvent]") -> None:
        """Have the events of a task's runs put into a queue."""
        self.plane.session.subscribe_typed(
            self.plane.keys.run(task), RunEvent, lambda _, event: take.put_nowait(event) if event else None
        )
