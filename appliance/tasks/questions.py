"""Questions about tasks, and the wish to end one: answered here where the task is driven, else by whoever drives it."""

import asyncio
import contextlib
import time
from collections.abc import Mapping

from msgspec.structs import replace

from appliance.errors import NotFoundError, UnreachableError
from appliance.model import TaskRecord, TaskState, Word
from appliance.plane.keys import check_name
from appliance.plane.node import Plane
from appliance.tasks.api import TaskAsk, TaskList, TasksAsk, WhyAsk
from appliance.tasks.bounds import read_record
from appliance.tasks.driver import Driver
from appliance.tasks.durations import Durations
from appliance.tasks.explaining import explain
from appliance.tasks.listing import newest_tasks
from appliance.tasks.scheduling import Scheduler
from appliance.tasks.steering.api import CancelTaskAsk
from appliance.tasks.surroundings import CancelAsked, task_key
from appliance.tasks.why import TaskWhy, why

CANCEL_S = 1.5
"""How long the answer to a cancel waits for the record that it makes: less than whoever asks waits for the answer."""


class Questions:
    """Answers on one gateway. `sweep`: set to have tasks taken up that are owned here and not driven yet."""

    def __init__(
        self,
        plane: Plane,
        drivers: Mapping[str, Driver],
        *,
        scheduler: Scheduler,
        durations: Durations,
        sweep: asyncio.Event,
    ) -> None:
        self._plane = plane
        self._drivers = drivers
        self._scheduler = scheduler
        self._durations = durations
        self._sweep = sweep

    async def task(self, ask: TaskAsk) -> TaskRecord:
        """Return a task's record; NotFoundError when there is none.

        A driver's copy is the answer only where the record is this gateway's and has not changed under the driver:
        after a partition the other side's may stand.
        """
        driver = self._drivers.get(ask.id)
        if driver is not None and not driver.overtaken and self._plane.dht.owns(task_key(ask.id)):
            return driver.told
        stored = await self._plane.dht.read(task_key(check_name(ask.id, "task")))
        if stored is None or stored.deleted:
            raise NotFoundError(f"there is no task {ask.id}", remedy="see `swiftbot task list`")
        return read_record(stored.value)

    async def why(self, ask: WhyAsk) -> TaskWhy:
        """Tell why a task waits, or was served where it was; its coordinator knows what is in no record."""
        if driver := self._drivers.get(ask.id):
            return await explain(
                driver.record,
                ask.subtask,
                plane=self._plane,
                scheduler=self._scheduler,
                durations=self._durations,
                elapsed_s=driver.elapsed_s,
            )
        record = await self.task(TaskAsk(id=ask.id))
        owner = self._plane.ring.owner(task_key(ask.id))
        if not (record.state.final or ask.here or owner == self._plane.gateway):
            return await self._plane.rpc.call(owner, "why", replace(ask, here=True), TaskWhy)
        return why(record, ask.subtask)

    async def tasks(self, ask: TasksAsk) -> TaskList:
        """Return the newest tasks, of the whole fleet or of this gateway's shard."""
        return await newest_tasks(self._plane, ask, [driver.record for driver in self._drivers.values()])

    async def cancel(self, ask: CancelTaskAsk) -> TaskRecord:
        """Stop a task wherever it is coordinated; returns the record that came of it: see `cancel_here`."""
        if ask.id in self._drivers:
            return await self.cancel_here(ask)
        record = await self.task(TaskAsk(id=ask.id))
        if record.state.final:
            return record
        owner = await self._plane.owner_of(task_key(ask.id))
        if owner == self._plane.gateway:
            self._sweep.set()
            return await self.cancel_here(ask)
        return await self._plane.rpc.call(owner, "cancel_here", ask, TaskRecord)

    async def cancel_here(self, ask: CancelTaskAsk) -> TaskRecord:
        """Stop a task that is coordinated here; waits a moment for a driver that is being set up.

        Returns the record as it is written then: cancelled, cancelling while runs are being ended, or how it had ended
        before the cancel came.

        Raises:
            UnreachableError: nobody coordinates it just now.
        """
        for _ in range(20):
            if driver := self._drivers.get(ask.id):
                driver.tell(CancelAsked(Word(by=ask.by, why=ask.why, act=ask.act, at_ns=time.time_ns())))
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(CANCEL_S):
                        await driver.ending.wait()
                record = await self.task(TaskAsk(id=ask.id))
                if not driver.ending.is_set() or record.state.final or record.state is TaskState.CANCELLING:
                    return record  # what is not written in time stays noted: the record says that it is not confirmed
                # It has stepped down, since the record changed under it: the next one is told.
                self._sweep.set()
            else:
                record = await self.task(TaskAsk(id=ask.id))
            if record.state.final:
                return record
            await asyncio.sleep(0.1)
        raise UnreachableError(f"nobody coordinates task {ask.id} just now", remedy="try again in a second")
