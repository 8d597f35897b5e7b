"""Takes operators' orders on tasks to whoever coordinates the task, and begins tasks again that have ended."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import TypeVar

from msgspec.structs import replace

from appliance.errors import ConflictError, DeadlineError, NotFoundError, UnreachableError
from appliance.model import TaskRecord, VersionVector
from appliance.plane.node import Plane
from appliance.tasks.api import TaskAsk
from appliance.tasks.bounds import read_record
from appliance.tasks.driver import Driver
from appliance.tasks.keeper import Keeper, SupersededError
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.steering.api import ActsAsk, ApproveAsk, PauseAsk, RejectAsk, ResumeAsk, RetryAsk
from appliance.tasks.steering.audit import Audit
from appliance.tasks.steering.deciding import may_pause, may_resume, may_retry, proposal_for
from appliance.tasks.steering.driving import revived
from appliance.tasks.surroundings import Steered, task_key
from appliance.tasks.unknown import unknown, with_unknown

STEER_S = 4.0
"""How long an order may take to be written: a replicated write takes milliseconds, an inbox that is full a second."""
TRIES = 20

Ask = ApproveAsk | RejectAsk | PauseAsk | ResumeAsk | RetryAsk
A = TypeVar("A", ApproveAsk, RejectAsk, PauseAsk, ResumeAsk, RetryAsk)


class OperatorVerbs:
    """The verbs `approve`, `reject`, `pause`, `resume` and `retry` of one gateway.

    Args:
        plane: the fleet.
        drivers: of the tasks that are coordinated here.
        task: returns a task's record.
        drive: begins to drive a record at a version, as it is stored.
        published: hears of each transition that is published.
        audit: of this gateway.
    """

    def __init__(
        self,
        plane: Plane,
        drivers: Mapping[str, Driver],
        *,
        task: Callable[[TaskAsk], Awaitable[TaskRecord]],
        drive: Callable[[TaskRecord, VersionVector, bytes], None],
        published: Callable[[Transition], None],
        audit: Audit,
    ) -> None:
        self._plane = plane
        self._drivers = drivers
        self._task = task
        self._drive = drive
        self._published = published
        self._audit = audit

    def register(self) -> None:
        """Answer RPC."""
        rpc, audit = self._plane.rpc, self._audit
        rpc.register("approve", ApproveAsk, audit.signed("approve", self.approve))
        rpc.register("reject", RejectAsk, audit.signed("reject", self.reject))
        rpc.register("pause", PauseAsk, audit.signed("pause", self.pause))
        rpc.register("resume", ResumeAsk, audit.signed("resume", self.resume))
        rpc.register("retry", RetryAsk, audit.signed("retry", self.retry))
        rpc.register("acts", ActsAsk, audit.acts)

    async def approve(self, ask: ApproveAsk) -> TaskRecord:
        """Answer `approve`. Errors as `deciding.proposal_for`; PlanError for an edited plan that is not valid."""
        return await self._steer("approve", ask)

    async def reject(self, ask: RejectAsk) -> TaskRecord:
        """Answer `reject`. Errors as `deciding.proposal_for`."""
        return await self._steer("reject", ask)

    async def pause(self, ask: PauseAsk) -> TaskRecord:
        """Answer `pause`. Errors as `deciding.may_pause`."""
        return await self._steer("pause", ask)

    async def resume(self, ask: ResumeAsk) -> TaskRecord:
        """Answer `resume`. Errors as `deciding.may_resume`."""
        return await self._steer("resume", ask)

    async def retry(self, ask: RetryAsk) -> TaskRecord:
        """Answer `retry`. Errors as `deciding.may_retry`."""
        return await self._steer("retry", ask)

    async def _steer(self, verb: str, ask: A) -> TaskRecord:
        if ask.here or ask.id in self._drivers:
            return await self._here(ask)
        if not is_wanted(await self._task(TaskAsk(id=ask.id)), ask):
            return await self._task(TaskAsk(id=ask.id))
        owner = await self._plane.owner_of(task_key(ask.id))
        if owner == self._plane.gateway:
            return await self._here(ask)
        return await self._plane.rpc.call(owner, verb, replace(ask, here=True), TaskRecord, timeout_s=STEER_S + 1.0)

    async def _here(self, ask: Ask) -> TaskRecord:
        """Tell the task's driver; waits a moment for one that is being set up."""
        for _ in range(TRIES):
            if driver := self._drivers.get(ask.id):
                outcome: asyncio.Future[TaskRecord] = asyncio.get_running_loop().create_future()
                driver.tell(Steered(ask=ask, outcome=outcome))
                try:
                    async with asyncio.timeout(STEER_S):
                        return await outcome
                except TimeoutError:
                    raise DeadlineError(f"task {ask.id} did not take it in time", remedy="ask again") from None
            record = await self._task(TaskAsk(id=ask.id))
            if record.state.final:
                if isinstance(ask, RetryAsk):
                    return await self._begin_again(ask)
                if not is_wanted(record, ask):
                    return record
            await asyncio.sleep(0.1)
        raise UnreachableError(f"nobody coordinates task {ask.id} just now", remedy="try again in a second")

    async def _begin_again(self, ask: RetryAsk) -> TaskRecord:
        """Write that a task that has ended goes on, under compare-and-set, and drive it."""
        key = task_key(ask.id)
        stored = await self._plane.dht.read(key)
        if stored is None or stored.deleted:
            raise NotFoundError(f"there is no task {ask.id}", remedy="see `swiftbot task list`")
        record = read_record(stored.value)
        fields = revived(record, ask, elapsed_s=record.elapsed_s)
        if fields is None:
            return record
        keeper = Keeper(self._plane, record, stored.version, lambda _: None)
        keeper.unknown = unknown(stored.value)
        keeper.on_published = self._published
        keeper.apply(keeper.transition(TransitionKind.RETRIED, **fields))
        try:
            await keeper.flush()
        except SupersededError:
            now = await self._task(TaskAsk(id=ask.id))
            who = now.retried_by.by if now.retried_by is not None else "somebody else"
            raise ConflictError(f"{who} has had task {ask.id} tried again already") from None
        self._drive(keeper.record, keeper.version, with_unknown(keeper.record, keeper.unknown))
        return keeper.record


def is_wanted(record: TaskRecord, ask: Ask) -> bool:
    """Whether an order has anything to do by a record; False when it was done, errors where it cannot be."""
    match ask:
        case ApproveAsk() | RejectAsk():
            return proposal_for(record, ask) is not None
        case PauseAsk():
            return may_pause(record, ask)
        case ResumeAsk():
            return may_resume(record, ask)
        case RetryAsk():
            return may_retry(record, ask)
