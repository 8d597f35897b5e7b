"""The shell of charging: one gateway submits, once, and leaves a robot alone whose task somebody cancelled."""

from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.charging.keeper import AGAIN_S, Charging
from appliance.errors import RefusedError
from appliance.floor.decide import Body, Floor
from appliance.floor.geometry import Size
from appliance.model import Place, Pose, RobotInfo, RobotWork, Site, TaskRecord, TaskRequest, TaskState
from appliance.model.task_api import TaskAsk
from appliance.tasks.settings import BatteryConfig
from tests.unit.tasks.fake_plane import FakePlane

pytestmark = pytest.mark.anyio
SITE = Site(places={"charger": Place(x=0.0, y=0.0), "yard": Place(x=9.0, y=9.0)})


class Fleet:
    """One rover with little charge, and the tasks that were submitted for it."""

    def __init__(self, site: Site = SITE) -> None:
        self.plane: Any = FakePlane()
        self.roster = self.plane.registry.robots
        self.add("rover_1", 5.0, 10.0)
        self.tasks: dict[str, TaskRecord] = {}
        self.work: list[RobotWork] = []
        self.stopped = ""
        self.closed: set[str] = set()
        self.now = 6000.0
        self.problem: RefusedError | None = None
        keeper: Any = SimpleNamespace(floor=Floor(site), bodies=self.bodies)
        self.charging = Charging(
            self.plane, site, BatteryConfig(auto_charge=True), floor=keeper, work=lambda: self.work,
            hindrance=lambda _: self.stopped, closed=lambda: self.closed, submit=self.submit, task=self.task,
            now_s=lambda: self.now,
        )  # fmt: skip

    def add(self, name: str, percent: float, x: float) -> None:
        """Put a rover on the floor."""
        self.roster[name] = RobotInfo(id=name, kind="zenoh", verbs=("goto",), pose=Pose(x=x), battery_percent=percent)

    def bodies(self) -> dict[str, Body]:
        """Return where robots are seen."""
        return {
            name: Body(
                robot=name, at=(each.pose.x, each.pose.y, 0.0), size=Size(radius_m=0.4, height_m=1.0, margin_m=0.1)
            )
            for name, each in self.roster.items()
        }

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Take a task; the same id is the same task."""
        if self.problem is not None:
            raise self.problem
        made = TaskRecord(
            id=request.id, instruction=request.instruction, submitter=request.submitter, plan=request.plan
        )
        return self.tasks.setdefault(request.id, made)

    async def task(self, ask: TaskAsk) -> TaskRecord:
        """Return a task."""
        return self.tasks[ask.id]

    def end(self, state: TaskState) -> None:
        """End all tasks."""
        self.tasks = {name: replace(each, state=state) for name, each in self.tasks.items()}


@pytest.fixture
def fleet() -> Fleet:
    """Return it."""
    return Fleet()


async def test_a_robot_with_little_charge_is_sent_once(fleet: Fleet) -> None:
    """By a task of the system that docks at the charger and says why."""
    for _ in range(3):
        await fleet.charging.look()
    (record,) = fleet.tasks.values()
    assert (record.id, record.submitter) == ("charge-rover_1-10", "swiftbot")
    assert record.instruction == "rover_1 has 5 % of its battery, below 20 %: charge at charger"
    assert record.plan is not None
    (subtask,) = record.plan.subtasks
    assert (subtask.skill, subtask.robot, subtask.params) == ("dock", "rover_1", {"station": "charger"})


async def test_nobody_is_sent_who_is_stopped_or_busy_or_where_the_charger_is_closed(fleet: Fleet) -> None:
    """And only the owner of the key sends anybody."""
    fleet.stopped = "stopped by ann"
    await fleet.charging.look()
    fleet.stopped, fleet.work = "", [RobotWork(robot="rover_1", task="t-1", state="ready")]
    await fleet.charging.look()
    fleet.work, fleet.closed = [], {"charger"}
    await fleet.charging.look()
    fleet.closed, fleet.plane.ring.name = set(), "gw-2"
    await fleet.charging.look()
    assert fleet.tasks == {}
    fleet.plane.ring.name = "gw-1"
    await fleet.charging.look()
    assert len(fleet.tasks) == 1


@pytest.mark.parametrize("state", [TaskState.CANCELLED, TaskState.FAILED])
async def test_a_task_that_was_cancelled_is_not_made_again_at_once(fleet: Fleet, state: TaskState) -> None:
    """Whoever cancels it wants the robot; after a while it is sent again."""
    await fleet.charging.look()
    fleet.end(state)
    fleet.now += AGAIN_S - 1
    await fleet.charging.look()
    fleet.now += AGAIN_S - 1
    await fleet.charging.look()
    assert len(fleet.tasks) == 1
    fleet.now += 2
    await fleet.charging.look()
    assert len(fleet.tasks) == 2


async def test_one_that_has_charged_makes_room(fleet: Fleet) -> None:
    """By a task of its own; the one that waits is sent when the charger is free."""
    fleet.add("rover_2", 90.0, 0.0)
    await fleet.charging.look()
    (record,) = fleet.tasks.values()
    assert record.instruction == "rover_2 has 90 % of its battery, and another waits for charger: go to yard"
    assert record.plan is not None
    assert record.plan.subtasks[0].params == {"place": "yard"}
    fleet.end(TaskState.SUCCEEDED)
    fleet.add("rover_2", 90.0, 9.0)
    await fleet.charging.look()
    assert list(fleet.tasks) == ["leave-rover_2-10", "charge-rover_1-10"]


async def test_a_fleet_that_takes_no_task_is_asked_again(fleet: Fleet) -> None:
    """A refusal, as of a coordinator that is full, loses nothing."""
    fleet.problem = RefusedError("is full")
    await fleet.charging.look()
    fleet.problem = None
    fleet.now += 5
    await fleet.charging.look()
    assert list(fleet.tasks) == ["charge-rover_1-10"]


async def test_long_names_of_robots_give_names_of_tasks() -> None:
    """A task's name has 63 characters at most; those of two robots with long names are not the same."""
    fleet = Fleet(Site(places={"charger": Place(x=0.0, y=0.0, capacity=2)}))
    fleet.roster.clear()
    for end in "ab":
        fleet.add(f"{'x' * 62}{end}", 5.0, 10.0)
    await fleet.charging.look()
    assert len(fleet.tasks) == 2
    assert all(len(name) <= 63 for name in fleet.tasks)
