"""A small fleet and a view of it that needs no network: the fake at the terminal UI's one seam."""

import pytest

from appliance.errors import SwiftbotError
from appliance.model import (
    Attempt,
    ContainerInfo,
    ContainerState,
    Failure,
    GatewayStatus,
    Phase,
    Plan,
    Pose,
    RobotInfo,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Tier,
)
from appliance.record.facts import RecorderStatus
from appliance.tasks.api import PlanAnswer
from appliance.tui.board import Board, Connection, Snapshot

PLAN = Plan(
    domain="inspection",
    subtasks=(
        Subtask(id="s1", skill="takeoff", robot="drone-1", params={"altitude_m": 10}),
        Subtask(id="s2", skill="goto", robot="drone-1", params={"place": "gate"}, after=("s1",)),
        Subtask(id="s3", skill="photograph", robot="rover-1", params={"target": "door"}),
        Subtask(id="s4", skill="report", after=("s2", "s3")),
    ),
    tier=Tier.RULES,
    confidence=0.9,
    latency_ms=3.0,
)

RUNNING = TaskRecord(
    id="t-running",
    instruction="drone-1: fly to the gate; rover-1: photograph the door; then report",
    submitter="cli",
    state=TaskState.RUNNING,
    plan=PLAN,
    coordinator="gw-a",
    created_ns=2,
    sequence=5,
    subtasks=(
        SubtaskRecord(
            subtask=PLAN.subtasks[0],
            state=SubtaskState.SUCCEEDED,
            gateway="gw-a",
            phase=Phase.LOCAL_WARM,
            startup_ms=3.25,
            duration_ms=1500.0,
            attempts=(Attempt(number=1, gateway="gw-a"),),
            result={"altitude_m": 10},
        ),
        SubtaskRecord(
            subtask=PLAN.subtasks[1],
            state=SubtaskState.RUNNING,
            gateway="gw-b",
            phase=Phase.REMOTE_WARM,
            startup_ms=9.5,
            progress=0.5,
            note="leg 1 of 2",
            attempts=(Attempt(number=1, gateway="gw-a"), Attempt(number=2, gateway="gw-b")),
        ),
        SubtaskRecord(
            subtask=PLAN.subtasks[2],
            state=SubtaskState.FAILED,
            gateway="gw-b",
            phase=Phase.COLD,
            failure=Failure(code="robot", message="the camera does not answer", remedy="switch rover-1 on"),
        ),
        SubtaskRecord(subtask=PLAN.subtasks[3]),
    ),
)

DONE = TaskRecord(id="t-done", instruction="greet", state=TaskState.SUCCEEDED, created_ns=1, sequence=9)


class FakeView:
    """A view whose facts a test sets, and which remembers what it was asked."""

    fleet = "test"

    def __init__(self) -> None:
        self.board = Board(tasks=50, entries=100)
        self.board.take_tasks([RUNNING, DONE])
        self.gateways = (
            GatewayStatus(
                id="gw-a",
                fleet="test",
                load=0.42,
                cpu_percent=12.0,
                memory_mb=120.0,
                containers=4,
                ready=3,
                running=1,
                tasks=1,
                robots=("drone-1",),
            ),
            GatewayStatus(
                id="gw-b",
                fleet="test",
                limits_enforced=False,
                pool_problem="podman.socket is absent",
                refused={"payload": 2},
            ),
        )
        self.containers = (
            ContainerInfo(
                id="c1",
                gateway="gw-a",
                image="localhost/swiftbot/base:1",
                state=ContainerState.BUSY,
                run="t-running/s1/1",
                cold_ms=812.0,
                runs=3,
            ),
            ContainerInfo(id="c2", gateway="gw-a", image="localhost/swiftbot/vision:1", state=ContainerState.READY),
        )
        self.robots = (
            RobotInfo(
                id="drone-1",
                kind="mavlink",
                gateway="gw-a",
                mode="GUIDED",
                armed=True,
                battery_percent=81.0,
                pose=Pose(x=1.0, y=2.0, z=10.0),
            ),
            RobotInfo(id="rover-1", kind="zenoh", online=False, note="no heartbeat for 3 s"),
        )
        self.connection = Connection(connected=True)
        self.recorders: tuple[RecorderStatus, ...] = ()
        self.changes = 0
        self.error: SwiftbotError | None = None
        self.planned: list[str] = []
        self.submitted: list[tuple[str, Plan, str]] = []
        self.cancelled: list[str] = []
        self.started = self.closed = False

    async def start(self) -> None:
        """Note that it was started."""
        self.started = True

    async def close(self) -> None:
        """Note that it was closed."""
        self.closed = True

    @property
    def revision(self) -> int:
        """Rise with the board and with `changes`."""
        return self.board.revision + self.changes

    def snapshot(self) -> Snapshot:
        """Return the facts as they are set."""
        return Snapshot(
            fleet=self.fleet,
            connection=self.connection,
            gateways=self.gateways,
            containers=self.containers,
            robots=self.robots,
            tasks=self.board.tasks,
            entries=self.board.entries,
            recorders=self.recorders,
        )

    def _fail(self) -> None:
        if self.error is not None:
            raise self.error

    async def plan(self, instruction: str) -> PlanAnswer:
        """Answer with the plan above, or the error that is set."""
        self.planned.append(instruction)
        self._fail()
        return PlanAnswer(plan=PLAN)

    async def submit(self, instruction: str, *, plan: Plan, task_id: str) -> TaskRecord:
        """Accept the task, or raise the error that is set."""
        self.submitted.append((instruction, plan, task_id))
        self._fail()
        record = TaskRecord(id=task_id, instruction=instruction, plan=plan, created_ns=3)
        self.board.take_task(record)
        return record

    async def cancel(self, task_id: str) -> TaskRecord:
        """Note the wish, or raise the error that is set."""
        self.cancelled.append(task_id)
        self._fail()
        return RUNNING


@pytest.fixture
def view() -> FakeView:
    """Return a view of the small fleet."""
    return FakeView()
