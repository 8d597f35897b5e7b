# ruff: noqa: ARG002 - fakes take what the real ones take
"""What a coordinator decides with: facts, placement, the decomposer, and runs that the test orders."""

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

from appliance.errors import NotFoundError, PlanError
from appliance.model import (
    Choice,
    Group,
    Phase,
    Plan,
    RobotInfo,
    RobotWork,
    RunAccepted,
    RunRequest,
    SubtaskRecord,
    TaskRecord,
)
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.context import FREE
from appliance.tasks.machine import Transition
from appliance.tasks.placement import Place, Placement
from appliance.tasks.replan import Robots
from appliance.tasks.settings import TasksConfig
from tests.unit.tasks.fake_plane import FakePlane
from tests.unit.tasks.sample_records import manifest, plan_of

FAST = TasksConfig(check_s=0.03, grace_s=0.1, run_timeout_s=0.05)


class FakeContext:
    """The parts of a gateway in one, with all of it in the test's hands: `new_plan` is what the decomposer answers."""

    def __init__(self, plane: FakePlane, plan: Plan | None = None) -> None:
        self.plane = plane
        self.config = FAST
        self.skills = {"work": manifest()}
        self.the_plan: Plan | Exception = plan or plan_of()
        self.planning: asyncio.Event | None = None
        self.robot: tuple[str | None, str] = ("r1", "")
        self.places: list[str] = ["gw-1", "gw-2"]
        self.orders: asyncio.Queue[tuple[str, RunRequest]] = asyncio.Queue()
        self.refusals: list[Exception] = []
        self.passed_to = ""
        self.groups: list[Group] = []
        self.room = True
        self.others_first = ""
        self.work: list[RobotWork] = []
        self.left_s: list[float] = []
        self.expected = ""
        self.moved: list[tuple[tuple[str, ...], dict[str, float]]] = []
        self.took: list[tuple[str, float]] = []
        self.choice: Choice | None = None
        self.slow_answer: asyncio.Event | None = None
        self.commands: Any = FREE
        self.approve_why = ""
        self.wrong: tuple[str, ...] = ()
        self.roster: dict[str, RobotInfo] = {}
        self.known: dict[str, tuple[float, ...]] = {}
        self.noted: list[str] = []
        self.new_plan: Plan | Exception = PlanError("no planner is configured")
        self.asked: list[TaskRecord] = []
        self.asking: asyncio.Event | None = None
        self.forbidden: tuple[str, ...] = ()
        self.catalogue = self.scheduler = self.plans = self.ahead = self
        plane.rpc.on["run"] = self.run

    def on_transition(self, transition: Transition) -> None:
        """Nobody keeps a log here."""

    def manifest(self, skill: str) -> SkillManifest:
        """Return a manifest."""
        if skill not in self.skills:
            raise NotFoundError(f"no skill {skill}")
        return self.skills[skill]

    def durations(self, skill: str) -> tuple[float, ...]:
        """Return what is known."""
        return self.known.get(skill, ())

    def expected_s(self, skill: str, params: dict[str, Any]) -> float:
        """Know nothing."""
        return 0.0

    def expect(self, plan: Plan, *, deadline_s: float, elapsed_s: float) -> str:
        """Return what the test says."""
        return self.expected

    def measured(self, skill: str, duration_ms: float) -> None:
        """Remember."""
        self.took.append((skill, duration_ms))

    def notify(self, what: str, record: TaskRecord, target: SubtaskRecord, why: str) -> None:
        """Remember."""
        self.noted.append(what)

    # --- plans --------------------------------------------------------------------------------------------------

    def robots(self) -> Robots:
        """Return the roster."""
        return Robots(roster=self.roster)

    def against(self, record: TaskRecord, target: SubtaskRecord, plan: Plan, robot: str = "") -> tuple[str, ...]:
        """Return what the test forbids: robots that take over, skills."""
        return tuple(f"{each} is forbidden" for each in self.forbidden if each in (robot, plan.subtasks[-1].skill))

    async def replan(self, record: TaskRecord) -> Plan:
        """Return the new plan or raise it."""
        self.asked.append(record)
        if self.asking is not None:
            await self.asking.wait()
        if isinstance(self.new_plan, Exception):
            raise self.new_plan
        return self.new_plan

    def approval(self, record: TaskRecord, plan: Plan) -> str:
        """Return why the test wants it approved."""
        return self.approve_why

    def problems(self, record: TaskRecord, plan: Plan) -> tuple[str, ...]:
        """Return what the test says is wrong."""
        return self.wrong

    async def plan(self, record: TaskRecord) -> Plan:
        """Return the plan or raise it."""
        if self.planning is not None:
            await self.planning.wait()
        if isinstance(self.the_plan, Exception):
            raise self.the_plan
        return self.the_plan

    # --- placement ----------------------------------------------------------------------------------------------

    def bind(self, record: TaskRecord, target: SubtaskRecord) -> tuple[tuple[str, ...], str]:
        """Return the robot, and those that the plan names beside it."""
        robot, reason = self.robot
        return (() if robot is None else (robot, *target.subtask.robots[1:])), reason

    def goes_first(self, record: TaskRecord, target: SubtaskRecord, robots: Sequence[str]) -> str:
        """Return what the test says."""
        return self.others_first

    def fleet_work(self) -> list[RobotWork]:
        """Return what the test says."""
        return self.work

    def place(self, record: TaskRecord, target: SubtaskRecord, robot: str | None) -> Placement:
        """Gateways in order, those where it failed last."""
        failed = {each.gateway for each in target.attempts if each.failure}
        return Placement(order=tuple(sorted(self.places, key=lambda each: each in failed)), why="none is there")

    def case(self, record: TaskRecord, target: SubtaskRecord, placement: Placement) -> None:
        """Nobody keeps a log here."""

    def regroup(self, record: TaskRecord) -> Group | None:
        """Return the group that the test says."""
        return self.groups.pop(0) if self.groups else None

    def turn(self, record: TaskRecord, target: SubtaskRecord, placement: Placement, left_s: float) -> Place:
        """Send it to the first, while the test says that there is room."""
        self.left_s.append(left_s)
        return Place(gateway=placement.order[0]) if self.room else Place(position=1, waiting=1)

    def plan_moved(self, record: TaskRecord, running_s: Mapping[str, float]) -> None:
        """Remember the states."""
        self.moved.append((tuple(str(each.state) for each in record.subtasks), dict(running_s)))

    async def run(self, gateway: str, request: RunRequest) -> RunAccepted:
        """Take an order, or refuse it."""
        self.orders.put_nowait((gateway, request))
        await asyncio.sleep(0)
        if self.refusals:
            raise self.refusals.pop(0)
        if self.slow_answer is not None:
            await self.slow_answer.wait()
        return RunAccepted(
            gateway=self.passed_to or gateway, container="c1", phase=Phase.LOCAL_WARM, choice=self.choice
        )
