"""Sends the ready subtasks of a driven task to gateways, says what those that stay wait for, and ends its runs.

What it decides becomes transitions; the orders go out when the keeper has written the record with them.
"""

import time

from appliance.errors import NotFoundError
from appliance.model import Failure, SubtaskRecord, TaskState
from appliance.tasks import machine
from appliance.tasks.bounds import MAX_NOTE, clean
from appliance.tasks.deadline import left_s
from appliance.tasks.hearing import Hearing
from appliance.tasks.keeper import Keeper
from appliance.tasks.machine import TransitionKind
from appliance.tasks.orders import Orders, request_for
from appliance.tasks.pace import Pace
from appliance.tasks.replanning import Replanning
from appliance.tasks.surroundings import MoveReady, Surroundings, figures


class Dispatching:
    """Dispatches one task's subtasks; on the way to its end, cancels what still runs."""

    def __init__(
        self,
        around: Surroundings,
        keeper: Keeper,
        orders: Orders,
        hearing: Hearing,
        pace: Pace,
        replanning: Replanning,
    ) -> None:
        self._around = around
        self._keeper = keeper
        self._orders = orders
        self._hearing = hearing
        self._pace = pace
        self._replanning = replanning
        self._cancelled_at: float | None = None
        self._cancel_at: dict[str, float] = {}

    def advance(self, now: float) -> None:
        """Dispatch what can be dispatched now, or end what runs if the task is being ended."""
        keeper = self._keeper
        if keeper.record.state is TaskState.CANCELLING:
            self._end_runs(now)
            return
        ready = machine.ready(keeper.record)
        if any(self._pace.not_before.get(each.subtask.id, 0.0) <= now for each in ready):
            group = self._around.regroup(keeper.record)
            if group is not None:
                keeper.apply(keeper.transition(TransitionKind.GROUPED, group=group))
        for each in machine.ready(keeper.record):
            keeper.ready_ns.setdefault(each.subtask.id, time.monotonic_ns())
            if keeper.record.state is TaskState.RUNNING and self._pace.may_go(each.subtask.id, now):
                self._dispatch(each, now)

    def _dispatch(self, target: SubtaskRecord, now: float) -> None:
        keeper, subtask = self._keeper, target.subtask
        try:
            manifest = self._around.manifest(subtask.skill)
        except NotFoundError as error:
            # Planned on a gateway that knows more skills than this one, or before this one forgot it.
            failure = Failure(code=error.code, message=error.message, remedy=error.remedy)
            keeper.apply(
                keeper.transition(
                    TransitionKind.ATTEMPT_FAILED,
                    subtask=subtask.id,
                    attempt=target.next_attempt,
                    failure=failure,
                    give_up=True,
                    replan=True,
                )
            )
            return
        robot = None
        if subtask.robot is not None:
            robot, reason = self._around.bind(keeper.record, target)
            if robot is None:
                reason = self._replanning.robot_missing(target, reason, now)
                if reason:
                    self._wait(target, reason, now)
                return
        placement = self._around.place(keeper.record, target, robot)
        if not placement.order:
            self._wait(target, f"waits for a gateway: {placement.why}", now)
            return
        left = left_s(keeper.record, keeper.elapsed_s)
        turn = self._around.turn(keeper.record, target, placement, left)
        if not turn.gateway:
            self._wait(target, f"waits for room: {', '.join(placement.order)} have enough to do", now)
            return
        self._pace.goes(subtask.id)
        request = request_for(
            keeper.record,
            target,
            manifest,
            robot=robot,
            coordinator=self._around.plane.gateway,
            elapsed_s=keeper.elapsed_s,
        )
        gateway = turn.gateway
        keeper.apply(
            keeper.transition(
                TransitionKind.DISPATCHED,
                subtask=subtask.id,
                attempt=request.attempt,
                gateway=gateway,
                robot=robot,
                placed=clean(placement.why, MAX_NOTE),
                **figures(self._around.plane, gateway),
            )
        )
        self._around.sent(keeper.record, target, placement)
        self._orders.add(gateway, request)

    def move(self, news: MoveReady) -> None:
        """Leave a run for a new attempt on the gateway that was made ready for it, unless it has ended meanwhile."""
        keeper = self._keeper
        try:
            target = keeper.record.of(news.subtask)
            manifest = self._around.manifest(target.subtask.skill)
        except (KeyError, NotFoundError):
            news.give_up("the task has no such subtask, or its coordinator no such skill")
            return
        if news.outcome.done():
            return
        request = request_for(
            keeper.record,
            target,
            manifest,
            robot=target.bound_robot,
            coordinator=self._around.plane.gateway,
            elapsed_s=keeper.elapsed_s,
        )
        moved = keeper.transition(
            TransitionKind.MOVED,
            subtask=news.subtask,
            attempt=news.attempt,
            gateway=news.gateway,
            note=clean(news.why, MAX_NOTE),
            placed=clean(news.placed, MAX_NOTE),
            choice=self._orders.choice(news.subtask, news.attempt),
            **figures(self._around.plane, news.gateway),
        )
        if request.attempt != news.next_attempt or not keeper.take(moved):
            news.give_up(f"attempt {news.attempt} has ended meanwhile")
            return
        keeper.ready_ns[news.subtask] = time.monotonic_ns()
        self._orders.move(news, request, left=target)

    def _wait(self, target: SubtaskRecord, reason: str, now: float) -> None:
        """Tell people why it waits, once per reason, and look again soon.

        Written to the record, since every gateway must be able to say why nothing goes on.
        """
        if self._pace.waits(target.subtask.id, reason, now):
            keeper = self._keeper
            keeper.apply(
                keeper.transition(
                    TransitionKind.PROGRESS, subtask=target.subtask.id, attempt=target.attempt, note=clean(reason, 500)
                )
            )

    def _end_runs(self, now: float) -> None:
        if self._cancelled_at is None:
            self._cancelled_at = now
        for each in machine.active(self._keeper.record):
            if now - self._cancelled_at > self._around.config.grace_s:
                failure = Failure(code="cancelled", message=f"{each.gateway} did not confirm the cancel in time")
                self._hearing.attempt_failed(each, failure, None)
            elif self._cancel_at.get(each.subtask.id, 0.0) <= now:
                # Again and again: the first may overtake the order to run, or be lost.
                self._cancel_at[each.subtask.id] = now + self._around.config.check_s
                self._orders.cancel(each, self._keeper.record.id)
