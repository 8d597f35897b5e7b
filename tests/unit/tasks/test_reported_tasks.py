"""Schedulers that broke in Nomad and Ray, as their users reported; the table is in tests/reports."""

import asyncio
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import RefusedError
from appliance.model import Failure, RunEvent, RunEventKind, SubtaskState, TaskState, keyspace
from appliance.model.task_api import DrainAsk, RunStatus
from appliance.tasks.conflicts import foreign, heal
from appliance.tasks.events import CancelAsked, GatewayLost
from appliance.tasks.executor import Executor
from appliance.tasks.machine import StaleTransitionError, Transition, TransitionKind, apply, gives_up
from tests.unit.tasks import test_executor
from tests.unit.tasks.migration import test_draining, test_moving
from tests.unit.tasks.migration.test_draining import Gateway, here
from tests.unit.tasks.migration.test_moving import ASK, Fleet, start_there
from tests.unit.tasks.test_coordinator import answer
from tests.unit.tasks.test_executor import REQUEST, finish, until
from tests.unit.tasks.test_healing import lost, record_of, split
from tests.unit.tasks.test_machine import dispatched, planned, step

pytestmark = pytest.mark.anyio
executor, fleet, quick = test_executor.executor, test_moving.fleet, test_draining.quick
"""Fixtures of those modules."""
SUCCEEDED, FAILED, STARTED = RunEventKind.SUCCEEDED, RunEventKind.FAILED, RunEventKind.STARTED


async def test_a_gateway_that_comes_back_ends_what_was_repeated_meanwhile(plane: Any) -> None:
    """Of a run that went on there and its repetition one is kept, and the other is ended once.

    Reported as hashicorp/nomad#12680.
    """
    record = record_of(plane, split(lost(1, "gw-1")), attempt=2)
    healing = heal(record)
    assert healing is not None
    assert [(each.attempt, each.gateway) for each in healing.ends] == [(1, "gw-1")]


async def test_no_two_runs_have_one_number(plane: Any) -> None:
    """After both sides have counted on, the next attempt is above both (hashicorp/nomad#14948)."""
    record = record_of(plane, split(lost(1, "gw-1"), lost(4, "gw-3")))
    healing = heal(record)
    assert healing is not None
    healed = Transition(
        task="t-1", sequence=record.sequence + 1, kind=TransitionKind.HEALED, at_ns=9, coordinator="gw-1",
        splits=healing.splits, fences=healing.fences,
    )  # fmt: skip
    record = apply(record, healed)
    assert record.subtasks[0].next_attempt == 5
    event = RunEvent(task="t-1", subtask="s1", attempt=1, kind=SUCCEEDED, gateway="gw-3")
    assert foreign(record_of(plane, split(lost(1, "gw-3"))), event)


async def test_a_short_silence_repeats_nothing(bench: Any) -> None:
    """A coordinator that finds the run still going takes it over as it is (hashicorp/nomad#10953)."""
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, STARTED, gateway="gw-1")
    await bench.until(lambda record: record.subtasks[0].state is SubtaskState.RUNNING)
    bench.task.cancel()
    await asyncio.gather(bench.task, return_exceptions=True)
    bench.plane.gateway = "gw-3"
    bench.plane.rpc.on["run_status"] = answer(RunStatus(running=True))
    await bench.start(bench.stored())
    await bench.until(lambda record: record.coordinator == "gw-3")
    bench.tell(request, SUCCEEDED, gateway="gw-1")
    assert [each.number for each in (await bench.end()).subtasks[0].attempts] == [1]


async def test_a_run_of_a_task_that_has_ended_elsewhere_is_ended(executor: Executor, plane: Any, pool: Any) -> None:
    """A gateway that was cut off ends what nobody waits for any more (hashicorp/nomad#2185)."""
    await executor.run(REQUEST)
    await until(lambda: pool.runs)
    plane.session.publish(keyspace.TASK_UPDATE, replace(plane.accepted(), state=TaskState.CANCELLED), "t-1")
    await until(lambda: pool.cancelled)
    assert pool.cancelled == ["t-1/s1/1"]
    await finish(pool)


async def test_news_of_what_has_ended_change_nothing(bench: Any) -> None:
    """Late successes and failures of an earlier attempt are dropped (hashicorp/nomad#2545)."""
    await bench.start()
    _, first = await bench.ordered()
    bench.say(GatewayLost("gw-1"))
    gateway, second = await bench.ordered()
    bench.tell(first, SUCCEEDED, result={"late": 1})
    bench.tell(first, FAILED, failure=Failure(code="robot", message="late"))
    bench.tell(second, SUCCEEDED, gateway=gateway, result={"late": 0})
    ended = await bench.end()
    assert (ended.state, ended.subtasks[0].result) == (TaskState.SUCCEEDED, {"late": 0})


async def test_a_run_that_moves_is_ended_before_the_new_one_begins(fleet: Fleet) -> None:
    """Never two at once, and room for the new one is held first (hashicorp/nomad#9998)."""
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    await start_there(fleet)
    assert (await moving).started
    assert [verb for verb, _ in fleet.asked if verb != "run_status"] == ["run_reserve", "run_hold", "run_leave"]


async def test_a_drain_moves_what_finds_no_room_at_first() -> None:
    """It is asked for again until it is taken, and the drain does not end without it (hashicorp/nomad#7887)."""
    gateway = Gateway(here("s1"), here("s2"))
    gateway.problems["s1"] = [RefusedError("no gateway takes s1: exhausted") for _ in range(5)]
    await gateway.it.drain(DrainAsk())
    await gateway.empty()
    assert gateway.order.count("s1") == 6
    assert gateway.it.state().moved == 2
    assert gateway.cancelled == []


async def test_a_drain_tells_what_it_waits_for() -> None:
    """A run that cannot move does not leave it stuck without a word (hashicorp/nomad#12835)."""
    gateway = Gateway(here("s1"))
    gateway.problems["s1"] = [RefusedError("no gateway takes s1: its volume is here") for _ in range(50)]
    await gateway.it.drain(DrainAsk())
    async with asyncio.timeout(60):
        while "its volume is here" not in gateway.it.text:
            await asyncio.sleep(0.001)
    gateway.problems.clear()
    await gateway.empty()


async def test_a_task_that_was_cancelled_is_told_as_cancelled(bench: Any) -> None:
    """Although its run was under way, and whatever its run says last (ray-project/ray#32826)."""
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, STARTED)
    bench.say(CancelAsked())
    await bench.until(lambda record: record.state is TaskState.CANCELLING)
    bench.tell(request, FAILED, failure=Failure(code="cancelled", message="cancelled"))
    ended = await bench.end()
    assert (ended.state, ended.subtasks[0].state) == (TaskState.CANCELLED, SubtaskState.CANCELLED)


@given(st.permutations(["cancel", "succeeded", "failed"]))
def test_an_end_and_a_cancel_at_once_leave_one_end(order: list[str]) -> None:
    """In any order: the record is sound, ends once, and takes nothing after it (ray-project/ray#53680)."""
    record = dispatched(planned(), "s1")
    failure = Failure(code="cancelled", message="cancelled")
    kinds: dict[str, tuple[TransitionKind, dict[str, Any]]] = {
        "cancel": (TransitionKind.CANCEL, {}),
        "succeeded": (TransitionKind.SUCCEEDED, {"subtask": "s1", "attempt": 1, "result": {}}),
        "failed": (
            TransitionKind.ATTEMPT_FAILED,
            {"subtask": "s1", "attempt": 1, "failure": failure, "give_up": True},
        ),
    }
    ends = 0
    for name in order:
        kind, fields = kinds[name]
        before = record.state
        try:
            record = step(record, kind, **fields)
        except StaleTransitionError:
            continue
        ends += record.state in (TaskState.CANCELLED, TaskState.FAILED, TaskState.SUCCEEDED) and before != record.state
    assert ends == 1
    assert record.of("s1").state in (SubtaskState.SUCCEEDED, SubtaskState.FAILED, SubtaskState.CANCELLED)


@pytest.mark.parametrize(("code", "retries", "attempts"), [("skill", 0, 1), ("skill", 3, 4), ("pool", 0, 20)])
def test_a_crash_is_not_repeated_without_end(code: str, retries: int, attempts: int) -> None:
    """A handler's as often as its skill allows, one of a container in bounds too (modin-project/modin#3659)."""
    record = planned()
    failure = Failure(code=code, message="it died", retryable=True)
    number, ended = 0, False
    while not ended and number < 100:
        number += 1
        record = dispatched(record, "s1", attempt=number)
        ended = gives_up(record.of("s1"), failure, retries=retries)
        record = step(
            record, TransitionKind.ATTEMPT_FAILED, subtask="s1", attempt=number, failure=failure, give_up=ended
        )
    assert number <= attempts
    assert record.state is TaskState.FAILED
    assert not gives_up(planned().of("s1"), failure, retries=1)
    assert gives_up(planned().of("s1"), replace(failure, retryable=False), retries=5)
