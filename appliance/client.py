"""What a person's command does over Zenoh: one small client for the command line, the demo and the benchmarks.

It sits anywhere on the Zenoh network, asks any gateway, and knows nothing of a gateway's inside.
"""

import asyncio
import contextlib
import uuid
from collections.abc import AsyncGenerator

from msgspec.structs import replace

from appliance.connection import Endpoint
from appliance.errors import DeadlineError, RefusedError, SwiftbotError
from appliance.model import Notice, RunEvent, Site, TaskRecord, TaskRequest, TaskState
from appliance.plane.dedup import Deduplicator
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
from appliance.robots.api import Forgotten, LinkAdd, LinkFacts, LinkList, LinkRemove, LinksAsk, RobotForget
from appliance.steering import SteeringCalls
from appliance.tasks.api import (
    DrainAsk,
    DrainState,
    DrainStateAsk,
    ExperienceAsk,
    ExperienceList,
    MigrateAsk,
    Migrated,
    MoveAsk,
    MoveCancelled,
    PlanAnswer,
    PlanAsk,
    SiteAsk,
    TaskAsk,
    TaskList,
    TasksAsk,
    UndrainAsk,
    WhyAsk,
)
from appliance.tasks.lines import Line
from appliance.tasks.migration.moving import MOVE_S
from appliance.tasks.stream import Stream
from appliance.tasks.views import TaskWhy

__all__ = ["Endpoint", "FleetClient"]


def _news(last: TaskRecord, record: TaskRecord) -> bool:
    """Whether a record tells more than the last one shown.

    A coordinator that comes later, be it the same gateway after a restart, goes on from the last *written* record,
    so that its transitions may be numbered lower than what was pushed before. Within one coordinator its own clock
    orders; an end is always news.
    """
    if record.state.final or record.coordinator != last.coordinator:
        return True
    return record.sequence > last.sequence or record.updated_ns > last.updated_ns


class FleetClient(SteeringCalls):
    """All that can be asked of a fleet; use it as an async context manager."""

    async def plan(self, instruction: str, *, private: bool = False) -> PlanAnswer:
        """Decompose, run nothing; `private`: ask no other machine."""
        asked = PlanAsk(instruction=instruction, private=private)
        return await self._ask("plan", asked, PlanAnswer, timeout_s=60.0)

    async def experience(self, limit: int, gateway: str = "") -> ExperienceList:
        """How skills have done on robots lately, by what a gateway has heard; any gateway's by default."""
        asked = ExperienceAsk(limit=limit)
        if not gateway:
            return await self._ask("experience", asked, ExperienceList)
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "experience", asked, ExperienceList)

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

    async def site(self) -> Site:
        """The map by which any one gateway understands names of places."""
        return await self._ask("site", SiteAsk(), Site)

    async def why(self, task: str, subtask: str = "") -> TaskWhy:
        """Why a task waits, or was served where it was; NotFoundError when there is no such task or subtask."""
        return await self._ask("why", WhyAsk(id=task, subtask=subtask), TaskWhy)

    # --- moving runs --------------------------------------------------------------------------------------------

    async def migrate(self, ask: MigrateAsk) -> Migrated:
        """Move a subtask's run to another gateway; returns when it has started there.

        Raises:
            NotFoundError, RefusedError: it cannot be moved, with the reason; it goes on where it is.
            CancelledByOperatorError: somebody called it off.
        """
        signed = replace(ask, by=ask.by or self.operator)
        return await self.plane.rpc.call(await self.gateway(), "migrate", signed, Migrated, timeout_s=MOVE_S)

    async def migrate_cancel(self, task: str, subtask: str) -> bool:
        """Call off a move that is under way; False when it is too late, or there is none."""
        ask = MoveAsk(task=task, subtask=subtask)
        return (await self._ask("migrate_cancel", ask, MoveCancelled)).cancelled

    async def drain(self, gateway: str, deadline_s: float, *, why: str = "") -> DrainState:
        """Have a gateway give all its runs away and take no more; returns at once."""
        await self._known(gateway)
        return await self.plane.rpc.call(
            gateway, "drain", DrainAsk(deadline_s=deadline_s, **self._sign(why)), DrainState
        )

    async def undrain(self, gateway: str, *, why: str = "") -> DrainState:
        """Have a gateway take runs again."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "undrain", UndrainAsk(**self._sign(why)), DrainState)

    async def drain_state(self, gateway: str) -> DrainState:
        """How far a gateway is with giving its runs away."""
        return await self.plane.rpc.call(gateway, "drain_state", DrainStateAsk(), DrainState)

    # --- MAVLink links -----------------------------------------------------------------------------------------

    async def robot_links(self, gateway: str = "") -> tuple[dict[str, LinkList], dict[str, SwiftbotError]]:
        """The MAVLink links of all gateways, or one; and why the others did not tell."""
        await self._known(gateway)
        return await self._each(gateway, "robot_links", LinksAsk(), LinkList)

    async def robot_link_add(self, gateway: str, ask: LinkAdd) -> LinkFacts:
        """Have a gateway open a MAVLink link and keep it over restarts.

        Raises:
            ConfigError: it cannot be, or its port is taken.
            RefusedError: there is such a link with other settings.
        """
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "robot_link_add", ask, LinkFacts)

    async def robot_link_remove(self, gateway: str, ask: LinkRemove) -> LinkFacts:
        """Have a gateway close a MAVLink link for good; NotFoundError when it has none of that name."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "robot_link_remove", ask, LinkFacts, timeout_s=15.0)

    async def robot_forget(self, ask: RobotForget) -> Forgotten:
        """Remove the row of a robot that is offline, at the gateway that it was attached to, where that is there.

        Raises:
            NotFoundError: there is none of that name.
            RefusedError: it is online.
        """
        anyone = await self.gateway()
        known = self.plane.registry.robots.get(ask.robot)
        there = known is not None and known.gateway in self.plane.members()
        return await self.plane.rpc.call(known.gateway if known and there else anyone, "robot_forget", ask, Forgotten)

    # --- pools ------------------------------------------------------------------------------------------------

    async def pool_warm(self, gateway: str, ask: WarmAsk) -> Warmed:
        """Have a gateway keep containers of an image ready."""
        await self._known(gateway)
        signed = replace(ask, by=ask.by or self.operator)
        return await self.plane.rpc.call(gateway, "pool_warm", signed, Warmed, timeout_s=ask.wait_s + 5.0)

    async def image_fetch(
        self, gateway: str, reference: str, source: str = "", *, timeout_s: float = 900.0, why: str = ""
    ) -> Brought:
        """Have a gateway bring an image to itself, from `source` first; returns when it is there.

        Raises:
            NotFoundError: no gateway that answers has it.
        """
        await self._known(gateway)
        ask = FetchAsk(reference=reference, gateway=source, **self._sign(why))
        return await self.plane.rpc.call(gateway, "image_fetch", ask, Brought, timeout_s=timeout_s)

    def image_holders(self, reference: str) -> tuple[str, ...]:
        """Gateways whose status lists an image, by its full reference."""
        known = self.plane.registry.gateways
        return tuple(sorted(each for each, status in known.items() if reference in status.images))

    async def pool_evict(self, name: str, gateway: str = "", *, why: str = "") -> dict[str, Evicted]:
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
            ask = EvictAsk(container=container, **self._sign(why))
            return {where: await self.plane.rpc.call(where, "pool_evict", ask, Evicted)}
        return await self._all_of(gateway, "pool_evict", EvictAsk(image=name, **self._sign(why)), Evicted)

    async def pool_release(self, image: str, gateway: str = "", *, why: str = "") -> dict[str, Released]:
        """Have an image started again that is in quarantine, on one gateway or wherever it is."""
        ask = ReleaseAsk(image=image, **self._sign(why))
        return await self._all_of(gateway, "pool_release_quarantine", ask, Released)

    async def pool_decisions(
        self, limit: int, gateway: str = ""
    ) -> tuple[dict[str, DecisionList], dict[str, SwiftbotError]]:
        """What pools started and gave up lately, by gateway; and why the others did not tell."""
        await self._known(gateway)
        return await self._each(gateway, "pool_decisions", DecisionsAsk(limit=limit), DecisionList)

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
        """Have notices to people put into a queue, each once: both sides of a partition may have given it."""
        once = Deduplicator()

        def heard(_: str, notice: Notice | None) -> None:
            if notice is not None and once.new(notice.id):
                take.put_nowait(notice)

        self.plane.session.subscribe_typed(self.plane.keys.notice(), Notice, heard)

    def on_run(self, task: str, take: "asyncio.Queue[RunEvent]") -> None:
        """Have the events of a task's runs put into a queue."""
        self.plane.session.subscribe_typed(
            self.plane.keys.run(task), RunEvent, lambda _, event: take.put_nowait(event) if event else None
        )
