"""Moves a run, at the coordinator of its task: steps 2 to 4 of the paper's migration.

    fetch by key   the record, at the gateway that owns the task's key, where its coordinator is
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
import time
from collections.abc import Callable
from typing import Protocol

import structlog
from msgspec.structs import replace

from appliance.errors import (
    CancelledByOperatorError,
    NotFoundError,
    RefusedError,
    UnreachableError,
)
from appliance.model import RunRequest, SubtaskRecord, SubtaskState, TaskRecord, keyspace
from appliance.model.keys import check_name
from appliance.model.task_api import (
    MigrateAsk,
    Migrated,
    MoveAsk,
    MoveCancelled,
    Reason,
    Reserved,
    Weighed,
)
from appliance.plane.events import FleetEvent, Lost, Stage
from appliance.plane.node import Plane
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.events import Event, MoveReady
from appliance.tasks.handoff import Handoff, Outcome, run_of
from appliance.tasks.migration.policy import History, Place, closest
from appliance.tasks.orders import request_for
from appliance.tasks.placement import holds
from appliance.tasks.records import MAX_NOTE, clean, task_key
from appliance.tasks.settings import MigrationConfig

log = structlog.get_logger(__name__)

TRIES = 4
"""Gateways that are asked to take one run."""
WRITE_S = 8.0
"""How long the coordinator may take to write the record."""
START_S = 15.0
"""How long the start elsewhere is waited for; it goes on in any case."""
COORDINATOR_S = 2.0
"""How long a coordinator that is being set up is waited for."""
MOST_MOVES = 64
"""Moves that one coordinator carries out at the same time."""
MOST_ATTEMPTS = 64
"""A record must stay small: a subtask with so many attempts is left where it is."""


class Coordinator(Protocol):
    """What is needed of a task's coordinator."""

    @property
    def record(self) -> TaskRecord:
        """The task as it stands."""
        ...

    def put(self, event: Event) -> None:
        """Hand in an event."""
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
        coordinator: of a task that is coordinated here; None for others.
        manifest: of a skill; NotFoundError when it is not known.
        config: section `[tasks.migration]`.
    """

    def __init__(
        self,
        plane: Plane,
        *,
        coordinator: Callable[[str], Coordinator | None],
        manifest: Callable[[str], SkillManifest],
        config: MigrationConfig,
    ) -> None:
        self._plane = plane
        self._coordinator_of = coordinator
        self._manifest = manifest
        self._config = config
        self._history = History()
        self._moves: dict[tuple[str, str], _Move] = {}
        plane.events.subscribe(Stage.OFFLOAD, self._on_event)

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, Lost):
            self._history.forget(event.gateway)

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
        return await self._plane.rpc.call(owner, keyspace.MIGRATE_HERE, ask)

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
            done.exception()  # the asker has it

    async def cancel(self, ask: MoveAsk) -> MoveCancelled:
        """Call a move off, wherever it is carried out; False when there is none, or its record is written."""
        owner = await self._plane.owner_of(task_key(check_name(ask.task, "task")))
        if owner != self._plane.gateway:
            return await self._plane.rpc.call(owner, keyspace.MIGRATE_CANCEL, ask)
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

        coordinator = await self._coordinator(ask.task)
        target = _movable(coordinator.record, ask)
        manifest = self._manifest(target.subtask.skill)
        if manifest.mobility == "never" and target.state is SubtaskState.RUNNING:
            raise RefusedError(
                f"{target.subtask.skill} commands a robot and may not be moved",
                remedy="wait until it ends; its manifest says that it must not migrate (`migratable`)",
            )
        request = request_for(
            coordinator.record, target, manifest, robots=target.robots, coordinator=self._plane.gateway
        )
        step("fetch")
        offers = Closest(lambda tried: self._weigh(ask, coordinator.record, target, request, tried), self._history)
        async with Handoff(self._plane, request) as handoff:
            reserved = await handoff.reserve(offers)
            if reserved is None:
                raise RefusedError(
                    f"no gateway takes {ask.subtask}: {offers.reasons() or 'there is no other'}"[:MAX_NOTE],
                    remedy="it goes on where it is",
                )
            step("find")
            held = await handoff.hold(target.gateway, replace(run_of(request), attempt=target.attempt))
            step("hold")
            await self._write(ask, coordinator, target, request, reserved)
            handoff.commit()
        step("write")
        started, what = await self._started(coordinator, request)
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
            why=what or _told(offers.considered),
            checkpoint="fresh" if held.fresh else "last" if held.saved else "",
            started=started,
            took_ms=took_ms,
            steps_ms=steps,
            considered=tuple(offers.considered[:12]),
        )

    async def _coordinator(self, task: str) -> Coordinator:
        """Fetch by key: the coordinator of a task whose key this gateway owns, which may only be setting it up."""
        until = time.monotonic() + COORDINATOR_S
        while (coordinator := self._coordinator_of(task)) is None:
            if time.monotonic() > until:
                stored = await self._plane.dht.read(task_key(task))
                if stored is None:
                    raise NotFoundError(f"there is no task {task}", remedy="see `swiftbot task list`")
                raise RefusedError(f"task {task} has ended, or is not driven by {self._plane.gateway} just now")
            await asyncio.sleep(0.05)
        return coordinator

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

    async def _write(
        self, ask: MigrateAsk, coordinator: Coordinator, target: SubtaskRecord, request: RunRequest, reserved: Reserved
    ) -> None:
        """Migrate: have the coordinator write the record with the new attempt."""
        # It may have ended while it was held; a coordinator whose task has ended hears nothing any more.
        _movable(coordinator.record, replace(ask, attempt=target.attempt))
        if (move := self._moves.get((ask.task, ask.subtask))) is not None:
            move.written = True
        outcome: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        because = f"{ask.reason}: {ask.why}" if ask.why else str(ask.reason)
        coordinator.put(
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
            # Given up by its future: a coordinator that comes to it later does nothing. One that is writing it just now
            # makes a new attempt that finds no container held, which is repeated like any other.
            outcome.cancel()
            raise UnreachableError(
                f"the record of task {ask.task} could not be written in time", remedy="the run goes on; try again"
            ) from None

    async def _started(self, coordinator: Coordinator, request: RunRequest) -> tuple[bool, str]:
        """Wait until the new attempt has run its first line; otherwise what became of it."""
        until = time.monotonic() + START_S
        while time.monotonic() < until:
            target = coordinator.record.of(request.subtask)
            attempt = next((each for each in target.attempts if each.number == request.attempt), None)
            if attempt is not None and attempt.failure is not None:
                return False, f"moved, but its start there failed and is repeated: {attempt.failure.message}"
            if target.attempt > request.attempt:
                return True, "moved, and moved on since"
            if target.attempt == request.attempt and target.state not in (SubtaskState.DISPATCHED, SubtaskState.READY):
                return True, ""
            await asyncio.sleep(0.01)
        return False, f"moved; its first line there was not heard of within {START_S:g} s"


class Closest:
    """Offers for a run in progress: the gateways that `weigh` finds, given those that refused and why."""

    def __init__(self, weigh: Callable[[dict[str, str]], list[Weighed]], history: History) -> None:
        self.considered: list[Weighed] = []
        """All gateways as they were weighed last, the one that was asked first."""
        self._weigh = weigh
        self._history = history
        self._refused: dict[str, str] = {}

    async def best(self) -> str:
        """Find the closest node."""
        self.considered = self._weigh(self._refused)
        if not self.considered or self.considered[0].verdict or len(self._refused) >= TRIES:
            return ""
        return self.considered[0].gateway

    def note(self, outcome: Outcome) -> None:
        """Note whether it holds a container; where it does not, nothing has happened to the run."""
        if outcome.taken:
            self.considered[0] = replace(self.considered[0], verdict="taken")
            return
        gateway = self.considered[0].gateway
        self._refused[gateway] = clean(outcome.reason, 120)
        self._history.went(gateway, well=False)

    def reasons(self) -> str:
        """Say why no gateway holds a container for it."""
        return "; ".join(f"{each.gateway}: {each.verdict}" for each in self.considered if each.verdict)


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
