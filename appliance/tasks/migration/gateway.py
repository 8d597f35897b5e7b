"""Migration of one gateway, put together: what gives runs away, what takes them, what moves those it coordinates.

- `Requesting`: step 1 of migration, the request. The gateway says which runs are to leave it, and asks the coordinators
  of each. The request is put, for the log and all who watch; the coordinators answer for their runs one by
  one.
- `Draining`: the gateway gives all its runs away, before it stops or because an operator wants it empty. Runs that have
  not begun are moved at once, the others with a checkpoint. What cannot be moved (yet) is asked for again now and then
  and waited for, with the reason in the status; past the deadline it is cancelled, and its coordinator repeats it
  elsewhere.
- `Shedding`: load shedding. The gateway reads its own figures, asks `policy.Overload`, and requests moves.
- `Migration`: all of it, and the verbs.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterable, Sequence

import structlog

from appliance.errors import PayloadError, SwiftbotError
from appliance.model import GatewayStatus, keyspace
from appliance.model.task_api import (
    DrainAsk,
    DrainState,
    DrainStateAsk,
    MigrateAsk,
    Migrated,
    MigrationRequest,
    Reason,
    Remaining,
    UndrainAsk,
)
from appliance.plane.node import Plane
from appliance.pool.pool import Pool
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.audit import Audit
from appliance.tasks.executor import Executor
from appliance.tasks.handoff import Here, Reservations, Source, Target, run_of
from appliance.tasks.migration.moving import Coordinator, Moving
from appliance.tasks.migration.policy import Candidate, Load, Overload, Room, busy, may_leave
from appliance.tasks.settings import MigrationConfig


class Requesting:
    """Asks for runs of this gateway to be moved away."""

    def __init__(self, plane: Plane, moving: Moving) -> None:
        self._plane = plane
        self._moving = moving

    def put(self, runs: Sequence[Here], reason: Reason, why: str) -> None:
        """Put the request for so many runs."""
        request = MigrationRequest(
            reason=reason,
            node=self._plane.gateway,
            num_containers=len(runs),
            requirements=tuple(each.request.need for each in runs),
            runs=tuple(run_of(each.request) for each in runs),
            why=why,
            at_ns=time.time_ns(),
        )
        self._plane.session.publish(keyspace.MIGRATION, request, self._plane.gateway)

    async def move(self, run: Here, reason: Reason, why: str) -> Migrated:
        """Have one moved by the coordinator of its task; errors as for `Moving.migrate`."""
        ask = run_of(run.request)
        return await self._moving.migrate(
            MigrateAsk(task=ask.task, subtask=ask.subtask, attempt=ask.attempt, reason=reason, why=why)
        )


log = structlog.get_logger(__name__)

TICK_S = 0.1
CANCEL_S = 5.0
"""How long runs that are cancelled past the deadline may take to end."""
AGAIN_S = (0.5, 1.0, 2.0, 4.0)
"""Pauses before a run that could not be moved is asked for again; the last one from then on."""
LONGEST_S = 7 * 86_400.0
SHOWN = 3
"""Runs named in the status; all are in the drain's state."""
MOST_WHY = 160


class _Left:
    """A run that is still here."""

    def __init__(self, skill: str) -> None:
        self.skill = skill
        self.why = "about to be moved"
        self.tries = 0
        self.again_at = 0.0


class Draining:
    """Empties this gateway.

    Args:
        gateway: this gateway.
        executor: the runs here; takes none while it drains.
        source: which of them may be moved.
        requesting: asks for it.
        config: section `[tasks.migration]`.
        on_change: called when there is something to show.
    """

    def __init__(
        self,
        gateway: str,
        *,
        executor: Executor,
        source: Source,
        requesting: Requesting,
        config: MigrationConfig,
        on_change: Callable[[], None],
    ) -> None:
        self._gateway = gateway
        self._executor = executor
        self._source = source
        self._requesting = requesting
        self._at_once = 2 * config.at_once
        self._on_change = on_change
        self._left: dict[str, _Left] = {}
        self._moving: dict[str, asyncio.Task[None]] = {}
        self._working: asyncio.Task[None] | None = None
        self._began = 0.0
        self._deadline_s = 0.0
        self._moved = self._ended = 0
        self._stopping = False

    @property
    def text(self) -> str:
        """How far it is, in a sentence for the status; empty while it does not drain."""
        if not self._executor.draining:
            return ""
        left = [f"{run} ({each.skill}): {each.why}" for run, each in list(self._left.items())[:SHOWN]]
        more = f"; and {len(self._left) - SHOWN} more" if len(self._left) > SHOWN else ""
        done = f"{self._moved} runs moved away, {self._ended} ended here"
        return f"{done}; {len(self._left)} left: {'; '.join(left)}{more}" if self._left else f"{done}; it is empty"

    def state(self) -> DrainState:
        """How far it is."""
        draining = self._executor.draining
        return DrainState(
            gateway=self._gateway,
            draining=draining,
            done=draining and not self._executor.here(),
            moved=self._moved,
            ended=self._ended,
            left=tuple(Remaining(run=run, skill=each.skill, why=each.why) for run, each in self._left.items()),
            elapsed_s=round(time.monotonic() - self._began, 3) if draining else 0.0,
            deadline_s=self._deadline_s,
        )

    # --- verbs ------------------------------------------------------------------------------------------------

    async def drain(self, ask: DrainAsk) -> DrainState:
        """Begin to give all runs away and take no more; answers at once. Asked again it goes by the new deadline.

        Raises:
            PayloadError: a deadline that cannot be.
        """
        if not 0 <= ask.deadline_s <= LONGEST_S:
            raise PayloadError(f"a deadline of {ask.deadline_s:g} s", remedy=f"0 (none) to {LONGEST_S:g}")
        self.begin(ask.deadline_s)
        return self.state()

    async def undrain(self, ask: UndrainAsk) -> DrainState:
        """Take runs again; those being moved just now go all the same."""
        del ask
        if not self._stopping:
            await self._halt()
            self._executor.draining = False
            self._left.clear()
            log.info("gateway takes runs again", gateway=self._gateway)
            self._on_change()
        return self.state()

    async def ask_state(self, ask: DrainStateAsk) -> DrainState:
        """Tell how far it is."""
        del ask
        return self.state()

    # --- draining ---------------------------------------------------------------------------------------------

    def begin(self, deadline_s: float, *, stopping: bool = False) -> None:
        """Begin to drain; `stopping`: for good, since the gateway is about to end."""
        self._stopping = self._stopping or stopping
        if not self._executor.draining or self._working is None:
            self._moved = self._ended = 0
        self._began, self._deadline_s = time.monotonic(), deadline_s
        self._executor.draining = True
        log.info("gateway drains", gateway=self._gateway, runs=self._executor.running, deadline_s=deadline_s)
        if self._working is None or self._working.done():
            self._working = asyncio.create_task(self._work(), name="drain")
        self._on_change()

    async def until_empty(self) -> None:
        """Wait until no run is left, or the deadline has passed and what was left is cancelled."""
        if self._working is not None:
            await asyncio.shield(self._working)

    async def _work(self) -> None:
        while self._executor.here() or self._moving:
            now = time.monotonic()
            if self._deadline_s and now - self._began >= self._deadline_s:
                await self._cancel_rest()
                break
            self._look(now)
            await asyncio.sleep(TICK_S)
        self._look(time.monotonic())
        log.info("gateway is drained", gateway=self._gateway, moved=self._moved, ended=self._ended)
        self._on_change()

    def _look(self, now: float) -> None:
        """Note what has gone, and have moved what is due: first what has not begun."""
        here = self._executor.here()
        for run in [each for each in self._left if each not in here and each not in self._moving]:
            del self._left[run]
            self._ended += 1
            self._on_change()
        due: list[tuple[str, Here]] = []
        for run, each in sorted(here.items(), key=lambda item: (item[1].began, item[1].since)):
            left = self._left.setdefault(run, _Left(each.request.skill))
            if run in self._moving or left.again_at > now:
                continue
            if each.began and self._source.mobility(each.request) == "never":
                left.why = "commands a robot and may not be moved: its end is waited for"
            elif not each.request.coordinator:
                left.why = "no coordinator has sent it: its end is waited for"
            else:
                due.append((run, each))
        due = due[: max(0, self._at_once - len(self._moving))]
        if any(not self._left[run].tries for run, _ in due):
            self._requesting.put([each for _, each in due], Reason.DRAIN, f"{self._gateway} drains")
        for run, each in due:
            work = asyncio.create_task(self._move(run, each), name=f"drain {run}")
            self._moving[run] = work
            work.add_done_callback(lambda _, run=run: self._moving.pop(run, None))

    async def _move(self, run: str, here: Here) -> None:
        left = self._left[run]
        left.why = "is being moved"
        try:
            await self._requesting.move(here, Reason.DRAIN, f"{self._gateway} drains")
        except SwiftbotError as error:
            left.why = f"waited for: {error.message}"[:MOST_WHY]
            left.again_at = time.monotonic() + AGAIN_S[min(left.tries, len(AGAIN_S) - 1)]
            left.tries += 1
            log.info("a run stays on a draining gateway for now", run=run, reason=error.message)
        else:
            self._left.pop(run, None)
            self._moved += 1
        self._on_change()

    async def _cancel_rest(self) -> None:
        """The deadline has passed: end what is left; it is repeated elsewhere."""
        for run, each in self._executor.here().items():
            log.warning("a run is cancelled: the drain's deadline has passed", run=run)
            with contextlib.suppress(SwiftbotError):
                await self._executor.cancel(run_of(each.request))
        for _ in range(int(CANCEL_S / TICK_S)):
            if not self._executor.here():
                return
            await asyncio.sleep(TICK_S)

    async def _halt(self) -> None:
        if self._working is not None:
            self._working.cancel()
            await asyncio.gather(self._working, return_exceptions=True)
            self._working = None

    async def close(self) -> None:
        """Stop asking."""
        await self._halt()
        works = list(self._moving.values())
        for work in works:
            work.cancel()
        await asyncio.gather(*works, return_exceptions=True)


class Shedding:
    """Watches this gateway's load and has runs moved away from it.

    Args:
        plane: the fleet.
        executor: the runs here.
        source: which of them may be moved.
        requesting: asks for it.
        config: section `[tasks.migration]`.
        load: what the gateway sees of itself.
        volumes_mb: size of the state volumes of these names here, MB.
        on_change: called when the gateway becomes overloaded, or is so no longer.
    """

    def __init__(
        self,
        plane: Plane,
        *,
        executor: Executor,
        source: Source,
        requesting: Requesting,
        config: MigrationConfig,
        load: Callable[[], Load],
        volumes_mb: Callable[[Iterable[str]], float],
        on_change: Callable[[], None],
    ) -> None:
        self.overload = Overload(config)
        self._plane = plane
        self._executor = executor
        self._source = source
        self._requesting = requesting
        self._config = config
        self._load = load
        self._volumes_mb = volumes_mb
        self._on_change = on_change
        self._moving: dict[str, asyncio.Task[None]] = {}

    @property
    def reason(self) -> str:
        """Why this gateway is no target of moves just now, for its status."""
        return self.overload.shown(time.monotonic())

    async def run(self) -> None:
        """Look at the load for as long as the gateway lives."""
        while True:
            await asyncio.sleep(self._config.every_s)
            try:
                self._look(time.monotonic())
            except Exception:  # supervision boundary: a defect here must not end the looks for good
                log.exception("a look at the load failed")

    def _look(self, now: float) -> None:
        load = self._load()
        before = self.overload.shown(now)
        reason = self.overload.look(load, now)
        if bool(before) != bool(self.overload.shown(now)):
            self._on_change()
        if not reason or self._executor.draining:
            return
        here = self._executor.here()
        runs = {run: self._candidate(run, each, now) for run, each in here.items()}
        chosen = self.overload.choose(
            load,
            [each for run, each in runs.items() if run not in self._moving],
            self._room(),
            under_way=[each for run, each in runs.items() if run in self._moving],
            now=now,
        )
        if not chosen:
            return
        self._requesting.put([here[run] for run in chosen], Reason.OVERLOAD, reason)
        for run in chosen:
            work = asyncio.create_task(self._move(run, here[run], reason), name=f"shed {run}")
            self._moving[run] = work
            work.add_done_callback(lambda _, run=run: self._moving.pop(run, None))

    async def _move(self, run: str, here: Here, reason: str) -> None:
        try:
            await self._requesting.move(here, Reason.OVERLOAD, reason)
        except SwiftbotError as error:
            self.overload.refused(run, time.monotonic())
            log.info("a run stays on an overloaded gateway", run=run, reason=error.message)
        else:
            self.overload.gave(time.monotonic())
            self._on_change()

    def _candidate(self, run: str, here: Here, now: float) -> Candidate:
        request = here.request
        mobility = self._source.mobility(request)
        return Candidate(
            id=run,
            mobile=may_leave(request, mobility, began=here.began, others=self._plane.members() - {self._plane.gateway}),
            began=here.began,
            cpu=request.need.cpu,
            elapsed_s=now - here.since,
            expected_s=request.expected_s,
            saved=self._executor.saved(run_of(request)),
            state_mb=self._volumes_mb(request.need.volumes) if request.need.volumes else 0.0,
            moves=request.moves,
        )

    def _room(self) -> Room:
        statuses = [
            each
            for name, each in self._plane.registry.gateways.items()
            if name in self._plane.members() and name != self._plane.gateway
        ]
        places = sum(free_places(each, self._config) for each in statuses)
        return Room(places=places, overloaded=1 + sum(bool(each.overloaded) for each in statuses))

    async def close(self) -> None:
        """Ask for nothing more; what coordinators have begun goes on."""
        works = list(self._moving.values())
        for work in works:
            work.cancel()
        await asyncio.gather(*works, return_exceptions=True)


def free_places(status: GatewayStatus, config: MigrationConfig) -> int:
    """How many runs a gateway may take as far as is known: none while it drains, is overloaded, or nearly is."""
    if status.draining or status.overloaded or status.pool_problem:
        return 0
    if config.cpu_high and status.cpu_percent / 100 > config.cpu_low:
        return 0
    return max(0, status.capacity - status.running - status.queue) if busy(status, config) < 1.0 else 0


class Migration:
    """All of it; `start` answers the verbs and begins to look at the load.

    Args:
        plane: the fleet.
        pool: this gateway's containers.
        executor: its runs.
        source: runs of it that are about to go.
        reservations: containers held for runs that come; the executor has it too.
        coordinator: of a task that is coordinated here; None for others.
        manifest: of a skill; NotFoundError when it is not known.
        config: section `[tasks.migration]`.
        load: what the gateway sees of itself.
        volumes_mb: size of the state volumes of these names here, MB.
        on_change: called when there is something to show in the status.
        audit: of operators' orders.
    """

    def __init__(
        self,
        plane: Plane,
        pool: Pool,
        *,
        executor: Executor,
        source: Source,
        reservations: Reservations,
        coordinator: Callable[[str], Coordinator | None],
        manifest: Callable[[str], SkillManifest],
        config: MigrationConfig,
        load: Callable[[], Load],
        volumes_mb: Callable[[Iterable[str]], float],
        on_change: Callable[[], None],
        audit: Audit,
    ) -> None:
        self._plane = plane
        self._source = source
        self._audit = audit
        self._moving = Moving(plane, coordinator=coordinator, manifest=manifest, config=config)
        requesting = Requesting(plane, self._moving)
        self.shedding = Shedding(
            plane, executor=executor, source=source, requesting=requesting, config=config, load=load,
            volumes_mb=volumes_mb, on_change=on_change,
        )  # fmt: skip
        self.draining = Draining(
            plane.gateway, executor=executor, source=source, requesting=requesting, config=config,
            on_change=on_change,
        )  # fmt: skip
        shedding = self.shedding
        self._target = Target(
            plane.gateway, executor, reservations=reservations, warm=pool.verbs.warm, config=config,
            refuses=lambda: shedding.reason, on_taken=lambda: shedding.overload.received(time.monotonic()),
        )  # fmt: skip
        self._looking: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Answer the verbs, and begin to look at the load."""
        rpc = self._plane.rpc
        signed = self._audit.signed
        rpc.register(keyspace.MIGRATE, signed("migrate", self._moving.migrate, when=_by_operator))
        rpc.register(keyspace.MIGRATE_HERE, self._moving.migrate_here)
        rpc.register(keyspace.MIGRATE_CANCEL, self._moving.cancel)
        rpc.register(keyspace.RUN_HOLD, self._source.hold)
        rpc.register(keyspace.RUN_RESUME, self._source.resume)
        rpc.register(keyspace.RUN_LEAVE, self._source.leave)
        rpc.register(keyspace.RUN_RESERVE, self._target.reserve)
        rpc.register(keyspace.RUN_UNRESERVE, self._target.unreserve)
        rpc.register(keyspace.DRAIN, signed("drain", self.draining.drain))
        rpc.register(keyspace.UNDRAIN, signed("undrain", self.draining.undrain))
        rpc.register(keyspace.DRAIN_STATE, self.draining.ask_state)
        self._looking = asyncio.create_task(self.shedding.run(), name="looks at the load")

    async def close(self) -> None:
        """Move nothing more."""
        if self._looking is not None:
            self._looking.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._looking
        await self.draining.close()
        await self.shedding.close()
        await self._moving.close()


def _by_operator(ask: MigrateAsk) -> bool:
    """Gateways ask for moves too, when they drain or have too much to do."""
    return ask.reason is Reason.OPERATOR
