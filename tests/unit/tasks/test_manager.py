"""Accepting, taking over and answering on fakes: what must not be lost, refused or driven twice."""

import asyncio
import itertools
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
from msgspec.structs import replace

from appliance.client import _news
from appliance.errors import DeadlineError, PayloadError, RefusedError, UnreachableError
from appliance.llm.cascade import Decomposer
from appliance.llm.experience import Experience
from appliance.llm.review import Review
from appliance.llm.settings import LlmConfig, PlanContext, SafetyConfig
from appliance.model import (
    Approval,
    Decision,
    GatewayStatus,
    Place,
    Plan,
    Pose,
    RobotInfo,
    RobotWork,
    RunEvent,
    RunEventKind,
    Site,
    Split,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    encode,
    keyspace,
)  # fmt: skip
from appliance.model.task_api import CancelTaskAsk, RetryAsk, TaskAsk, TasksAsk, WhyAsk
from appliance.model.tasks import LostRun
from appliance.plane.dht import Record
from appliance.skills.catalogue import load_catalogue
from appliance.tasks import machine
from appliance.tasks import manager as module
from appliance.tasks.executor import Telling
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.manager import TaskManager
from appliance.tasks.plans import Plans
from appliance.tasks.records import read_record, trimmed
from appliance.tasks.scheduler import Scheduler
from appliance.tasks.settings import TasksConfig

pytestmark = pytest.mark.anyio


class AgreeableDecomposer:
    """Finds nothing wrong with a plan that is handed in, and has experience of nothing."""

    def __init__(self) -> None:
        self.memory = SimpleNamespace(experience=Experience(lambda: 0.0))

    def review(self, plan: Plan, context: PlanContext) -> Review:
        """Find nothing."""
        del plan, context
        return Review()


async def never(gateway: str, request: object) -> object:
    """Take an order, and do not answer."""
    await asyncio.Event().wait()
    return gateway, request


@pytest.fixture
async def manager(plane: Any, tasks_config: Any, catalogue: Any) -> AsyncIterator[TaskManager]:
    """Return a started manager without gateways, so that tasks wait; stopped afterwards."""
    plane.rpc.on["run"] = never
    made = TaskManager(
        tasks_config,
        plane=plane,
        catalogue=catalogue,
        decomposer=cast("Any", AgreeableDecomposer()),
        site=Site(),
    )
    await made.start()
    yield made
    await made.stop()


def state_of(manager: TaskManager, *, written: bool = False) -> TaskState | None:
    """Return the state of the task that is coordinated here, as it is known or as it is written; None without one."""
    found = manager.coordinator("t-1")
    return None if found is None else (found.written if written else found.record).state


def wish(plane: Any, task: str = "t-1") -> TaskRequest:
    """Return a request with a plan of one subtask."""
    return TaskRequest(instruction="work", id=task, plan=plane.plan_of())


async def until(holds: Any) -> None:
    """Wait until something holds."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.005)


async def test_a_known_id_is_the_same_task_and_is_driven(manager: TaskManager, plane: Any) -> None:
    """A first try whose answer was lost left a record that nobody drives: the second try sees to it."""
    await plane.dht.write("task/t-1", encode(plane.accepted(plan=plane.plan_of())), expected=None)
    await asyncio.sleep(0.02)
    assert (await manager.submit(wish(plane))).id == "t-1"
    await until(lambda: manager.unfinished == 1)


@pytest.mark.parametrize("submitter", ["", "ann", "rover_1"])
@pytest.mark.parametrize("text", ["stop", "HALT!", "rover_1: stop"])
async def test_a_stop_is_no_task(manager: TaskManager, plane: Any, text: str, submitter: str) -> None:
    """From each submitter: an operator's tool carries it out, robots and scripts get the command to use."""
    with pytest.raises(RefusedError, match="this is a stop, not a task") as refused:
        await manager.submit(TaskRequest(instruction=text, submitter=submitter))
    assert refused.value.remedy.startswith("swiftbot stop")
    assert manager.unfinished == 0
    assert not plane.dht.records


@pytest.mark.parametrize("verb", ["submit", "accept"])
async def test_a_plan_that_is_too_long_is_refused_before_it_is_a_task(
    manager: TaskManager, plane: Any, verb: str
) -> None:
    """From each submitter, with the limit and what to do about it: no task is made of it that would fail later."""
    step = plane.plan_of().subtasks[0]
    subtasks = tuple(replace(step, id=f"s{number}", after=()) for number in range(65))
    request = TaskRequest(instruction="work", id="t-1", plan=Plan(domain="navigation", subtasks=subtasks))
    with pytest.raises(PayloadError, match="65 subtasks, at most 64") as refused:
        await getattr(manager, verb)(request)
    assert "split it" in refused.value.remedy
    assert not plane.dht.records


async def test_an_undriven_task_is_taken_up_without_a_ring_change(
    manager: TaskManager, plane: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A record that came after the last sweep is found by the regular look."""
    monkeypatch.setattr(module, "SWEEP_S", 0.02)
    manager._sweep.set()
    await asyncio.sleep(0.02)
    await plane.dht.write("task/t-1", encode(plane.accepted(plan=plane.plan_of())), expected=None)
    await until(lambda: manager.unfinished == 1)


async def test_a_broken_sweep_and_poisoned_records_do_not_end_takeover(manager: TaskManager, plane: Any) -> None:
    """Records nested beyond decoding and a store that breaks are survived."""
    deep = b"[" * 100_000
    poison = (
        b'{"id":"t-9","instruction":"x","plan":{"domain":"a","subtasks":[{"id":"s1","skill":"w","params":{"x":' + deep
    )
    plane.dht.records["task/t-9"] = Record(key="task/t-9", value=poison, version={"x": 1})
    manager._sweep.set()
    await asyncio.sleep(0.02)
    working = plane.dht.local

    async def broken(prefix: str, **_: object) -> list[Any]:
        raise OSError("the disk is gone")

    plane.dht.local = broken
    manager._sweep.set()
    await asyncio.sleep(0.02)
    plane.dht.local = working
    await plane.dht.write("task/t-1", encode(plane.accepted(plan=plane.plan_of())), expected=None)
    manager._sweep.set()
    await until(lambda: manager.unfinished == 1)


async def test_a_key_that_is_anothers_is_let_go(manager: TaskManager, plane: Any) -> None:
    """The ring changes: the driver here ends, the record stays."""
    await manager.submit(wish(plane))
    plane.dht.mine = False
    manager._sweep.set()
    await until(lambda: manager.unfinished == 0)
    assert "task/t-1" in plane.dht.records


async def test_a_task_whose_end_could_not_be_written_is_driven_again(manager: TaskManager, plane: Any) -> None:
    """Final in memory is not final: the next driver cancels it again and writes that."""
    await manager.submit(wish(plane))
    await until(lambda: manager._coordinators["t-1"].record.state is TaskState.RUNNING)
    await asyncio.sleep(0.05)
    plane.dht.break_next = [UnreachableError("no owner")]
    answer = await manager.questions.cancel(CancelTaskAsk(id="t-1"))
    assert answer.state in (TaskState.CANCELLING, TaskState.CANCELLED)
    await until(lambda: manager.unfinished == 0)
    assert read_record(plane.dht.records["task/t-1"].value).state is TaskState.CANCELLED


async def test_a_driver_that_breaks_again_and_again_ends_its_task_with_the_reason(
    manager: TaskManager, plane: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No task is retried for ever without a word."""
    monkeypatch.setattr(module, "MAX_BREAKS", 1)
    await manager.submit(wish(plane))
    plane.dht.break_next = [PayloadError("the record is too large")]
    async with asyncio.timeout(60):
        while not (record := await manager.questions.task(TaskAsk(id="t-1"))).state.final:
            await asyncio.sleep(0.02)
    assert record.state is TaskState.FAILED
    assert record.failure is not None
    assert "too large" in record.failure.message


async def test_an_unsound_record_is_ended_with_the_reason(manager: TaskManager, plane: Any) -> None:
    """A stranger's record whose subtasks wait for each other is not driven for ever: it fails, says why, is counted."""
    circle = tuple(
        SubtaskRecord(subtask=Subtask(id=name, skill="photograph", after=(after,)))
        for name, after in (("s1", "s2"), ("s2", "s1"))
    )
    forged = replace(plane.accepted(plan=plane.plan_of()), state=TaskState.RUNNING, subtasks=circle, sequence=2)
    await plane.dht.write("task/t-1", encode(forged), expected=None)
    manager._sweep.set()
    async with asyncio.timeout(60):
        while not (record := await manager.questions.task(TaskAsk(id="t-1"))).state.final:
            await asyncio.sleep(0.02)
    assert record.state is TaskState.FAILED
    assert record.failure is not None
    assert "wait for each other" in record.failure.message
    assert plane.session.refused["unsound task record"] >= 1


async def test_a_record_under_anothers_name_is_left_alone(manager: TaskManager, plane: Any) -> None:
    """A record that says it is of another task is counted and not driven: that one's would be written over."""
    await plane.dht.write("task/t-2", encode(plane.accepted(plan=plane.plan_of())), expected=None)
    manager._sweep.set()
    await until(lambda: plane.session.refused.get("misplaced task record") == 1)
    assert manager.unfinished == 0


async def test_fields_of_a_later_version_stay_in_the_record(manager: TaskManager, plane: Any) -> None:
    """What this version does not know of a record that it takes up is written back with what it does."""
    value = msgspec.json.decode(encode(plane.accepted(plan=plane.plan_of()))) | {"colour": {"of": "later"}}
    await plane.dht.write("task/t-1", encode(value), expected=None)
    manager._sweep.set()
    await until(lambda: "subtasks" in msgspec.json.decode(plane.dht.records["task/t-1"].value))
    assert msgspec.json.decode(plane.dht.records["task/t-1"].value)["colour"] == {"of": "later"}


@pytest.fixture
async def small(plane: Any, tasks_config: Any, catalogue: Any) -> AsyncIterator[TaskManager]:
    """Return a started manager that works on two tasks at once, with room for six more."""
    plane.rpc.on["run"] = never
    made = TaskManager(
        replace(tasks_config, max_tasks=2, max_queue=6),
        plane=plane,
        catalogue=catalogue,
        decomposer=cast("Any", AgreeableDecomposer()),
        site=Site(),
    )
    await made.start()
    yield made
    await made.stop()


async def test_a_flood_of_tasks_does_not_get_past_the_bound_while_records_are_written(
    small: TaskManager, plane: Any
) -> None:
    """Those that are only being written count as well; a second request for a task that was taken gets that task."""
    wishes = [small.accept(wish(plane, f"t-{number}")) for number in range(12)]
    answers = await asyncio.gather(*wishes, return_exceptions=True)
    assert sum(isinstance(each, RefusedError) for each in answers) == 4
    assert (small.unfinished, small.waiting) == (8, 6)
    assert (await small.submit(wish(plane, "t-7"))).id == "t-7"
    with pytest.raises(RefusedError, match="8 unfinished"):
        await small.submit(wish(plane, "t-new"))


async def test_tasks_beyond_the_places_wait_and_are_taken_up_when_one_ends(small: TaskManager, plane: Any) -> None:
    """They are durable as accepted, say what they wait for, and have their turn in the order of acceptance."""
    for number in range(4):
        await small.submit(wish(plane, f"t-{number}"))
    assert small.coordinator("t-2") is None
    found = await small.questions.why(WhyAsk(id="t-3"))
    assert (found.state, found.waits.partition(" go")[0]) == ("accepted", "its turn: 1 tasks of its submitter")
    await small.questions.cancel(CancelTaskAsk(id="t-0"))
    await until(lambda: small.coordinator("t-2") is not None)
    assert small.coordinator("t-3") is None
    assert (small.unfinished, small.waiting) == (3, 1)


async def test_no_more_is_taken_up_than_there_is_room_to_run(
    manager: TaskManager, plane: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While subtasks wait for room, tasks wait for their turn, but for the few that each submitter has at work."""
    monkeypatch.setattr(module, "MOST_IN_LINE", 0)
    for number in range(6):
        await manager.submit(wish(plane, f"t-{number}"))
    await until(lambda: manager.waiting == 4)
    assert manager.unfinished == 6
    monkeypatch.setattr(module, "MOST_IN_LINE", 16)
    await until(lambda: manager.waiting == 0)


async def test_the_task_of_another_submitter_does_not_wait_for_a_flood(small: TaskManager, plane: Any) -> None:
    """The places are full of one submitter's: another's goes at once, and so does an order of higher priority."""
    for number in range(5):
        await small.submit(wish(plane, f"t-{number}"))
    await small.submit(replace(wish(plane, "t-ann"), submitter="ann"))
    await until(lambda: small.coordinator("t-ann") is not None)
    await small.submit(replace(wish(plane, "t-now"), priority=9))
    await until(lambda: small.coordinator("t-now") is not None)
    assert small.waiting == 3


async def test_a_waiting_task_is_cancelled_at_once(small: TaskManager, plane: Any) -> None:
    """It need not have its turn first, and what was said stands in its record."""
    for number in range(5):
        await small.submit(wish(plane, f"t-{number}"))
    record = await small.questions.cancel(CancelTaskAsk(id="t-4", by="ann", why="not needed"))
    assert record.state is TaskState.CANCELLED
    assert record.cancelled_by is not None
    assert record.cancelled_by.why == "not needed"
    assert small.waiting == 2


async def test_a_waiting_task_ends_when_its_deadline_passes(small: TaskManager, plane: Any) -> None:
    """It fails with the code that says so, although its turn never came."""
    for number in range(2):
        await small.submit(wish(plane, f"t-{number}"))
    await small.submit(replace(wish(plane, "t-late"), deadline_s=0.2))
    assert small.waiting == 1
    async with asyncio.timeout(60):
        while not (record := await small.questions.task(TaskAsk(id="t-late"))).state.final:
            await asyncio.sleep(0.02)
    assert record.failure is not None
    assert record.failure.code == "deadline"


async def test_waiting_tasks_of_the_shard_are_taken_over_and_let_go(small: TaskManager, plane: Any) -> None:
    """A gateway that becomes their owner finds all; one that is not any more keeps none; records stay as they are."""
    for number in range(6):
        record = replace(plane.accepted(plan=plane.plan_of()), id=f"t-{number}", created_ns=number)
        await plane.dht.write(f"task/t-{number}", encode(record), expected=None)
    small._sweep.set()
    await until(lambda: small.unfinished == 6)
    assert small.waiting == 4
    assert small.coordinator("t-0") is not None
    plane.dht.mine = False
    small._sweep.set()
    await until(lambda: small.unfinished == 0)
    assert len(plane.dht.records) == 6


async def test_forged_run_events_are_counted_and_dropped(manager: TaskManager, plane: Any) -> None:
    """Events of gateways that are not there, or under another key, reach no driver; other tasks' are not looked at."""
    await manager.submit(wish(plane))
    event = RunEvent(task="t-1", subtask="s1", attempt=0, kind=RunEventKind.SUCCEEDED, gateway="evil")
    plane.session.publish(keyspace.RUN_EVENT, event, "t-1", "s1")
    plane.session.publish(keyspace.RUN_EVENT, replace(event, gateway="gw-1"), "t-1", "s2")
    assert plane.session.refused == {"forged run event": 2}
    plane.session.publish(keyspace.RUN_EVENT, replace(event, gateway="gw-1"), "t-2", "s1")
    plane.session.put(plane.keys(keyspace.RUN_EVENT, "t-2", "s1"), b"{")
    assert plane.session.refused == {"forged run event": 2}


async def test_own_runs_are_heard_without_the_network(plane: Any, tasks_config: Any, catalogue: Any) -> None:
    """The executor here hands its events to the coordinator; what comes over the network in this name is not heard."""
    plane.rpc.on["run"] = never
    telling = Telling(plane)
    manager = TaskManager(
        tasks_config, plane=plane, catalogue=catalogue, decomposer=cast("Any", AgreeableDecomposer()), site=Site(),
        runs=telling,
    )  # fmt: skip
    plane.registry.gateways = {"gw-1": GatewayStatus(id="gw-1", fleet="f", capacity=1)}
    await manager.start()
    await manager.submit(wish(plane))
    coordinator = manager.coordinator("t-1")
    assert coordinator is not None
    await until(lambda: [each.state for each in coordinator.record.subtasks] == [SubtaskState.DISPATCHED])
    event = RunEvent(task="t-1", subtask="s1", attempt=1, kind=RunEventKind.STARTED, gateway="gw-1")
    plane.session.publish(keyspace.RUN_EVENT, replace(event, kind=RunEventKind.SUCCEEDED), "t-1", "s1")
    telling.tell(event)
    telling.tell(replace(event, task="t-other"))
    await until(lambda: coordinator.record.subtasks[0].state is not SubtaskState.DISPATCHED)
    assert coordinator.record.subtasks[0].state is SubtaskState.RUNNING
    assert plane.session.refused == {}
    await manager.stop()


async def test_hostile_requests_are_refused_with_a_reason(manager: TaskManager, plane: Any) -> None:
    """Endless names, deep parameters, bad ids: nothing is written."""
    deep: Any = 1
    for _ in range(200):
        deep = [deep]
    plan = plane.plan_of(Subtask(id="s1", skill="work", params={"x": deep}))
    for request in (
        TaskRequest(instruction=" "),
        TaskRequest(instruction="x" * 5000),
        TaskRequest(instruction="x", id="../../etc"),
        TaskRequest(instruction="x", submitter="s" * 10_000),
        TaskRequest(instruction="x", plan=plan),
    ):
        with pytest.raises(PayloadError):
            await manager.submit(request)
    assert not plane.dht.records


async def test_priority_deadline_and_group_are_kept_and_checked(manager: TaskManager, plane: Any) -> None:
    """What the submitter asked for stands in the record; numbers and names that can be none are refused."""
    asked = replace(wish(plane), priority=9, deadline_s=60.0, group=("gw-1", "gw-2"))
    record = await manager.submit(asked)
    assert (record.priority, record.deadline_s, record.within) == (9, 60.0, ("gw-1", "gw-2"))
    for wrong in ({"priority": 10}, {"priority": -1}, {"deadline_s": float("nan")}, {"deadline_s": -1.0},
                  {"deadline_s": float("inf")}, {"group": ("no name",)}):  # fmt: skip
        with pytest.raises(PayloadError):
            await manager.submit(replace(wish(plane, "t-wrong"), **wrong))
    assert "task/t-wrong" not in plane.dht.records


async def test_a_silent_owner_is_asked_again_and_then_its_successor(manager: TaskManager, plane: Any) -> None:
    """Submission survives the death of the key's owner."""

    async def silent(gateway: str, request: object) -> object:
        plane.ring.name = "gw-1"
        raise DeadlineError("no answer")

    plane.ring.name = "gw-2"
    plane.rpc.on["accept"] = silent
    assert (await manager.submit(wish(plane))).coordinator == "gw-1"


def test_a_watcher_follows_a_coordinator_that_came_back_with_lower_numbers(plane: Any) -> None:
    """After a restart the same gateway goes on from the written record; its end must not be overlooked."""
    pushed = replace(plane.accepted(), sequence=50, updated_ns=100)
    assert _news(pushed, replace(pushed, sequence=12, updated_ns=200))
    assert _news(pushed, replace(pushed, sequence=20, state=TaskState.SUCCEEDED))
    assert not _news(pushed, replace(pushed, sequence=40, updated_ns=90))


async def test_a_plan_that_a_robot_hands_in_waits_where_the_policy_says_so(manager: TaskManager, plane: Any) -> None:
    """`confirm_skills` holds for robots' plans too; a person who hands in a plan has seen it."""
    policy = SafetyConfig(confirm_skills=("push",))
    catalogue = load_catalogue()
    decomposer = Decomposer(LlmConfig(tiers=("rules",)), catalogue, safety=policy)
    plans = Plans(
        TasksConfig(),
        plane,
        catalogue=catalogue,
        decomposer=decomposer,
        site=Site(),
        task=manager.questions.task,
        busy=tuple,
    )
    plane.registry.robots["rover_1"] = RobotInfo(id="rover_1", kind="zenoh")
    plan = plane.plan_of(Subtask(id="s1", skill="push", robot="rover_1"))
    record = plane.accepted(plan=plan)
    assert record.handed_in
    assert "safety.confirm_skills" in plans.approval(replace(record, submitter="rover_1"), plan)
    assert plans.approval(replace(record, submitter="ann"), plan) == ""
    harmless = plane.plan_of(Subtask(id="s1", skill="hold", robot="rover_1"))
    assert plans.approval(replace(record, submitter="rover_1"), harmless) == ""


async def test_robots_are_chosen_by_cost_and_a_plan_below_the_reserve_is_held(manager: TaskManager, plane: Any) -> None:
    """By the gateway's map, roster and open tasks; a plan that a person handed in is not held."""
    subtask = Subtask(id="s1", skill="goto", robot="any", params={"place": "shelf"})
    site = Site(places={"shelf": Place(x=100.0, y=0.0)})
    roster = plane.registry.robots
    for name, x, percent in (("rover_1", 0.0, 90.0), ("rover_2", 90.0, 90.0), ("rover_3", 99.0, 20.0)):
        roster[name] = RobotInfo(
            id=name, kind="zenoh", uses=("base",), verbs=("goto", "state"), pose=Pose(x=x), battery_percent=percent
        )
    records: list[TaskRecord] = []
    scheduler = Scheduler(
        plane, load_catalogue(), TasksConfig(), records=lambda: records, wake=lambda _: None, image_of=lambda _: "",
        site=site,
    )  # fmt: skip
    plan = plane.plan_of(subtask)
    record = replace(plane.accepted(plan=plan), subtasks=(SubtaskRecord(subtask=subtask),))
    robot, why = scheduler.bind(record, record.subtasks[0])
    assert robot == ("rover_2",), why
    assert "took rover_2" in why
    assert "rover_3 would end with" in why
    busy = tuple(SubtaskRecord(subtask=replace(subtask, id=f"s{n}"), bound_robot="rover_2") for n in range(60))
    records.append(replace(record, id="t-2", subtasks=busy))
    assert scheduler.bind(record, record.subtasks[0])[0] == ("rover_1",), "rover_2 has much to do first"
    told = scheduler.work()
    assert [(each.robot, each.task, each.takes_s) for each in told] == [("rover_2", "t-2", 180.0)]
    records.clear()
    gateway = GatewayStatus(id="gw-9", fleet="f", work=(RobotWork(robot="rover_2", task="t-3", takes_s=90.0),))
    plane.registry.gateways["gw-9"] = gateway
    assert scheduler.bind(record, record.subtasks[0])[0] == ("rover_2",), "a gateway that is gone does not count"
    plane.present.add("gw-9")
    assert scheduler.bind(record, record.subtasks[0])[0] == ("rover_1",), "work that another gateway coordinates counts"
    plane.registry.gateways["gw-9"] = replace(gateway, work=(replace(gateway.work[0], task=record.id),))
    assert scheduler.bind(record, record.subtasks[0])[0] == ("rover_2",), "the task's own work does not"
    del plane.registry.gateways["gw-9"]
    await scheduler.close()

    catalogue = load_catalogue()
    plans = Plans(
        TasksConfig(), plane, catalogue=catalogue, decomposer=Decomposer(LlmConfig(tiers=("rules",)), catalogue),
        site=site, task=manager.questions.task, busy=tuple,
    )  # fmt: skip
    low = plane.plan_of(replace(subtask, robot="rover_3"))
    assert "rover_3 would end with 19." in plans.approval(plane.accepted(), low)
    assert plans.approval(plane.accepted(), plane.plan_of(replace(subtask, robot="rover_2"))) == ""
    assert plans.approval(replace(plane.accepted(plan=low), submitter="ann"), low) == ""


async def test_fields_of_a_newer_version_stay_whatever_is_done_with_a_task(manager: TaskManager, plane: Any) -> None:
    """It is driven, cancelled, and begun again after its end; and one that had ended is settled after a partition."""
    versions = itertools.count(1)

    def later(task: str) -> list[Any]:
        table = msgspec.json.decode(plane.dht.records[f"task/{task}"].value)
        return [table.get("later"), *(each.get("later") for each in table.get("subtasks", []))]

    def put(record: TaskRecord) -> None:
        table = msgspec.json.decode(encode(record)) | {"later": 1}
        for each in table.get("subtasks", []):
            each["later"] = 2
        key, version = f"task/{record.id}", {"gw-2": next(versions)}
        plane.dht.records[key] = Record(key=key, value=msgspec.json.encode(table), version=version)
        manager._sweep.set()

    put(plane.accepted(plan=plane.plan_of()))
    await until(lambda: state_of(manager) is TaskState.RUNNING)
    await manager.questions.cancel(CancelTaskAsk(id="t-1"))
    await until(lambda: manager.unfinished == 0)
    ended = read_record(plane.dht.records["task/t-1"].value)
    assert (ended.state, later("t-1")[0]) == (TaskState.CANCELLED, 1)
    put(ended)
    await plane.rpc.registered["retry"](RetryAsk(id="t-1", by="ann", act="r"))
    assert later("t-1") == [1, 2]
    await until(lambda: state_of(manager) is TaskState.RUNNING)
    await manager.questions.cancel(CancelTaskAsk(id="t-1"))
    await until(lambda: manager.unfinished == 0)
    assert later("t-1") == [1, 2]
    lost = LostRun(subtask="s1", attempt=9, gateway="gw-3", state=SubtaskState.RUNNING)
    split = Split(coordinator="gw-3", sequence=3, state=TaskState.RUNNING, runs=(lost,))
    put(replace(ended, splits=(split,)))
    await until(lambda: read_record(plane.dht.records["task/t-1"].value).splits[0].settled)
    assert later("t-1") == [1, 2]


async def test_a_cancel_answers_with_the_state_that_came_of_it(manager: TaskManager, plane: Any) -> None:
    """Not with the one before it: as it is written, in the record that others read as well."""
    await manager.submit(wish(plane))
    await until(lambda: manager._coordinators["t-1"].record.subtasks)
    answer = await manager.questions.cancel(CancelTaskAsk(id="t-1", by="ann", why="enough"))
    assert answer.state is TaskState.CANCELLED
    assert read_record(plane.dht.records["task/t-1"].value).state is TaskState.CANCELLED
    assert (await manager.questions.cancel(CancelTaskAsk(id="t-1"))).cancelled_by == answer.cancelled_by, (
        "asked again: the same"
    )


async def waiting(manager: TaskManager, plane: Any) -> Record:
    """Have a task wait for approval of its plan; returns its record as it is stored."""
    await manager.submit(replace(wish(plane), approval=Approval.ALWAYS))
    await until(lambda: state_of(manager, written=True) is TaskState.PROPOSED)
    return plane.dht.records["task/t-1"]


@pytest.mark.parametrize("state", [TaskState.SUCCEEDED, TaskState.CANCELLED])
async def test_a_coordinator_follows_the_record_that_changes_under_it(
    manager: TaskManager, plane: Any, state: TaskState
) -> None:
    """The other side of a partition has ended the task: it is answered and published so at once, and driven no more."""
    stored = await waiting(manager, plane)
    other = replace(read_record(stored.value), state=state, coordinator="gw-2", sequence=9)
    told = len(plane.session.puts)
    plane.dht.change(Record(key=stored.key, value=encode(other), version={**stored.version, "gw-2": 5}))
    await asyncio.sleep(0)
    assert (await manager.questions.task(TaskAsk(id="t-1"))).state is state
    await until(lambda: manager.unfinished == 0 and len(plane.session.puts) > told)
    published = [msgspec.json.decode(value, type=TaskRecord) for _, value in plane.session.puts[told:]]
    assert [each.state for each in published] == [state]
    assert plane.dht.records["task/t-1"].version == {**stored.version, "gw-2": 5}, "and nothing was written over it"


async def test_a_task_that_goes_on_under_its_coordinator_is_driven_from_there(manager: TaskManager, plane: Any) -> None:
    """An approval of the other side stands: the coordinator goes on from it instead of waiting for another."""
    stored = await waiting(manager, plane)
    before = manager._coordinators["t-1"]
    record = read_record(stored.value)
    assert record.proposal is not None
    approved = Transition(
        task="t-1", sequence=record.sequence + 1, kind=TransitionKind.APPROVED, at_ns=2, coordinator="gw-2",
        decision=Decision(approved=True, by="ann", act="a-1"),
    )  # fmt: skip
    plane.dht.change(
        Record(key=stored.key, value=encode(machine.apply(record, approved)), version={**stored.version, "gw-2": 1})
    )
    await until(lambda: "t-1" in manager._coordinators and manager._coordinators["t-1"] is not before)
    await until(lambda: manager._coordinators["t-1"].written.coordinator == "gw-1")
    assert manager._coordinators["t-1"].written.state is TaskState.RUNNING
    assert plane.dht.records["task/t-1"].version["gw-2"] == 1, "the approval's write is in what was written since"


async def test_a_cancel_goes_to_the_driver_that_follows_one_that_steps_down(manager: TaskManager, plane: Any) -> None:
    """The record changes under a driver that was just told to cancel: the next one gets it, and the answer is true."""
    stored = await waiting(manager, plane)
    before = manager._coordinators["t-1"]
    cancel = asyncio.create_task(manager.questions.cancel(CancelTaskAsk(id="t-1", by="ann")))
    other = replace(read_record(stored.value), coordinator="gw-2", sequence=9)
    plane.dht.change(Record(key=stored.key, value=encode(other), version={**stored.version, "gw-2": 1}))
    answer = await cancel
    assert answer.state is TaskState.CANCELLED
    assert manager._coordinators.get("t-1") is not before
    assert read_record(plane.dht.records["task/t-1"].value).state is TaskState.CANCELLED


async def test_a_driver_of_a_key_that_is_anothers_answers_for_nobody(manager: TaskManager, plane: Any) -> None:
    """The ring has given the key away: the record is read where it belongs, though the driver still stands here."""
    stored = await waiting(manager, plane)
    plane.dht.mine = False
    other = replace(read_record(stored.value), state=TaskState.CANCELLED, coordinator="gw-2")
    plane.dht.records[stored.key] = Record(key=stored.key, value=encode(other), version={"gw-2": 9})
    assert (await manager.questions.task(TaskAsk(id="t-1"))).state is TaskState.CANCELLED


async def test_an_id_whose_record_was_trimmed_is_not_done_again(manager: TaskManager, plane: Any) -> None:
    """It is answered with the outcome, on whatever way it comes; nothing is driven, and it is in no list."""
    record = replace(plane.accepted(plan=plane.plan_of()), state=TaskState.SUCCEEDED, sequence=5)
    small = trimmed(record, "recorder-1.mcap")
    plane.dht.records["task/t-1"] = Record(key="task/t-1", value=encode(small), version={"gw-2": 1})
    for door in (manager.submit, manager.accept):
        assert await door(wish(plane)) == small
    assert "details are in the log recorder-1.mcap" in (await manager.questions.why(WhyAsk(id="t-1"))).done
    assert (await manager.questions.tasks(TasksAsk(limit=10, local=True))).tasks == ()
    await until(lambda: not manager._sweep.is_set())
    assert manager.unfinished == 0
    assert plane.dht.records["task/t-1"].version == {"gw-2": 1}
