"""A robot of a kind: where a plan leaves open who does it, and the words say "a drone", it is a drone."""

import pytest
from msgspec.structs import replace

from appliance.llm.completion import completed
from appliance.llm.review import Facts, review
from appliance.llm.settings import PlanContext, SafetyConfig
from appliance.model import Plan, RobotInfo, Subtask
from appliance.skills.catalogue import load_catalogue
from workshop.bench.plan.rosters import fleet

CATALOGUE = load_catalogue()
DOMAIN = CATALOGUE.skills["photograph"].domain


def whom(text: str, *robots: str, fleet_: tuple[RobotInfo, ...] | None = None) -> list[str | None]:
    """Return who does what robots of a plan were to photograph, once it is completed."""
    subtasks = tuple(
        Subtask(id=f"s{number}", skill="photograph", robot=who, params={"target": "gate"})
        for number, who in enumerate(robots, start=1)
    )
    context = PlanContext(instruction=text, robots=fleet_ or fleet(8))
    plan, _ = completed(Plan(domain=DOMAIN, subtasks=subtasks), context, CATALOGUE)
    return [each.robot for each in plan.subtasks]


@pytest.mark.parametrize(
    ("text", "robot"),
    [
        ("a drone photographs the gate", "drone_1"),
        ("photograph the gate with a drone", "drone_1"),
        ("one of the rovers photographs the gate", "rover_1"),
        ("a robot photographs the gate", "any"),
        ("photograph the gate", "any"),
        ("photograph the gate, then give the box to a drone", "any"),
    ],
)
def test_any_robot_is_one_of_the_kind_that_is_said(text: str, robot: str) -> None:
    """The scheduler would take whichever robot can do it; the words say which kind."""
    assert whom(text, "any") == [robot]


def test_two_of_a_kind_are_two_robots() -> None:
    """Each label is another robot; one that is offline, or has work already, is passed over."""
    assert whom("two drones photograph the gate", "any1", "any2") == ["drone_1", "drone_2"]
    away = tuple(replace(each, online=each.id != "drone_1") for each in fleet(8))
    assert whom("a drone photographs the gate", "any", fleet_=away) == ["drone_2"]
    text = "drone_1 photographs the gate, then a drone photographs the gate"
    assert whom(text, "drone_1") == ["drone_1"]


@pytest.mark.parametrize("choose_robot", ["ask", "auto"])
def test_who_it_is_stays_a_persons_choice(choose_robot: str) -> None:
    """With `choose_robot` "ask" the plan is held as before; with "auto" it runs, with a robot of that kind."""
    context = PlanContext(instruction="a drone photographs the gate", robots=fleet(8))
    open_ = Plan(
        domain=DOMAIN, subtasks=(Subtask(id="s1", skill="photograph", robot="any", params={"target": "gate"}),)
    )
    plan, _ = completed(open_, context, CATALOGUE)
    safety = SafetyConfig(choose_robot="ask" if choose_robot == "ask" else "auto")
    checks = {each.check for each in review(Facts(plan, context, CATALOGUE, safety)).findings}
    assert checks == ({"choose_robot"} if choose_robot == "ask" else set())


@pytest.mark.parametrize("text", ["a drone photographs drone_1", "photograph drone_1 with a drone"])
def test_a_robot_of_a_kind_is_not_the_one_that_has_a_name(text: str) -> None:
    """What is done to drone_1 is done by another drone, and by no rover."""
    step = Subtask(id="s1", skill="photograph", robot="any", params={"target": "drone_1"})
    plan, _ = completed(
        Plan(domain=DOMAIN, subtasks=(step,)), PlanContext(instruction=text, robots=fleet(8)), CATALOGUE
    )
    assert [each.robot for each in plan.subtasks] == ["drone_2"]
