"""Migration of one gateway, put together: what gives runs away, what takes them, what moves those it coordinates."""

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterable

from appliance.model import RunRequest
from appliance.plane.node import Plane
from appliance.pool.pool import Pool
from appliance.tasks.api import RunAsk
from appliance.tasks.executor import Executor
from appliance.tasks.migration.api import DrainAsk, DrainStateAsk, HoldAsk, MigrateAsk, MoveAsk, Reason, UndrainAsk
from appliance.tasks.migration.draining import Draining
from appliance.tasks.migration.leaving import Leaving
from appliance.tasks.migration.moving import Moving, Tasks
from appliance.tasks.migration.overload import Load
from appliance.tasks.migration.requesting import Requesting
from appliance.tasks.migration.settings import MigrationConfig
from appliance.tasks.migration.shedding import Shedding
from appliance.tasks.migration.taking import Taking
from appliance.tasks.steering.audit import Audit


class Migration:
    """All of it; `start` answers the verbs and begins to look at the load.

    Args:
        plane: the fleet.
        pool: this gateway's containers.
        executor: its runs.
        leaving: made before the others, since the handlers' calls go through it.
        tasks: the tasks that are coordinated here.
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
        leaving: Leaving,
        tasks: Tasks,
        config: MigrationConfig,
        load: Callable[[], Load],
        volumes_mb: Callable[[Iterable[str]], float],
        on_change: Callable[[], None],
        audit: Audit,
    ) -> None:
        self._plane = plane
        self._leaving = leaving
        self._audit = audit
        self._moving = Moving(plane, tasks, config)
        requesting = Requesting(plane, self._moving)
        self.shedding = Shedding(
            plane, executor=executor, leaving=leaving, requesting=requesting, config=config, load=load,
            volumes_mb=volumes_mb, on_change=on_change,
        )  # fmt: skip
        self.draining = Draining(
            plane.gateway, executor=executor, leaving=leaving, requesting=requesting, config=config,
            on_change=on_change,
        )  # fmt: skip
        self._taking = Taking(plane.gateway, pool, executor, warm=pool.verbs.warm, config=config)
        self._taking.refuses = lambda: self.shedding.reason
        self._taking.on_taken = lambda: self.shedding.overload.received(time.monotonic())
        executor.reserved = self._taking.reserved
        self._looking: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Answer the verbs, and begin to look at the load."""
        rpc = self._plane.rpc
        signed = self._audit.signed
        rpc.register("migrate", MigrateAsk, signed("migrate", self._moving.migrate, when=_by_operator))
        rpc.register("migrate_here", MigrateAsk, self._moving.migrate_here)
        rpc.register("migrate_cancel", MoveAsk, self._moving.cancel)
        rpc.register("run_hold", HoldAsk, self._leaving.hold)
        rpc.register("run_resume", RunAsk, self._leaving.resume)
        rpc.register("run_leave", RunAsk, self._leaving.leave)
        rpc.register("run_reserve", RunRequest, self._taking.reserve)
        rpc.register("run_unreserve", RunAsk, self._taking.unreserve)
        rpc.register("drain", DrainAsk, signed("drain", self.draining.drain))
        rpc.register("undrain", UndrainAsk, signed("undrain", self.draining.undrain))
        rpc.register("drain_state", DrainStateAsk, self.draining.ask_state)
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
