"""Replanning by the real decomposer's checks: the safety policy holds for what takes a failed subtask's place."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.llm.cascade import Decomposer
from appliance.llm.settings import LlmConfig, PlanContext, RobotLimits, SafetyConfig
from appliance.model import Failure, Plan, RobotInfo, Site, Subtask, TaskRecord
from appliance.model.transitions import Transition, TransitionKind
from appliance.skills.catalogue import load_catalogue
from appliance.tasks import machine
from appliance.tasks.plans import Plans
from appliance.tasks.settings import TasksConfig

pytestmark = pytest.mark.anyio

VERBS = ("state", "goto", "pick", "place", "capture", "record", "hold", "return_home")
ROBOTS = {name: RobotInfo(id=name, kind="zenoh", uses=("base", "camera"), verbs=VERBS) for name in ("r1", "r2")}
PHOTO = Subtask(id="s1", skill="photograph", robot="any", params={"target": "shelf"})


def recovery(safety: SafetyConfig) -> Plans:
    """Return it with two robots and a decomposer of this policy."""
    catalogue = load_catalogue()
    return Plans(
        TasksConfig(),
        cast("Any", SimpleNamespace(registry=SimpleNamespace(robots=ROBOTS))),
        catalogue=catalogue,
        decomposer=Decomposer(LlmConfig(tiers=("rules",)), catalogue, safety=safety),
        site=Site(),
        task=cast("Any", None),
        busy=tuple,
    )


def running(submitter: str = "") -> TaskRecord:
    """Return a task whose one subtask runs on r1."""
    plan = Plan(domain="navigation", subtasks=(PHOTO,))

    def step(record: TaskRecord | None, kind: TransitionKind, **fields: Any) -> TaskRecord:
        sequence = record.sequence + 1 if record else 1
        common = {"task": "t", "sequence": sequence, "at_ns": sequence, "coordinator": "gw-1"}
        return machine.apply(record, Transition(**common, kind=kind, **fields))

    record = step(None, TransitionKind.ACCEPTED, instruction="r1: photograph the shelf", submitter=submitter)
    record = step(record, TransitionKind.PLANNED, plan=plan)
    return step(record, TransitionKind.DISPATCHED, subtask="s1", attempt=1, gateway="gw-1", robot="r1")


@pytest.mark.parametrize(
    ("safety", "submitter", "allowed"),
    [
        (SafetyConfig(), "", True),
        (SafetyConfig(limits=(RobotLimits(robots=("r2",), skills_never=("photograph",)),)), "", False),
        (SafetyConfig(robot_tasks="own"), "ann", True),
        (SafetyConfig(robot_tasks="own"), "r1", False),
    ],
)
def test_another_robot_is_held_to_the_policy(safety: SafetyConfig, submitter: str, allowed: bool) -> None:
    """The robot that takes over may do what is left, and a robot's own task commands no other robot."""
    record = failed(running(submitter))
    assert record.plan is not None
    assert (recovery(safety).against(record, record.of("s1"), record.plan, "r2") == ()) is allowed


def test_another_skill_is_held_to_the_policy() -> None:
    """A skill that no plan may have does not come in place of another; what was wrong before is no reason."""
    record = failed(running())
    assert record.plan is not None
    other = replace(
        record.plan, subtasks=(replace(PHOTO, id="r1s_1", skill="record_video", params={"target": "shelf"}),)
    )
    forbids = SafetyConfig(skills_never=("record_video", "photograph"))
    (problem,) = recovery(forbids).against(record, record.of("s1"), other)
    assert "safety.skills_never: record_video" in problem
    assert recovery(forbids).against(record, record.of("s1"), record.plan) == ()
    assert recovery(SafetyConfig()).against(record, record.of("s1"), other) == ()


async def test_a_robots_task_is_planned_anew_as_a_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    """The decomposer knows who asked: with `own` a new plan commands no other robot either."""
    asked: list[PlanContext] = []

    async def keep(self: Decomposer, record: TaskRecord, context: PlanContext, **_: Any) -> None:
        del self, record
        asked.append(context)
        raise PlanError("enough")

    monkeypatch.setattr(Decomposer, "replan", keep)
    for submitter in ("r1", "ann"):
        with pytest.raises(PlanError):
            await recovery(SafetyConfig()).replan(failed(running(submitter)))
    assert [(each.submitter, each.from_robot) for each in asked] == [("r1", True), ("ann", False)]


def failed(record: TaskRecord) -> TaskRecord:
    """Return the task with its subtask given up."""
    given_up = Transition(
        task="t", sequence=record.sequence + 1, kind=TransitionKind.ATTEMPT_FAILED, at_ns=9, coordinator="gw-1",
        subtask="s1", attempt=1, gateway="gw-1", failure=Failure(code="unreachable", message="r1 is away"),
        give_up=True, replan=True,
    )  # fmt: skip
    return machine.apply(record, given_up)
