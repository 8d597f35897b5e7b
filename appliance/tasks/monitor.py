"""The execution monitor of one task: when each run was last heard of, and what follows when it is stuck or straggles.

The judgement is `detection`'s. A **stuck** run is ended and its attempt has failed, so that the next is made elsewhere.
A **straggler** is left for a new attempt on another gateway, with its last checkpoint, where its manifest allows it
(`speculate`: it commands no robot and writes no volume). MapReduce lets both copies run and takes the first; here one
attempt at a subtask is current, that is what keeps effects from doubling, and two that are current would not be. So
speculation is moving on, once for a subtask, and only to a gateway that can have it.
"""

import asyncio
import time

from appliance.model import Failure, RunEvent, RunEventKind, SubtaskRecord, SubtaskState
from appliance.tasks.bounds import MAX_NOTE, clean
from appliance.tasks.detection import Condition, Finding, Known, asked_s, judge
from appliance.tasks.dispatching import Dispatching
from appliance.tasks.hearing import Hearing
from appliance.tasks.keeper import Keeper
from appliance.tasks.machine import TransitionKind
from appliance.tasks.orders import Orders
from appliance.tasks.surroundings import MoveReady, Surroundings

_LEFT = "straggling"
"""How the reason of an attempt that was left for speculation begins."""


class Monitor:
    """Watches the runs of one task."""

    def __init__(
        self, around: Surroundings, keeper: Keeper, orders: Orders, hearing: Hearing, dispatching: Dispatching
    ) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._hearing = hearing
        self._dispatching = dispatching
        self._heard: dict[tuple[str, int], float] = {}
        self._began: dict[tuple[str, int], float] = {}

    def seen(self, event: RunEvent) -> None:
        """Note a sign of life of a run; whatever it tells is one. Of attempts that nobody ordered nothing is kept."""
        run = (event.subtask, event.attempt)
        now = time.monotonic()
        target = next((each for each in self._keeper.record.subtasks if each.subtask.id == event.subtask), None)
        if target is None or target.attempt != event.attempt:
            return
        if event.kind is RunEventKind.STARTED:
            self._began.setdefault(run, now)
        self._heard[run] = now

    def look(self, target: SubtaskRecord, silent_s: float | None) -> None:
        """Judge a run that is under way, and do what follows.

        Args:
            target: the subtask as it stands.
            silent_s: since its last sign of life by its own gateway's account; None when that did not tell.
        """
        if target.state is not SubtaskState.RUNNING:
            return
        now = time.monotonic()
        run = (target.subtask.id, target.attempt)
        # Of a run that another coordinator heard begin nothing is known but that it runs now.
        began, heard = self._began.setdefault(run, now), self._heard.setdefault(run, now)
        manifest = self._around.recovery.manifests.get(target.subtask.skill)
        if manifest is None:
            return
        silent = now - heard if silent_s is None else min(silent_s, now - heard)
        found = judge(
            manifest,
            running_s=now - began,
            silent_s=silent,
            known=Known(learned=self._around.recovery.experience(manifest.id), siblings=self._siblings(target)),
            asked_s=asked_s(target.subtask.params),
            config=self._around.config.detection,
        )
        if found is None:
            return
        if target.condition != found.condition:
            self._note(target, found)
        if found.condition is Condition.STUCK:
            self._end(target, found)
        elif manifest.speculate:
            self._move_on(target, found)

    def _siblings(self, target: SubtaskRecord) -> tuple[float, ...]:
        return tuple(
            each.duration_ms / 1e3
            for each in self._keeper.record.subtasks
            if each.subtask.skill == target.subtask.skill
            and each.state is SubtaskState.SUCCEEDED
            and each.duration_ms is not None
        )

    def _note(self, target: SubtaskRecord, found: Finding) -> None:
        keeper = self._keeper
        noticed = keeper.transition(
            TransitionKind.NOTICED,
            subtask=target.subtask.id,
            attempt=target.attempt,
            condition=str(found.condition),
            note=clean(found.note, MAX_NOTE),
        )
        if keeper.take(noticed):
            self._around.recovery.note(str(found.condition), keeper.record, target, found.note)

    def _end(self, target: SubtaskRecord, found: Finding) -> None:
        self._orders.cancel(target, self._keeper.record.id)
        failure = Failure(
            code=str(found.condition),
            message=f"{found.note} (on {target.gateway})",
            remedy="`swiftbot task watch` has its last lines; silent_s in its skill.toml bounds its silence",
            retryable=True,
        )
        self._hearing.attempt_failed(target, failure, None)

    def _move_on(self, target: SubtaskRecord, found: Finding) -> None:
        """Leave a straggler for a new attempt, once, where there is a gateway for it."""
        if any(each.left.startswith(_LEFT) for each in target.attempts):
            return
        placement = self._around.place(self._keeper.record, target, None)
        tried = {each.gateway for each in target.attempts}
        other = next((each for each in placement.order if each not in tried), None)
        if other is None:
            return
        outcome: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        outcome.add_done_callback(lambda done: done.cancelled() or done.exception())
        self._dispatching.move(
            MoveReady(
                subtask=target.subtask.id,
                attempt=target.attempt,
                next_attempt=target.next_attempt,
                gateway=other,
                why=f"{_LEFT} on {target.gateway}, goes on here: {found.note}",
                placed=placement.why,
                outcome=outcome,
            )
        )
        self._around.recovery.note("speculated", self._keeper.record, target, f"goes on on {other}")
