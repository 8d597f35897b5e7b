"""The rest of a task is replanned, by a real HTTP server or, without one, by the rules."""

from collections.abc import Iterator
from typing import Any

import pytest
from llm_server import CATALOGUE, Server, completion, config
from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.llm.cascade import Decomposer
from appliance.llm.settings import PlanContext
from appliance.model import Failure, Plan, RobotInfo, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState, Tier
from appliance.tasks.plans import rest_of
from appliance.tasks.replan import problems

pytestmark = pytest.mark.anyio


@pytest.fixture
def server() -> Iterator[Server]:
    """Return a running server."""
    running = Server()
    yield running
    running.close()


def broken_off() -> TaskRecord:
    """A task whose rover went to dock 1 and could not photograph there."""
    plan = Plan(
        domain="navigation",
        subtasks=(
            Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "dock 1"}),
            Subtask(id="s2", skill="photograph", robot="rover_1", params={"target": "shelf"}, after=("s1",)),
        ),
    )
    failure = Failure(code="robot", message="the camera is dirty")
    return TaskRecord(
        id="t",
        instruction="Rover_1: go to dock 1 and photograph the shelf",
        state=TaskState.RUNNING,
        plan=plan,
        subtasks=(
            SubtaskRecord(subtask=plan.subtasks[0], state=SubtaskState.SUCCEEDED, result={}),
            SubtaskRecord(subtask=plan.subtasks[1], state=SubtaskState.FAILED, failure=failure),
        ),
    )


FILM = {
    "domain": "media",
    "subtasks": [
        {"id": "s1", "skill": "goto", "robot": "rover_1", "params": {"place": "dock 1"}, "after": []},
        {"id": "s2", "skill": "record_video", "robot": "rover_1", "params": {"target": "shelf"}, "after": ["s1"]},
    ],
}

SAME = {
    "domain": "media",
    "subtasks": [
        {"id": "s1", "skill": "photograph", "robot": "rover_1", "params": {"target": "shelf"}, "after": []},
    ],
}


async def replan(cascade: Decomposer, record: TaskRecord) -> Any:
    """Have the rest of a task replanned, with the checks of the task manager."""
    return await cascade.replan(
        record,
        PlanContext(instruction=record.instruction),
        problems=lambda plan: problems(record, plan, CATALOGUE.skills),
        rest=lambda plan: rest_of(record, plan),
    )


async def test_the_rest_of_a_task_is_planned_anew(server: Server) -> None:
    """The model gets what is done and what failed; a plan that repeats the failure is sent back with the reason."""
    server.answers = [completion(SAME), completion(FILM)]
    cascade = Decomposer(config(server, tiers=("upstream",)), CATALOGUE)
    try:
        outcome = await replan(cascade, broken_off())
    finally:
        await cascade.close()
    assert [each.skill for each in outcome.plan.subtasks] == ["goto", "record_video"]
    told = server.asked[0]["messages"][-1]["content"]
    assert 'Done: {"id":"s1","skill":"goto"' in told
    assert 'because: "the camera is dirty"' in told
    assert "this has failed (the camera is dirty)" in server.asked[1]["messages"][-1]["content"]


async def test_without_a_model_rules_use_alternatives_or_say_that_they_cannot(server: Server) -> None:
    """With a server that hangs, rules put the declared alternative in; without one the error names the failure."""
    server.answers = [30.0]
    cascade = Decomposer(config(server, upstream_deadline_s=0.2), CATALOGUE)
    record = broken_off()
    nothing = replace(record.subtasks[1].subtask, skill="goto", params={"place": "dock 2"})
    hopeless = replace(record, subtasks=(record.subtasks[0], replace(record.subtasks[1], subtask=nothing)))
    rover = RobotInfo(id="rover_1", kind="zenoh", uses=("base", "camera"), verbs=("goto", "state", "capture", "record"))
    try:
        context = PlanContext(instruction=record.instruction, robots=(rover,))
        outcome = await cascade.replan(
            record, context, problems=lambda _: (), rest=lambda plan: rest_of(record, plan)
        )  # fmt: skip
        assert [(each.skill, each.robot) for each in outcome.plan.subtasks] == [
            ("goto", "rover_1"),
            ("record_video", "rover_1"),
        ]
        assert outcome.plan.tier is Tier.RULES
        with pytest.raises(PlanError, match="rules cannot plan around a failure") as refused:
            await cascade.replan(hopeless, context, problems=lambda _: (), rest=lambda plan: plan)
        assert any("s2 (goto) has failed and no alternative" in each for each in refused.value.problems)
    finally:
        await cascade.close()
