"""A small fleet and a view of it that needs no network: the fake at the terminal UI's one seam."""
# pyright: reportPrivateUsage=false

from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator
from typing import cast

import pytest
from textual.css.model import RuleSet
from textual.css.stylesheet import Stylesheet
from textual.css.types import CSSLocation

from appliance.errors import SwiftbotError
from appliance.model import (
    Attempt,
    ContainerInfo,
    ContainerState,
    Failure,
    GatewayStatus,
    Phase,
    Place,
    Plan,
    Pose,
    RobotInfo,
    Site,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    Tier,
)
from appliance.model.roles import Role
from appliance.model.task_api import Line, PlanAnswer, TaskWhy
from appliance.tasks.views import why
from appliance.tui.store import Connection, Store

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


GATEWAYS = (
    GatewayStatus(
        id="gw-a",
        fleet="test",
        version="0.1.0",
        load=0.42,
        cpu_percent=12.0,
        memory_mb=120.0,
        containers=4,
        ready=3,
        running=1,
        tasks=1,
        robots=("drone-1",),
        models=("local:tiny", "rules"),
    ),
    GatewayStatus(
        id="gw-b",
        fleet="test",
        limits_enforced=False,
        pool_problem="podman.socket is absent",
        refused={"payload": 2},
    ),
)
CONTAINERS = (
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
ROBOTS = (
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


SITE = Site(places={"gate": Place(x=5.0, y=8.0), "cold store": Place(x=-4.0, y=2.0, aliases=("freezer",))})


class FakeOrders:
    """A client of a fleet that notes what it is asked, by verb, and answers or raises what a test has set."""

    def __init__(self, store: Store) -> None:
        self.asked: list[tuple[object, ...]] = []
        self.error: SwiftbotError | None = None
        self.options: dict[str, dict[str, object]] = {}
        """The named arguments of the last call of a verb."""
        self.answers: dict[str, object] = {"site": SITE, "pool_decisions": ({}, {})}
        self.lines: list[Line] = []
        """What runs of any task say."""
        self._store = store

    def of(self, verb: str) -> list[tuple[object, ...]]:
        """Return the arguments of all calls of a verb."""
        return [call[1:] for call in self.asked if call[0] == verb]

    async def plan(self, instruction: str) -> PlanAnswer:
        """Answer with the plan above."""
        self._note("plan", instruction)
        return PlanAnswer(plan=PLAN)

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Accept the task."""
        self._note("submit", request.instruction, request.plan, request.id)
        record = TaskRecord(id=request.id, instruction=request.instruction, plan=request.plan, created_ns=3)
        self._store.take_task(record)
        return record

    async def cancel(self, task: str, *, why: str = "") -> TaskRecord:
        """Answer with the task as it is."""
        self.options["cancel"] = {"why": why}
        self._note("cancel", task)
        return RUNNING

    async def why(self, task: str, subtask: str = "") -> TaskWhy:
        """Answer with the reasons of the record, and a wait for what has not begun."""
        self._note("why", task, subtask)
        if "why" in self.answers:
            return cast("TaskWhy", self.answers["why"])
        return why(self._store.tasks[task])

    async def stream(self, task: str) -> AsyncGenerator[Line]:
        """Yield what is set, then nothing more."""
        self._note("stream", task)
        for line in self.lines:
            yield line

    def knows_robot(self, name: str) -> bool:
        """Whether the fleet has a robot of that name."""
        return name in self._store.robots

    async def gateway(self) -> str:
        """Return any gateway."""
        return "gw-a"

    def __getattr__(self, verb: str) -> Callable[..., Awaitable[object]]:
        """Return what notes any other verb and answers what the test has set for it."""
        if verb.startswith("_"):
            raise AttributeError(verb)

        async def ask(*arguments: object, **options: object) -> object:
            self.options[verb] = options
            self._note(verb, *arguments)
            return self.answers[verb]

        return ask

    def _note(self, *call: object) -> None:
        self.asked.append(call)
        if self.error is not None:
            raise self.error


class FakeView:
    """A view whose facts a test sets, and whose orders are noted."""

    fleet = "test"
    operator = "ops"
    role: Role | None = None
    steerable = True
    moment = ""

    def __init__(self) -> None:
        self.store = Store(tasks=50, entries=100)
        self.store.tell(Connection(connected=True))
        self.store.take_tasks([RUNNING, DONE])
        self.store.take_gateways({each.id: each for each in GATEWAYS}, 1)
        self.store.take_robots({each.id: each for each in ROBOTS})
        self.store.take_containers({"gw-a": {each.id: each for each in CONTAINERS}})
        self.orders = FakeOrders(self.store)
        self.synced = 0
        self.started = self.closed = False

    async def start(self) -> None:
        """Note that it was started."""
        self.started = True

    async def close(self) -> None:
        """Note that it was closed."""
        self.closed = True

    def sync(self) -> None:
        """Count how often it was brought up to date."""
        self.synced += 1


@pytest.fixture(autouse=True, scope="session")
def parsed_once() -> Iterator[None]:
    """Parse each part of a stylesheet once for the same colours, not in each app: an eighth of these tests' time."""
    known: dict[tuple[object, ...], list[RuleSet]] = {}
    parse = Stylesheet._parse_rules

    def once(
        self: Stylesheet,
        css: str,
        read_from: CSSLocation,
        is_default_rules: bool = False,
        tie_breaker: int = 0,
        scope: str = "",
    ) -> list[RuleSet]:
        key = (css, read_from, is_default_rules, tie_breaker, scope, *self._variables.items())
        if key not in known:
            known[key] = parse(self, css, read_from, is_default_rules, tie_breaker, scope)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Stylesheet, "_parse_rules", once)
        yield


@pytest.fixture
def view() -> FakeView:
    """Return a view of the small fleet."""
    return FakeView()
