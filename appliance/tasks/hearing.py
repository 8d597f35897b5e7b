"""Makes transitions of a driven task's record from the news of its runs; what does not fit the record is dropped."""

import time
from typing import Any

import msgspec

from appliance.errors import NotFoundError, TakenError
from appliance.model import Failure, RunEvent, RunEventKind, SubtaskRecord, SubtaskState, TaskState
from appliance.tasks import machine
from appliance.tasks.bounds import MAX_NOTE, clean, tidy
from appliance.tasks.healing import foreign
from appliance.tasks.keeper import Keeper
from appliance.tasks.machine import TransitionKind
from appliance.tasks.orders import Orders
from appliance.tasks.pace import Pace
from appliance.tasks.partials import Partials, shown
from appliance.tasks.replan.decide import worth_replanning
from appliance.tasks.surroundings import Surroundings

TAKEN_PAUSE_S = 2.0
"""Before the next attempt with a robot that was taken over at the vehicle."""


class Hearing:
    """Hears of the runs of one task."""

    def __init__(self, around: Surroundings, keeper: Keeper, orders: Orders, pace: Pace) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._pace = pace
        self._partials = Partials()
        self.gives_way: set[str] = set()
        """Subtasks whose runs are being ended because a new plan leaves them out."""

    def useful(self, event: RunEvent) -> bool:
        """Whether an event is of a current attempt and tells something that the record keeps."""
        if event.kind in (RunEventKind.LOG, RunEventKind.ALIVE):
            return False
        current = next((each for each in self._keeper.record.subtasks if each.subtask.id == event.subtask), None)
        return (
            current is not None
            and event.attempt == current.attempt
            and not current.state.final
            and not foreign(self._keeper.record, event)
        )

    @property
    def next_partial_at(self) -> float | None:
        """When a partial result may go into the record next; None when there is none."""
        return self._partials.next_at()

    def tell_partials(self, now: float) -> None:
        """Have the partial results that are due in the record."""
        keeper = self._keeper
        for event in self._partials.due(now):
            partial = keeper.transition(
                TransitionKind.PARTIAL, subtask=event.subtask, attempt=event.attempt, result=shown(event.result)
            )
            keeper.take(partial, durable=False)

    async def hear(self, event: RunEvent) -> None:
        """Take in an event; before an end, wait a moment for the answer to the order."""
        if event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            await self._orders.answered(event.subtask, event.attempt)
        self.take_in(event)

    def take_in(self, event: RunEvent) -> None:
        """Make a transition of an event."""
        keeper = self._keeper
        try:
            target = keeper.record.of(event.subtask)
        except KeyError:
            return
        if event.attempt != target.attempt or target.state.final or foreign(keeper.record, event):
            return
        event = tidy(event, max_result_bytes=self._around.config.max_result_bytes)
        common: dict[str, Any] = {
            "subtask": event.subtask,
            "attempt": event.attempt,
            "gateway": event.gateway,
            "container": event.container,
            "phase": event.phase,
        }
        choice = self._orders.choice(event.subtask, event.attempt)
        match event.kind:
            case RunEventKind.STARTED:
                ready_ns = keeper.ready_ns.get(event.subtask)
                startup_ms = (time.monotonic_ns() - ready_ns) / 1e6 if ready_ns else event.startup_ms
                keeper.take(keeper.transition(TransitionKind.STARTED, startup_ms=startup_ms, choice=choice, **common))
            case RunEventKind.PROGRESS:
                if event.choice is not None:
                    self._orders.passed_on(event.subtask, event.attempt, event.choice)
                keeper.take(
                    keeper.transition(TransitionKind.PROGRESS, progress=event.progress, note=event.note, **common),
                    durable=False,
                )
            case RunEventKind.SUCCEEDED:
                self._partials.drop(event.subtask)
                succeeded = keeper.transition(
                    TransitionKind.SUCCEEDED,
                    result=event.result,
                    duration_ms=event.duration_ms,
                    cpu_ms=event.cpu_ms,
                    peak_mb=event.peak_mb,
                    choice=choice,
                    **common,
                )
                if keeper.take(succeeded) and event.duration_ms is not None:
                    self._around.took(target.subtask.skill, event.duration_ms)
            case RunEventKind.FAILED:
                failure = event.failure or Failure(code="internal", message="the run failed without a reason")
                if failure.code == "cancelled" and keeper.record.state is TaskState.RUNNING:
                    # By its gateway, which drains or heard an outdated record: nothing is wrong with the subtask.
                    failure = msgspec.structs.replace(
                        failure, code="orphaned", message=f"ended there, though its task goes on: {failure.message}",
                        retryable=True,
                    )  # fmt: skip
                if failure.code == TakenError.code and self._wait_for_robot(target, failure):
                    return
                self.attempt_failed(target, failure, event.duration_ms, event=event)
            case RunEventKind.PARTIAL:
                self._partials.add(event)
            case RunEventKind.CHECKPOINT:
                # The first one is written at once: whoever comes later must know that there is something to remove.
                keeper.take(keeper.transition(TransitionKind.CHECKPOINT, **common), durable=not target.checkpoint_ns)
            case RunEventKind.LOG | RunEventKind.ALIVE:
                pass

    def _wait_for_robot(self, target: SubtaskRecord, failure: Failure) -> bool:
        """Let a subtask wait whose robot a pilot or a failsafe has taken: nothing is wrong with it or its attempt.

        It goes on with the next attempt when the robot is given back; until then nobody commands it.
        """
        keeper = self._keeper
        note = clean(f"waits for {target.bound_robot or 'its robot'}: {failure.message}", MAX_NOTE)
        held = keeper.transition(TransitionKind.HELD, subtask=target.subtask.id, attempt=target.attempt, note=note)
        if not keeper.take(held):
            return False
        # The roster hears of it with the next heartbeat; a new attempt before that would meet the same refusal.
        self._pace.repeats(target.subtask.id, time.monotonic() + TAKEN_PAUSE_S)
        return True

    def gateway_lost(self, gateway: str) -> None:
        """End the attempts on a gateway that is gone."""
        for each in machine.active(self._keeper.record):
            if each.gateway == gateway:
                failure = Failure(code="unreachable", message=f"{gateway} was lost", retryable=True)
                self.attempt_failed(each, failure, None)

    def give_way(self, target: SubtaskRecord, why: str) -> None:
        """Give up a run that a new plan leaves out and that does not end when told to."""
        self.gives_way.add(target.subtask.id)
        self.attempt_failed(target, Failure(code="cancelled", message=why), None)

    def attempt_failed(
        self, target: SubtaskRecord, failure: Failure, duration_ms: float | None, *, event: RunEvent | None = None
    ) -> None:
        """Note that an attempt has failed, and whether another will be made; `event`: what its gateway told of it."""
        keeper = self._keeper
        judged = _with_failure(target, failure)
        leaves = target.subtask.id in self.gives_way
        retries = self._retries(target)
        give_up = leaves or machine.gives_up(judged, failure, retries=retries + 1)
        replan = leaves or worth_replanning(failure.code)
        taken = keeper.take(
            keeper.transition(
                TransitionKind.ATTEMPT_FAILED,
                subtask=target.subtask.id,
                attempt=target.attempt,
                gateway=target.gateway,
                failure=failure,
                give_up=give_up,
                retries=None if leaves else retries,
                replan=give_up and replan and keeper.record.state is TaskState.RUNNING,
                duration_ms=duration_ms,
                cpu_ms=event.cpu_ms if event else None,
                peak_mb=event.peak_mb if event else None,
                choice=self._orders.choice(target.subtask.id, target.attempt),
            )
        )
        self._partials.drop(target.subtask.id)
        if taken and not give_up:
            keeper.ready_ns[target.subtask.id] = time.monotonic_ns()
            self._pace.repeats(target.subtask.id, time.monotonic() + machine.retry_delay_s(target.attempt))

    def _retries(self, target: SubtaskRecord) -> int:
        try:
            return self._around.manifest(target.subtask.skill).retries
        except NotFoundError:
            return 0


def _with_failure(target: SubtaskRecord, failure: Failure) -> SubtaskRecord:
    if not target.attempts or target.state is SubtaskState.READY:
        return target
    last = msgspec.structs.replace(target.attempts[-1], failure=failure)
    return msgspec.structs.replace(target, attempts=(*target.attempts[:-1], last))
