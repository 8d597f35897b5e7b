"""The review: what each check finds by name, and that no check takes back what another found."""

import itertools
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.llm import review as module
from appliance.llm.checks.reading import spelled
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
        ("Drone_1: take off and photograph the latter",
         [("takeoff", "drone_1", {}), ("photograph", "drone_1", {"target": "latter"})], "names", "hold"),
        ("Drone_1: photograph the green crate come Thursday",
         [("photograph", "drone_1", {"target": "green crate come thursday"})], "names", "hold"),
        ("Rover_1: pick up three hundred green crates at the shelf",
         [("goto", "rover_1", {"place": "shelf"}), ("pick", "rover_1", {"object": "three hundred green crates"})],
         "names", "hold"),
        ("Drone_1: photograph the red box 1000 times",
         [("photograph", "drone_1", {"target": "red box", "count": 1000})], "schema", "refuse"),
        ("Drone_1: count the red boxes on the moored barge",
         [("count", "drone_1", {"target": "red boxes", "area": "moored barge"})], "unknown_place", "hold"),
        ("Rover_1: drive to goal 1 (28, 20)", [("goto", "rover_1", {"place": "goal 1"})], "names", "hold"),
        ("Rover_1: drive to dock 1, forget I asked", [GO1], "correction", "hold"),
        ("Rover_1 goes to dock 1 and at the same time drone_1 goes to dock 2",
         [("goto", "drone_1", {"place": "dock 1"}), GO2], "assignment", "hold"),
        ("First rover_1 goes to dock 2. Then drone_1 goes to dock 2 too",
         [("goto", "drone_1", {"place": "dock 2"}), GO2], "sequence", "hold"),
        ("Rover_1: drive to dock 1, I mean dock 2", [GO2], "correction", "hold"),
        ("did rover_1 go to dock 1?", [GO1], "question", "hold"),
        ("Rover_1: take it there", [GO1], "pronoun", "hold"),
        ("Rover_1: go to dock 1, then to dock 2 for 7 minutes", [GO1, GO2], "quantity", "hold"),
        ("Rover_1 goes to dock 1 and drone_1 to dock 2", [GO2], "idle_robot", "hold"),
        ("Rover_1: go to d\u043eck 1", [GO1], "unseen", "hold"),
        ("Rover_1: drive away from dock 1", [GO1], "polarity", "hold"),
        ("Rover_1: bring three red boxes to dock 2",
         [("goto", "rover_1", {"place": "dock 3"}), ("pick", "rover_1", {"object": "red boxes"}), GO2,
          ("place", "rover_1", {"object": "red boxes", "at": "dock 2"})], "quantity", "hold"),
        ("Rover_1: pick up all the red boxes at dock 3",
         [("goto", "rover_1", {"place": "dock 3"}), ("pick", "rover_1", {"object": "red boxes"})], "quantity", "hold"),
        ("Drone_1: track the driver for 90000 ms",
         [("track", "drone_1", {"target": "driver", "window_ms": 90000})], "quantity", "hold"),
        ("Rover_1: hold, spot go to dock 1", [("hold", "rover_1", {}), GO1], "coverage", "hold"),
        ("Rover_1 is at dock 1, drone_1 takes off", [GO1, ("takeoff", "drone_1", {})], "coverage", "hold"),
        ("Rover_1: take the green crate upside down to dock 2",
         [("pick", "rover_1", {"object": "green crate upside"}), GO2,
          ("place", "rover_1", {"object": "green crate upside", "at": "dock 2"})], "names", "hold"),
        ("Rover_1: say good morning in the voice of my mother in law",
         [("say", "rover_1", {"text": "good morning in the voice of my mother in law"})], "names", "hold"),
        ("Rover_1 and drone_1 go to dock 1, then it photographs the truck",
         [GO1, ("goto", "drone_1", {"place": "dock 1"}), ("photograph", "rover_1", {"target": "truck"})],
         "pronoun", "hold"),
        ("Rover_1: go to dock 3, pick up the red box and the green crate, go to dock 1 and put it down there",
         [("goto", "rover_1", {"place": "dock 3"}), ("pick", "rover_1", {"object": "red box"}),
          ("pick", "rover_1", {"object": "green crate"}), GO1,
          ("place", "rover_1", {"object": "green crate", "at": "dock 1"})], "pronoun", "hold"),
        ("Rover_1: when you have a moment go to dock 1",
         [("wait_for", "rover_1", {"event": "you have a moment"}), GO1], "names", "hold"),
        ("Send rover_1 to dock 1 and have it photograph dock 2 from there",
         [GO1, GO2, ("photograph", "rover_1", {"target": "dock 2"})], "polarity", "hold"),
        ("Drone_1 tracks rover_1, send rover_1 to dock 2",
         [("track", "drone_1", {"target": "rover_1"}), ("goto", "drone_1", {"place": "dock 2"})], "assignment", "hold"),
        ("Send rover_1 to dock 2 and have drone_1 photograph rover_1",
         [("goto", "drone_1", {"place": "dock 2"}), ("photograph", "drone_1", {"target": "rover_1"})],
         "idle_robot", "hold"),
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
        ("Send rover_1 to dock 1 and have it photograph dock 2 from there",
         [GO1, ("photograph", "rover_1", {"target": "dock 2"})]),
        ("pls rover_1 go @ dock 1 :)", [GO1]),
        ("rover_1 pls photograph the shelf x3", [("photograph", "rover_1", {"target": "shelf", "count": 3})]),
        ("Drone_1: track rover_1", [("track", "drone_1", {"target": "rover_1"})]),
        ("Drone_1 tracks rover_1, send rover_1 to dock 2", [("track", "drone_1", {"target": "rover_1"}), GO2]),
        ("Drone_1: take a photo of rover_1", [("photograph", "drone_1", {"target": "rover_1"})]),
        ("Rover_1: go to dock 1, then dock 2. That's all, over and out", [GO1, GO2]),
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


@pytest.mark.parametrize("said", ["all five drones", "both drones", "all 3 drones"])
def test_a_group_of_another_size_is_asked_about(said: str) -> None:
    """Who says "all five drones" of a fleet with one is asked: the words are of another fleet."""
    found = review(facts(f"{said}: land", ("land", "drone_1", {})))
    assert found.decision is Verdict.HOLD


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("rover_1 & rover_2 @ dock 1 :)", "rover_1 and rover_2 at dock 1"),
        ("photo of the shelf x3, then home", "photo of the shelf 3 times, then home"),
        ("go to x 5, y 3", "go to x 5, y 3"),
        ("all of u n them", "all of you and them"),
        ('say "me & u x3"', 'say "me & u x3"'),
        ("say 'me & u x3', then go @ home", "say 'me & u x3', then go at home"),
        ("say “me & u :)”", "say “me & u :)”"),
        ('say "me & u', 'say "me and you'),
        ("go to R&D", "go to R&D"),
    ],
)
def test_shorthand_is_read_as_what_it_is_short_for(typed: str, meant: str) -> None:
    """Signs of chat become words, but not in quotation marks, in names and between coordinates."""
    assert spelled(typed) == meant


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("u goes to dock 1", "u goes to dock 1"),
        ("U and u_1: land, both of you", "U and u_1: land, both of you"),
        ("unit n 1 & rover_x2 go home", "unit n 1 and rover_x2 go home"),
        ("unit_n then u", "unit_n then u"),
        ("go to bay x3", "go to bay x3"),
        ("go to bay x3, photo of it x3", "go to bay x3, photo of it 3 times"),
        ("thats to Bay  X3", "thats to Bay  X3"),
        ("load & go & ship", "load & go and ship"),
    ],
)
def test_names_are_no_shorthand(typed: str, meant: str) -> None:
    """A robot called `u`, a place called "bay x3": names of the fleet and of the site stay as they are."""
    known = ("u", "u_1", "unit_n", "unit_n_1", "rover_x2", "thats", "bay x3", "load & go")
    assert spelled(typed, known) == meant


@pytest.mark.parametrize(
    "said",
    [
        "Rover_1 goes to dock 1, after that drone_1 takes off",
        "Rover_1 goes to dock 1. When it's done, drone_1 takes off",
        "Rover_1 goes to dock 1. As soon as it is there, drone_1 takes off",
        "Rover_1 goes to dock 1. When you've arrived, drone_1 takes off",
    ],
)
def test_what_is_first_by_a_clause_without_content_is_first(said: str) -> None:
    """Such a clause orders what comes before and behind it: a plan that does both side by side is held."""
    subtasks = (
        Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "dock 1"}),
        Subtask(id="s2", skill="takeoff", robot="drone_1", params={}),
    )
    context = PlanContext(instruction=said, robots=roster("demo"), site=SITE)
    for after, held in (((), True), (("s1",), False)):
        plan = Plan(domain="navigation", subtasks=(subtasks[0], replace(subtasks[1], after=after)))
        found = review(Facts(plan, context, CATALOGUE, SafetyConfig()))
        assert ("sequence" in {each.check for each in found.findings}) is held


def test_a_clause_with_content_is_first_itself() -> None:
    """Of "return home once you have photographed the shelf" the photograph comes first, and nothing is to be asked."""
    text = "Rover_1: return home once you have photographed the shelf"
    steps: list[Step] = [("photograph", "rover_1", {"target": "shelf"}), ("return_home", "rover_1", {})]
    assert review(facts(text, *steps)).decision is Verdict.RUN


def test_in_the_meantime_is_side_by_side() -> None:
    """As "meanwhile" is."""
    text = "Rover_1 goes to dock 1, drone_1 in the meantime takes off"
    assert "sequence" in {each.check for each in review(facts(text, GO1, ("takeoff", "drone_1", {}))).findings}
