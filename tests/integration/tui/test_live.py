"""The terminal UI against real Zenoh sessions: a small stand-in gateway answers its questions."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

import msgspec
import pytest
import structlog
from textual.pilot import Pilot

from appliance.errors import PlanError
from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    LogLine,
    Notice,
    Plan,
    RobotInfo,
    RunEvent,
    RunEventKind,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    encode,
    keyspace,
)
from appliance.model.messages import enums_open
from appliance.model.task_api import CancelTaskAsk, PlanAnswer, PlanAsk, TaskList, TasksAsk
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.tui.app import SwiftbotApp
from appliance.tui.settings import TuiConfig
from appliance.tui.subscriptions import FleetView

pytestmark = pytest.mark.anyio

PLAN = Plan(domain="patrol", subtasks=(Subtask(id="s1", skill="goto", robot="r1"),))
OLD = TaskRecord(id="t-old", instruction="an older task", state=TaskState.SUCCEEDED, created_ns=1, sequence=3)
CONFIG = TuiConfig(refresh_hz=10.0, reconnect_s=0.2, silence_s=1.0, resync_s=5.0, write=True)


class Gateway:
    """A gateway as the terminal UI sees one: token, status, and the verbs `plan`, `submit`, `tasks`, `cancel`."""

    def __init__(self, session: Session, name: str = "gw-a") -> None:
        self.session = session
        self.name = name
        self.keys = session.keys
        self.submitted: list[TaskRequest] = []
        self.cancelled: list[str] = []
        self._rpc = Rpc(session, name)
        self._rpc.register(keyspace.PLAN, self._plan)
        self._rpc.register(keyspace.SUBMIT, self._submit)
        self._rpc.register(keyspace.TASKS, self._tasks)
        self._rpc.register(keyspace.CANCEL, self._cancel)
        self._token = session.declare_alive(self.session.keys(keyspace.GATEWAY_ALIVE, name))
        self._beat = asyncio.create_task(self._run())

    async def _plan(self, ask: PlanAsk) -> PlanAnswer:
        if "sing" in ask.instruction:
            raise PlanError("no skill for it", remedy="say what to do", problems=("'sing' is no skill",))
        return PlanAnswer(plan=PLAN)

    async def _submit(self, request: TaskRequest) -> TaskRecord:
        self.submitted.append(request)
        record = TaskRecord(id=request.id, instruction=request.instruction, plan=request.plan, created_ns=2)
        self.session.publish(keyspace.TASK_UPDATE, record, request.id)
        return record

    async def _tasks(self, ask: TasksAsk) -> TaskList:
        return TaskList(tasks=(OLD,)[: ask.limit])

    async def _cancel(self, ask: CancelTaskAsk) -> TaskRecord:
        self.cancelled.append(ask.id)
        return TaskRecord(id=ask.id, instruction="x", state=TaskState.CANCELLING, created_ns=2, sequence=9)

    async def _run(self) -> None:
        status = GatewayStatus(id=self.name, fleet="f1", load=0.25, containers=1, ready=1, limits_enforced=False)
        container = ContainerInfo(id="c-one", gateway=self.name, image="base", state=ContainerState.READY)
        while True:
            self.session.publish(keyspace.STATUS, status, self.name)
            self.session.publish(keyspace.CONTAINER, container, self.name, "c-one")
            self.session.publish(keyspace.ROBOT, RobotInfo(id="r1", kind="zenoh"), "r1")
            await asyncio.sleep(0.1)

    async def close(self) -> None:
        """Vanish."""
        self._beat.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._beat
        await self.session.close()


async def _gateway(port: int) -> Gateway:
    return Gateway(await Session.open(PlaneConfig(listen=(f"tcp/127.0.0.1:{port}",)), "f1"))


@pytest.fixture
async def gateway(free_port: int) -> AsyncIterator[Gateway]:
    """Run a stand-in gateway."""
    made = await _gateway(free_port)
    yield made
    await made.close()


@pytest.fixture
def app(free_port: int) -> SwiftbotApp:
    """Return the terminal UI of the fleet at the free port."""
    plane = PlaneConfig(mode="client", connect=(f"tcp/127.0.0.1:{free_port}",), connect_timeout_s=0.5)
    return SwiftbotApp(FleetView(plane, "f1", CONFIG), CONFIG)


def _seen(app: SwiftbotApp) -> str:
    strips = app.screen._compositor.render_strips()
    return "\n".join("".join(segment.text for segment in strip) for strip in strips)


async def _see(app: SwiftbotApp, pilot: Pilot[None], *wanted: str | Callable[[str], bool]) -> str:
    """Wait until the screen shows all that is wanted; after half a minute, fail with what it shows."""
    for _ in range(600):
        text = _seen(app)
        if all(part in text if isinstance(part, str) else part(text) for part in wanted):
            return text
        await pilot.pause(0.05)
    pytest.fail(f"the screen does not show {wanted}:\n{_seen(app)}")


async def test_fleet_and_pool_are_live(gateway: Gateway, app: SwiftbotApp) -> None:
    """Gateways, containers and robots put on their keys are on the screens, limits not enforced among them."""
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press("1")
        await _see(app, pilot, "gw-a", "25%", "1/1", "limits are not enforced", "f1 · 1 gw · 1 robot")
        await pilot.press("3")
        await _see(app, pilot, "r1", "zenoh")
        await pilot.press("4")
        await _see(app, pilot, "c-one", "ready")


async def test_task_from_instruction_to_end(gateway: Gateway, app: SwiftbotApp) -> None:
    """An instruction is planned by the gateway, submitted with that plan, and followed to its end."""
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press("2")
        await _see(app, pilot, "t-old", "an older task")
        await pilot.press("s", *"walk", "enter")
        await _see(app, pilot, "patrol: 1 subtask", "s1 goto r1", "Enter runs this plan")
        assert gateway.submitted == []
        await pilot.press("enter")
        await _see(app, pilot, "walk", "accepted")
        (request,) = gateway.submitted
        assert request.plan == PLAN
        running = TaskRecord(
            id=request.id,
            instruction="walk",
            plan=PLAN,
            state=TaskState.RUNNING,
            created_ns=2,
            sequence=2,
            subtasks=(SubtaskRecord(subtask=PLAN.subtasks[0], state=SubtaskState.RUNNING, progress=0.25),),
        )
        gateway.session.publish(keyspace.TASK_UPDATE, running, request.id)
        await _see(app, pilot, "● s1 goto r1", "25%")
        await pilot.press("c", "y")
        await _see(app, pilot, "cancelling")
        assert gateway.cancelled == [request.id]


async def test_refusal_comes_through(gateway: Gateway, app: SwiftbotApp) -> None:
    """The gateway's own words on an instruction without a plan are shown, with the remedy."""
    async with app.run_test(size=(80, 24)) as pilot:
        await _see(app, pilot, "gw-a")
        await pilot.press("s", *"sing", "enter")
        await _see(app, pilot, "no skill for it", "say what to do")
        assert gateway.submitted == []


async def test_log_is_live(gateway: Gateway, app: SwiftbotApp) -> None:
    """Notices, run events and log lines are on the log screen; a malformed one is counted and does no harm."""
    async with app.run_test(size=(80, 24)) as pilot:
        await _see(app, pilot, "gw-a")
        await pilot.press("7")
        session = gateway.session
        session.put(session.keys(keyspace.LOG, "gw-a"), b"\xff{")
        session.put(session.keys(keyspace.NOTICE, "ops"), b"[1, 2")
        session.publish(keyspace.LOG, LogLine(at_ns=1, level="error", source="gw-a", event="container died"), "gw-a")
        session.publish(keyspace.NOTICE, Notice(id="n", to="ops", text="patrol over", at_ns=1), "ops")
        event = RunEvent(task="t", subtask="s1", attempt=1, kind=RunEventKind.STARTED, gateway="gw-a", startup_ms=2.5)
        session.publish(keyspace.RUN_EVENT, event, "t", "s1")
        await _see(app, pilot, "container died", "patrol over", "t/s1 · started · start 2.5 ms")


async def test_states_of_a_newer_version_are_shown(gateway: Gateway, app: SwiftbotApp) -> None:
    """A task and a container in states that only a newer gateway knows are on the screens with those states' words."""
    session = gateway.session
    task = msgspec.json.decode(encode(TaskRecord(id="t-new", instruction="x", created_ns=9))) | {"state": "dreaming"}
    container = ContainerInfo(id="c-two", gateway=gateway.name, image="base", state=ContainerState.READY)
    asleep = msgspec.json.decode(encode(container)) | {"state": "hibernating", "depth_m": 3}
    with enums_open():
        async with app.run_test(size=(80, 24)) as pilot:
            await _see(app, pilot, "gw-a")
            session.publish(keyspace.TASK_UPDATE, task, "t-new")
            session.publish(keyspace.CONTAINER, asleep, gateway.name, "c-two")
            await pilot.press("2")
            await _see(app, pilot, "t-new", "? dreaming")
            await pilot.press("4")
            await _see(app, pilot, "c-one", "c-two", "? hiberna")


@pytest.mark.long
async def test_lost_gateway_comes_back(app: SwiftbotApp, free_port: int) -> None:
    """Without a gateway the banner names cause and remedy; when one comes, and after it was lost, all is live."""
    async with app.run_test(size=(100, 24)) as pilot:
        await _see(app, pilot, "✘", "swiftbot gateway")
        await pilot.press("s", *"walk", "enter")
        await _see(app, pilot, "not connected")
        await pilot.press("escape")
        first = await _gateway(free_port)
        await _see(app, pilot, "gw-a", lambda text: "swiftbot gateway" not in text)
        await first.close()
        await _see(app, pilot, "✘", "swiftbot gateway")
        second = await _gateway(free_port)
        await _see(app, pilot, "gw-a", lambda text: "swiftbot gateway" not in text)
        await second.close()


async def test_the_gateway_it_hangs_on_dies(free_ports: Callable[..., list[int]]) -> None:
    """When the gateway that carries the connection dies, the next one does: the UI goes on and a task is accepted."""
    ports = free_ports(2)
    first, second = (f"tcp/127.0.0.1:{port}" for port in ports)
    one = Gateway(await Session.open(PlaneConfig(listen=(first,)), "f1"), "gw-a")
    two = Gateway(await Session.open(PlaneConfig(listen=(second,), connect=(first,)), "f1"), "gw-b")
    plane = PlaneConfig(mode="client", connect=(first, second), connect_timeout_s=0.5)
    app = SwiftbotApp(FleetView(plane, "f1", CONFIG), CONFIG)
    try:
        async with app.run_test(size=(80, 24)) as pilot:
            await _see(app, pilot, "gw-a", "gw-b", "2 gw")
            await one.close()
            await _see(app, pilot, "gw-b", "1 gw", lambda text: "swiftbot gateway" not in text)
            await pilot.press("s", *"walk", "enter")
            await _see(app, pilot, "Enter runs this plan")
            await pilot.press("enter")
            await _see(app, pilot, "walk", "accepted")
            assert len(two.submitted) == 1
    finally:
        await one.close()
        await two.close()


def test_own_log_lines_go_to_the_log_screen(free_port: int) -> None:
    """A log line of this process is taken from the terminal and shown on the log screen."""
    view = FleetView(PlaneConfig(mode="client", connect=(f"tcp/127.0.0.1:{free_port}",)), "f1")
    before = structlog.get_config()
    try:
        structlog.configure(processors=[view.take_own_log])
        structlog.get_logger("x").warning("refused", what="malformed log")
    finally:
        structlog.configure(**before)
    (entry,) = view.store.entries
    assert (entry.source, entry.level, entry.text) == ("tui", "warning", "refused what=malformed log")
