"""Moves on fakes: whatever fails at whichever step, the subtask goes on where it was or is repeated, and runs once."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import (
    CancelledByOperatorError,
    DeadlineError,
    NotFoundError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    Need,
    Phase,
    RunEventKind,
    RunRequest,
    SubtaskState,
    TaskState,
)
from appliance.model.task_api import Held, MigrateAsk, Migrated, MoveAsk, Reserved, RunStatus
from appliance.tasks.migration import moving as module
from appliance.tasks.migration.moving import Moving
from appliance.tasks.settings import MigrationConfig

pytestmark = pytest.mark.anyio

ASK = MigrateAsk(task="t-1", subtask="s1")


class Fleet:
    """Three gateways as a driver and its mover on gw-1 see them; each verb answers as the test says."""

    def __init__(self, bench: Any) -> None:
        self.bench = bench
        self.problems: dict[str, SwiftbotError] = {}
        self.gates: dict[str, asyncio.Event] = {}
        self.asked: list[tuple[str, str]] = []
        plane = bench.plane
        for name in ("gw-1", "gw-2", "gw-3"):
            plane.registry.gateways[name] = GatewayStatus(id=name, fleet="f", capacity=4, containers=1, ready=1)
            info = ContainerInfo(id=f"c-{name}", gateway=name, image="base", state=ContainerState.READY)
            plane.registry.containers[name] = {info.id: info}
        for verb in ("run_reserve", "run_unreserve", "run_hold", "run_resume", "run_leave", "run_status"):
            plane.rpc.on[verb] = self._answer(verb)
        self.moving = Moving(
            plane,
            coordinator=lambda _: bench.coordinator,
            manifest=bench.context.manifest,
            config=MigrationConfig(cpu_high=0.0),
        )

    def _answer(self, verb: str) -> Any:
        async def answer(gateway: str, ask: Any) -> Any:
            self.asked.append((verb, gateway))
            if verb in self.gates:
                await self.gates[verb].wait()
            if problem := self.problems.get(verb) or self.problems.get(f"{verb} {gateway}"):
                raise problem
            match verb:
                case "run_reserve":
                    return Reserved(gateway=gateway, container="c1", phase=Phase.LOCAL_WARM, lease_s=15.0)
                case "run_hold":
                    return Held(began=True, fresh=True, saved=True, hold_s=10.0)
                case _:
                    return RunStatus(running=verb == "run_status")

        return answer

    def did(self, verb: str) -> list[str]:
        """Which gateways were asked that."""
        return [gateway for each, gateway in self.asked if each == verb]


@pytest.fixture
async def fleet(bench: Any, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Fleet]:
    """A subtask that runs on gw-1, and what could be done about it."""
    monkeypatch.setattr(module, "WRITE_S", 20.0)
    monkeypatch.setattr(module, "START_S", 20.0)
    monkeypatch.setattr(module, "COORDINATOR_S", 0.05)
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.STARTED)
    await bench.until(lambda record: record.subtasks[0].state is SubtaskState.RUNNING)
    made = Fleet(bench)
    yield made
    await made.moving.close()


async def start_there(fleet: Fleet, *, gateway: str = "") -> tuple[str, Any]:
    """Take the order to the new attempt, and let it start."""
    there, request = await fleet.bench.ordered()
    fleet.bench.tell(request, RunEventKind.STARTED, gateway=gateway or there)
    return there, request


async def test_a_move_in_its_steps(fleet: Fleet) -> None:
    """A container there, the run held, the record written, the run ended, then the order: in that order, once each."""
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    gateway, request = await start_there(fleet)
    moved = await moving
    assert (moved.moved, moved.started, moved.source, moved.target, moved.attempt) == (True, True, "gw-1", gateway, 2)
    assert moved.checkpoint == "fresh"
    steps = [verb for verb, _ in fleet.asked if verb != "run_status"]
    assert steps == ["run_reserve", "run_hold", "run_leave"]
    assert (request.attempt, request.moves) == (2, 1)
    fleet.bench.tell(request, RunEventKind.SUCCEEDED, gateway=gateway, result={"ok": 1})
    last = await fleet.bench.end()
    assert last.state is TaskState.SUCCEEDED
    assert last.subtasks[0].attempts[0].left
    assert last.subtasks[0].attempts[0].failure is None


@pytest.mark.parametrize(
    ("verb", "problem"),
    [
        ("run_reserve", RefusedError("no room")),
        ("run_reserve", UnreachableError("gone")),
        ("run_hold", RefusedError("is in a robot command")),
        ("run_hold", DeadlineError("no answer")),
        ("run_hold", NotFoundError("has ended")),
    ],
)
async def test_what_fails_before_the_record_is_written_leaves_the_run_where_it_was(
    fleet: Fleet, verb: str, problem: SwiftbotError
) -> None:
    """The same attempt goes on and its result counts; whatever was held is let go of."""
    fleet.problems[verb] = problem
    with pytest.raises(SwiftbotError):
        await fleet.moving.migrate(ASK)
    record = fleet.bench.coordinator.record
    assert (record.subtasks[0].attempt, record.subtasks[0].gateway) == (1, "gw-1")
    assert not fleet.did("run_leave")
    if verb == "run_hold":
        assert fleet.did("run_resume") == ["gw-1"], "it may be held though the answer was lost"
        assert fleet.did("run_unreserve") == fleet.did("run_reserve")
    else:
        assert set(fleet.did("run_reserve")) == {"gw-2", "gw-3"}, "all others were tried"
    await _ends_where_it_was(fleet)


async def _ends_where_it_was(fleet: Fleet) -> None:
    first = RunRequest(task="t-1", subtask="s1", attempt=1, skill="work", need=Need(image="base"))
    fleet.bench.tell(first, RunEventKind.SUCCEEDED, result={"by": 1})
    last = await fleet.bench.end()
    assert (last.state, last.subtasks[0].result) == (TaskState.SUCCEEDED, {"by": 1})


async def test_a_target_that_refuses_is_followed_by_the_next_best(fleet: Fleet) -> None:
    """Nothing has happened to the run by then."""
    fleet.problems["run_reserve gw-2"] = RefusedError("full")
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    assert (await start_there(fleet))[0] == "gw-3"
    assert (await moving).target == "gw-3"


async def test_a_record_that_cannot_be_written_leaves_the_run_where_it_was(fleet: Fleet) -> None:
    """The store fails at the compare and set: the driver breaks, nothing was ordered, what was held is let go of."""
    fleet.bench.plane.dht.break_next = [UnreachableError("no owner")]
    with pytest.raises(SwiftbotError):
        await fleet.moving.migrate(ASK)
    assert not fleet.did("run_leave")
    assert fleet.did("run_resume") == ["gw-1"]
    assert fleet.bench.context.orders.empty()
    assert fleet.bench.stored().subtasks[0].attempt == 1


async def test_a_run_that_ends_meanwhile_is_not_moved(fleet: Fleet) -> None:
    """Its result counts, though a container was held and it was held itself."""
    fleet.gates["run_hold"] = asyncio.Event()
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    async with asyncio.timeout(60):
        while not fleet.did("run_hold"):
            await asyncio.sleep(0.005)
    await _ends_where_it_was(fleet)
    fleet.gates["run_hold"].set()
    with pytest.raises(SwiftbotError):
        await moving
    assert not fleet.did("run_leave")


async def test_an_old_run_that_does_not_confirm_its_end_is_fenced_off(fleet: Fleet) -> None:
    """The new attempt is ordered all the same, and a late result of the old one is refused."""
    fleet.problems["run_leave"] = DeadlineError("no answer")
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    gateway, request = await start_there(fleet)
    assert (await moving).moved
    fleet.bench.tell(replace(request, attempt=1), RunEventKind.SUCCEEDED, result={"by": 1})
    fleet.bench.tell(request, RunEventKind.SUCCEEDED, gateway=gateway, result={"by": 2})
    assert (await fleet.bench.end()).subtasks[0].result == {"by": 2}


@pytest.mark.parametrize("problem", [RefusedError("drains by now"), UnreachableError("gone"), DeadlineError("silent")])
async def test_an_order_that_fails_after_the_record_is_written_is_repeated_at_no_retry(
    fleet: Fleet, problem: SwiftbotError
) -> None:
    """As one that was lost with its gateway: under a higher number, and the skill's retries are untouched."""
    fleet.bench.context.refusals = [problem]
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    await fleet.bench.ordered()
    moved = await moving
    assert (moved.moved, moved.started) == (True, False)
    assert "repeated" in moved.why
    gateway, request = await start_there(fleet)
    assert request.attempt == 3
    fleet.bench.tell(request, RunEventKind.SUCCEEDED, gateway=gateway, result={})
    last = await fleet.bench.end()
    assert last.state is TaskState.SUCCEEDED


async def test_a_coordinator_that_dies_after_the_write_is_succeeded(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next driver finds an attempt that its gateway does not know: it is repeated, no result of the old counts."""
    monkeypatch.setattr(module, "START_S", 0.1)
    fleet.gates["run_leave"] = asyncio.Event()
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    await fleet.bench.until(lambda record: record.subtasks[0].attempt == 2)
    async with asyncio.timeout(60):
        while fleet.bench.stored().subtasks[0].attempt != 2:
            await asyncio.sleep(0.005)
    fleet.bench.task.cancel()
    await asyncio.gather(fleet.bench.task, moving, return_exceptions=True)

    async def unknown(gateway: str, ask: Any) -> RunStatus:
        return RunStatus(running=False)

    fleet.bench.plane.rpc.on["run_status"] = unknown
    await fleet.bench.start(fleet.bench.stored())
    gateway, request = await start_there(fleet)
    assert request.attempt == 3
    fleet.bench.tell(request, RunEventKind.SUCCEEDED, gateway=gateway, result={"by": 3})
    assert (await fleet.bench.end()).subtasks[0].result == {"by": 3}


async def test_a_move_can_be_called_off_until_its_record_is_written(fleet: Fleet) -> None:
    """Then the run goes on where it was; later it is too late."""
    fleet.gates["run_hold"] = asyncio.Event()
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    async with asyncio.timeout(60):
        while not fleet.did("run_hold"):
            await asyncio.sleep(0.005)
    assert (await fleet.moving.cancel(MoveAsk(task="t-1", subtask="s1"))).cancelled
    with pytest.raises(CancelledByOperatorError):
        await moving
    async with asyncio.timeout(60):
        while not (fleet.did("run_resume") and fleet.did("run_unreserve")):
            await asyncio.sleep(0.005)
    assert fleet.bench.coordinator.record.subtasks[0].attempt == 1
    assert not (await fleet.moving.cancel(MoveAsk(task="t-1", subtask="s1"))).cancelled
    await _ends_where_it_was(fleet)


async def test_one_move_of_a_subtask_at_a_time(fleet: Fleet) -> None:
    """A second one is refused while the first is under way."""
    fleet.gates["run_reserve"] = asyncio.Event()
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    async with asyncio.timeout(60):
        while not fleet.did("run_reserve"):
            await asyncio.sleep(0.005)
    with pytest.raises(RefusedError, match="already"):
        await fleet.moving.migrate(ASK)
    moving.cancel()
    await asyncio.gather(moving, return_exceptions=True)


async def test_a_run_that_commands_a_robot_stays_unless_its_manifest_says_otherwise(fleet: Fleet) -> None:
    """By default such a skill never moves once it has begun."""
    work = fleet.bench.context.skills["work"]
    fleet.bench.context.skills["work"] = replace(work, runs="robot", verbs=("goto",))
    with pytest.raises(RefusedError, match="commands a robot"):
        await fleet.moving.migrate(ASK)
    assert not [verb for verb, _ in fleet.asked if verb != "run_status"]  # the driver itself may have asked that
    fleet.bench.context.skills["work"] = replace(work, runs="robot", verbs=("goto",), migratable="between commands")
    moving = asyncio.create_task(fleet.moving.migrate(ASK))
    await start_there(fleet)
    assert isinstance(await moving, Migrated)


async def test_whoever_asks_for_what_cannot_be_is_told_why(fleet: Fleet) -> None:
    """Unknown subtask, attempt or gateway; where it is already; nobody else there."""
    for ask, error in (
        (replace(ASK, subtask="s9"), NotFoundError),
        (replace(ASK, attempt=7), RefusedError),
        (replace(ASK, to="gw-1"), RefusedError),
        (replace(ASK, to="gw-9"), NotFoundError),
    ):
        with pytest.raises(error):
            await fleet.moving.migrate(ask)
    fleet.bench.plane.present = {"gw-1"}
    with pytest.raises(RefusedError, match="it is there now"):
        await fleet.moving.migrate(ASK)
