"""The review: what each check finds by name, and that no check takes back what another found."""

import itertools
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm import review as module
from appliance.llm.completion import completed
from appliance.llm.review import CHECKS, Facts, review
from appliance.llm.settings import PlanContext, SafetyConfig
from appliance.model import Finding, Plan, Severity, Subtask, Verdict
from appliance.skills.catalogue import load_catalogue
from appliance.skills.sites import load_site
from workshop.bench.intent.cases import roster

CATALOGUE = load_catalogue()
SITE = load_site("warehouse")
Step = tuple[str, str | None, dict[str, Any]]


def facts(instruction: str, *steps: Step, fleet: str = "demo", **more: Any) -> Facts:
    """Return what the checks look at: a plan of steps one after the other, for an instruction to a fleet."""
    subtasks = tuple(
        Subtask(id=f"s{n}", skill=skill, robot=robot, params=params, after=(f"s{n - 1}",) if n > 1 else ())
        for n, (skill, robot, params) in enumerate(steps, start=1)
    )
    domain = CATALOGUE.skills[steps[0][0]].domain
    context = PlanContext(instruction=instruction, robots=roster(fleet), site=SITE)
    return Facts(Plan(domain=domain, subtasks=subtasks), context, CATALOGUE, SafetyConfig(), **more)


GO1: Step = ("goto", "rover_1", {"place": "dock 1"})
GO2: Step = ("goto", "rover_1", {"place": "dock 2"})


@pytest.mark.parametrize(
    ("instruction", "steps", "check", "decision"),
    [
        ("Drone_1: don't take off", [("takeoff", "drone_1", {})], "negation", "refuse"),
        ("Drone_1: do\nnot take off", [("takeoff", "drone_1", {})], "negation", "refuse"),
        ("Rover_1: do not pick up the red box", [("pick", "rover_1", {"object": "red box"})], "negation", "refuse"),
        ("Rover_1: never go to dock 2", [GO2], "negation", "refuse"),
        ("Rover_1: stop going to dock 1", [GO1], "negation", "refuse"),
        ("Drone_1: land now, do not go to dock 1", [("land", "drone_1", {}), ("goto", "drone_1", {"place": "dock 1"})],
         "negation", "refuse"),
        ("Rover_1: go to dock 1 unless the battery is low", [GO1], "exception", "hold"),
        ("Rover_1: go to dock 1 if the door is open", [GO1], "condition", "hold"),
        ("Rover_1: go to dock 1 or dock 2, whichever is closer", [GO1], "alternative", "hold"),
        ("Rover_1: go to dock 1 in 5 minutes", [GO1], "time", "refuse"),
        ("Rover_1: go to dock 1 at 5 pm", [GO1], "time", "refuse"),
        ("Rover_1: go to dock 1 every 10 minutes", [GO1], "time", "refuse"),
        ("Rover_1: go to dock 1 slowly", [GO1], "coverage", "hold"),
        ("Rover_1: drop the box", [("pick", "rover_1", {"object": "box"})], "polarity", "refuse"),
        ("Rover_1: put down the red box", [("pick", "rover_1", {"object": "red box"})], "polarity", "refuse"),
        ("Drone_1: descend to 2 m", [("takeoff", "drone_1", {"altitude_m": 2})], "polarity", "refuse"),
        ("Drone_1 fly to 47.3979, 8.5457", [("goto", "drone_1", {"place": "47.3979, 8.5457"})], "schema", "refuse"),
        ("Rover_1: go to 500, 500", [("goto", "rover_1", {"place": "500, 500"})], "schema", "refuse"),
        ("Rover_1: go to dcok 1", [("goto", "rover_1", {"place": "dcok 1"})], "schema", "refuse"),
        ("Please send the rover over to dock 2", [("goto", "drone_1", {"place": "dock 2"}), GO2],
         "unnamed_robot", "hold"),
        ("wait 30 seconds then go to dock 4",
         [("hold", "drone_1", {"duration_s": 30}), ("goto", "drone_1", {"place": "dock 4"})], "choose_robot", "hold"),
        ("Rover_1: get me a coffee", [("pick", "rover_1", {"object": "me coffee"})], "unknown_thing", "hold"),
        ("Rover_1: drive to dock 1, I mean dock 2", [GO2], "correction", "hold"),
        ("did rover_1 go to dock 1?", [GO1], "question", "hold"),
        ("Rover_1: take it there", [GO1], "pronoun", "hold"),
        ("Rover_1: go to dock 1, then to dock 2 for 7 minutes", [GO1, GO2], "quantity", "hold"),
        ("Rover_1 goes to dock 1 and drone_1 to dock 2", [GO2], "idle_robot", "hold"),
        ("Rover_1: go to d\u043eck 1", [GO1], "unseen", "hold"),
        ("Rover_1: drive away from dock 1", [GO1], "polarity", "hold"),
    ],
)  # fmt: skip
def test_each_kind_is_found_by_the_check_of_its_name(
    instruction: str, steps: list[Step], check: str, decision: str
) -> None:
    """A planner that misreads these is stopped by the same checks, whichever it is."""
    found = review(facts(instruction, *steps))
    assert check in {each.check for each in found.findings if each.severity is not Severity.NOTE}
    assert found.decision == decision


@pytest.mark.parametrize(
    ("instruction", "steps"),
    [
        ("Rover_1: go to dock 1 but do not photograph it", [GO1]),
        ("Don't forget to send rover_1 to dock 1, please", [GO1]),
        ('Rover_1: say "do not enter"', [("say", "rover_1", {"text": "do not enter"})]),
        ("Could you please send the rover to dock 1?", [GO1]),
        ("Rover_1 go to loading dock one, then bay 2", [GO1, GO2]),
        ("drone: land please", [("land", "drone_1", {})]),
        ("Rover_1: wait until Eva confirms, then go to dock 1",
         [("wait_for", "rover_1", {"event": "eva confirms"}), GO1]),
        ("Drone_1: take off to 30 feet", [("takeoff", "drone_1", {"altitude_m": 9.144})]),
        ("Rover_1: go to (26, 6)", [("goto", "rover_1", {"place": "26, 6"})]),
        ("Rover_1: photograph the stop sign", [("photograph", "rover_1", {"target": "stop sign"})]),
    ],
)  # fmt: skip
def test_good_orders_run(instruction: str, steps: list[Step]) -> None:
    """What accounts for all words is held by nothing."""
    assert review(facts(instruction, *steps)).decision is Verdict.RUN


def test_of_an_edited_plan_the_words_give_notes_and_limits_still_refuse() -> None:
    """A person's plan is what they typed; a fence is a fence."""
    ours = review(facts("Rover_1: do not go to dock 1", GO1, edited=True))
    assert ours.decision is Verdict.RUN
    assert "negation" in {each.check for each in ours.findings}
    beyond = review(facts("", ("goto", "rover_1", {"place": "500, 500"}), edited=True))
    assert beyond.decision is Verdict.REFUSE


def test_a_thing_is_gone_to_before_it_is_picked_up() -> None:
    """The site knows where the red box is; a robot that has been sent elsewhere for it is left to a person."""
    context = PlanContext(instruction="fetch red box", robots=roster("demo"), site=SITE)
    pick = Subtask(id="s1", skill="pick", robot="any", params={"object": "red box"})
    plan, added = completed(Plan(domain="manipulation", subtasks=(pick,)), context, CATALOGUE)
    assert [(each.skill, each.robot, each.after) for each in plan.subtasks] == [
        ("goto", "rover_1", ()),
        ("pick", "rover_1", ("s1",)),
    ]
    assert added == {"s1"}
    told = facts("Rover_1: drive to dock 1 and pick the red box", GO1, ("pick", "rover_1", {"object": "red box"}))
    assert "elsewhere" in {each.check for each in review(told).findings}


findings = st.lists(
    st.builds(Finding, check=st.sampled_from(["a", "b"]), severity=st.sampled_from(list(Severity)), message=st.text()),
    max_size=4,
)


@given(st.lists(findings, min_size=1, max_size=5), st.randoms())
@settings(deadline=None)
def test_the_order_of_checks_does_not_matter_for_the_severity(found: list[list[Finding]], random: Any) -> None:
    """The worst severity decides, wherever its check stands, and another check cannot take it back."""
    order = {severity: number for number, severity in enumerate((Severity.NOTE, Severity.HOLD, Severity.REFUSE))}
    worst = max((order[each.severity] for group in found for each in group), default=0)
    wanted = (Verdict.RUN, Verdict.HOLD, Verdict.REFUSE)[worst]
    checks = [module.Check(f"c{n}", lambda _, group=group: group) for n, group in enumerate(found)]
    for shuffled in (checks, random.sample(checks, len(checks))):
        made = [each for check in shuffled for each in check.run(facts("go", GO1))]
        assert module.Review(findings=tuple(made)).decision is wanted


def test_checks_have_names_and_survive_hostile_plans() -> None:
    """Cycles, unknown skills, odd types and 100 kB of words end in findings, not in an exception."""
    assert all(each.name.replace("_", "").isalpha() for each in CHECKS)
    hostile = (
        Subtask(id="s1", skill="goto", robot="rover_1", params={"place": ["x"], "speed_mps": "fast"}, after=("s2",)),
        Subtask(id="s2", skill="dance", robot="\u202eall", params={"object": None}, after=("s1", "s9")),
        Subtask(id="s2", skill="say", robot=None, params={"text": "not " * 2000}),
    )
    for words, plan in itertools.product(("", "not " * 25_000, "\x00\u202e{}[red]"), (hostile, hostile[::-1])):
        context = PlanContext(instruction=words, robots=roster("demo"), site=SITE)
        made = Facts(Plan(domain="navigation", subtasks=plan), context, CATALOGUE, SafetyConfig())
        assert review(made).decision is Verdict.REFUSE
        for check in CHECKS:
            list(check.run(made))
