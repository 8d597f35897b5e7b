"""Tasks that come on a robot's key: whose they are, and which are refused."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.errors import RefusedError
from appliance.gateway import Gateway
from appliance.llm.safety.settings import SafetyConfig
from appliance.model import Plan, RobotInfo, Subtask, TaskRecord, TaskRequest
from appliance.tasks.api import TaskAsk
from appliance.tasks.steering.api import CancelTaskAsk

pytestmark = pytest.mark.anyio


class Intake:
    """A gateway as far as robots' tasks need one: what is submitted, and what is refused."""

    def __init__(self, policy: Any, *confirm: str) -> None:
        self.submitted: list[TaskRequest] = []
        self.refused: list[str] = []
        self.cancelled: list[tuple[str, str]] = []
        self.config = SimpleNamespace(safety=SafetyConfig(robot_tasks=policy, confirm_skills=confirm))
        self.plane = SimpleNamespace(
            registry=SimpleNamespace(robots={"rover_1": RobotInfo(id="rover_1", kind="zenoh")})
        )
        self.manager = self
        self._ready = asyncio.Event()
        self._ready.set()

    async def task(self, ask: TaskAsk) -> TaskRecord:
        """Say whose it is."""
        return TaskRecord(id=ask.id, instruction="", submitter=ask.id)

    async def cancel(self, ask: CancelTaskAsk) -> TaskRecord:
        """Keep who wanted it."""
        self.cancelled.append((ask.id, ask.by))
        return TaskRecord(id=ask.id, instruction="")

    async def stop(self, task: str, by: str) -> None:
        """Stop a task as the gateway does."""
        await Gateway._cancel_for_link(cast("Gateway", self), task, by)

    async def submit(self, request: TaskRequest) -> None:
        """Keep it."""
        self.submitted.append(request)

    def _refuse_intake(self, robot: str, reason: str) -> None:
        self.refused.append(f"{robot}: {reason}")

    def _check_known(self, robot: str) -> None:
        Gateway._check_known(cast("Gateway", self), robot)

    async def _submit_own(self, robot: str, request: TaskRequest) -> Any:
        return await Gateway._submit_own(cast("Gateway", self), robot, request)

    def _check_ready(self) -> None:
        assert self._ready.is_set()

    async def asked(self, robot: str, submitter: str = "", plan: Plan | None = None) -> None:
        """Hand in what was asked by query, as the gateway does."""
        request = TaskRequest(instruction="drone_1: land", submitter=submitter, plan=plan)
        await Gateway._submit_of_robot(cast("Gateway", self), robot, request)

    async def hand_in(self, robot: str, submitter: str = "", plan: Plan | None = None) -> None:
        """Hand in as the gateway does."""
        request = TaskRequest(instruction="drone_1: land", submitter=submitter, plan=plan)
        await Gateway._hand_in(cast("Gateway", self), robot, request)


@pytest.mark.parametrize("policy", ["own", "never"])
async def test_the_task_of_a_robot_that_nobody_knows_is_refused(policy: str) -> None:
    """A robot without a state would count as an operator: where robots may do less, it is refused."""
    intake = Intake(policy)
    await intake.hand_in("ghost", submitter="ann")
    assert intake.submitted == []
    (reason,) = intake.refused
    assert "there is no robot ghost" in reason
    assert "put its state on its key first" in reason
    await intake.hand_in("rover_1", submitter="ann")
    assert [each.submitter for each in intake.submitted] == ["rover_1"]


@pytest.mark.parametrize("policy", ["own", "never"])
async def test_what_a_robot_asks_by_query_is_held_to_the_same(policy: str) -> None:
    """The asker hears why a robot that nobody knows is refused; a known one's task is its own."""
    intake = Intake(policy)
    with pytest.raises(RefusedError, match="there is no robot ghost"):
        await intake.asked("ghost", submitter="ann")
    with pytest.raises(RefusedError):
        await intake.asked("mavlink-255-190", submitter="ann")  # a ground station's name does not help
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
    assert len(intake.refused) == 1


async def test_a_robot_whose_tasks_may_do_less_stops_its_own_alone() -> None:
    """By MAVLink anybody may name a task: who wanted it stopped is told, and a robot stops no task of others."""
    intake = Intake("own")
    await intake.stop("rover_1", "rover_1")
    with pytest.raises(RefusedError, match="ann is not a task of rover_1"):
        await intake.stop("ann", "rover_1")
    await intake.stop("ann", "mavlink-255-190")  # a person at a ground station
    assert intake.cancelled == [("rover_1", "rover_1"), ("ann", "mavlink-255-190")]
    free = Intake("any")
    await free.stop("ann", "rover_1")
    assert free.cancelled == [("ann", "rover_1")]
