"""The decider alone, without a loop, a plane that answers, or time that passes: any events in any order."""

import asyncio
from typing import Any, cast

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import Failure, RunEventKind, RunRequest, Subtask, SubtaskState, TaskState
from appliance.model.task_api import PauseAsk, ResumeAsk, RetryAsk, RunStatus
from appliance.tasks import machine
from appliance.tasks.decide import Decider
from appliance.tasks.events import (
    Answer,
    AskRun,
    CancelAsked,
    CancelRun,
    Dispatch,
    EndRun,
    Event,
    GatewayLost,
    Instruction,
    MakePlan,
    OperatorAsked,
    PlanMade,
    RunChecked,
    RunReported,
    StopPlanning,
    Wake,
)
from appliance.tasks.record_writer import Draft
from tests.unit.tasks.fake_context import FakeContext
from tests.unit.tasks.fake_plane import FakePlane
from tests.unit.tasks.sample_records import accepted, event, plan_of

PLAN = plan_of(
    Subtask(id="s1", skill="work"),
    Subtask(id="s2", skill="work"),
    Subtask(id="s3", skill="work", after=("s1",)),
)


class Table:
    """A decider, what it was handed and what it has instructed."""

    def __init__(self) -> None:
        self.context = FakeContext(FakePlane(), PLAN)
        self.draft = Draft(accepted(), "gw-1")
        self.now = 100.0
        self.decider = Decider(cast("Any", self.context), self.draft, self.now)
        self.out: list[Instruction] = []
        self.first: RunRequest | None = None

    def hand(self, given_event: Event) -> list[Instruction]:
        """Hand in an event, then do what follows; returns the instructions."""
        out = self.decider.handle(given_event, self.now) + self.decider.advance(self.now)
        self.out += out
        return out

    def begin(self) -> list[Instruction]:
        """Have it planned."""
        assert self.decider.advance(self.now) == [MakePlan()]
        return self.hand(PlanMade(plan=PLAN))


def test_a_plan_is_asked_for_once_and_its_first_subtasks_are_dispatched() -> None:
    """Nothing waits for anything but events."""
    table = Table()
    out = table.begin()
    assert [each.request.subtask for each in out if isinstance(each, Dispatch)] == ["s1", "s2"]
    assert table.draft.dirty


def test_a_cancel_ends_the_planning() -> None:
    """The plan that comes all the same is dropped."""
    table = Table()
    table.decider.advance(table.now)
    assert StopPlanning() in table.hand(CancelAsked())
    assert table.hand(PlanMade(plan=PLAN)) == []
    assert table.draft.record.state is TaskState.CANCELLED


def test_a_run_is_asked_after_once_until_its_gateway_has_answered() -> None:
    """A gateway that takes long is not asked again meanwhile; one that knows nothing has lost the run."""
    table = Table()
    table.begin()
    for _ in range(3):
        table.now += 2 * table.context.config.check_s
        table.hand(Wake())
    asked = [each.run.subtask.id for each in table.out if isinstance(each, AskRun)]
    assert asked == ["s1", "s2"]
    table.hand(RunChecked(subtask="s1", attempt=1, gateway="gw-1", status=RunStatus(running=False)))
    assert table.draft.record.of("s1").attempts[0].failure is not None


def _known(request: RunRequest | None) -> RunRequest:
    assert request is not None
    return request


STEPS = st.lists(
    st.tuples(st.sampled_from(("run", "lost", "checked", "wake", "cancel", "operator")), st.integers(0, 40)),
    max_size=60,
)


def _step(table: Table, kind: str, choice: int, loop: asyncio.AbstractEventLoop) -> None:
    targets = table.draft.record.subtasks
    target = targets[choice % len(targets)]
    request = replace(_known(table.first), subtask=target.subtask.id, attempt=max(1, target.attempt - choice % 2))
    kinds = (RunEventKind.STARTED, RunEventKind.PROGRESS, RunEventKind.SUCCEEDED, RunEventKind.FAILED)
    match kind:
        case "run":
            found = kinds[choice % 4]
            failure = Failure(code="skill", message="no", retryable=choice % 3 > 0)
            fields = {"failure": failure} if found is RunEventKind.FAILED else {}
            table.hand(RunReported(event(request, found, gateway=target.gateway or "gw-1", **fields)))
        case "lost":
            table.hand(GatewayLost(f"gw-{choice % 3}"))
        case "checked":
            status = None if choice % 3 == 0 else RunStatus(running=choice % 3 == 1)
            table.hand(
                RunChecked(subtask=request.subtask, attempt=request.attempt, gateway=target.gateway, status=status)
            )
        case "operator":
            asks = (PauseAsk(id="t-1", by="ann"), ResumeAsk(id="t-1", by="ann"), RetryAsk(id="t-1", subtask="s1"))
            table.hand(OperatorAsked(ask=asks[choice % 3], outcome=loop.create_future()))
        case "cancel" if choice > 35:
            table.hand(CancelAsked())
        case _:
            table.now += choice / 20
            table.hand(Wake())


@given(STEPS)
def test_whatever_comes_no_attempt_is_ordered_twice(steps: list[tuple[str, int]]) -> None:
    """Each order is of the attempt that the record has as the current one, on the gateway that the record names.

    Attempts count up by one, runs that have ended are not asked after, and each operator gets one answer.
    """
    loop = asyncio.new_event_loop()
    try:
        table = Table()
        table.first = next(each.request for each in table.begin() if isinstance(each, Dispatch))
        operators = 0
        for kind, choice in steps:
            if table.draft.record.state.final:
                break
            before = len(table.out)
            operators += kind == "operator"
            _step(table, kind, choice, loop)
            for each in table.out[before:]:
                if isinstance(each, Dispatch):
                    target = table.draft.record.of(each.request.subtask)
                    assert (target.attempt, target.gateway) == (each.request.attempt, each.gateway)
                    assert target.state is SubtaskState.DISPATCHED
                if isinstance(each, AskRun | CancelRun | EndRun):
                    assert each.run.attempt <= table.draft.record.of(each.run.subtask.id).attempt
        orders = [(each.request.subtask, each.request.attempt) for each in table.out if isinstance(each, Dispatch)]
        assert len(set(orders)) == len(orders)
        for target in table.draft.record.subtasks:
            numbers = [attempt.number for attempt in target.attempts]
            assert numbers == sorted(set(numbers))
        assert sum(isinstance(each, Answer) for each in table.out) == operators
        assert not (table.draft.record.state.final and machine.active(table.draft.record))
    finally:
        loop.close()
