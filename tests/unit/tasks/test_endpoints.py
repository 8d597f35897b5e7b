"""`task why`: what a waiting task waits for, who could serve it, who could not, and when it may start."""

from collections.abc import AsyncIterator
from typing import Any, cast

import pytest
from msgspec.structs import replace

from appliance.errors import NotFoundError
from appliance.model import GatewayStatus, RunEvent, RunEventKind, Site, Subtask, SubtaskState, TaskRequest, TaskState
from appliance.model.task_api import RunAsk, RunStatus, WhyAsk
from appliance.reasons import why_text
from appliance.tasks.manager import TaskManager

from .test_manager import AgreeableDecomposer, never, until

pytestmark = pytest.mark.anyio


@pytest.fixture
async def manager(plane: Any, tasks_config: Any, catalogue: Any) -> AsyncIterator[TaskManager]:
    """Return a manager of gw-1 that knows three gateways: one full, one draining, one too small."""
    plane.rpc.on["run"] = never
    made = TaskManager(
        tasks_config, plane=plane, catalogue=catalogue, decomposer=cast("Any", AgreeableDecomposer()),
        site=Site(),
    )  # fmt: skip
    plane.registry.gateways = {
        "gw-1": GatewayStatus(id="gw-1", fleet="f", capacity=1, running=2),
        "gw-2": GatewayStatus(id="gw-2", fleet="f", capacity=4, draining=True),
        "gw-3": GatewayStatus(id="gw-3", fleet="f", capacity=4, pool_memory_mb=1),
    }
    await made.start()
    yield made
    await made.stop()


def wish(plane: Any, task: str, **fields: Any) -> TaskRequest:
    """Return a task of two subtasks, one after the other."""
    plan = plane.plan_of(Subtask(id="s1", skill="work"), Subtask(id="s2", skill="work", after=("s1",)))
    return TaskRequest(instruction="work", id=task, plan=plan, **fields)


async def waiting(manager: TaskManager, task: str) -> None:
    """Wait until a task waits for room."""
    await until(lambda: manager.scheduler.line.place_of((task, "s1"), 0.0).position)


async def test_a_wait_for_room_is_explained(manager: TaskManager, plane: Any) -> None:
    """Group, root, place in the line, candidates with scores, who is excluded and why, and when it may start."""
    manager.scheduler.line.completions.ended(3.0)
    await manager.submit(wish(plane, "t-1"))
    await waiting(manager, "t-1")
    await manager.submit(wish(plane, "t-2", submitter="ann", priority=2, deadline_s=100.0))
    await waiting(manager, "t-2")
    found = await manager.questions.why(WhyAsk(id="t-2"))
    assert (found.priority, found.submitter) == (2, "ann")
    assert found.left_s is not None
    assert 0 < found.left_s <= 100
    assert found.group is not None
    assert found.group.root == "gw-1"
    assert "subtasks wait for room before it" in found.note
    first, second = (each.waits for each in found.subtasks)
    assert first is not None
    assert second is not None
    assert (first.reason, first.position, first.waiting) == ("room at gw-1", 2, 2)
    assert first.expected_s == 6.0 / 5  # mean, place, and the five that gateways which do not drain may hold
    told = {each.gateway: each for each in first.candidates}
    assert told["gw-1"].score is not None
    assert told["gw-2"].excluded
    assert told["gw-3"].excluded
    assert second.reason == "comes after s1"
    assert [each.id for each in (await manager.questions.why(WhyAsk(id="t-2", subtask="s1"))).subtasks] == ["s1"]
    with pytest.raises(NotFoundError, match="s9"):
        await manager.questions.why(WhyAsk(id="t-2", subtask="s9"))
    assert why_text(found)


async def test_a_run_in_a_gateways_queue_is_asked_after_there(manager: TaskManager, plane: Any) -> None:
    """Its place in that queue and when it may have a container; one that runs waits for nothing."""

    async def status(gateway: str, ask: RunAsk) -> RunStatus:
        return RunStatus(running=True, position=3, queue=7, expected_s=1.25)

    plane.rpc.on["run_status"] = status
    plane.registry.gateways["gw-1"] = replace(plane.registry.gateways["gw-1"], running=0)
    await manager.submit(wish(plane, "t-1"))
    await until(lambda: manager._coordinators["t-1"].record.state is TaskState.RUNNING)
    await until(lambda: manager._coordinators["t-1"].record.subtasks[0].state is SubtaskState.DISPATCHED)
    waits = (await manager.questions.why(WhyAsk(id="t-1"))).subtasks[0].waits
    assert waits is not None
    assert (waits.at, waits.position, waits.waiting, waits.expected_s) == ("gw-1", 3, 7, 1.2)
    started = RunEvent(task="t-1", subtask="s1", attempt=1, kind=RunEventKind.STARTED, gateway="gw-1")
    manager._on_run_event("swiftbot/f/task/t-1/run/s1", started)
    await until(lambda: manager._coordinators["t-1"].record.subtasks[0].state is SubtaskState.RUNNING)
    running = (await manager.questions.why(WhyAsk(id="t-1"))).subtasks[0].waits
    assert running is not None
    assert running.reason == "nothing: it runs"
