"""Two examples as one: who waits for whom is what the words between them say."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm.language import read
from appliance.llm.words import words_of
from appliance.model import Subtask
from appliance.skills.catalogue import load_catalogue
from workshop.train.examples import Example, is_exact
from workshop.train.linking import abreast, joined

pytestmark = pytest.mark.timeout(900)  # to read the whole corpus takes ten seconds of a processor that is free
CATALOGUE = load_catalogue()
SEEDS = range(300)


def example(text: str, plan: str) -> Example:
    """An example of a text whose words have blanks between them."""
    words = words_of(text, ())
    return Example(tuple(words[number].lower() for number in range(len(words))), words.own, tuple(plan.split()))


FETCH = example(
    "Rex , fetch the drill from bay 2 .", "manipulation goto w0 w0 place: w6 w7 | pick w0 w0 object: w4 w4 < 1"
)
FILM = example("Kit films the drill for 30 seconds .", "perception record_video w0 w0 target: w3 w3 duration_s: w5 w6")
OPEN = example("The red robot opens the gate .", "manipulation open w1 w2 object: w5 w5")
BESIDE = example(
    "Rex lands , Kit docks .",
    "navigation land w0 w0 | dock w3 w3",
)


def text(of: Example) -> str:
    """The words of an example."""
    return " ".join(of.words)


def plan(of: Example) -> dict[str, Subtask]:
    """The plan of an example, by skill."""
    found = read(of.symbols, words_of(" ".join(of.words[: of.own]), of.words[of.own :]), CATALOGUE).subtasks
    return {each.skill: each for each in found}


def after(of: Example, skill: str) -> set[str]:
    """The skills that a subtask comes after."""
    skills = {each.id: each.skill for each in plan(of).values()}
    return {skills[each] for each in plan(of)[skill].after}


def all_of(one: Example, two: Example) -> list[Example]:
    """What the seeds make of two."""
    found = [joined(one, two, random.Random(seed)) for seed in SEEDS]  # noqa: S311 - variations to repeat, not secrets
    made = [each for each in found if each is not None]
    assert len(made) == len(found)
    return made


@settings(deadline=None, max_examples=100)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_two_are_exact(examples: list[Example], data: st.DataObject, seed: int) -> None:
    """The symbols of two as one are a plan over the words, with the subtasks of both."""
    one, two = data.draw(st.sampled_from(examples)), data.draw(st.sampled_from(examples))
    made = joined(one, two, random.Random(seed))  # noqa: S311 - a variation to repeat, not a secret
    if made is not None:
        assert is_exact(made, CATALOGUE)
        assert made.symbols.count("|") == one.symbols.count("|") + two.symbols.count("|") + 1


def test_in_order_side_by_side_or_the_second_first() -> None:
    """By the words between two orders the second waits for the first, nothing waits, or the first waits for it."""
    seen: set[tuple[bool, bool]] = set()
    for made in all_of(FETCH, FILM):
        later, sooner = after(made, "record_video") == {"pick"}, after(made, "goto") == {"record_video"}
        seen.add((later, sooner))
        said = text(made).replace("not before", "after")
        assert sooner == any(each in said for each in ("first", "before", "prior"))
    assert seen == {(True, False), (False, True), (False, False)}


def test_what_waits_for_one_by_name_waits_for_no_other() -> None:
    """Of two that work side by side the one that is named is waited for; both are when both are named, or neither."""
    seen: set[frozenset[str]] = set()
    for made in all_of(BESIDE, OPEN):
        said = text(made)[len(text(BESIDE)) - 2 :]
        named = {skill for name, skill in (("rex", "land"), ("kit", "dock")) if name in said.split()}
        awaited = after(made, "open")
        if named:
            assert awaited == named
        elif not after(made, "land"):
            assert awaited in (set(), {"land", "dock"})
        seen.add(frozenset(awaited))
    assert seen == {frozenset(), frozenset({"land"}), frozenset({"dock"}), frozenset({"land", "dock"})}


def test_a_name_keeps_its_article() -> None:
    """Who is called "the red robot" is waited for under that name."""
    waits = [text(made) for made in all_of(OPEN, FILM) if text(made).count("red robot") > 1]
    assert waits
    assert all(each.count("the red robot") == 2 for each in waits)


def test_of_a_robots_own_only_the_last_is_waited_for() -> None:
    """A chain is over with its last subtask, however long it is."""
    chain = example(
        "Rex , take off , go to bay 2 and land .",
        "navigation takeoff w0 w0 | goto w0 w0 place: w7 w8 < 1 | land w0 w0 < 2",
    )
    assert all(after(made, "open") in (set(), {"land"}) for made in all_of(chain, OPEN))
    assert all(after(made, "takeoff") in (set(), {"open"}) for made in all_of(chain, OPEN))


def test_whoever_is_named_once_does_what_follows() -> None:
    """An order without a name, said after or before in time, is the robot's that was named."""
    unnamed = example("film the gate", "perception record_video any target: w2 w2")
    seen: set[frozenset[str]] = set()
    for made in all_of(FETCH, unnamed):
        assert plan(made)["record_video"].robot == "rex"
        seen |= {frozenset(after(made, "record_video")), frozenset(after(made, "goto"))}
    assert seen == {frozenset({"pick"}), frozenset(), frozenset({"record_video"})}


def test_what_would_not_be_clear_is_not_joined() -> None:
    """Groups, refusals and robots of both without an order stay apart."""
    group = example("both drones land", "navigation land all")
    refused = Example(("what", "is", "love"), 3, ("none", "question"))
    for one, two in ((FETCH, group), (FETCH, refused), (refused, FETCH)):
        assert all(joined(one, two, random.Random(seed)) is None for seed in SEEDS)  # noqa: S311 - no secrets


def test_who_is_told_in_one_sentence_waits_together() -> None:
    """Two clauses side by side that follow something both come after it; two sentences are not made one."""
    lou = example("Lou opens the gate", "manipulation open w0 w0 object: w3 w3")
    for seed in SEEDS:
        both = abreast(FILM, lou, random.Random(seed))  # noqa: S311 - no secret
        assert both is not None
        assert (after(both, "record_video"), after(both, "open")) == (set(), set())
        made = joined(FETCH, both, random.Random(seed))  # noqa: S311 - no secret
        assert made is not None
        assert after(made, "record_video") == after(made, "open")
        assert abreast(FETCH, lou, random.Random(seed)) is None  # noqa: S311 - no secret
