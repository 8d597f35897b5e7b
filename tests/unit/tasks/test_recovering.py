"""Driving a task whose work goes wrong, on fakes: stuck runs, stragglers, new plans, an operator's word."""

import asyncio
import time
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.model import Failure, Plan, Provenance, RunEvent, RunEventKind, Subtask, SubtaskState, TaskState, Tier
from appliance.model.task_api import ApproveAsk, RejectAsk, RunStatus
from appliance.tasks.events import CancelAsked, RunReported
from appliance.tasks.settings import ReplanConfig

pytestmark = pytest.mark.anyio

SUCCEEDED, FAILED, STARTED = RunEventKind.SUCCEEDED, RunEventKind.FAILED, RunEventKind.STARTED
BROKEN = Failure(code="skill", message="broken on purpose")
WORK = Subtask(id="s1", skill="work", params={"n": 1})
NEXT = Subtask(id="s2", skill="work", params={"n": 2}, after=("s1",))
BESIDE = Subtask(id="s3", skill="work", params={"n": 3})


def new_plan(*subtasks: Subtask, confidence: float = 0.9) -> Plan:
    """What the decomposer answers."""
    return Plan(domain="any", subtasks=subtasks, confidence=confidence)


def unsure(plan: Plan) -> Plan:
    """Return a plan that the review holds: the decomposer is not sure enough of it."""
    found = Provenance(tier=Tier.RULES, confidence=0.4, confirm=("the planner is 0.40 sure",))
    return replace(plan, confidence=0.4, provenance=found)


OTHERWISE = new_plan(replace(WORK, id="a"), Subtask(id="b", skill="work", params={"n": 9}, after=("a",)))
ONCE_MORE = new_plan(replace(WORK, id="a"), Subtask(id="b", skill="work", params={"n": 10}, after=("a",)))


async def first_done_second_broken(bench: Any, *more: Subtask, then: str = "") -> None:
    """Drive a task until its second subtask is given up; `then`: why plans have to be approved from there."""
    bench.context.the_plan = bench.plan_of(WORK, NEXT, *more)
    await bench.start()
    orders = {}
    for _ in range(1 + len(more)):
        _, request = await bench.ordered()
        orders[request.subtask] = request
        bench.tell(request, STARTED)
    bench.tell(orders["s1"], SUCCEEDED, result={"first": True})
    _, request = await bench.ordered()
    assert request.subtask == "s2"
    bench.context.approve_why = then
    bench.tell(request, FAILED, failure=BROKEN)


async def test_a_new_plan_keeps_what_is_finished_and_replaces_the_rest(bench: Any) -> None:
    """The decomposer is asked with the record; its plan goes on from the first subtask's result."""
    bench.context.new_plan = OTHERWISE
    await first_done_second_broken(bench)
    _, request = await bench.ordered()
    assert (request.subtask, request.attempt, request.params) == ("r1ltn_1", 1, {"n": 9})
    assert request.inputs == {"s1": {"skill": "work", "first": True}}
    bench.tell(request, SUCCEEDED)
    ended = await bench.end()
    assert ended.state is TaskState.SUCCEEDED
    (asked,) = bench.context.asked
    assert asked.of("s2").state is SubtaskState.FAILED
    assert [(each.kind, each.subtask, each.why) for each in ended.revisions] == [("plan", "s2", "broken on purpose")]
    assert bench.context.noted == ["replanned"]


async def test_where_nobody_can_plan_anew_the_first_failure_stands(bench: Any) -> None:
    """The task fails with what failed, and with why there is no new plan."""
    bench.context.new_plan = PlanError("rules cannot plan around a failure")
    await first_done_second_broken(bench)
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert ended.failure.code == "skill"
    assert "broken on purpose" in ended.failure.message
    assert "rules cannot plan around a failure" in ended.failure.message


async def test_a_decomposer_that_breaks_or_hangs_ends_the_task_with_the_first_failure(bench: Any) -> None:
    """Neither a defect nor silence holds a task for ever."""
    bench.context.asking = asyncio.Event()
    bench.context.config = replace(bench.context.config, replan=ReplanConfig(ask_s=0.05))
    await first_done_second_broken(bench)
    ended = await bench.end()
    assert "the decomposer took over 0.05 s" in ended.failure.message


async def test_an_unsure_plan_waits_for_an_operator(bench: Any) -> None:
    """Below the threshold it is proposed and nothing is sent; with an operator's word it takes effect."""
    bench.context.new_plan = unsure(OTHERWISE)
    await first_done_second_broken(bench)
    record = await bench.until(lambda record: record.proposal is not None)
    assert record.proposal.waits
    assert "waits for an operator" in record.of("s2").note
    await asyncio.sleep(0.05)
    assert bench.context.orders.empty()
    await bench.order(ApproveAsk(id="t-1", by="ann"))
    _, request = await bench.ordered()
    assert request.subtask == "r1ltn_1"


async def test_whoever_confirmed_the_first_plan_is_asked_again(bench: Any) -> None:
    """A task from the terminal UI: its plan was the decomposer's and confirmed; the new one waits, however sure."""
    plan = replace(bench.plan_of(WORK), confidence=0.95)
    bench.context.the_plan = plan
    bench.context.new_plan = new_plan(Subtask(id="b", skill="work", params={"n": 9}))
    await bench.start(bench.plane.accepted(plan=plan))
    _, request = await bench.ordered()
    bench.tell(request, FAILED, failure=BROKEN)
    record = await bench.until(lambda record: record.proposal is not None)
    assert record.proposal.waits


async def test_the_approval_rule_counts_for_a_new_plan(bench: Any) -> None:
    """What must be approved before it runs must be after a failure too, however sure the decomposer is."""
    bench.context.new_plan = OTHERWISE
    await first_done_second_broken(bench, then="s2 flies")
    record = await bench.until(lambda record: record.proposal is not None or record.replans > 0)
    assert record.proposal is not None
    assert record.proposal.waits
    assert "s2 flies" in record.proposal.note


async def test_an_operator_turns_a_plan_down(bench: Any) -> None:
    """The task fails with the first failure, and says who did not agree."""
    bench.context.new_plan = unsure(OTHERWISE)
    await first_done_second_broken(bench)
    await bench.until(lambda record: record.proposal is not None)
    await bench.order(RejectAsk(id="t-1", by="ann"))
    ended = await bench.end()
    assert "ann turned the new plan down" in ended.failure.message


async def test_a_proposal_that_nobody_answers_ends(bench: Any) -> None:
    """The wait for an operator is bounded."""
    bench.context.config = replace(bench.context.config, replan=ReplanConfig(confirm_s=0.05))
    bench.context.new_plan = unsure(OTHERWISE)
    await first_done_second_broken(bench)
    ended = await bench.end()
    assert "no operator agreed" in ended.failure.message


async def test_each_proposal_has_the_whole_time_to_be_answered(bench: Any) -> None:
    """A second one, later than the first one's time, waits for an operator as well."""
    bench.plane.rpc.on["run_status"] = running
    bench.context.config = replace(bench.context.config, replan=ReplanConfig(confirm_s=2.0))
    bench.context.new_plan = unsure(OTHERWISE)
    await first_done_second_broken(bench)
    await bench.until(lambda record: record.proposal is not None)
    await bench.order(ApproveAsk(id="t-1", by="ann"))
    _, request = await bench.ordered()
    bench.tell(request, STARTED)
    await asyncio.sleep(2.1)
    bench.context.new_plan = unsure(ONCE_MORE)
    bench.tell(request, FAILED, failure=BROKEN)
    await bench.until(lambda record: record.proposal is not None or record.state.final)
    await bench.order(ApproveAsk(id="t-1", by="ann"))
    _, request = await bench.ordered()
    bench.tell(request, SUCCEEDED)
    assert (await bench.end()).state is TaskState.SUCCEEDED


async def test_a_takeover_does_not_prolong_the_wait_for_an_operator(bench: Any) -> None:
    """The next coordinator counts from when the plan was proposed, by the task's own age."""
    bench.context.new_plan = unsure(OTHERWISE)
    await first_done_second_broken(bench)
    await bench.until(lambda record: record.proposal is not None)
    async with asyncio.timeout(60):
        while bench.stored().proposal is None:
            await asyncio.sleep(0.005)
    bench.task.cancel()
    await asyncio.gather(bench.task, return_exceptions=True)
    await bench.start(bench.stored(), elapsed_s=bench.stored().proposal.expires_s + 60.0)
    ended = await bench.end()
    assert "no operator agreed" in ended.failure.message


async def test_runs_that_a_second_new_plan_leaves_out_have_the_whole_grace(bench: Any) -> None:
    """They are asked to end as those of the first one were, however long ago that was."""
    bench.plane.rpc.on["run_status"] = running
    bench.context.config = replace(bench.context.config, grace_s=1.0)
    beside = Subtask(id="c", skill="work", params={"n": 4})
    bench.context.new_plan = new_plan(*OTHERWISE.subtasks, beside)
    await first_done_second_broken(bench, BESIDE)
    ordered = [(await bench.ordered())[1] for _ in range(2)]  # s3 does not confirm that it ended: after the grace
    assert bench.coordinator.record.replans == 1
    for request in ordered:
        bench.tell(request, STARTED)
    bench.context.new_plan = ONCE_MORE
    broken, left = sorted(ordered, key=lambda request: request.params["n"], reverse=True)
    bench.tell(broken, FAILED, failure=BROKEN)
    async with asyncio.timeout(60):
        while not any(verb == "run_cancel" and ask.subtask == left.subtask for _, verb, ask in bench.plane.rpc.calls):
            await asyncio.sleep(0.005)
    event = replace(
        last_of(bench.coordinator.record.of(left.subtask)), kind=SUCCEEDED, result={"late": True}, failure=None
    )
    bench.coordinator.put(RunReported(event))
    _, request = await bench.ordered()
    bench.tell(request, SUCCEEDED)
    ended = await bench.end()
    assert ended.of(left.subtask).result == {"late": True}, "the run was given up before it could end"


async def test_runs_that_the_new_plan_leaves_out_are_ended_first(bench: Any) -> None:
    """s3 still runs and is not in the new plan: it is cancelled, and only then does the plan take effect."""
    bench.plane.rpc.on["run_status"] = running
    bench.context.config = replace(bench.context.config, grace_s=5.0)
    bench.context.new_plan = OTHERWISE
    await first_done_second_broken(bench, BESIDE)
    async with asyncio.timeout(60):
        while not any(verb == "run_cancel" and ask.subtask == "s3" for _, verb, ask in bench.plane.rpc.calls):
            await asyncio.sleep(0.005)
    assert bench.coordinator.record.revised == 0
    beside = next(each for each in bench.coordinator.record.subtasks if each.subtask.id == "s3")
    event = replace(last_of(beside), failure=Failure(code="cancelled", message="stopped"))
    bench.coordinator.put(RunReported(event))
    _, request = await bench.ordered()
    assert request.subtask == "r1ltn_1"
    bench.tell(request, SUCCEEDED)
    ended = await bench.end()
    assert ended.state is TaskState.SUCCEEDED
    assert {each.id for each in ended.revisions[0].dropped} == {"s2", "s3"}


async def test_what_finishes_while_it_is_to_be_ended_stays_finished(bench: Any) -> None:
    """The cancel comes too late: s3's result is kept."""
    bench.plane.rpc.on["run_status"] = running
    bench.context.config = replace(bench.context.config, grace_s=5.0)
    bench.context.new_plan = OTHERWISE
    await first_done_second_broken(bench, BESIDE)
    await bench.until(lambda record: record.proposal is not None)
    event = replace(last_of(bench.coordinator.record.of("s3")), kind=SUCCEEDED, result={"late": True}, failure=None)
    bench.coordinator.put(RunReported(event))
    _, request = await bench.ordered()
    bench.tell(request, SUCCEEDED)
    ended = await bench.end()
    assert ended.of("s3").result == {"late": True}


async def test_a_coordinator_that_takes_over_does_not_ask_again(bench: Any) -> None:
    """The proposal is in the record: the next driver has it take effect."""
    bench.context.new_plan = unsure(OTHERWISE)
    await first_done_second_broken(bench)
    await bench.until(lambda record: record.proposal is not None)
    async with asyncio.timeout(60):
        while bench.stored().proposal is None:
            await asyncio.sleep(0.005)
    bench.task.cancel()
    await asyncio.gather(bench.task, return_exceptions=True)
    bench.plane.gateway = "gw-3"
    await bench.start(bench.stored())
    await bench.order(ApproveAsk(id="t-1"))
    _, request = await bench.ordered()
    assert request.subtask == "r1ogp_1"
    assert len(bench.context.asked) == 1


async def test_cancel_while_it_is_planned_anew_ends_it(bench: Any) -> None:
    """The decomposer is not waited for."""
    bench.context.asking = asyncio.Event()
    await first_done_second_broken(bench)
    await bench.until(lambda _: bool(bench.context.asked))
    bench.say(CancelAsked())
    assert (await bench.end()).state is TaskState.CANCELLED


async def test_a_stuck_run_is_ended_and_tried_elsewhere(bench: Any) -> None:
    """A skill that promises a sign of life and gives none: its run is cancelled, the next attempt is on gw-2."""
    bench.context.skills = {"work": replace(bench.context.skills["work"], silent_s=0.1)}
    bench.plane.rpc.on["run_status"] = running
    await bench.start()
    gateway, request = await bench.ordered()
    bench.tell(request, STARTED)
    again, second = await bench.ordered()
    assert (gateway, again, second.attempt, second.avoid) == ("gw-1", "gw-2", 2, ("gw-1",))
    assert any(verb == "run_cancel" and ask.attempt == 1 for _, verb, ask in bench.plane.rpc.calls)
    first = bench.coordinator.record.of("s1").attempts[0]
    assert first.failure.code == "stuck"
    assert bench.context.noted == ["stuck"]


async def test_signs_of_life_keep_a_run_going(bench: Any) -> None:
    """Log lines and heartbeats are signs of life although the record keeps nothing of them."""
    bench.context.skills = {"work": replace(bench.context.skills["work"], silent_s=2.0)}
    bench.plane.rpc.on["run_status"] = running
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, STARTED)
    until = time.monotonic() + 2.5
    while time.monotonic() < until:
        for kind in (RunEventKind.ALIVE, RunEventKind.LOG):
            bench.tell(request, kind)
            await asyncio.sleep(0.02)
    bench.tell(request, SUCCEEDED)
    ended = await bench.end()
    assert [each.number for each in ended.of("s1").attempts] == [1]


async def test_nothing_is_kept_of_attempts_that_nobody_ordered(bench: Any) -> None:
    """However many somebody tells of: the record says which attempt is the present one."""
    decider = (await bench.start())._decider
    _, request = await bench.ordered()
    for attempt in range(2, 300):
        for subtask in ("s1", "nobody"):
            bench.tell(replace(request, subtask=subtask, attempt=attempt), STARTED)
    bench.tell(request, STARTED)
    assert list(decider._alive) == list(decider._began) == [("s1", 1)]


async def test_its_own_gateways_word_that_a_run_is_alive_counts(bench: Any) -> None:
    """Events that are lost on the way do not make a run stuck: its gateway is asked before."""

    async def alive(gateway: str, ask: Any) -> RunStatus:
        return RunStatus(running=True, silent_s=0.0)

    bench.context.skills = {"work": replace(bench.context.skills["work"], silent_s=0.1)}
    bench.plane.rpc.on["run_status"] = alive
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, STARTED)
    await asyncio.sleep(0.5)
    assert bench.coordinator.record.of("s1").state is SubtaskState.RUNNING


async def test_a_straggler_of_a_willing_skill_goes_on_elsewhere_once(bench: Any) -> None:
    """It is left for a new attempt on gw-2; that one straggles too and is let be, with a note."""
    bench.context.skills = {"work": replace(bench.context.skills["work"], speculate=True)}
    detection = replace(bench.context.config.detection, straggler_minimum_s=0.1, stuck_minimum_s=100.0)
    bench.context.config = replace(bench.context.config, detection=detection)
    bench.context.known = {"work": (0.01,) * 5}
    bench.plane.rpc.on["run_status"] = running
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, STARTED)
    gateway, second = await bench.ordered()
    assert (gateway, second.attempt) == ("gw-2", 2)
    bench.tell(second, STARTED, gateway="gw-2")
    await bench.until(lambda record: record.of("s1").attempt == 2 and record.of("s1").condition == "straggling")
    await asyncio.sleep(0.1)
    assert bench.context.orders.empty()
    bench.tell(second, SUCCEEDED, gateway="gw-2")
    ended = await bench.end()
    assert ended.of("s1").attempts[0].left.startswith("straggling")
    assert bench.context.noted == ["straggling", "speculated", "straggling"]


async def test_a_straggler_of_any_other_skill_is_only_noted(bench: Any) -> None:
    """What commands a robot is never moved on: its effects could double."""
    detection = replace(bench.context.config.detection, straggler_minimum_s=0.1, stuck_minimum_s=100.0)
    bench.context.config = replace(bench.context.config, detection=detection)
    bench.context.known = {"work": (0.01,) * 5}
    bench.plane.rpc.on["run_status"] = running
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, STARTED)
    record = await bench.until(lambda record: record.of("s1").condition == "straggling")
    assert "others took" in record.of("s1").note
    await asyncio.sleep(0.1)
    assert bench.context.orders.empty()


async def running(gateway: str, ask: Any) -> RunStatus:
    """Answer that it runs."""
    return RunStatus(running=True)


def last_of(target: Any) -> Any:
    """The end of a subtask's current run."""
    return RunEvent(
        task="t-1", subtask=target.subtask.id, attempt=target.attempt, kind=FAILED, gateway=target.gateway
    )  # fmt: skip
