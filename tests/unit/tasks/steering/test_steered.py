"""Operators' orders on a driven task: approval, pauses, retries; and what soft stops and leases mean for it."""

import asyncio
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from appliance.errors import ConflictError, NotFoundError, PlanError, RefusedError, SwiftbotError
from appliance.model import (
    Failure,
    Provenance,
    RobotWork,
    RunEventKind,
    SoftStop,
    Subtask,
    SubtaskState,
    TaskRecord,
    TaskState,
    Tier,
    encode,
)
from appliance.model.task_api import (
    ApproveAsk,
    FirstAsk,
    Held,
    PauseAsk,
    RejectAsk,
    ResumeAsk,
    RetryAsk,
    RunAsk,
    RunStatus,
)
from appliance.tasks import machine
from appliance.tasks.events import CancelAsked, Wake
from appliance.tasks.machine import plan_hash
from appliance.tasks.record_writer import Draft, RecordWriter
from appliance.tasks.steering import revived

pytestmark = pytest.mark.anyio

ONE_AFTER_ANOTHER = (Subtask(id="s1", skill="work"), Subtask(id="s2", skill="work", after=("s1",)))
ON_ROBOT = (Subtask(id="s1", skill="work", robot="r1"), Subtask(id="s2", skill="work", after=("s1",)))


async def proposed(bench: Any) -> TaskRecord:
    """Have a task whose first plan waits."""
    bench.context.approve_why = "every plan is approved first"
    await bench.start()
    return await bench.until(lambda record: record.state is TaskState.PROPOSED)


def fold(bench: Any) -> TaskRecord:
    """Fold the published transitions over what was accepted, as a replay of the log does."""
    record = bench.plane.accepted()
    for each in bench.transitions():
        record = machine.apply(record, each)
    return record


def same(one: TaskRecord, other: TaskRecord) -> bool:
    """Whether two records tell the same."""
    return msgspec.to_builtins(one) == msgspec.to_builtins(other)


async def test_a_plan_that_waits_runs_when_it_is_approved(bench: Any) -> None:
    """Nothing is sent before; the record says why it waits, by which hash, and then who approved it."""
    record = await proposed(bench)
    assert record.proposal.note == "every plan is approved first"
    assert record.proposal.hash == plan_hash(bench.context.the_plan)
    assert record.proposal.expires_s == 600.0
    await asyncio.sleep(0.05)
    assert bench.context.orders.empty()
    ask = ApproveAsk(id="t-1", hash=record.proposal.hash[:12], by="ann", why="looks right", act="o-1")
    approved = await bench.order(ask)
    assert approved.state is TaskState.RUNNING
    assert (approved.decision.by, approved.decision.why, approved.decision.edited) == ("ann", "looks right", False)
    assert bench.stored().decision == approved.decision
    _, request = await bench.ordered()
    assert request.subtask == "s1"
    assert same(fold(bench), bench.coordinator.written)
    again = await bench.order(ask)  # the answer was lost: the same order is done once
    assert again.decision == approved.decision


async def test_of_two_operators_one_wins_and_the_other_hears_who(bench: Any) -> None:
    """The second gets `conflict` with the first one's name and verdict, whatever they wanted."""
    record = await proposed(bench)
    given = record.proposal.hash
    asks = [
        ApproveAsk(id="t-1", hash=given, by="ann", act="a"),
        RejectAsk(id="t-1", hash=given, by="bob", act="b"),
        ApproveAsk(id="t-1", hash=given, by="cy", act="c"),
    ]
    outcomes = await asyncio.gather(*(bench.order(each) for each in asks), return_exceptions=True)
    assert isinstance(outcomes[0], TaskRecord)
    for late in outcomes[1:]:
        assert isinstance(late, ConflictError)
        assert "ann has approved" in late.message


async def test_an_edited_plan_is_checked_before_it_is_taken(bench: Any) -> None:
    """What is wrong comes back as problems and the task waits on; a valid one runs, and the record says edited."""
    record = await proposed(bench)
    edited = bench.plan_of(Subtask(id="s1", skill="work", params={"n": 2}))
    bench.context.wrong = ("s1: there is no dock 9",)
    with pytest.raises(PlanError) as refused:
        await bench.order(ApproveAsk(id="t-1", hash=record.proposal.hash, plan=edited, by="ann"))
    assert refused.value.problems == ("s1: there is no dock 9",)
    assert bench.coordinator.record.state is TaskState.PROPOSED
    bench.context.wrong = ()
    await bench.order(ApproveAsk(id="t-1", hash=record.proposal.hash, plan=edited, by="ann"))
    _, request = await bench.ordered()
    assert request.params == {"n": 2}
    ran = bench.coordinator.record
    assert ran.decision.edited
    assert (ran.decision.plan, ran.decision.note) == (record.proposal.plan, record.proposal.note)
    assert same(fold(bench), bench.coordinator.written)


async def test_an_edited_plan_keeps_where_the_one_before_came_from(bench: Any) -> None:
    """Its provenance says that it was edited; one that is sent back as it was is no edit."""
    origin = Provenance(tier=Tier.LOCAL, confidence=0.7, key="k")
    bench.context.the_plan = replace(bench.context.the_plan, provenance=origin)
    record = await proposed(bench)
    edited = bench.plan_of(Subtask(id="s1", skill="work", params={"n": 2}))
    await bench.order(ApproveAsk(id="t-1", hash=record.proposal.hash, plan=edited, by="ann"))
    await bench.ordered()
    ran = bench.coordinator.record
    assert ran.plan.provenance == replace(origin, edited=True)
    assert ran.decision.plan.provenance == origin
    assert same(fold(bench), bench.coordinator.written)


async def test_a_plan_that_is_sent_back_as_it_was_is_approved_and_not_edited(bench: Any) -> None:
    """An editor that was closed without a change: the record has one plan, approved."""
    record = await proposed(bench)
    await bench.order(ApproveAsk(id="t-1", hash=record.proposal.hash, plan=record.proposal.plan, by="ann"))
    await bench.ordered()
    ran = bench.coordinator.record
    assert (ran.decision.edited, ran.decision.plan) == (False, None)


async def test_an_approval_is_bound_to_the_hash(bench: Any) -> None:
    """Another hash is a conflict, and one that is too short means none."""
    await proposed(bench)
    with pytest.raises(ConflictError, match="another one"):
        await bench.order(ApproveAsk(id="t-1", hash="0" * 64, by="ann"))
    with pytest.raises(RefusedError, match="too short"):
        await bench.order(ApproveAsk(id="t-1", hash="ab", by="ann"))
    assert bench.coordinator.record.state is TaskState.PROPOSED


async def test_a_plan_that_is_turned_down_cancels_its_task(bench: Any) -> None:
    """Nothing has run; who said no and why is in the record, and later orders hear of it."""
    await proposed(bench)
    await bench.order(RejectAsk(id="t-1", by="ann", why="the dock is closed"))
    ended = await bench.end()
    assert ended.state is TaskState.CANCELLED
    assert (ended.cancelled_by.by, ended.cancelled_by.why) == ("ann", "the dock is closed")
    assert (ended.decision.plan, ended.decision.note) == (bench.context.the_plan, "every plan is approved first")
    assert same(fold(bench), ended)


async def test_a_plan_that_nobody_approves_expires(bench: Any) -> None:
    """The task fails with the reason, by its own clock, whichever gateway coordinated it before."""
    bench.context.config = replace(bench.context.config, approval_s=0.05)
    bench.context.approve_why = "every plan is approved first"
    await bench.start()
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert "no operator approved its plan" in ended.failure.message


async def test_a_successor_waits_on_with_the_same_proposal(bench: Any) -> None:
    """It does not plan again; the approval given to it counts."""
    record = await proposed(bench)
    async with asyncio.timeout(60):
        while bench.stored().proposal is None:
            await asyncio.sleep(0.005)
    bench.task.cancel()
    await asyncio.gather(bench.task, return_exceptions=True)
    bench.plane.gateway = "gw-3"
    bench.context.the_plan = PlanError("must not be asked again")
    await bench.start(bench.stored())
    await bench.order(ApproveAsk(id="t-1", hash=record.proposal.hash))
    _, request = await bench.ordered()
    assert request.subtask == "s1"


async def test_cancel_while_a_plan_waits(bench: Any) -> None:
    """It ends at once as cancelled."""
    await proposed(bench)
    bench.say(CancelAsked())
    assert (await bench.end()).state is TaskState.CANCELLED


async def test_a_paused_task_starts_nothing_and_goes_on_when_resumed(bench: Any) -> None:
    """What runs goes on to its end; its successor waits with the reason until somebody resumes."""
    bench.context.the_plan = bench.plan_of(
        Subtask(id="s1", skill="work"), Subtask(id="s2", skill="work", after=("s1",))
    )
    await bench.start()
    _, request = await bench.ordered()
    record = await bench.order(PauseAsk(id="t-1", by="ann", why="lunch", act="p"))
    assert record.paused == "paused by ann: lunch"
    with pytest.raises(ConflictError, match="paused by ann"):
        await bench.order(PauseAsk(id="t-1", by="bob", act="q"))
    bench.tell(request, RunEventKind.SUCCEEDED, result={})
    await bench.until(lambda record: record.of("s2").state is SubtaskState.READY)
    bench.say(Wake())
    await asyncio.sleep(0.05)
    assert bench.context.orders.empty()
    await bench.order(ResumeAsk(id="t-1", by="bob"))
    _, request = await bench.ordered()
    assert request.subtask == "s2"
    assert same(fold(bench), bench.coordinator.written)


async def test_a_task_waits_for_its_turn_at_a_robot_and_is_put_before_another(bench: Any) -> None:
    """It is not given to another robot meanwhile; the order is in the record, and carried out once."""
    bench.context.the_plan = bench.plan_of(*ON_ROBOT)
    bench.context.others_first = "waits for r1: task t-0 goes first"
    row = RobotWork(robot="r1", task="t-0", state="ready", priority=7, place_ns=50, uses=("base",))
    bench.context.work = [row, replace(row, task="t-1", priority=5)]
    await bench.start()
    await bench.until(lambda record: record.subtasks and record.of("s1").note == bench.context.others_first)
    assert bench.context.orders.empty()
    for _ in range(2):
        record = await bench.order(FirstAsk(id="t-1", by="ann", why="urgent", before="t-0", act="f"))
        assert record.priority == 7
        assert record.place_ns < 50
        assert (record.ranked_by.by, record.ranked_by.why) == ("ann", "urgent")
    with pytest.raises(RefusedError, match="cannot go before itself"):
        await bench.order(FirstAsk(id="t-1", before="t-1"))
    with pytest.raises(RefusedError, match="t-9 does not wait for a robot of task t-1"):
        await bench.order(FirstAsk(id="t-1", before="t-9"))
    bench.context.others_first = ""
    bench.say(Wake())
    _, request = await bench.ordered()
    assert request.robot == "r1"
    assert same(fold(bench), bench.coordinator.written)


async def test_a_pause_with_hold_ends_runs_that_save_checkpoints(bench: Any) -> None:
    """Such a run is made ready to leave, ended, and goes on as the next attempt; another one is left alone."""
    bench.context.skills = {
        "work": replace(bench.context.skills["work"], checkpoints=True),
        "plain": replace(bench.context.skills["work"], id="plain", checkpoints=False),
    }
    bench.context.the_plan = bench.plan_of(Subtask(id="s1", skill="work"), Subtask(id="s2", skill="plain"))
    cancelled: list[str] = []

    async def hold(gateway: str, ask: Any) -> Any:
        return Held(began=True, fresh=True, saved=True, hold_s=5.0)

    async def cancel(gateway: str, ask: RunAsk) -> RunStatus:
        cancelled.append(ask.run_id)
        return RunStatus(running=False)

    bench.plane.rpc.on |= {"run_hold": hold, "run_cancel": cancel}
    await bench.start()
    requests = {(await bench.ordered())[1].subtask for _ in range(2)}
    assert requests == {"s1", "s2"}
    await bench.order(PauseAsk(id="t-1", by="ann", hold=True))
    record = await bench.until(lambda record: record.of("s1").state is SubtaskState.READY)
    assert record.of("s1").attempts[0].left.startswith("held at its checkpoint")
    assert record.of("s2").state in (SubtaskState.DISPATCHED, SubtaskState.RUNNING)
    async with asyncio.timeout(60):
        while not cancelled:
            await asyncio.sleep(0.005)
    assert cancelled == ["t-1/s1/1"]
    await bench.order(ResumeAsk(id="t-1", by="ann"))
    _, request = await bench.ordered()
    assert (request.subtask, request.attempt) == ("s1", 2)
    assert same(fold(bench), bench.coordinator.written)


class Stopping:
    """Soft stops and leases in the test's hands."""

    def __init__(self) -> None:
        self.active: tuple[SoftStop, ...] = ()
        self.over: set[str] = set()
        self.lease = ""

    def holds(self, stop: SoftStop, robot: str) -> bool:
        """Whether it is one of its robots."""
        return stop in self.active and (not stop.robots or robot in stop.robots)

    def ended(self, stop: str, robots: Any) -> bool:  # noqa: ARG002 - as Commands has it
        """Whether the test has lifted it."""
        return stop in self.over

    def hindrance(self, robot: str) -> str:
        """The first stop, or the lease."""
        return next((each.text for each in self.active if self.holds(each, robot)), self.lease)

    def lift(self) -> None:
        """Lift all."""
        self.over |= {each.id for each in self.active}
        self.active = ()


async def test_a_soft_stop_pauses_tasks_of_the_robot_and_its_lifting_resumes_them(bench: Any) -> None:
    """The run is ended and counts for no failure, its late news is fenced off, and the next attempt follows."""
    bench.context.the_plan = bench.plan_of(*ON_ROBOT)
    bench.context.commands = stopping = Stopping()

    async def cancel(gateway: str, ask: RunAsk) -> RunStatus:
        return RunStatus(running=False)

    bench.plane.rpc.on["run_cancel"] = cancel
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.STARTED)
    await bench.until(lambda record: record.of("s1").state is SubtaskState.RUNNING)
    stopping.active = (SoftStop(id="st-1", robots=("r1",), by="ann", why="a person"),)
    bench.say(Wake())
    record = await bench.until(lambda record: bool(record.pauses))
    assert record.paused == "r1 stopped by ann: a person"
    assert record.of("s1").state is SubtaskState.READY
    broken = Failure(code="robot", message="stopped on request")
    bench.tell(request, RunEventKind.FAILED, failure=broken)
    with pytest.raises(RefusedError, match="goes on when the stop is lifted"):
        await bench.order(ResumeAsk(id="t-1", by="bob"))
    await asyncio.sleep(0.05)
    assert bench.context.orders.empty()
    assert bench.coordinator.record.of("s1").failure is None
    stopping.lift()
    bench.say(Wake())
    _, request = await bench.ordered()
    assert request.attempt == 2
    assert bench.coordinator.record.paused == ""
    assert same(fold(bench), bench.coordinator.written)


@pytest.mark.parametrize("stopped", ["r1", "r2", "r3"])
async def test_a_stop_of_any_robot_of_a_joint_step_ends_its_run(bench: Any, stopped: str) -> None:
    """The order names all its robots; a stop of any one ends the run, and the next attempt is of the same robots."""
    step = Subtask(id="s1", skill="work", robot="r1", params={"robots": ["r1", "r2", "r3"]})
    bench.context.the_plan = bench.plan_of(step)
    bench.context.commands = stopping = Stopping()
    ended: list[str] = []

    async def cancel(gateway: str, ask: RunAsk) -> RunStatus:
        ended.append(ask.run_id)
        return RunStatus(running=False)

    bench.plane.rpc.on["run_cancel"] = cancel
    await bench.start()
    _, request = await bench.ordered()
    assert (request.robot, request.others) == ("r1", ("r2", "r3"))
    bench.tell(request, RunEventKind.STARTED)
    record = await bench.until(lambda record: record.of("s1").state is SubtaskState.RUNNING)
    assert record.of("s1").robots == ("r1", "r2", "r3")
    stopping.active = (SoftStop(id="st-1", robots=(stopped,), by="ann"),)
    bench.say(Wake())
    record = await bench.until(lambda record: bool(record.pauses))
    assert record.of("s1").state is SubtaskState.READY
    await bench.until(lambda _: ended == ["t-1/s1/1"])
    assert bench.context.orders.empty()
    stopping.lift()
    bench.say(Wake())
    _, request = await bench.ordered()
    assert (request.attempt, request.robot, request.others) == (2, "r1", ("r2", "r3"))
    assert same(fold(bench), bench.coordinator.written)


async def test_a_stop_that_is_not_known_here_keeps_a_task_paused(bench: Any) -> None:
    """A successor that has not heard of the stop must not resume: only one that is known to be lifted ends a pause."""
    bench.context.the_plan = bench.plan_of(*ON_ROBOT)
    bench.context.commands = stopping = Stopping()
    stopping.active = (SoftStop(id="st-1", by="ann"),)
    await bench.start()
    await bench.until(lambda record: bool(record.pauses))
    stopping.active = ()
    bench.say(Wake())
    await asyncio.sleep(0.05)
    assert bench.coordinator.record.paused
    assert bench.context.orders.empty()


async def test_a_task_without_the_robot_is_left_alone(bench: Any) -> None:
    """A stop of another robot means nothing for it."""
    bench.context.commands = stopping = Stopping()
    stopping.active = (SoftStop(id="st-1", robots=("r9",), by="ann"),)
    await bench.start()
    await bench.ordered()
    assert not bench.coordinator.record.pauses


async def test_a_lease_ends_the_run_and_the_subtask_waits(bench: Any) -> None:
    """The task is not paused; its run on that robot is left for later."""
    bench.context.the_plan = bench.plan_of(*ON_ROBOT)
    bench.context.commands = stopping = Stopping()
    await bench.start()
    await bench.ordered()
    stopping.lease = "taken over by ann"
    bench.context.robot = (None, "waits for r1: taken over by ann")
    bench.say(Wake())
    record = await bench.until(lambda record: record.of("s1").state is SubtaskState.READY)
    assert not record.pauses
    assert "taken over by ann" in record.of("s1").note
    stopping.lease, bench.context.robot = "", ("r1", "")
    bench.say(Wake())
    _, request = await bench.ordered()
    assert request.attempt == 2


async def test_a_subtask_that_runs_is_tried_again_on_request(bench: Any) -> None:
    """Its run is left, the next attempt begins; what has succeeded is kept, and what there is not is reported."""
    bench.context.the_plan = bench.plan_of(
        Subtask(id="s1", skill="work"), Subtask(id="s2", skill="work", after=("s1",))
    )
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.SUCCEEDED, result={"n": 1})
    _, request = await bench.ordered()
    with pytest.raises(RefusedError, match="has succeeded"):
        await bench.order(RetryAsk(id="t-1", subtask="s1"))
    with pytest.raises(NotFoundError, match="has no subtask 's9'"):
        await bench.order(RetryAsk(id="t-1", subtask="s9"))
    with pytest.raises(RefusedError, match="nothing to try again"):
        await bench.order(RetryAsk(id="t-1"))
    await bench.order(RetryAsk(id="t-1", subtask="s2", by="ann", act="r"))
    _, request = await bench.ordered()
    assert (request.subtask, request.attempt) == ("s2", 2)
    assert bench.coordinator.record.retried_by.by == "ann"
    assert same(fold(bench), bench.coordinator.written)


async def test_a_failed_task_is_tried_again(bench: Any) -> None:
    """Attempts count on, the skill's retries start from zero, what has succeeded is kept; it replays the same."""
    bench.context.skills = {"work": replace(bench.context.skills["work"], retries=0)}
    bench.context.the_plan = bench.plan_of(
        Subtask(id="s1", skill="work"), Subtask(id="s2", skill="work", after=("s1",))
    )
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.SUCCEEDED, result={"n": 1})
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.FAILED, failure=Failure(code="handler", message="no", retryable=False))
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    before = ended.of("s2").attempt
    stored = bench.plane.dht.records["task/t-1"]
    draft = Draft(ended, "gw-1")
    fields = revived(ended, RetryAsk(id="t-1", by="ann", act="r"), elapsed_s=ended.elapsed_s)
    assert fields is not None
    draft.apply(machine.TransitionKind.RETRIED, **fields)
    await RecordWriter(bench.plane, draft, stored.version).flush()
    record = draft.record
    assert record.state is TaskState.RUNNING
    assert record.of("s1").state is SubtaskState.SUCCEEDED
    assert (record.of("s2").state, record.failure, record.retries) == (SubtaskState.READY, None, 1)
    assert not machine.gives_up(record.of("s2"), Failure(code="handler", message="x", retryable=True), retries=1)
    assert revived(record, RetryAsk(id="t-1", by="ann", act="r"), elapsed_s=0.0) is None
    await bench.start(record)
    _, request = await bench.ordered()
    assert (request.subtask, request.attempt) == ("s2", before + 1)
    bench.tell(request, RunEventKind.SUCCEEDED, result={})
    ended = await bench.end()
    assert ended.state is TaskState.SUCCEEDED
    assert same(fold(bench), ended)


async def test_orders_that_come_while_it_is_planned_are_looked_at_afterwards(bench: Any) -> None:
    """A pause given before there is a plan holds its first subtask."""
    bench.context.planning = asyncio.Event()
    await bench.start()
    pausing = asyncio.create_task(bench.order(PauseAsk(id="t-1", by="ann")))
    await asyncio.sleep(0.02)
    bench.context.planning.set()
    assert (await pausing).pauses
    await asyncio.sleep(0.05)
    # The plan may have been begun in the same breath as the pause was read: nothing is started after it.
    started = bench.context.orders.qsize()
    await asyncio.sleep(0.05)
    assert bench.context.orders.qsize() == started


async def test_an_order_that_a_driver_cannot_take_any_more_is_refused(bench: Any) -> None:
    """The caller hears that it was not written, and asks again."""
    await bench.start()
    await bench.ordered()
    stored = bench.plane.dht.records["task/t-1"]
    bench.plane.dht.records["task/t-1"] = type(stored)(
        key=stored.key, value=encode(bench.coordinator.record), version={"gw-2": 9}
    )
    with pytest.raises(SwiftbotError, match="before it was written"):
        await bench.order(PauseAsk(id="t-1", by="ann"))


async def test_a_robot_that_is_taken_at_the_vehicle_is_waited_for(bench: Any) -> None:
    """A pilot's takeover ends the run, counts for no failure, and the next attempt follows when it is given back."""
    bench.context.the_plan = bench.plan_of(*ON_ROBOT)
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.STARTED)
    bench.context.robot = (None, "waits for r1: taken at the vehicle: its mode was changed")
    taken = Failure(code="taken", message="r1 was taken over during goto: its mode was changed from AUTO to LOITER")
    bench.tell(request, RunEventKind.FAILED, failure=taken)
    record = await bench.until(lambda record: record.of("s1").state is SubtaskState.READY)
    assert record.state is TaskState.RUNNING
    assert record.of("s1").failure is None
    assert "from AUTO to LOITER" in record.of("s1").attempts[0].left
    bench.context.robot = ("r1", "")
    bench.say(Wake())
    _, request = await bench.ordered()
    assert request.attempt == 2
    assert same(fold(bench), bench.coordinator.written)
