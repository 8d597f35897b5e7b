"""Tasks that come on a robot's key: whose they are, and which are refused."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.errors import RefusedError
from appliance.llm.settings import SafetyConfig
from appliance.model import Plan, RobotInfo, Subtask, TaskRecord, TaskRequest
from appliance.model.task_api import CancelTaskAsk, TaskAsk
from appliance.plane.node import Plane
from appliance.robot_tasks import MOST_HANDED_IN, RobotTasks
from appliance.tasks.endpoints import Questions

pytestmark = pytest.mark.anyio


class Intake:
    """A task manager as far as robots' tasks need one, and what comes to it: what is submitted, and what is refused."""

    def __init__(self, policy: Any, *confirm: str) -> None:
        self.submitted: list[TaskRequest] = []
        self.cancelled: list[tuple[str, str]] = []
        self.plane = SimpleNamespace(
            gateway="gw-1",
            registry=SimpleNamespace(robots={"rover_1": RobotInfo(id="rover_1", kind="zenoh")}),
            session=SimpleNamespace(refused={}),
            dht=self,
        )
        safety = SafetyConfig(robot_tasks=policy, confirm_skills=confirm)
        self.tasks = RobotTasks(cast("Plane", self.plane), safety)
        self.tasks.open(self.submit, cast("Questions", self))

    def owns(self, key: str) -> bool:
        """The keys of robots number one are this gateway's."""
        return key.endswith("_1")

    @property
    def refused(self) -> int:
        """How many were refused without an answer."""
        return self.plane.session.refused.get("robot task", 0)

    async def task(self, ask: TaskAsk) -> TaskRecord:
        """Say whose it is."""
        return TaskRecord(id=ask.id, instruction="", submitter=ask.id)

    async def cancel(self, ask: CancelTaskAsk) -> TaskRecord:
        """Keep who wanted it."""
        self.cancelled.append((ask.id, ask.by))
        return TaskRecord(id=ask.id, instruction="")

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Keep it."""
        self.submitted.append(request)
        return TaskRecord(id="t-1", instruction="")

    async def asked(self, robot: str, submitter: str = "", plan: Plan | None = None) -> None:
        """Hand in what was asked by query."""
        request = TaskRequest(instruction="drone_1: land", submitter=submitter, plan=plan)
        await self.tasks.submit_of(robot, request)

    async def hand_in(self, robot: str, submitter: str = "", plan: Plan | None = None) -> None:
        """Hand in what was put on the robot's key."""
        request = TaskRequest(instruction="drone_1: land", submitter=submitter, plan=plan)
        await self.tasks.hand_in(robot, request)


@pytest.mark.parametrize("policy", ["own", "never"])
async def test_the_task_of_a_robot_that_nobody_knows_is_refused(policy: str) -> None:
    """A robot without a state would count as an operator: where robots may do less, it is refused."""
    intake = Intake(policy)
    await intake.hand_in("ghost", submitter="ann")
    assert (intake.submitted, intake.refused) == ([], 1)
    await intake.hand_in("rover_1", submitter="ann")
    assert [each.submitter for each in intake.submitted] == ["rover_1"]


@pytest.mark.parametrize("policy", ["own", "never"])
async def test_what_a_robot_asks_by_query_is_held_to_the_same(policy: str) -> None:
    """The asker hears why a robot that nobody knows is refused; a known one's task is its own."""
    intake = Intake(policy)
    with pytest.raises(RefusedError, match="there is no robot ghost") as refused:
        await intake.asked("ghost", submitter="ann")
    with pytest.raises(RefusedError):
        await intake.asked("mavlink-255-190", submitter="ann")  # a ground station's name does not help
    assert refused.value.remedy == "put its state on its key first"
    await intake.asked("rover_1", submitter="ann")
    assert [each.submitter for each in intake.submitted] == ["rover_1"]


async def test_a_task_is_of_the_robot_on_whose_key_it_came() -> None:
    """With `any` robots need not be known; their turns, and who is said to have asked, are their own all the same."""
    intake = Intake("any")
    await intake.hand_in("ghost", submitter="ann")
    await intake.asked("rover_1", submitter="ann")
    assert [each.submitter for each in intake.submitted] == ["ghost", "rover_1"]


async def test_a_robots_plan_is_its_own_where_plans_have_to_be_agreed_to() -> None:
    """A robot that names an operator, or is none, does not get round `confirm_skills`."""
    intake = Intake("any", "push")
    plan = Plan(domain="manipulation", subtasks=(Subtask(id="s1", skill="push", robot="rover_1"),))
    await intake.hand_in("rover_1", submitter="ann", plan=plan)
    await intake.hand_in("ghost", submitter="ann", plan=plan)
    assert [each.submitter for each in intake.submitted] == ["rover_1"]
    assert intake.refused == 1


async def test_a_robot_whose_tasks_may_do_less_stops_its_own_alone() -> None:
    """By MAVLink anybody may name a task: the record says who stopped it, and a robot stops no task of others."""
    intake = Intake("own")
    await intake.tasks.cancel("rover_1", "rover_1")
    with pytest.raises(RefusedError, match="ann is not a task of rover_1"):
        await intake.tasks.cancel("ann", "rover_1")
    await intake.tasks.cancel("ann", "mavlink-255-190")  # a person at a ground station
    assert intake.cancelled == [("rover_1", "rover_1"), ("ann", "mavlink-255-190")]
    free = Intake("any")
    await free.tasks.cancel("ann", "rover_1")
    assert free.cancelled == [("ann", "rover_1")]


async def test_what_comes_before_the_tasks_are_there_waits_for_them() -> None:
    """What was put on a key waits; a question is answered with "ask again", also while the gateway drains."""
    intake = Intake("any")
    early = RobotTasks(cast("Plane", intake.plane), SafetyConfig())
    request = TaskRequest(instruction="land")
    early.take("rover_1", request)
    early.take("rover_2", request)  # its key is another gateway's
    with pytest.raises(RefusedError, match="gw-1 is starting"):
        await early.look("t-1")
    early.open(intake.submit, cast("Questions", intake))
    while not intake.submitted:
        await asyncio.sleep(0)
    assert [each.submitter for each in intake.submitted] == ["rover_1"]
    early.draining = True
    with pytest.raises(RefusedError, match="gw-1 is draining"):
        await early.submit(request)


async def test_a_robot_that_asks_without_end_is_refused() -> None:
    """So many are on their way at once; those beyond are counted, and those that wait are given up at the end."""
    intake = Intake("any")
    early = RobotTasks(cast("Plane", intake.plane), SafetyConfig())
    for _ in range(MOST_HANDED_IN + 3):
        early.take("rover_1", TaskRequest(instruction="land"))
    assert intake.refused == 3
    early.close()
    early.open(intake.submit, cast("Questions", intake))
    await asyncio.sleep(0)
    assert intake.submitted == []
