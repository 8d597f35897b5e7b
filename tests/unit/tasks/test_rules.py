"""Which robot a subtask gets while standing rules hold, and what it waits for."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.llm.cascade import Decomposer
from appliance.llm.settings import LlmConfig, OutOfUse
from appliance.model import Place, RobotInfo, Site, Subtask, SubtaskRecord, TaskRecord, Word
from appliance.model.closures import Closure, Rule
from appliance.skills.catalogue import load_catalogue
from appliance.tasks.plans import Plans
from appliance.tasks.scheduler import Scheduler
from appliance.tasks.settings import TasksConfig

VERBS = ("state", "goto", "pick", "place", "hold", "return_home")
ROBOTS = {name: RobotInfo(id=name, kind="zenoh", uses=("base", "arm"), verbs=VERBS) for name in ("r1", "r2")}
SITE = Site(places={"dock 1": Place(x=1, y=1), "dock 2": Place(x=2, y=9)})
CATALOGUE = load_catalogue()


def scheduler(*rules: Rule) -> Scheduler:
    """Return one of a gateway where these rules hold."""
    plane: Any = SimpleNamespace(registry=SimpleNamespace(robots=ROBOTS, gateways={}, lost_ns={}))
    kept = tuple(Closure(kind="rule", name=each.id, rule=each, by=Word(by="ann", why="wet")) for each in rules)
    plans = Plans(
        TasksConfig(),
        plane,
        catalogue=CATALOGUE,
        decomposer=Decomposer(LlmConfig(tiers=("rules",)), CATALOGUE),
        site=SITE,
        task=cast("Any", None),
        busy=tuple,
        out_of_use=lambda: OutOfUse(rules=kept),
    )
    return Scheduler(
        plane,
        CATALOGUE,
        TasksConfig(),
        records=tuple,
        wake=lambda _: None,
        image_of=str,
        closed=plans.closed,
        kept_from=plans.kept_from,
    )


def task(*steps: tuple[str, str], bound: str | None = None) -> TaskRecord:
    """Return a task whose robots go to places, one after the other; `bound`: who does the first."""
    made = [
        SubtaskRecord(subtask=Subtask(id=f"s{number}", skill="goto", robot=robot, params={"place": place}))
        for number, (robot, place) in enumerate(steps, start=1)
    ]
    if bound:
        made[0] = SubtaskRecord(subtask=made[0].subtask, bound_robot=bound)
    return TaskRecord(id="t", instruction="go", subtasks=tuple(made))


AWAY = Rule(robots=("r1",), places=("dock 2",))


@pytest.mark.parametrize(
    ("rules", "record", "robot"),
    [
        ((), task(("r1", "dock 2")), "r1"),
        ((AWAY,), task(("r1", "dock 2")), None),
        ((AWAY,), task(("r1", "dock 1"), ("r1", "dock 2")), "r1"),
        ((AWAY,), task(("r2", "dock 2")), "r2"),
        ((AWAY,), task(("any", "dock 2")), "r2"),
        ((AWAY,), task(("any1", "dock 1"), ("any1", "dock 2")), "r2"),
        ((AWAY,), task(("any1", "dock 1"), ("any1", "dock 2"), bound="r1"), "r1"),
        ((Rule(places=("dock 2",)),), task(("any", "dock 2")), None),
    ],
)
def test_a_robot_that_no_rule_keeps_from_it(rules: tuple[Rule, ...], record: TaskRecord, robot: str | None) -> None:
    """One that is still to be chosen may do all that is its own; one that is known, what begins now. Else it waits."""
    found, why = scheduler(*rules).bind(record, record.subtasks[0])
    assert found == ((robot,) if robot else ())
    if robot is None:
        assert why.startswith("waits for")
        assert f"kept from it by standing rule {rules[0].id}" in why
        assert "by ann: wet" in why
