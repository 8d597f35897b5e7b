"""What surrounds an order: with the plain order's own plan in hand, nothing runs but what is read whole."""

from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm.checks import clauses
from appliance.llm.review import Facts, review
from appliance.llm.settings import PlanContext, SafetyConfig
from appliance.llm.stop_words import stop_request
from appliance.model import Plan, Subtask, Verdict
from appliance.skills.catalogue import load_catalogue
from appliance.skills.sites import load_site
from workshop.bench.intent.cases import roster

CATALOGUE = load_catalogue()
SITE = load_site("warehouse")
ROBOTS = roster("demo")
Order = tuple[str, str, list[tuple[str, dict[str, Any]]]]
ORDERS: list[Order] = [
    ("rover_1", "go to dock 1", [("goto", {"place": "dock 1"})]),
    ("rover_1", "pick up the red box at dock 3", [("goto", {"place": "dock 3"}), ("pick", {"object": "red box"})]),
    ("drone_1", "take off to 5 m", [("takeoff", {"altitude_m": 5})]),
    ("rover_1", "photograph the shelf", [("photograph", {"target": "shelf"})]),
    ("rover_1", 'say "hello"', [("say", {"text": "hello"})]),
    ("drone_1", "land", [("land", {})]),
    ("rover_1", "wait 20 seconds, then go to dock 2", [("hold", {"duration_s": 20}), ("goto", {"place": "dock 2"})]),
    ("rover_1", "open the gate", [("open", {"object": "gate"})]),
]
KNOWN = {
    "{} if the coast is clear": "what only reports may be told at any time",
    "{} if you ask me": "what only reports may be told at any time",
    "wish list: {}": "what is said is said",
    "{} with the box": "the box is the red box that is picked up",
    "-- {}": "a mark of a list or of a message",
    "{} and wait for it": "a robot that waited first is asked to wait",
    "{} but stay here": "a robot that waited first is asked to stay",
    "{} up to a point": "a point is a place that a robot goes to",
}
"""Wrappers that run with some order, and why that is left so."""


def wrappers() -> list[tuple[str, str]]:
    """Return the kinds of wrappers with each one: `{}` is the order, `{r}` its robot, `{v}` the rest."""
    kind, found = "", list[tuple[str, str]]()
    for file in sorted(Path(__file__).parent.glob("wrappers*.txt")):
        for line in file.read_text(encoding="utf-8").splitlines():
            if line.startswith("# ") and "{" not in line:
                kind = line[2:]
            elif line.strip():
                found.append((kind, line))
    return found


def decided(wrapper: str, order: Order) -> tuple[str, str]:
    """Return a wrapped order and what becomes of it, planned as the plain order is."""
    robot, rest, steps = order
    text = wrapper.format(f"{robot} {rest}", r=robot, v=rest)
    subtasks = tuple(
        Subtask(id=f"s{n}", skill=skill, robot=robot, params=params, after=(f"s{n - 1}",) if n > 1 else ())
        for n, (skill, params) in enumerate(steps, start=1)
    )
    if stop_request(text, [each.id for each in ROBOTS]) is not None:
        return text, "stop"
    plan = Plan(domain=CATALOGUE.skills[steps[0][0]].domain, subtasks=subtasks)
    context = PlanContext(instruction=text, robots=ROBOTS, site=SITE)
    return text, review(Facts(plan, context, CATALOGUE, SafetyConfig())).decision.value


def test_there_are_wrappers_of_many_kinds() -> None:
    """At least 400, with those that plainly are courtesy."""
    found = wrappers()
    assert len(found) >= 400
    assert len({kind for kind, _ in found}) >= 10


@pytest.mark.parametrize("shift", [0, pytest.param(1, marks=pytest.mark.long)])
def test_what_surrounds_an_order_is_accounted_for_or_holds(shift: int) -> None:
    """Each wrapper around some order (the long one: around all): only courtesies run."""
    ran: list[str] = []
    held: list[str] = []
    for number, (kind, wrapper) in enumerate(wrappers()):
        orders = ORDERS if shift or kind == "courtesy" else [ORDERS[number % len(ORDERS)]]
        for text, decision in (decided(wrapper, each) for each in orders):
            if kind == "courtesy" and decision != "run":
                held.append(text)
            elif kind != "courtesy" and decision == "run" and wrapper not in KNOWN:
                ran.append(text)
    assert ran == []
    assert held == []


WORDS = st.text(st.characters(categories=("L", "N", "P", "S", "Z")), min_size=1, max_size=12)


@given(st.sampled_from(ORDERS), WORDS, st.sampled_from(["{w} {o}", "{o} {w}", "{o}. {w}", "{r} {w} {v}"]))
@settings(deadline=None)
def test_a_word_that_nothing_derives_holds(order: Order, word: str, form: str) -> None:
    """Whatever is put beside an order: it runs only where each word is of the closed lists."""
    known = set(chain.from_iterable(clauses.VOCABULARY))
    robot, rest, _ = order
    text = form.format(w=word.replace("{", "").replace("}", ""), o=f"{robot} {rest}", r=robot, v=rest)
    _, decision = decided(text.replace("{", "").replace("}", ""), order)
    own = {*robot.split("_"), *rest.replace(",", " ").replace('"', " ").split()}
    strange = [each for each in word.casefold().split() if each.isalpha() and each not in known | own]
    if strange and len(strange[0]) > 3:
        assert decision != Verdict.RUN.value or any(each in str(CATALOGUE.skills) for each in strange)


def test_a_run_of_words_is_read_between_its_contents() -> None:
    """Places matter: a courtesy begins or ends a clause, a link stands within it."""
    assert clauses.derivable("START", ("could", "you", "please", "have"), "R")
    assert clauses.derivable("V", ("to", "the"), "A")
    assert clauses.derivable("A", (",", "then"), "V")
    assert not clauses.derivable("A", (",", "and", "then"), "V", several=False)
    assert not clauses.derivable("V", ("could", "you", "maybe"), "A")
    assert not clauses.derivable("A", ("have",), "END")
    assert clauses.outstanding(["R", "V"], ["rover_1", "went"]) == [1]
    labels = ["once", "R", "has", "V", "A", ",", "R", "V", "A"]
    assert clauses.outstanding(labels, ["once", "one", "has", "reached", "dock", ",", "two", "goes", "home"]) == []
