"""Handing a run over to another gateway: reserve there, transfer, commit. The one way in which work moves.

Three callers hand runs over, each when it must, to gateways that it chooses (`Offers`):

    caller               the run           reserve         transfer                     commit
    `offload.Choosing`   is not accepted   by the order    nothing                      the target's answer
    `offload.Passing`    waits here        by the order    leaves the queue here        the target's answer
    `migration.Moving`   is in progress    `run_reserve`   held and saved: `run_hold`   its record is written

A run that has not begun has nothing to transfer, so the order to run it reserves and commits in one message
(`Handoff.begin`). One that is in progress goes on where it is until a container is held for it elsewhere
(`Handoff.reserve`, `hold`, `commit`); what fails before the commit is undone.

**Target** (`Reservations`, `Target`): who takes a run decides by what is here at that moment, not by what others had
heard of it; so many gateways may choose the same one at once, and only as many runs come as it has room for.

**Source** (`Holds`, `Source`): the run is held at a safe point, saved, and ended when the record says that it goes on
elsewhere. While it is held it sends no robot commands and no notices: a command of the old attempt must not come
between those of the new one. A hold ends by itself, so that a coordinator that dies in the middle costs a run some
seconds and nothing else; what was held goes out then, or never if the run has been ended.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

import structlog
from msgspec import Struct

from appliance.errors import DeadlineError, NotFoundError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import Need, Phase, RunAccepted, RunRequest, keyspace
from appliance.model.keys import Verb
from appliance.model.pool_api import WarmAsk, Warmed
from appliance.model.task_api import Held, HoldAsk, Reserved, RunAsk, RunStatus
from appliance.plane.node import Plane
from appliance.pool.fair_queue import Turn, turn_of
from appliance.pool.pool import Call
from appliance.pool.selection import Decision
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.bucket import Bucket
from appliance.tasks.orders import LEAVE_S
from appliance.tasks.placement import bytes_by_gateway
from appliance.tasks.settings import MigrationConfig

log = structlog.get_logger(__name__)

ORDER_S = 2.0
"""How long another gateway may take to accept a run."""
RESERVE_S = 10.0
"""How long it may take to hold a container: it may have to start one."""
HOLD_S = 6.0
"""How long the run's gateway may take to bring it to a safe point."""
UNDO_S = 2.0
"""How long a gateway may take to undo what was not committed; what it does not undo ends by itself."""

Answer = TypeVar("Answer", RunAccepted, Reserved)


# --- handing over -----------------------------------------------------------------------------------------------


class Outcome(Struct, frozen=True, kw_only=True):
    """What came of asking a gateway to take a run."""

    taken: bool | None
    """Whether it has the run, or holds a container for it; None: it gave no answer, and may run it."""
    container: str = ""
    """The container, if it was taken."""
    reason: str = ""
    """Why not, otherwise."""


class Offers(Protocol):
    """Gateways that may take one run, best first."""

    async def best(self) -> str:
        """Return the gateway to ask next; empty when there is none."""
        ...

    def note(self, outcome: Outcome) -> None:
        """Note what came of asking the one that was returned last."""
        ...


def may_run(error: SwiftbotError) -> bool:
    """Whether an order to run that ended so may have been taken: it had no answer, but may have arrived.

    The same attempt must not be begun in a second place then, for nothing fences the two off from each other. Only the
    next attempt is safe, which ends this one wherever it is.
    """
    return isinstance(error, DeadlineError) or (isinstance(error, UnreachableError) and error.sent)


class Handoff:
    """One run on its way to another gateway. Leaving the context before `commit` undoes what was done.

    Args:
        plane: the fleet.
        request: the order, as the target is to get it.
    """

    def __init__(self, plane: Plane, request: RunRequest) -> None:
        self._plane = plane
        self._request = request
        self._undo = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        """Begin; nothing is done yet."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Undo what was not committed, the last first."""
        await self._undo.aclose()

    async def begin(self, offers: Offers) -> RunAccepted | None:
        """Have a run that has not begun accepted elsewhere; None when nobody takes it.

        Raises:
            UnreachableError: a gateway that was asked did not say whether it runs it.
        """
        return await self._ask(offers, keyspace.RUN, timeout_s=ORDER_S)

    async def reserve(self, offers: Offers) -> Reserved | None:
        """Have a container held for it elsewhere until the commit; None when nobody does."""
        reserved = await self._ask(offers, keyspace.RUN_RESERVE, timeout_s=RESERVE_S)
        if reserved is not None:
            self._otherwise(reserved.gateway, keyspace.RUN_UNRESERVE, run_of(self._request))
        return reserved

    async def hold(self, source: str, run: RunAsk) -> Held:
        """Have the attempt that runs at the source brought to a safe point and saved; it goes on unless committed."""
        ask = HoldAsk(task=run.task, subtask=run.subtask, attempt=run.attempt)
        # Also when the answer is lost: it may be held all the same.
        self._otherwise(source, keyspace.RUN_RESUME, run)
        return await self._plane.rpc.call(source, keyspace.RUN_HOLD, ask, timeout_s=HOLD_S)

    def commit(self) -> None:
        """From here on the new attempt is the one that counts: nothing is undone any more."""
        self._undo.pop_all()

    async def _ask(self, offers: Offers, verb: Verb[RunRequest, Answer], *, timeout_s: float) -> Answer | None:
        while gateway := await offers.best():
            try:
                answer = await self._plane.rpc.call(gateway, verb, self._request, timeout_s=timeout_s)
            except SwiftbotError as error:
                # A container that is held without need is free again after its lease; a run would be there twice.
                if verb is keyspace.RUN and may_run(error):
                    offers.note(Outcome(taken=None, reason=error.message))
                    raise UnreachableError(f"{gateway} did not say whether it runs {self._request.run_id}") from error
                if verb is keyspace.RUN:
                    self._plane.session.refuse(
                        "stale offer", key=gateway, run=self._request.run_id, reason=error.message
                    )
                offers.note(Outcome(taken=False, reason=error.message))
            else:
                offers.note(Outcome(taken=True, container=answer.container))
                return answer
        return None

    def _otherwise(self, gateway: str, verb: Verb[RunAsk, RunStatus], run: RunAsk) -> None:
        """Have this asked if nothing is committed, also when the move is cancelled."""

        async def undo() -> None:
            with contextlib.suppress(SwiftbotError):
                await self._plane.rpc.call(gateway, verb, run, timeout_s=UNDO_S)

        async def shielded() -> None:
            await asyncio.shield(asyncio.create_task(undo(), name=f"undo: {verb.name} {run.run_id}"))

        self._undo.push_async_callback(shielded)


def run_of(request: RunRequest) -> RunAsk:
    """Name the attempt that an order is about."""
    return RunAsk(task=request.task, subtask=request.subtask, attempt=request.attempt)


# --- the gateway that a run leaves --------------------------------------------------------------------------------

EFFECTS = ("command", "notify")
"""Calls that do something in the world; files and questions may go on."""


class Here(Struct):
    """A run in progress on this gateway."""

    request: RunRequest
    since: float
    """When it was accepted, on this machine's monotonic clock."""
    began: bool = False
    """Whether its handler has run its first line."""


class SourceRuns(Protocol):
    """What is needed of the executor."""

    def here(self) -> dict[str, Here]:
        """Return the runs in progress by their ids."""
        ...

    async def save(self, ask: RunAsk, *, wait_s: float, may_save: bool) -> bool:
        """Have a run's newest checkpoint kept now."""
        ...

    def saved(self, ask: RunAsk) -> bool:
        """Whether there is a checkpoint of it."""
        ...

    async def end(self, ask: RunAsk, *, wait_s: float) -> RunStatus:
        """Have a run end, and wait for it."""
        ...

    async def status(self, ask: RunAsk) -> RunStatus:
        """Tell what is known of a run."""
        ...


class _Hold(Struct):
    until: float
    lifted: asyncio.Event


class Holds:
    """Runs that are held for a move: their commands wait. Handlers' calls with effects go through `guard`."""

    def __init__(self) -> None:
        self._holds: dict[str, _Hold] = {}
        self._inside: Counter[str] = Counter()
        """Calls with effects in progress, by run."""
        self._outside = asyncio.Event()

    async def guard(self, call: Call, carry_out: Callable[[Call], Awaitable[dict[str, Any]]]) -> dict[str, Any]:
        """Carry out a handler's call, when its run is not held."""
        if call.name not in EFFECTS:
            return await carry_out(call)
        run_id = call.run.run_id
        while (hold := self._holds.get(run_id)) is not None and (left_s := hold.until - time.monotonic()) > 0:
            try:
                async with asyncio.timeout(left_s):
                    await hold.lifted.wait()
            except TimeoutError:
                log.warning("a run was held for a move that did not come", run=run_id)
        self._inside[run_id] += 1
        try:
            return await carry_out(call)
        finally:
            self._inside[run_id] -= 1
            if not self._inside[run_id]:
                del self._inside[run_id]
            self._outside.set()

    def hold(self, run_id: str, for_s: float) -> None:
        """Have a run's next commands wait, until `lift` or for so long."""
        self.lift(run_id)
        self._holds[run_id] = _Hold(time.monotonic() + for_s, asyncio.Event())

    def lift(self, run_id: str) -> None:
        """Let a run's commands go on."""
        if (hold := self._holds.pop(run_id, None)) is not None:
            hold.lifted.set()

    async def until_outside(self, run_id: str, within_s: float) -> None:
        """Wait for the end of the commands that a run has sent; RefusedError when that takes too long."""
        try:
            async with asyncio.timeout(within_s):
                while self._inside[run_id]:
                    self._outside.clear()
                    await self._outside.wait()
        except TimeoutError:
            raise RefusedError(
                f"{run_id} is in a robot command, and moves between commands only", remedy="try again when it has ended"
            ) from None


class Source:
    """Runs of this gateway that are about to leave it.

    Args:
        gateway: this gateway.
        runs: the executor.
        holds: makes handlers' calls wait.
        skills: manifests by skill.
        config: section `[tasks.migration]`.
    """

    def __init__(
        self,
        gateway: str,
        runs: SourceRuns,
        *,
        holds: Holds,
        skills: dict[str, SkillManifest],
        config: MigrationConfig,
    ) -> None:
        self._gateway = gateway
        self._runs = runs
        self._holds = holds
        self._skills = skills
        self._config = config

    def mobility(self, request: RunRequest) -> str:
        """When a run may be moved, by its skill's manifest; a skill that is not known here stays."""
        manifest = self._skills.get(request.skill)
        return manifest.mobility if manifest is not None else "never"

    async def hold(self, ask: HoldAsk) -> Held:
        """Make a run ready to be left: at a point where it is not in a command, with a checkpoint as fresh as can be.

        Raises:
            NotFoundError: it does not run here (any more).
            RefusedError: it may not be moved, or not now; it goes on as before.
        """
        run = RunAsk(task=ask.task, subtask=ask.subtask, attempt=ask.attempt)
        here = self._runs.here().get(run.run_id)
        if here is None:
            raise NotFoundError(f"{run.run_id} does not run on {self._gateway}", remedy="it has ended, or moved")
        when = self.mobility(here.request)
        if when == "never" and here.began:
            raise RefusedError(
                f"{here.request.skill} commands a robot and may not be moved",
                remedy="wait until it ends; its manifest says that it must not migrate (`migratable`)",
            )
        self._holds.hold(run.run_id, self._config.hold_s)
        try:
            if when != "anytime" and here.began:
                await self._holds.until_outside(run.run_id, self._config.command_wait_s)
            manifest = self._skills.get(here.request.skill)
            fresh = here.began and await self._runs.save(
                run, wait_s=self._config.checkpoint_wait_s, may_save=manifest is not None and manifest.checkpoints
            )
        except BaseException:
            self._holds.lift(run.run_id)
            raise
        if run.run_id not in self._runs.here():
            self._holds.lift(run.run_id)
            raise NotFoundError(f"{run.run_id} has ended meanwhile")
        return Held(began=here.began, fresh=fresh, saved=self._runs.saved(run), hold_s=self._config.hold_s)

    async def resume(self, ask: RunAsk) -> RunStatus:
        """Let a run go on that was held."""
        self._holds.lift(ask.run_id)
        return await self._runs.status(ask)

    async def leave(self, ask: RunAsk) -> RunStatus:
        """End a run that goes on elsewhere; answers when it has ended, or cannot be waited for any longer."""
        try:
            # Somewhat shorter than the asker waits for the answer.
            return await self._runs.end(ask, wait_s=LEAVE_S - 1.0)
        finally:
            self._holds.lift(ask.run_id)


# --- the gateway that it comes to ---------------------------------------------------------------------------------

LEASE_S = 15.0
"""Longer than all that lies between reserving and the order: a command's end, a checkpoint, the end of the old run."""
WARM_S = 8.0
"""How long a container that is started for it may take."""
MOST_RESERVED = 64


class Pool(Protocol):
    """What is needed of the pool."""

    async def select(
        self, need: Need, *, allow_remote: bool, inputs: Mapping[str, int] | None = None, turn: Turn | None = None
    ) -> Decision:
        """Decide where a subtask runs; a local container is reserved."""
        ...

    def has_room(self, need: Need) -> bool:
        """Whether a container could be started at once for a run that comes now."""
        ...

    def keep(self, decision: Decision, lease_s: float) -> bool:
        """Hold it for longer."""
        ...

    def release(self, decision: Decision) -> None:
        """Let go of it."""
        ...


class TargetRuns(Protocol):
    """What is needed of the executor."""

    def check(self, request: RunRequest) -> None:
        """Raise RefusedError when an order could not begin here."""
        ...

    async def status(self, ask: RunAsk) -> RunStatus:
        """Tell what is known of a run."""
        ...


class _Place(Struct, frozen=True):
    decision: Decision
    until: float


class Reservations:
    """Containers of this gateway for runs that come from others: chosen as they come, or held before, for one attempt.

    Args:
        gateway: this gateway.
        pool: its containers.
    """

    def __init__(self, gateway: str, pool: Pool) -> None:
        self._gateway = gateway
        self._pool = pool
        self._places: dict[str, _Place] = {}

    @property
    def count(self) -> int:
        """How many are held."""
        return len(self._places)

    async def reserve(self, request: RunRequest, *, start: Callable[[], Awaitable[object]] | None = None) -> Decision:
        """Choose a container here, for a run that comes from elsewhere; a ready one is reserved for the usual lease.

        Args:
            request: the order.
            start: starts a container, if none is ready.

        Raises:
            RefusedError: none is ready, and the order does not say that a new one will do, or there is no room for it.
            PoolError, NotFoundError: no container can be had, or there is no such image.
        """
        need, inputs = request.need, bytes_by_gateway(request.inputs)
        decision = await self._pool.select(need, allow_remote=False, inputs=inputs, turn=turn_of(request))
        if decision.phase is Phase.COLD and start is not None:
            await start()
            decision = await self._pool.select(need, allow_remote=False, inputs=inputs, turn=turn_of(request))
        if decision.phase is Phase.COLD and not (request.new_container and self._pool.has_room(need)):
            what = "room for a new container" if request.new_container else f"ready container of {need.image}"
            raise RefusedError(f"{self._gateway} has no {what} any more")
        return decision

    def hold(self, run_id: str, decision: Decision) -> bool:
        """Hold a reserved container until its run is ordered, in place of any held for it before; False: it is gone."""
        if not self._pool.keep(decision, LEASE_S):
            return False
        self.drop(run_id)
        self._places[run_id] = _Place(decision, time.monotonic() + LEASE_S)
        return True

    def take(self, request: RunRequest) -> Decision | None:
        """Return what is held for a run whose order has come; once."""
        place = self._places.pop(request.run_id, None)
        return place.decision if place is not None and place.until > time.monotonic() else None

    def drop(self, run_id: str) -> None:
        """Let go of what is held for a run."""
        if (place := self._places.pop(run_id, None)) is not None:
            try:
                self._pool.release(place.decision)
            except SwiftbotError as error:
                log.info("a container that was held is gone", run=run_id, reason=str(error))

    def forget_expired(self) -> None:
        """Forget those whose lease is over: the pool has freed them by itself."""
        now = time.monotonic()
        for run_id in [run_id for run_id, place in self._places.items() if place.until <= now]:
            del self._places[run_id]


class Target:
    """Runs that are moved to this gateway.

    Args:
        gateway: this gateway.
        runs: the executor.
        reservations: what is held; the executor takes from it when the order comes.
        warm: has a container of an image started.
        config: section `[tasks.migration]`.
        refuses: why runs are not taken just now ("": they are): this gateway gives some away itself.
        on_taken: called when a container is held for another run.
    """

    def __init__(
        self,
        gateway: str,
        runs: TargetRuns,
        *,
        reservations: Reservations,
        warm: Callable[[WarmAsk], Awaitable[Warmed]],
        config: MigrationConfig,
        refuses: Callable[[], str],
        on_taken: Callable[[], None],
    ) -> None:
        self._gateway = gateway
        self._runs = runs
        self._reservations = reservations
        self._warm = warm
        self._bucket = Bucket(config.moves_per_s, burst=2 * config.moves_per_s)
        self._refuses = refuses
        self._on_taken = on_taken

    async def reserve(self, request: RunRequest) -> Reserved:
        """Hold a container for a run that will be moved here; one is started if none is ready.

        Raises:
            RefusedError: it drains, is overloaded itself, takes enough already, or has no room.
            PoolError, NotFoundError: no container can be had, or there is no such image.
        """
        self._reservations.forget_expired()
        self._runs.check(request)
        if why := self._refuses():
            raise RefusedError(f"{self._gateway} takes no runs: {why}")
        if self._reservations.count >= MOST_RESERVED or not self._bucket.take(time.monotonic()):
            raise RefusedError(f"{self._gateway} takes as many runs as it may already", remedy="try another, or later")
        # Started before the run is ended where it is: meanwhile it goes on there.
        wanted = WarmAsk(image=request.need.image, keep_s=2 * LEASE_S, wait_s=WARM_S)
        decision = await self._reservations.reserve(request, start=lambda: self._warm(wanted))
        if not self._reservations.hold(request.run_id, decision):
            raise RefusedError(f"{self._gateway} has no container of {request.need.image} to hold for it")
        self._on_taken()
        return Reserved(
            gateway=self._gateway, container=decision.container or "", phase=decision.phase, lease_s=LEASE_S
        )

    async def unreserve(self, ask: RunAsk) -> RunStatus:
        """Let go of a container that was held for a run which does not come."""
        self._reservations.drop(ask.run_id)
        return await self._runs.status(ask)
