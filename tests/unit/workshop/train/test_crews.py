"""Orders to crews made of orders to whomever: the plan has those who are meant, and each does all of it."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm.language import read
from appliance.llm.words import words_of
from appliance.model import Subtask
from appliance.skills.catalogue import load_catalogue
from workshop.train.crews import crewed, named
from workshop.train.examples import Example, is_exact
from workshop.train.lexicon import Lexicon

pytestmark = pytest.mark.timeout(900)  # to read the whole corpus takes ten seconds of a processor that is free
CATALOGUE = load_catalogue()


@pytest.fixture(scope="module")
def lexicon(examples: list[Example]) -> Lexicon:
    """The words of those examples, by what they may stand for."""
    return Lexicon(examples)


def example(text: str, plan: str, *roster: str) -> Example:
    """An example of a text whose words have blanks between them."""
    words = words_of(text, roster)
    return Example(tuple(words[number].lower() for number in range(len(words))), words.own, tuple(plan.split()))


ORDER = example("Go to bay 2 and pick the drill .", "manipulation goto any place: w2 w3 | pick any object: w7 w7 < 1")


def plan(of: Example) -> tuple[Subtask, ...]:
    """The plan of an example."""
    return read(of.symbols, words_of(" ".join(of.words[: of.own]), of.words[of.own :]), CATALOGUE).subtasks


@settings(deadline=None, max_examples=100)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_a_crews_plan_is_exact(examples: list[Example], lexicon: Lexicon, data: st.DataObject, seed: int) -> None:
    """The symbols are a plan over the words, for robots of the roster."""
    one = data.draw(st.sampled_from(examples))
    made = crewed(one, lexicon, random.Random(seed))  # noqa: S311 - a variation to repeat, not a secret
    assert is_exact(made, CATALOGUE)
    if made != one:
        assert {each.robot for each in plan(made)} <= set(made.words[made.own :])


@pytest.mark.parametrize("seed", range(200))
def test_each_that_is_meant_does_all_and_nobody_else_does_anything(lexicon: Lexicon, seed: int) -> None:
    """Who is left out by name, by number or by kind has no part; the others each wait for nobody but themselves."""
    made = crewed(ORDER, lexicon, random.Random(seed))  # noqa: S311 - a variation to repeat, not a secret
    if made == ORDER:
        return  # more names of two words than of one were drawn
    roster, said = made.words[made.own :], " ".join(made.words[: made.own])
    robots = {each.robot or "" for each in plan(made)}
    for robot in robots:
        first, second = (each for each in plan(made) if each.robot == robot)
        assert (first.skill, second.skill) == ("goto", "pick")
        assert (first.after, second.after) == ((), (first.id,))
    for robot in set(roster) - robots:
        kind, _, number = robot.rpartition("_")
        names = (robot, robot.replace("_", " "), f"number {number}", f"and {number}", f"{kind}s", f"no {kind}")
        meant = {each.rpartition("_")[0] for each in robots}
        assert any(each in said for each in names) or kind not in meant


@pytest.mark.parametrize("seed", range(100))
def test_robots_by_name_or_number_each_do_all(lexicon: Lexicon, seed: int) -> None:
    """Two to four, whose names are made of what is said: of a range those between its ends too."""
    made = named(ORDER, lexicon, random.Random(seed))  # noqa: S311 - a variation to repeat, not a secret
    assert is_exact(made, CATALOGUE)
    assert made.own == len(made.words)
    robots = list(dict.fromkeys(each.robot or "" for each in plan(made)))
    assert 1 <= len(robots) <= 4
    for robot in robots:
        first, second = (each for each in plan(made) if each.robot == robot)
        assert (first.params, second.params) == ({"place": "bay 2"}, {"object": "drill"})
        assert (first.after, second.after) == ((), (first.id,))
    said = " ".join(made.words)
    for robot in (robots[0], robots[-1]):
        kind, _, number = robot.rpartition("_")
        assert robot in said or robot.replace("_", " ") in said or (f"{kind}s" in said and number in made.words)


@pytest.mark.parametrize(
    "other",
    [
        example("Rex , land .", "navigation land w0 w0"),
        example("Land .", "navigation land any", "rex"),
        example("The nearest robot lands .", "navigation land any"),
        example("Hm .", "none chatter"),
    ],
)
def test_orders_to_somebody_stay_as_they_are(lexicon: Lexicon, other: Example) -> None:
    """So do those with a roster of their own, and what is no order."""
    for seed in range(50):
        assert crewed(other, lexicon, random.Random(seed)) == other  # noqa: S311 - no secret
        assert named(other, lexicon, random.Random(seed)) == other  # noqa: S311 - no secret
