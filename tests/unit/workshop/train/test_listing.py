"""Orders about several of a kind made of orders about one: each is named in full, and they come one after the other."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm.language import read
from appliance.llm.words import words_of
from appliance.model import Subtask
from appliance.skills.catalogue import load_catalogue
from workshop.train.examples import Example, is_exact
from workshop.train.listing import listed

pytestmark = pytest.mark.timeout(900)  # to read the whole corpus takes ten seconds of a processor that is free
CATALOGUE = load_catalogue()


def example(text: str, plan: str) -> Example:
    """An example of a text whose words have blanks between them."""
    words = words_of(text, ())
    return Example(tuple(words[number].lower() for number in range(len(words))), words.own, tuple(plan.split()))


VALVE = example("Rex , inspect the valve 3 in the hall now .", "inspection inspect w0 w0 asset: w4 w5")


def plan(of: Example) -> tuple[Subtask, ...]:
    """The plan of an example."""
    return read(of.symbols, words_of(" ".join(of.words), ()), CATALOGUE).subtasks


@settings(deadline=None, max_examples=100)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_a_list_is_exact(examples: list[Example], data: st.DataObject, seed: int) -> None:
    """The symbols are a plan over the words: copies of one subtask, in turn."""
    one = data.draw(st.sampled_from(examples))
    made = listed(one, random.Random(seed))  # noqa: S311 - a variation to repeat, not a secret
    assert is_exact(made, CATALOGUE)
    if made != one:
        before = [each.after for each in plan(made)]
        assert before == [(), *((f"s{number}",) for number in range(1, len(before)))]
        assert {each.skill for each in plan(made)} == {one.symbols[1]}


@pytest.mark.parametrize("seed", range(60))
def test_each_is_named_in_full(seed: int) -> None:
    """By number all of a range are there, those between its ends too; by looks each has its own word and the noun."""
    made = listed(VALVE, random.Random(seed))  # noqa: S311 - a variation to repeat, not a secret
    assets = [str(each.params["asset"]) for each in plan(made)]
    assert 2 <= len(set(assets)) == len(assets) <= 4
    assert {each.robot for each in plan(made)} == {"rex"}
    said = " ".join(made.words)
    assert said.endswith("in the hall now .")
    if all(each.split()[-1].isdigit() for each in assets):
        numbers = [int(each.split()[-1]) for each in assets]
        assert assets == [f"valve {each}" for each in numbers]
        assert all(str(each) in said for each in (numbers[0], numbers[-1]))
        if not all(str(each) in said for each in numbers):
            assert numbers == list(range(numbers[0], numbers[-1] + 1))
    else:
        assert all(each.startswith("valve ") or each.endswith(" valve") for each in assets)


@pytest.mark.parametrize(
    "other",
    [
        example(
            "Rex , inspect valve 3 and open it .",
            "manipulation inspect w0 w0 asset: w3 w4 | open w0 w0 object: w3 w4 < 1",
        ),
        example("Inspect the scissors .", "inspection inspect any asset: w2 w2"),
        example("Open the valve before it bursts .", "manipulation open any object: w2 w2"),
        example("Guide the guest to the exit .", "interaction guide any person: w2 w2 place: w5 w5"),
        example("Inspect the crack in the wall .", "inspection inspect any asset: w2 w5"),
        example("Hm .", "none chatter"),
    ],
)
def test_what_cannot_be_several_stays_one(other: Example) -> None:
    """Several steps, plurals, what is meant again by "it", names with a place in them, and what is no order."""
    assert all(listed(other, random.Random(seed)) == other for seed in range(50))  # noqa: S311 - no secrets
