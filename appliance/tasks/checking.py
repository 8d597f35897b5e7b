"""Checks the runs of a driven task against their gateways, in case an event was lost or a gateway went deaf."""

import asyncio
import time
from collections.abc import Sequence

from appliance.errors import NotFoundError
from appliance.model import Failure, RunEventKind, SubtaskRecord
from appliance.tasks import machine
from appliance.tasks.api import RunStatus
from appliance.tasks.bounds import MAX_RUN_S
from appliance.tasks.hearing import Hearing
from appliance.tasks.keeper import Keeper
from appliance.tasks.monitor import Monitor
from appliance.tasks.orders import Orders
from appliance.tasks.surroundings import Surroundings, deadline_s


class Checking:
    """Asks after the runs of one task now and then."""

    def __init__(
        self, around: Surroundings, keeper: Keeper, orders: Orders, hearing: Hearing, monitor: Monitor
    ) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._hearing = hearing
        self._monitor = monitor
        self.next_at = time.monotonic() + around.config.check_s

    async def check(self) -> None:
        """When it is time: ask after runs, in case an event was lost, and give up the silent past their deadline."""
        now = time.monotonic()
        if now < self.next_at:
            return
        members = self._around.plane.members()
        asked: list[SubtaskRecord] = []
        for each in machine.active(self._keeper.record):
            limit = self._limit_s(each)
            silent_s = now - self._orders.silent_since(each.subtask.id, now)
            if each.gateway not in members:
                self._hearing.gateway_lost(each.gateway)
            elif silent_s > limit + self._around.config.grace_s:
                failure = Failure(code="deadline", message=f"nothing came of it within {limit:.0f} s")
                self._hearing.attempt_failed(each, failure, None)
            elif silent_s > self._around.config.check_s:
                asked.append(each)
        await self.ask_after(asked)
        # Answers may have taken a while; the next look is a whole interval away from them.
        self.next_at = time.monotonic() + self._around.config.check_s

    async def ask_after(self, targets: Sequence[SubtaskRecord]) -> None:
        """Learn from their gateways what became of runs."""
        task = self._keeper.record.id
        answers = await asyncio.gather(*(self._orders.ask(each, task, "run_status") for each in targets))
        for target, status in zip(targets, answers, strict=True):
            self._learn(target, status)
        for target, status in zip(targets, answers, strict=True):
            self._judge(target, status)

    def _learn(self, target: SubtaskRecord, status: RunStatus | None) -> None:
        lost = ""
        if status is None:
            if target.gateway not in self._around.plane.members():
                lost = f"{target.gateway} was lost"
        elif status.last is None:
            sent = self._orders.sent_at(target.subtask.id)
            if not status.running and time.monotonic() - sent > self._around.config.run_timeout_s:
                lost = f"{target.gateway} does not know the run"
        elif status.last.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            self._hearing.take_in(status.last)
        elif not status.running:
            lost = f"{target.gateway} lost the run"
        elif status.last.kind is RunEventKind.STARTED:
            self._hearing.take_in(status.last)
        if lost:
            failure = Failure(code="unreachable", message=lost, retryable=True)
            self._hearing.attempt_failed(target, failure, None)

    def _judge(self, target: SubtaskRecord, status: RunStatus | None) -> None:
        """Have a run looked at as it stands now that its gateway was asked."""
        current = next((each for each in machine.active(self._keeper.record) if each.subtask == target.subtask), None)
        if current is not None and current.attempt == target.attempt:
            self._monitor.look(current, status.silent_s if status is not None and status.running else None)

    def _limit_s(self, target: SubtaskRecord) -> float:
        """How long a run may take; for a skill that only its gateway knows, as long as any."""
        try:
            return deadline_s(self._around.manifest(target.subtask.skill), target.subtask.params)
        except NotFoundError:
            return MAX_RUN_S
