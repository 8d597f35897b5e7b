"""Orders in other frames: what the plan means stays, or is what the frame says."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm.language import read
from appliance.llm.words import words_of
from appliance.model import Subtask
from appliance.skills.catalogue import load_catalogue
from workshop.train.examples import Example, is_exact
from workshop.train.framing import framed, fronted, gapped, is_an_order, past, told
from workshop.train.lexicon import Lexicon
from workshop.train.linking import robots_of

pytestmark = pytest.mark.timeout(900)  # to read the whole corpus takes ten seconds of a processor that is free
CATALOGUE = load_catalogue()
SEEDS = range(200)


@pytest.fixture(scope="module")
def lexicon(examples: list[Example]) -> Lexicon:
    """The words of those examples, by what they may stand for."""
    return Lexicon(examples)


def chance(seed: int) -> random.Random:
    """Return a generator of what is random."""
    return random.Random(seed)  # noqa: S311 - variations to repeat, not secrets


def example(text: str, plan: str) -> Example:
    """An example of a text whose words have blanks between them."""
    words = words_of(text, ())
    return Example(tuple(words[number].lower() for number in range(len(words))), words.own, tuple(plan.split()))


def plan(of: Example) -> tuple[Subtask, ...]:
    """The plan of an example."""
    return read(of.symbols, words_of(" ".join(of.words[: of.own]), of.words[of.own :]), CATALOGUE).subtasks


PHOTO = example(
    "Photograph the mast at the pier .", "perception goto any place: w5 w5 | photograph any target: w2 w2 < 1"
)
FETCH = example(
    "Bring the drill from bay 2 to the bench .",
    "manipulation goto any place: w4 w5 | pick any object: w2 w2 < 1 | goto any place: w8 w8 < 2"
    " | place any object: w2 w2 at: w8 w8 < 3",
)


@settings(deadline=None, max_examples=100)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_whatever_is_put_otherwise_is_exact(
    examples: list[Example], lexicon: Lexicon, data: st.DataObject, seed: int
) -> None:
    """The symbols are a plan over the new words; but for who does it, it is the plan from before."""
    start, rng = data.draw(st.sampled_from(examples)), chance(seed)
    for made in (framed(start, lexicon, rng, share=1.0), fronted(start, rng)):
        assert is_exact(made, CATALOGUE)
        assert [(each.skill, each.params, each.after) for each in plan(made)] == [
            (each.skill, each.params, each.after) for each in plan(start)
        ]
    several = gapped(start, lexicon, rng)
    assert is_exact(several, CATALOGUE)
    assert len(plan(several)) % max(1, len(plan(start))) == 0


@settings(deadline=None, max_examples=100)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_whoever_is_told_does_all_of_it(
    examples: list[Example], lexicon: Lexicon, data: st.DataObject, seed: int
) -> None:
    """An order to whomever becomes one to the robot named before or behind it; what computers do stays theirs."""
    start = data.draw(st.sampled_from(examples))
    if start.symbols[0] == "none" or robots_of(start) != {"any"} or len(start.words) > start.own:
        return
    made = told(start, lexicon.noun("robot", chance(seed)), chance(seed))
    assert is_exact(made, CATALOGUE)
    robots = {each.robot for each in plan(made)} - {None}
    assert len(robots) == 1
    assert "any" not in robots


def test_what_is_worked_on_comes_first(lexicon: Lexicon) -> None:
    """The verb stands behind its object, as a participle or a gerund; a robot may be named behind it."""
    order = example("Photograph the mast .", "perception photograph any target: w2 w2")
    made = [framed(order, lexicon, chance(seed), share=1.0) for seed in SEEDS]
    texts = [each.text for each in made]
    assert {"have the mast photographed.", "the mast needs photographing.", "i want the mast photographed."} <= set(
        texts
    )
    for each in made:
        (subtask,) = plan(each)
        assert subtask.params == {"target": "mast"}
        assert (subtask.robot == "any") == (each.text.endswith(("photographed.", "photographing.", "now.")))


def test_behind_and_only_what_an_order_can_be(lexicon: Lexicon) -> None:
    """Behind "and" no statement is put: "... and have the mast photographed", never "and the mast needs ..."."""
    order = example(
        "Go to the pier and photograph the mast .",
        "perception goto any place: w3 w3 | photograph any target: w7 w7 < 1",
    )
    texts = {framed(order, lexicon, chance(seed), share=1.0).text for seed in SEEDS}
    assert "go to the pier and have the mast photographed." in texts
    assert not any(" and the mast" in each or " and i " in each for each in texts)


@pytest.mark.parametrize(
    ("text", "plan"),
    [
        (
            "photograph the mast , the hull .",
            "perception photograph any target: w2 w2 | photograph any target: w5 w5 < 1",
        ),
        ("photograph the mast of the ship .", "perception photograph any target: w2 w2"),
        ("the second photograph the mast", "perception photograph any target: w4 w4"),
    ],
)
def test_what_goes_on_or_is_no_verb_stays(lexicon: Lexicon, text: str, plan: str) -> None:
    """Lists, longer names, and words that are no order's beginning are left as they are."""
    start = example(text, plan)
    assert all(framed(start, lexicon, chance(seed), share=1.0) == start for seed in SEEDS)


@pytest.mark.parametrize(
    ("verb", "form"),
    [
        ("wipe", "wiped"),
        ("empty", "emptied"),
        ("grab", "grabbed"),
        ("bring", "brought"),
        ("patrol", "patrolled"),
        ("survey", "surveyed"),
        ("map", "mapped"),
        ("read", "read"),
        ("wash", "washed"),
        ("scan", "scanned"),
    ],
)
def test_the_past_of_a_verb(verb: str, form: str) -> None:
    """Regular verbs and those that are not."""
    assert past(verb) == form


def test_places_first(lexicon: Lexicon) -> None:
    """The last words of a clause, where they say a place, can stand before it."""
    assert {fronted(PHOTO, chance(seed)).text for seed in SEEDS} == {
        "at the pier, photograph the mast.",
        "at the pier photograph the mast.",
    }
    go = example("Go to the pier .", "navigation goto any place: w3 w3")
    assert fronted(go, chance(1)) == go


def test_the_verb_said_once(lexicon: Lexicon) -> None:
    """One thing more, with its own places, is done the same way after the first."""
    made = gapped(FETCH, lexicon, chance(4))
    first, second = plan(made)[:4], plan(made)[4:8]
    assert [each.skill for each in first] == [each.skill for each in second]
    assert second[0].after == [first[3].id] or second[0].after == (first[3].id,)
    assert made.text.count("bring") == 1
    assert first[1].params != second[1].params


def test_an_order_begins_with_a_verb() -> None:
    """What "Kit should" can stand before."""
    assert is_an_order(FETCH)
    assert not is_an_order(example("the mast , please .", "perception photograph any target: w1 w1"))
