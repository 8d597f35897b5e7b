"""A gateway gives runs away while it is overloaded: reads its own figures, asks `overload`, and requests moves."""

import asyncio
import time
from collections.abc import Callable, Iterable

import structlog

from appliance.errors import SwiftbotError
from appliance.model import GatewayStatus
from appliance.plane.node import Plane
from appliance.tasks.api import RunAsk
from appliance.tasks.executor import Executor, Here
from appliance.tasks.migration.api import Reason
from appliance.tasks.migration.closest import busy
from appliance.tasks.migration.leaving import Leaving
from appliance.tasks.migration.overload import Candidate, Load, Overload, Room, may_leave
from appliance.tasks.migration.requesting import Requesting
from appliance.tasks.migration.settings import MigrationConfig

log = structlog.get_logger(__name__)


class Shedding:
    """Watches this gateway's load and has runs moved away from it.

    Args:
        plane: the fleet.
        executor: the runs here.
        leaving: which of them may be moved.
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
        leaving: Leaving,
        requesting: Requesting,
        config: MigrationConfig,
        load: Callable[[], Load],
        volumes_mb: Callable[[Iterable[str]], float],
        on_change: Callable[[], None],
    ) -> None:
        self.overload = Overload(config)
        self._plane = plane
        self._executor = executor
        self._leaving = leaving
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
        mobility = self._leaving.mobility(request)
        ask = RunAsk(task=request.task, subtask=request.subtask, attempt=request.attempt)
        return Candidate(
            id=run,
            mobile=may_leave(request, mobility, began=here.began, others=self._plane.members() - {self._plane.gateway}),
            began=here.began,
            cpu=request.need.cpu,
            elapsed_s=now - here.since,
            expected_s=request.expected_s,
            saved=self._executor.saved(ask),
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
