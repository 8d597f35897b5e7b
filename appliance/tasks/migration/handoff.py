"""The two ends of a move: the gateway that a run leaves (source), and the one that it comes to (target).

**Source** (`Leaving`): the run is held at a safe point, saved, and ended when the record says that it goes on
elsewhere. While it is held it sends no robot commands and no notices: a command of the old attempt must not come
between those of the new one. A hold ends by itself, so that a coordinator that dies in the middle costs a run some
seconds and nothing else; what was held goes out then, or never if the run has been ended.

**Target** (`Taking`): a container is held for the run before anything is given up where it runs now. Who takes decides
by what is here at that moment, not by what others had heard of it; so many gateways may choose the same one at once,
and only as many runs come as it has room for.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import structlog
from msgspec import Struct

from appliance.errors import NotFoundError, RefusedError, SwiftbotError
from appliance.model import Need, Phase, RunRequest
from appliance.pool.api import WarmAsk, Warmed
from appliance.pool.pool import Call
from appliance.pool.selection import Decision
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.api import Held, HoldAsk, Reserved, RunAsk, RunStatus
from appliance.tasks.executor import Here
from appliance.tasks.migration.policy import Bucket
from appliance.tasks.orders import LEAVE_S
from appliance.tasks.settings import MigrationConfig

log = structlog.get_logger(__name__)

EFFECTS = ("command", "notify")
"""Calls that do something in the world; files and questions may go on."""


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


class Leaving:
    """Runs of this gateway that are about to leave it.

    Args:
        gateway: this gateway.
        runs: the executor.
        skills: manifests by skill.
        config: section `[tasks.migration]`.
    """

    def __init__(
        self, gateway: str, runs: SourceRuns, *, skills: dict[str, SkillManifest], config: MigrationConfig
    ) -> None:
        self._gateway = gateway
        self._runs = runs
        self._skills = skills
        self._config = config
        self._holds: dict[str, _Hold] = {}
        self._inside: Counter[str] = Counter()
        """Calls with effects in progress, by run."""
        self._outside = asyncio.Event()

    def mobility(self, request: RunRequest) -> str:
        """When a run may be moved, by its skill's manifest; a skill that is not known here stays."""
        manifest = self._skills.get(request.skill)
        return manifest.mobility if manifest is not None else "never"

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
        self._lift(run.run_id)
        self._holds[run.run_id] = _Hold(time.monotonic() + self._config.hold_s, asyncio.Event())
        try:
            if when != "anytime" and here.began:
                await self._until_outside(run.run_id)
            manifest = self._skills.get(here.request.skill)
            fresh = here.began and await self._runs.save(
                run, wait_s=self._config.checkpoint_wait_s, may_save=manifest is not None and manifest.checkpoints
            )
        except BaseException:
            self._lift(run.run_id)
            raise
        if run.run_id not in self._runs.here():
            self._lift(run.run_id)
            raise NotFoundError(f"{run.run_id} has ended meanwhile")
        return Held(began=here.began, fresh=fresh, saved=self._runs.saved(run), hold_s=self._config.hold_s)

    async def _until_outside(self, run_id: str) -> None:
        """Wait for the end of the commands that a run has sent; RefusedError when that takes too long."""
        try:
            async with asyncio.timeout(self._config.command_wait_s):
                while self._inside[run_id]:
                    self._outside.clear()
                    await self._outside.wait()
        except TimeoutError:
            raise RefusedError(
                f"{run_id} is in a robot command, and moves between commands only", remedy="try again when it has ended"
            ) from None

    async def resume(self, ask: RunAsk) -> RunStatus:
        """Let a run go on that was held."""
        self._lift(ask.run_id)
        return await self._runs.status(ask)

    async def leave(self, ask: RunAsk) -> RunStatus:
        """End a run that goes on elsewhere; answers when it has ended, or cannot be waited for any longer."""
        try:
            # Somewhat shorter than whoever asks waits for the answer.
            return await self._runs.end(ask, wait_s=LEAVE_S - 1.0)
        finally:
            self._lift(ask.run_id)

    def _lift(self, run_id: str) -> None:
        if (hold := self._holds.pop(run_id, None)) is not None:
            hold.lifted.set()


LEASE_S = 15.0
"""Longer than all that lies between reserving and the order: a command's end, a checkpoint, the end of the old run."""
WARM_S = 8.0
"""How long a container that is started for it may take."""
MOST_RESERVED = 64


class Pool(Protocol):
    """What is needed of the pool."""

    async def select(self, need: Need, *, allow_remote: bool) -> Decision:
        """Decide where a subtask runs; a local container is reserved."""
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


class Taking:
    """Runs that are moved to this gateway.

    Args:
        gateway: this gateway.
        pool: its containers.
        warm: has a container of an image started.
        runs: the executor.
        config: section `[tasks.migration]`.
    """

    def __init__(
        self,
        gateway: str,
        pool: Pool,
        runs: TargetRuns,
        *,
        warm: Callable[[WarmAsk], Awaitable[Warmed]],
        config: MigrationConfig,
    ) -> None:
        self._gateway = gateway
        self._pool = pool
        self._runs = runs
        self._warm = warm
        self._places: dict[str, _Place] = {}
        self._bucket = Bucket(config.moves_per_s, burst=2 * config.moves_per_s)
        self.refuses: Callable[[], str] = lambda: ""
        """Why runs are not taken just now: this gateway gives some away itself."""
        self.on_taken: Callable[[], None] = lambda: None

    async def reserve(self, request: RunRequest) -> Reserved:
        """Hold a container for a run that will be moved here; one is started if none is ready.

        Raises:
            RefusedError: it drains, is overloaded itself, takes enough already, or has no room.
            PoolError, NotFoundError: no container can be had, or there is no such image.
        """
        self._forget(time.monotonic())
        self._runs.check(request)
        if why := self.refuses():
            raise RefusedError(f"{self._gateway} takes no runs: {why}")
        if len(self._places) >= MOST_RESERVED or not self._bucket.take(time.monotonic()):
            raise RefusedError(f"{self._gateway} takes as many runs as it may already", remedy="try another, or later")
        decision = await self._pool.select(request.need, allow_remote=False)
        if decision.phase is not Phase.LOCAL_WARM:
            # Started before the run is ended where it is: meanwhile it goes on there.
            await self._warm(WarmAsk(image=request.need.image, keep_s=2 * LEASE_S, wait_s=WARM_S))
            decision = await self._pool.select(request.need, allow_remote=False)
        if decision.phase is not Phase.LOCAL_WARM or not self._pool.keep(decision, LEASE_S):
            raise RefusedError(f"{self._gateway} has no container of {request.need.image} to hold for it")
        self._drop(request.run_id)
        self._places[request.run_id] = _Place(decision, time.monotonic() + LEASE_S)
        self.on_taken()
        return Reserved(
            gateway=self._gateway, container=decision.container or "", phase=decision.phase, lease_s=LEASE_S
        )

    def reserved(self, request: RunRequest) -> Decision | None:
        """Return what is held for a run whose order has come; once."""
        place = self._places.pop(request.run_id, None)
        return place.decision if place is not None and place.until > time.monotonic() else None

    async def unreserve(self, ask: RunAsk) -> RunStatus:
        """Let go of a container that was held for a run which does not come."""
        self._drop(ask.run_id)
        return await self._runs.status(ask)

    def _drop(self, run_id: str) -> None:
        if (place := self._places.pop(run_id, None)) is not None:
            try:
                self._pool.release(place.decision)
            except SwiftbotError as error:
                log.info("a container that was held is gone", run=run_id, reason=str(error))

    def _forget(self, now: float) -> None:
        """Forget those whose lease is over: the pool has freed them by itself."""
        for run_id in [each for each, place in self._places.items() if place.until <= now]:
            del self._places[run_id]
