"""A run that comes to this gateway: a container is held for it before anything is given up where it runs now.

Who takes decides by what is here at that moment, not by what others had heard of it; so many gateways may choose the
same one at once, and only as many runs come as it has room for.
"""

import time
from collections.abc import Awaitable, Callable
from typing import Protocol

import structlog
from msgspec import Struct

from appliance.errors import RefusedError, SwiftbotError
from appliance.model import Need, Phase, RunRequest
from appliance.pool.api import WarmAsk, Warmed
from appliance.pool.selection import Decision
from appliance.tasks.api import RunAsk, RunStatus
from appliance.tasks.migration.api import Reserved
from appliance.tasks.migration.budget import Bucket
from appliance.tasks.migration.settings import MigrationConfig

log = structlog.get_logger(__name__)

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


class Runs(Protocol):
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
        runs: Runs,
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
