"""Driving one task on fakes: what follows from events, refusals, losses and conflicts."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import DeadlineError, PlanError, RefusedError, UnreachableError
from appliance.model import Failure, RunEvent, RunEventKind, Subtask, SubtaskState, TaskState, encode
from appliance.model.task_api import RunAsk, RunStatus
from appliance.tasks.events import CancelAsked, GatewayLost, GatewayRelinked, Wake
from appliance.tasks.records import task_key

pytestmark = pytest.mark.anyio

SUCCEEDED, FAILED, STARTED, PROGRESS = (
    RunEventKind.SUCCEEDED,
    RunEventKind.FAILED,
    RunEventKind.STARTED,
    RunEventKind.PROGRESS,
)


def answer(status: RunStatus) -> Callable[[str, RunAsk], Any]:
    """An RPC answer that is always the same."""

    async def reply(gateway: str, ask: RunAsk) -> RunStatus:
        return status

    return reply


async def test_a_task_is_planned_run_and_ends(bench: Any) -> None:
    """Accepted, planned, dispatched with an attempt number, succeeded; the end is in the record."""
    driver = await bench.start()
    gateway, request = await bench.ordered()
    assert (gateway, request.attempt) == ("gw-1", 1)
    bench.tell(request, STARTED)
    bench.tell(request, SUCCEEDED, result={"ok": 1})
    assert (await bench.end()).state is TaskState.SUCCEEDED
    assert bench.stored().subtasks[0].result == {"ok": 1}
    assert driver.ended


async def test_a_refused_order_is_tried_on_another_gateway(bench: Any) -> None:
    """A draining gateway's refusal costs an attempt number, not a retry of the skill."""
    bench.context.refusals = [RefusedError("gw-1 is draining")]
    await bench.start()
    assert (await bench.ordered())[0] == "gw-1"
    gateway, request = await bench.ordered()
    assert (gateway, request.attempt) == ("gw-2", 2)
    bench.tell(request, SUCCEEDED, gateway="gw-2")
    assert (await bench.end()).state is TaskState.SUCCEEDED


async def test_an_order_without_an_answer_is_repeated_as_a_new_attempt(bench: Any) -> None:
    """A run that may or may not have begun is outdated by the next attempt."""
    bench.context.refusals = [DeadlineError("no answer in time")]
    await bench.start()
    await bench.ordered()
    _, request = await bench.ordered()
    assert request.attempt == 2


async def test_an_order_that_breaks_fails_its_attempt_only(bench: Any) -> None:
    """A defect on the way of an order is an attempt that failed, and not a silent wait."""
    bench.context.refusals = [KeyError("defect")]
    await bench.start()
    await bench.ordered()
    gateway, request = await bench.ordered()
    assert (gateway, request.attempt) == ("gw-2", 2)
    failure = bench.coordinator.record.subtasks[0].attempts[0].failure
    assert failure is not None
    assert "KeyError" in failure.message


async def test_a_failed_attempt_is_repeated_until_the_skills_retries_are_used(bench: Any) -> None:
    """One retry: two attempts, then the task fails with the reason."""
    await bench.start()
    for _ in range(2):
        _, request = await bench.ordered()
        bench.tell(request, FAILED, failure=Failure(code="robot", message="slipped", retryable=True))
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert "slipped" in ended.failure.message


async def test_a_plan_that_fails_ends_the_task_with_its_problems(bench: Any) -> None:
    """PlanError becomes a failed task that says why."""
    bench.context.the_plan = PlanError("no plan", problems=("s1: no such robot",))
    await bench.start()
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert "no such robot" in ended.failure.message


async def test_a_planner_that_breaks_ends_the_task_too(bench: Any) -> None:
    """A defect in planning is reported, instead of being met again and again."""
    bench.context.the_plan = RecursionError("too deep")
    await bench.start()
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert "planning broke" in ended.failure.message


async def test_cancel_while_planning_ends_it_at_once(bench: Any) -> None:
    """The plan is not waited for."""
    bench.context.planning = asyncio.Event()
    await bench.start()
    await asyncio.sleep(0.01)
    bench.say(CancelAsked())
    assert (await bench.end()).state is TaskState.CANCELLED


async def test_a_driver_that_is_stopped_leaves_no_planning_behind(bench: Any) -> None:
    """Planning ends with the driver that wanted it."""
    bench.context.planning = asyncio.Event()
    before = asyncio.all_tasks()

    async def others(count: int) -> None:
        async with asyncio.timeout(60):
            while len(asyncio.all_tasks() - before) != count:
                await asyncio.sleep(0.001)

    await bench.start()
    await others(2)  # the coordinator and the planning
    bench.task.cancel()
    await asyncio.gather(bench.task, return_exceptions=True)
    await others(0)


async def test_cancel_is_repeated_until_the_run_has_ended(bench: Any) -> None:
    """The first `run_cancel` may be lost or overtake the order; the end of the run makes the task cancelled."""
    await bench.start()
    _, request = await bench.ordered()
    bench.context.config = replace(bench.context.config, grace_s=5.0)
    bench.say(CancelAsked())
    async with asyncio.timeout(60):
        while sum(verb == "run_cancel" for _, verb, _ in bench.plane.rpc.calls) < 3:
            await asyncio.sleep(0.01)
    bench.tell(request, FAILED, failure=Failure(code="cancelled", message="cancelled"))
    ended = await bench.end()
    assert ended.state is TaskState.CANCELLED
    assert ended.subtasks[0].state is SubtaskState.CANCELLED


async def test_a_cancel_that_nobody_confirms_ends_after_the_grace(bench: Any) -> None:
    """A deaf gateway cannot hold a cancelled task."""
    bench.plane.rpc.on["run_status"] = answer(RunStatus(running=True))
    await bench.start()
    await bench.ordered()
    bench.say(CancelAsked())
    ended = await bench.end()
    assert ended.state is TaskState.CANCELLED
    assert "did not confirm" in ended.subtasks[0].failure.message


async def test_takeover_goes_on_with_a_run_in_progress(bench: Any) -> None:
    """A second driver adopts the record, asks after the run, and takes its result: no second attempt."""
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, STARTED, gateway="gw-2")
    await bench.until(lambda record: record.subtasks[0].state is SubtaskState.RUNNING)
    bench.task.cancel()
    await asyncio.gather(bench.task, return_exceptions=True)
    bench.plane.gateway = "gw-3"
    bench.plane.rpc.on["run_status"] = answer(RunStatus(running=True))
    await bench.start(bench.stored())
    await bench.until(lambda record: record.coordinator == "gw-3")
    bench.tell(request, SUCCEEDED, gateway="gw-2")
    ended = await bench.end()
    assert ended.state is TaskState.SUCCEEDED
    assert [each.number for each in ended.subtasks[0].attempts] == [1]


async def test_takeover_takes_the_result_of_a_run_that_has_ended(bench: Any) -> None:
    """What ended while nobody coordinated is learned from the gateway that ran it."""
    await bench.start()
    _, request = await bench.ordered()
    bench.task.cancel()
    await asyncio.gather(bench.task, return_exceptions=True)
    last = RunEvent(task=request.task, subtask="s1", attempt=1, kind=SUCCEEDED, gateway="gw-1", result={"found": 2})
    bench.plane.rpc.on["run_status"] = answer(RunStatus(running=False, last=last))
    await bench.start(bench.stored())
    ended = await bench.end()
    assert ended.subtasks[0].result == {"found": 2}


async def test_a_run_that_ended_without_a_word_is_repeated(bench: Any) -> None:
    """A gateway that knows of a begun run, runs it no more and has no outcome, has lost it."""
    await bench.start()
    _, request = await bench.ordered()
    last = RunEvent(task=request.task, subtask="s1", attempt=1, kind=STARTED, gateway="gw-1")
    bench.plane.rpc.on["run_status"] = answer(RunStatus(running=False, last=last))
    _, again = await bench.ordered()
    assert again.attempt == 2


async def test_a_talkative_run_does_not_hide_a_silent_one(bench: Any) -> None:
    """Checks follow the clock: s2 is found lost although s1 never stops telling."""
    bench.context.the_plan = bench.plan_of(Subtask(id="s1", skill="work"), Subtask(id="s2", skill="work"))

    async def status(gateway: str, ask: RunAsk) -> RunStatus:
        return RunStatus(running=ask.subtask == "s1")

    bench.plane.rpc.on["run_status"] = status
    await bench.start()
    _, first = await bench.ordered()
    await bench.ordered()

    async def talk() -> None:
        for number in range(400):
            bench.tell(first, PROGRESS, progress=number / 1000)
            await asyncio.sleep(0.005)

    talking = asyncio.create_task(talk())
    _, again = await bench.ordered()
    assert (again.subtask, again.attempt) == ("s2", 2)
    talking.cancel()


async def test_a_lost_gateways_runs_are_repeated_elsewhere(bench: Any) -> None:
    """The attempt on it has failed; the next goes to another gateway."""
    await bench.start()
    await bench.ordered()
    bench.say(GatewayLost("gw-1"))
    gateway, request = await bench.ordered()
    assert (gateway, request.attempt) == ("gw-2", 2)


async def test_events_of_outdated_attempts_and_strange_subtasks_change_nothing(bench: Any) -> None:
    """A late success of attempt 1 does not end attempt 2, and events of no subtask are dropped."""
    await bench.start()
    _, first = await bench.ordered()
    bench.say(GatewayLost("gw-1"))
    _, second = await bench.ordered()
    bench.tell(first, SUCCEEDED, result={"late": True})
    bench.tell(replace(second, subtask="s9"), SUCCEEDED)
    bench.tell(second, SUCCEEDED, gateway="gw-2", result={"late": False})
    assert (await bench.end()).subtasks[0].result == {"late": False}


async def test_repeated_failures_of_an_attempt_do_not_put_off_the_next(bench: Any) -> None:
    """A second word of the same failure is stale."""
    await bench.start()
    _, request = await bench.ordered()
    failure = Failure(code="robot", message="slipped", retryable=True)
    bench.tell(request, FAILED, failure=failure)
    await bench.until(lambda record: record.subtasks[0].state is SubtaskState.READY)
    due = dict(bench.coordinator._decider._backoff.not_before)
    bench.tell(request, FAILED, failure=failure)
    await asyncio.sleep(0.02)
    assert bench.coordinator._decider._backoff.not_before == due


async def test_a_record_that_has_moved_on_stops_the_driver_before_it_orders_anything(bench: Any) -> None:
    """Two coordinators: the one whose write conflicts stops, and its order is never sent."""
    bench.context.planning = asyncio.Event()
    driver = await bench.start()
    stored = bench.plane.dht.records[task_key("t-1")]
    other = replace(driver.record, coordinator="gw-2", sequence=2)
    await bench.plane.dht.write(task_key("t-1"), encode(other), expected=stored.version)
    bench.context.planning.set()
    await bench.end()
    assert bench.context.orders.empty()
    assert not driver.ended
    assert bench.stored().coordinator == "gw-2"


async def test_a_final_record_that_could_not_be_written_is_not_an_end(bench: Any) -> None:
    """The driver breaks and says so: somebody must drive the task again."""
    driver = await bench.start()
    _, request = await bench.ordered()
    bench.plane.dht.break_next = [UnreachableError("no owner")]
    bench.tell(request, SUCCEEDED)
    with pytest.raises(UnreachableError):
        await bench.end()
    assert driver.record.state.final
    assert not driver.ended


async def test_without_a_robot_it_waits_with_a_note_and_goes_on_when_there_is_one(bench: Any) -> None:
    """The reason is in the written record, for every gateway to tell."""
    bench.context.the_plan = bench.plan_of(Subtask(id="s1", skill="work", robot="r1"))
    bench.context.robot = (None, "waits for r1: offline")
    driver = await bench.start()
    await bench.until(lambda record: bool(record.subtasks) and "offline" in record.subtasks[0].note)
    async with asyncio.timeout(60):
        while not bench.stored().subtasks or "offline" not in bench.stored().subtasks[0].note:
            await asyncio.sleep(0.005)
    assert driver.waits
    bench.context.robot = ("r1", "")
    bench.say(Wake())
    _, request = await bench.ordered()
    assert request.robot == "r1"
    assert not driver.waits


async def test_without_a_gateway_it_waits_with_a_note(bench: Any) -> None:
    """Nobody can run it: the record says who is there and why not."""
    bench.context.places = []
    await bench.start()
    await bench.until(lambda record: bool(record.subtasks) and "waits for a gateway" in record.subtasks[0].note)
    bench.context.places = ["gw-2"]
    assert (await bench.ordered())[0] == "gw-2"


async def test_a_skill_that_this_gateway_does_not_know_fails_the_task_with_the_reason(bench: Any) -> None:
    """No KeyError over and over."""
    bench.context.skills = {}
    await bench.start()
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert "no skill work" in ended.failure.message


async def test_an_oversize_result_fails_the_subtask(bench: Any) -> None:
    """Also one that did not pass our executor: it never gets into the record."""
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, SUCCEEDED, result={"x": "y" * 60_000})
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert "artifact" in ended.subtasks[0].failure.remedy


async def test_strange_numbers_and_endless_notes_are_cut(bench: Any) -> None:
    """Progress is 0 to 1, and a note has an end."""
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, PROGRESS, progress=1e308, note="n" * 100_000)
    record = await bench.until(lambda record: record.subtasks[0].progress > 0)
    assert record.subtasks[0].progress == 1.0
    assert len(record.subtasks[0].note) <= 500


async def test_a_run_that_was_passed_on_is_asked_for_where_it_went(bench: Any) -> None:
    """The gateway that accepted answers for the run."""
    bench.context.passed_to = "gw-3"
    await bench.start()
    await bench.ordered()
    await bench.until(lambda record: record.subtasks[0].gateway == "gw-3")
    bench.say(GatewayLost("gw-3"))
    _, request = await bench.ordered()
    assert request.attempt == 2


async def test_runs_are_asked_for_where_messages_may_be_missing(bench: Any) -> None:
    """At once, and not when they have been silent for long: the end of the run may be what did not arrive."""
    await bench.start()
    _, request = await bench.ordered()
    ended = RunEvent(
        task=request.task, subtask=request.subtask, attempt=request.attempt, gateway="gw-1", kind=SUCCEEDED, at_ns=1,
        result={"x": 1},
    )  # fmt: skip
    bench.plane.rpc.on["run_status"] = answer(RunStatus(running=False, last=ended))
    bench.say(GatewayRelinked("gw-2"))
    bench.say(GatewayRelinked("gw-1"))
    assert (await bench.end()).subtasks[0].result == {"x": 1}


async def test_a_silent_run_is_given_up_after_its_deadline(bench: Any) -> None:
    """A gateway that says `running` for ever does not hold the task for ever."""
    bench.context.skills = {"work": replace(bench.context.skills["work"], timeout_s=0.05)}
    bench.plane.rpc.on["run_status"] = answer(RunStatus(running=True))
    await bench.start()
    await bench.ordered()
    ended = await bench.end()
    assert ended.subtasks[0].failure.code == "deadline"


async def test_news_that_nobody_can_take_in_is_dropped(bench: Any) -> None:
    """A flood while the driver waits stays bounded, and a cancel still gets through."""
    driver = await bench.start()
    _, request = await bench.ordered()
    for _ in range(10_000):
        bench.tell(request, PROGRESS)
        bench.tell(request, RunEventKind.LOG)
        bench.say(Wake())
    assert driver._inbox.qsize() <= 1000
    bench.say(CancelAsked())
    assert driver._inbox.qsize() <= 1001


async def test_a_task_that_is_given_up_ends_with_the_reason(bench: Any) -> None:
    """When drivers of it broke again and again, its runs are ended and it fails."""
    why = Failure(code="internal", message="driving it broke: KeyError")
    await bench.start()
    _, request = await bench.ordered()
    bench.task.cancel()
    await asyncio.gather(bench.task, return_exceptions=True)
    bench.plane.rpc.on["run_status"] = answer(RunStatus(running=True))
    await bench.start(bench.stored(), give_up=why)
    await bench.until(lambda record: record.state is TaskState.CANCELLING)
    bench.tell(request, FAILED, failure=Failure(code="cancelled", message="cancelled"))
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert ended.failure.message == why.message


async def test_a_run_that_its_gateway_ended_by_itself_is_repeated(bench: Any) -> None:
    """Nobody has cancelled the task: the attempt is repeated, at no cost to the skill's retries."""
    await bench.start()
    for _ in range(3):
        _, request = await bench.ordered()
        bench.tell(request, FAILED, failure=Failure(code="cancelled", message="the gateway drains"))
    _, request = await bench.ordered()
    bench.tell(request, SUCCEEDED, result={"ok": 1})
    ended = await bench.end()
    assert ended.state is TaskState.SUCCEEDED
    assert [each.failure.code for each in ended.subtasks[0].attempts[:3]] == ["orphaned"] * 3
