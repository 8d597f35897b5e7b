"""A run that leaves this gateway: held at a safe point, saved, ended when the record says that it goes on elsewhere.

While it is held it sends no robot commands and no notices: a command of the old attempt must not come between those of
the new one. A hold ends by itself, so that a coordinator that dies in the middle costs a run some seconds and nothing
else; what was held goes out then, or never if the run has been ended.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import structlog
from msgspec import Struct

from appliance.errors import NotFoundError, RefusedError
from appliance.model import RunRequest
from appliance.pool.pool import Call
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.api import RunAsk, RunStatus
from appliance.tasks.executor import Here
from appliance.tasks.migration.api import Held, HoldAsk
from appliance.tasks.migration.settings import MigrationConfig
from appliance.tasks.orders import LEAVE_S

log = structlog.get_logger(__name__)

EFFECTS = ("command", "notify")
"""Calls that do something in the world; files and questions may go on."""


class Runs(Protocol):
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

    def __init__(self, gateway: str, runs: Runs, *, skills: dict[str, SkillManifest], config: MigrationConfig) -> None:
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
