"""Takes an operator's word on the plan that is proposed for a task after a failure to whoever coordinates the task."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping

from appliance.errors import RefusedError, UnreachableError
from appliance.model import TaskRecord
from appliance.plane.node import Plane
from appliance.tasks.api import AgreeAsk, TaskAsk
from appliance.tasks.bounds import clean
from appliance.tasks.driver import Driver
from appliance.tasks.surroundings import Agreement, task_key

MAX_BY = 120


class Agreeing:
    """The verbs `agree` (any gateway) and `agree_here` (the coordinator)."""

    def __init__(
        self, plane: Plane, drivers: Mapping[str, Driver], task: Callable[[TaskAsk], Awaitable[TaskRecord]]
    ) -> None:
        self._plane = plane
        self._drivers = drivers
        self._task = task

    def register(self) -> None:
        """Answer RPC."""
        self._plane.rpc.register("agree", AgreeAsk, self.agree)
        self._plane.rpc.register("agree_here", AgreeAsk, self.agree_here)

    async def agree(self, ask: AgreeAsk) -> TaskRecord:
        """Pass an operator's word on; returns the task's record at that moment.

        Raises:
            NotFoundError: there is no such task.
            RefusedError: nothing of it waits for an operator.
            UnreachableError: nobody coordinates it just now.
        """
        if ask.id in self._drivers:
            return await self.agree_here(ask)
        _checked(await self._task(TaskAsk(id=ask.id)))
        owner = await self._plane.owner_of(task_key(ask.id))
        if owner == self._plane.gateway:
            return await self.agree_here(ask)
        return await self._plane.rpc.call(owner, "agree_here", ask, TaskRecord)

    async def agree_here(self, ask: AgreeAsk) -> TaskRecord:
        """Tell the task's driver; waits a moment for one that is being set up."""
        for _ in range(20):
            if driver := self._drivers.get(ask.id):
                _checked(driver.record)
                driver.tell(Agreement(agree=ask.agree, by=clean(ask.by, MAX_BY)))
                return driver.record
            _checked(await self._task(TaskAsk(id=ask.id)))
            await asyncio.sleep(0.1)
        raise UnreachableError(f"nobody coordinates task {ask.id} just now", remedy="try again in a second")


def _checked(record: TaskRecord) -> None:
    if record.state.final or record.proposal is None or not record.proposal.waits:
        raise RefusedError(
            f"nothing of task {record.id} waits for an operator's word: it is {record.state}",
            remedy=f"see `swiftbot task show {record.id}`",
        )
