"""Moves a run, at the coordinator of its task: steps 2 to 4 of the paper's migration.

    fetch by key   the record, at the gateway that owns the task's key, where its driver is
    closest node   candidates by what is known; the best holds a container for the run, or says why not, and then
                   the next best is asked: nothing has happened to the run yet
    hold           the run's gateway brings it to a safe point and has its checkpoint kept
    migrate        compare and set on the record: attempt + 1, the other gateway, version + 1. From here on the
                   run goes on there, whatever fails: the old attempt's result is refused, by coordinators and robots
    leave, start   the old run is ended, so that its volumes are noted, then the new attempt is ordered (`orders`)

What fails before the record is written leaves the run where it was: its hold is lifted, the container is let go of.
What fails after it makes the new attempt one that was lost with its gateway, which is repeated like any other and
counts against nothing. A coordinator that dies leaves one or the other; both holds end by themselves.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Protocol

import structlog
from msgspec.structs import replace

from appliance.errors import (
    CancelledByOperatorError,
    NotFoundError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import RunRequest, SubtaskRecord, SubtaskState, TaskRecord
from appliance.plane.keys import check_name
from appliance.plane.node import Plane
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.api import (
    Held,
    HoldAsk,
    MigrateAsk,
    Migrated,
    MoveAsk,
    MoveCancelled,
    Reason,
    Reserved,
    RunAsk,
    RunStatus,
    Weighed,
)
from appliance.tasks.context import Input, MoveReady, task_key
from appliance.tasks.migration.policy import History, Place, closest
from appliance.tasks.orders import request_for
from appliance.tasks.placement import holds
from appliance.tasks.records import MAX_NOTE, clean
from appliance.tasks.settings import MigrationConfig

log = structlog.get_logger(__name__)

TRIES = 4
"""Gateways that are asked to take one run."""
RESERVE_S = 10.0
"""How long one of them may take: it may have to start a container."""
HOLD_S = 6.0
"""How long the run's gateway may take to bring it to a safe point."""
WRITE_S = 8.0
"""How long the driver may take to write the record."""
START_S = 15.0
"""How long the start elsewhere is waited for; it goes on in any case."""
DRIVER_S = 2.0
"""How long a driver that is being set up is waited for."""
MOVE_S = 60.0
"""What whoever asks should wait at most."""
MOST_MOVES = 64
"""Moves that one coordinator carries out at the same time."""
MOST_ATTEMPTS = 64
"""A record must stay small: a subtask with so many attempts is left where it is."""


class Driver(Protocol):
    """What is needed of a task's driver."""

    @property
    def record(self) -> TaskRecord:
        """The task as it stands."""
        ...

    def tell(self, news: Input) -> None:
        """Hand in what happened."""
        ...


class Tasks(Protocol):
    """What is needed of the task manager."""

    def driver(self, task: str) -> Driver | None:
        """The driver of a task that is coordinated here."""
        ...

    def manifest(self, skill: str) -> SkillManifest:
        """A skill's manifest; NotFoundError when it is not known."""
        ...


class _Move:
    """A move under way."""

    def __init__(self, work: "asyncio.Task[Migrated]") -> None:
        self.work = work
        self.written = False
        """Whether the record may have been written: too late to call it off."""


class Moving:
    """Moves runs of the tasks that are coordinated here.

    Args:
        plane: the fleet.
        tasks: the tasks driven here.
        config: section `[tasks.migration]`.
    """

    def __init__(self, plane: Plane, tasks: Tasks, config: MigrationConfig) -> None:
        self._plane = plane
        self._tasks = tasks
        self._config = config
        self._history = History()
        self._moves: dict[tuple[str, str], _Move] = {}
        plane.on_member_lost.append(self._history.forget)

    # --- the door ---------------------------------------------------------------------------------------------

    async def migrate(self, ask: MigrateAsk) -> Migrated:
        """Move a subtask's run, wherever its task is coordinated.

        Raises:
            NotFoundError: no such task or subtask, or nobody knows its skill.
            RefusedError: it cannot be moved (now), with the reason.
            CancelledByOperatorError: it was called off.
            UnreachableError, DeadlineError: its coordinator or its gateway does not answer; the run goes on.
        """
        owner = await self._plane.owner_of(task_key(check_name(ask.task, "task")))
        if owner == self._plane.gateway:
            return await self.migrate_here(ask)
        return await self._plane.rpc.call(owner, "migrate_here", ask, Migrated, timeout_s=MOVE_S)

    async def migrate_here(self, ask: MigrateAsk) -> Migrated:
        """Move a subtask's run of a task that is coordinated here; errors as above."""
        key = (check_name(ask.task, "task"), check_name(ask.subtask, "subtask"))
        if key in self._moves:
            raise RefusedError(f"{ask.subtask} is being moved already", remedy="wait for the outcome")
        if len(self._moves) >= MOST_MOVES:
            raise RefusedError(f"{len(self._moves)} runs are being moved already", remedy="try again in a second")
        move = self._moves[key] = _Move(asyncio.create_task(self._move(ask), name=f"move {'/'.join(key)}"))
        move.work.add_done_callback(lambda done: self._moved(key, done))
        try:
            return await asyncio.shield(move.work)
        except asyncio.CancelledError:
            if not move.work.cancelled():
                raise  # who asked is gone; the move is brought to its end
            raise CancelledByOperatorError(
                f"the move of {ask.subtask} was called off; it goes on where it was"
            ) from None

    def _moved(self, key: tuple[str, str], done: "asyncio.Task[Migrated]") -> None:
        self._moves.pop(key, None)
        if not done.cancelled():
            done.exception()  # whoever asked has it

    async def cancel(self, ask: MoveAsk) -> MoveCancelled:
        """Call a move off, wherever it is carried out; False when there is none, or its record is written."""
        owner = await self._plane.owner_of(task_key(check_name(ask.task, "task")))
        if owner != self._plane.gateway:
            return await self._plane.rpc.call(owner, "migrate_cancel", ask, MoveCancelled)
        move = self._moves.get((ask.task, ask.subtask))
        if move is None or move.written:
            return MoveCancelled(cancelled=False)
        move.work.cancel()
        return MoveCancelled(cancelled=True)

    async def close(self) -> None:
        """Give up what is under way; records that are written stand."""
        works = [each.work for each in self._moves.values()]
        for work in works:
            work.cancel()
        await asyncio.gather(*works, return_exceptions=True)

    # --- the steps --------------------------------------------------------------------------------------------

    async def _move(self, ask: MigrateAsk) -> Migrated:
        began = at = time.monotonic()
        steps: dict[str, float] = {}

        def step(name: str) -> None:
            nonlocal at
            now = time.monotonic()
            steps[name], at = round((now - at) * 1e3, 3), now

        driver = await self._driver(ask.task)
        target = _movable(driver.record, ask)
        manifest = self._tasks.manifest(target.subtask.skill)
        if manifest.mobility == "never" and target.state is SubtaskState.RUNNING:
            raise RefusedError(
                f"{target.subtask.skill} commands a robot and may not be moved",
                remedy="wait until it ends; its manifest says that it must not migrate (`migratable`)",
            )
        request = request_for(
            driver.record, target, manifest, robot=target.bound_robot, coordinator=self._plane.gateway
        )
        step("fetch")
        reserved, considered = await self._find(ask, driver.record, target, request)
        step("find")
        async with contextlib.AsyncExitStack() as undo:
            undo.push_async_callback(self._quietly, self._unreserve(reserved.gateway, request))
            held = await self._hold(target, request.task, undo)
            step("hold")
            await self._write(ask, driver, target, request, reserved)
            undo.pop_all()  # from here on the new attempt is the one that counts
        step("write")
        started, what = await self._started(driver, request)
        step("start")
        self._history.went(reserved.gateway, well=started)
        took_ms = round((time.monotonic() - began) * 1e3, 3)
        log.info(
            "run moved", task=ask.task, subtask=ask.subtask, attempt=request.attempt, source=target.gateway,
            target=reserved.gateway, reason=str(ask.reason), took_ms=took_ms, started=started,
        )  # fmt: skip
        return Migrated(
            task=ask.task,
            subtask=ask.subtask,
            moved=True,
            source=target.gateway,
            target=reserved.gateway,
            attempt=request.attempt,
            why=what or _told(considered),
            checkpoint="fresh" if held.fresh else "last" if held.saved else "",
            started=started,
            took_ms=took_ms,
            steps_ms=steps,
            considered=tuple(considered[:12]),
        )

    async def _driver(self, task: str) -> Driver:
        """Fetch by key: the driver of a task whose key this gateway owns, which may only be setting it up."""
        until = time.monotonic() + DRIVER_S
        while (driver := self._tasks.driver(task)) is None:
            if time.monotonic() > until:
                stored = await self._plane.dht.read(task_key(task))
                if stored is None:
                    raise NotFoundError(f"there is no task {task}", remedy="see `swiftbot task list`")
                raise RefusedError(f"task {task} has ended, or is not driven by {self._plane.gateway} just now")
            await asyncio.sleep(0.05)
        return driver

    async def _find(
        self, ask: MigrateAsk, record: TaskRecord, target: SubtaskRecord, request: RunRequest
    ) -> tuple[Reserved, list[Weighed]]:
        """Find the closest node and have it hold a container; RefusedError when none does, with all reasons."""
        tried: dict[str, str] = {}
        while True:
            weighed = self._weigh(ask, record, target, request, tried)
            if not weighed or weighed[0].verdict or len(tried) >= TRIES:
                reasons = "; ".join(f"{each.gateway}: {each.verdict}" for each in weighed if each.verdict)
                raise RefusedError(
                    f"no gateway takes {ask.subtask}: {reasons or 'there is no other'}"[:MAX_NOTE],
                    remedy="it goes on where it is",
                )
            gateway = weighed[0].gateway
            try:
                reserved = await self._plane.rpc.call(gateway, "run_reserve", request, Reserved, timeout_s=RESERVE_S)
            except SwiftbotError as error:
                tried[gateway] = clean(error.message, 120)
                self._history.went(gateway, well=False)
            else:
                return reserved, [replace(weighed[0], verdict="taken"), *weighed[1:]]

    def _weigh(
        self, ask: MigrateAsk, record: TaskRecord, target: SubtaskRecord, request: RunRequest, tried: dict[str, str]
    ) -> list[Weighed]:
        registry, members = self._plane.registry, self._plane.members()
        statuses = {name: each for name, each in registry.gateways.items() if name in members}
        near = holds(record, target, request.need.volumes, statuses)
        robot = registry.robots.get(request.robot) if request.robot else None
        places = {
            name: Place(
                status=status,
                containers=tuple(registry.containers.get(name, {}).values()),
                near=near.get(name, float(robot is not None and not near and robot.gateway == name)),
            )
            for name, status in statuses.items()
        }
        if ask.to and ask.to not in places:
            raise NotFoundError(
                f"no gateway {ask.to[:60]!r} is there", remedy=f"there are: {', '.join(sorted(places))}"
            )
        return closest(
            request.need,
            request.run_id,
            places,
            source=target.gateway,
            config=self._config,
            history=self._history,
            tried=tried,
            to=ask.to,
            may=frozenset(record.within),
            lenient=ask.reason is not Reason.OVERLOAD,
        )

    async def _hold(self, target: SubtaskRecord, task: str, undo: contextlib.AsyncExitStack) -> Held:
        """Have the run brought to a safe point; it is let go on again unless the record is written."""
        ask = HoldAsk(task=task, subtask=target.subtask.id, attempt=target.attempt)
        run = RunAsk(task=task, subtask=target.subtask.id, attempt=target.attempt)
        # Also when the answer is lost: it may be held all the same.
        undo.push_async_callback(self._quietly, self._resume(target.gateway, run))
        return await self._plane.rpc.call(target.gateway, "run_hold", ask, Held, timeout_s=HOLD_S)

    async def _write(
        self, ask: MigrateAsk, driver: Driver, target: SubtaskRecord, request: RunRequest, reserved: Reserved
    ) -> None:
        """Migrate: have the driver write the record with the new attempt."""
        # It may have ended while it was held; a driver whose task has ended hears nothing any more.
        _movable(driver.record, replace(ask, attempt=target.attempt))
        if (move := self._moves.get((ask.task, ask.subtask))) is not None:
            move.written = True
        outcome: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        because = f"{ask.reason}: {ask.why}" if ask.why else str(ask.reason)
        driver.tell(
            MoveReady(
                subtask=ask.subtask,
                attempt=target.attempt,
                next_attempt=request.attempt,
                gateway=reserved.gateway,
                why=f"moved from {target.gateway} to {reserved.gateway} ({because})",
                placed=f"moved from {target.gateway}; holds container {reserved.container} for it",
                outcome=outcome,
            )
        )
        try:
            async with asyncio.timeout(WRITE_S):
                await asyncio.shield(outcome)
        except TimeoutError:
            # Given up by its future: a driver that comes to it later does nothing. One that is writing it just now
            # makes a new attempt that finds no container held, which is repeated like any other.
            outcome.cancel()
            raise UnreachableError(
                f"the record of task {ask.task} could not be written in time", remedy="the run goes on; try again"
            ) from None

    async def _started(self, driver: Driver, request: RunRequest) -> tuple[bool, str]:
        """Wait until the new attempt has run its first line; otherwise what became of it."""
        until = time.monotonic() + START_S
        while time.monotonic() < until:
            target = driver.record.of(request.subtask)
            attempt = next((each for each in target.attempts if each.number == request.attempt), None)
            if attempt is not None and attempt.failure is not None:
                return False, f"moved, but its start there failed and is repeated: {attempt.failure.message}"
            if target.attempt > request.attempt:
                return True, "moved, and moved on since"
            if target.attempt == request.attempt and target.state not in (SubtaskState.DISPATCHED, SubtaskState.READY):
                return True, ""
            await asyncio.sleep(0.01)
        return False, f"moved; its first line there was not heard of within {START_S:g} s"

    # --- undoing ----------------------------------------------------------------------------------------------

    def _unreserve(self, gateway: str, request: RunRequest) -> Callable[[], Awaitable[RunStatus]]:
        ask = RunAsk(task=request.task, subtask=request.subtask, attempt=request.attempt)
        return lambda: self._plane.rpc.call(gateway, "run_unreserve", ask, RunStatus, timeout_s=2.0)

    def _resume(self, gateway: str, run: RunAsk) -> Callable[[], Awaitable[RunStatus]]:
        return lambda: self._plane.rpc.call(gateway, "run_resume", run, RunStatus, timeout_s=2.0)

    async def _quietly(self, work: Callable[[], Awaitable[RunStatus]]) -> None:
        """Undo something, also when the move is cancelled; what cannot be undone now ends by itself."""

        async def go() -> None:
            with contextlib.suppress(SwiftbotError):
                await work()

        await asyncio.shield(asyncio.ensure_future(_coroutine(go())))


async def _coroutine(work: Coroutine[Any, Any, None]) -> None:
    await work


def _movable(record: TaskRecord, ask: MigrateAsk) -> SubtaskRecord:
    """Return the subtask that is to be moved; an error says why it cannot be."""
    try:
        target = record.of(ask.subtask)
    except KeyError:
        known = ", ".join(each.subtask.id for each in record.subtasks)
        raise NotFoundError(
            f"task {record.id} has no subtask {ask.subtask[:60]!r}",
            remedy=f"it has: {known or 'none, it is not planned'}",
        ) from None
    if target.state not in (SubtaskState.DISPATCHED, SubtaskState.RUNNING):
        raise RefusedError(f"{ask.subtask} is {target.state}: it has no run that could be moved")
    if record.state.final or str(record.state) != "running":
        raise RefusedError(f"task {record.id} is {record.state}: its runs are not moved")
    if ask.attempt and ask.attempt != target.attempt:
        raise RefusedError(f"{ask.subtask} is at attempt {target.attempt}, not {ask.attempt}, by now")
    if ask.to and ask.to == target.gateway:
        raise RefusedError(f"{ask.subtask} is on {ask.to} already")
    if len(target.attempts) >= MOST_ATTEMPTS:
        raise RefusedError(f"{ask.subtask} has had {len(target.attempts)} attempts: it is left where it is")
    return target


def _told(considered: list[Weighed]) -> str:
    scores = [f"{each.gateway} {each.score:.2f}" for each in considered if each.score]
    others = [f"{each.gateway}: {each.verdict}" for each in considered if not each.score]
    return ", ".join((scores + others)[:6])
