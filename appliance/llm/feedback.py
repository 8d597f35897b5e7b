"""What a gateway's planner remembers: experience, plan cache, thresholds, and what upstream has cost.

Each gateway hears the last record of every task of the fleet, from any coordinator, so that all of them learn the
same without asking anybody; one that was away has missed some, and learns on. What is remembered is kept in the
gateway's store and written together now and then: a second of it may be lost with the power.
"""

import asyncio
import contextlib
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Protocol

import msgspec
import structlog

from appliance.errors import SwiftbotError
from appliance.llm.experience import Experience, outcomes, plan_outcomes
from appliance.llm.plan_cache import Kept, PlanCache
from appliance.llm.routing import Budget, Spent, Thresholds
from appliance.model import Plan, TaskRecord, TaskState, encode
from appliance.model.planner_api import Row

log = structlog.get_logger(__name__)

PREFIX = "planner/"
_PLAN = "planner/plan/"
_EXPERIENCE = "planner/experience"
_THRESHOLDS = "planner/thresholds"
_SPENT = "planner/spent"
WRITE_S = 2.0
MOST_HEARD = 4096
"""Tasks whose end was heard and is not counted again: records are published more than once."""
_FINAL = (b'"state":"succeeded"', b'"state":"failed"', b'"state":"cancelled"')


class Store(Protocol):
    """Where it is kept: the gateway's store."""

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Write a value."""
        ...

    async def delete(self, key: str) -> object:
        """Forget a key."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Read all values whose keys begin so."""
        ...


class _Head(msgspec.Struct):
    """The part of a record that tells whether it is the last."""

    state: TaskState = TaskState.ACCEPTED


class Memory:
    """One per gateway.

    Args:
        thresholds: of the cascade.
        budget: of upstream.
        most_plans: in the cache; 0: no plan is reused.
        store: where it is kept; None: nowhere.
        clock: seconds.
    """

    def __init__(
        self,
        *,
        thresholds: Thresholds,
        budget: Budget,
        most_plans: int,
        store: Store | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.experience = Experience(clock)
        self.thresholds = thresholds
        self.cache = PlanCache(most_plans)
        self.budget = budget
        self._store = store
        self._heard: OrderedDict[str, None] = OrderedDict()
        self._changed: dict[str, Callable[[], bytes | None]] = {}
        """Keys of the store that are to be written, with what gives their value; None: to be removed."""
        self._writer: asyncio.Task[None] | None = None

    async def load(self, store: Store | None = None) -> None:
        """Read what was kept; what cannot be read is learned again."""
        self._store = store or self._store
        if self._store is None:
            return
        for key, value in await self._store.scan(PREFIX):
            try:
                self._take_in(key, value)
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                log.warning("what the planner remembered cannot be read", key=key, reason=str(error))

    def _take_in(self, key: str, value: bytes) -> None:
        if key.startswith(_PLAN):
            self.cache.load(key.removeprefix(_PLAN), msgspec.json.decode(value, type=Kept))
        elif key == _EXPERIENCE:
            self.experience.load(msgspec.json.decode(value, type=list[Row]))
        elif key == _THRESHOLDS:
            self.thresholds.load(msgspec.json.decode(value, type=dict[str, list[tuple[float, bool, float]]]))
        elif key == _SPENT:
            self.budget.load(msgspec.json.decode(value, type=Spent))

    def hear(self, key: str, payload: bytes) -> None:
        """Take in the news of a task's record, as it was put; only an end teaches anything."""
        if not any(each in payload for each in _FINAL):
            return
        try:
            # Its head first: most records with a finished part are not finished, and there are many.
            if not msgspec.json.decode(payload, type=_Head).state.final:
                return
            record = msgspec.json.decode(payload, type=TaskRecord)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return  # the gateway that keeps the record counts it
        if key.endswith(f"/task/{record.id}/record"):
            self.learn(record)

    def learn(self, record: TaskRecord) -> None:
        """Take in how a task ended; once."""
        if not record.state.final or record.id in self._heard:
            return
        self._heard[record.id] = None
        while len(self._heard) > MOST_HEARD:
            self._heard.popitem(last=False)
        found = outcomes(record)
        if found:
            self.experience.add(found)
            self._changed[_EXPERIENCE] = lambda: encode(self.experience.rows())
        self._learn_plan(record)
        if self._changed:
            self._write_soon()

    def _learn_plan(self, record: TaskRecord) -> None:
        for each in plan_outcomes(record):
            self.thresholds.add(each.origin.tier.value, each.origin.confidence, good=each.good)
            self._changed[_THRESHOLDS] = lambda: encode(self.thresholds.rows())
            if each.good and record.plan is not None:
                self._keep_plan(each.origin.key, record.plan)
            else:
                self.forget_plan(each.origin.key)
        first = record.plan.provenance if record.plan is not None else None
        if record.state is TaskState.FAILED and first is not None:
            # Whatever it failed for: what failed is not done again without a thought.
            self.forget_plan(first.key)

    def _keep_plan(self, key: str, plan: Plan) -> None:
        kept = self.cache.succeeded(key, plan)
        for gone in self.cache.surplus():
            self._changed[_PLAN + gone] = lambda: None
        if kept is not None:
            self._changed[_PLAN + key] = lambda: encode(kept)

    def forget_plan(self, key: str) -> None:
        """Forget a plan of the cache."""
        if self.cache.failed(key):
            self._changed[_PLAN + key] = lambda: None
            self._write_soon()

    def spent(self) -> None:
        """Note that upstream was paid."""
        self._changed[_SPENT] = lambda: encode(self.budget.last)
        self._write_soon()

    def _write_soon(self) -> None:
        if self._store is not None and (self._writer is None or self._writer.done()):
            self._writer = asyncio.create_task(self._write_later(), name="what the planner remembers")

    async def _write_later(self) -> None:
        await asyncio.sleep(WRITE_S)
        await self.write()

    async def write(self) -> None:
        """Write what has changed."""
        if self._store is None:
            return
        changed, self._changed = self._changed, {}
        for key, value_of in changed.items():
            try:
                value = value_of()
                if value is None:
                    await self._store.delete(key)
                else:
                    await self._store.put(key, value, durable=False)
            except SwiftbotError as error:
                log.info("what the planner remembers is not kept", key=key, reason=str(error))

    async def close(self) -> None:
        """Write what has not been written yet."""
        if self._writer is not None:
            self._writer.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._writer
        await self.write()
