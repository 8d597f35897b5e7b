"""Orders said in other words: what the plan means stays."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm.language import read
from appliance.llm.words import words_of
from appliance.model import Subtask
from appliance.skills.catalogue import load_catalogue
from workshop.train.examples import Example, is_exact
from workshop.train.reword import reworded

pytestmark = pytest.mark.timeout(900)  # to read the whole corpus takes ten seconds of a processor that is free
CATALOGUE = load_catalogue()


def chance(seed: int) -> random.Random:
    """Return a generator of what is random."""
    return random.Random(seed)  # noqa: S311 - variations to repeat, not secrets


def example(text: str, plan: str) -> Example:
    """An example of a text whose words have blanks between them."""
    words = tuple(text.lower().split())
    return Example(words, len(words), tuple(plan.split()))


def plan(of: Example) -> tuple[Subtask, ...]:
    """The plan of an example."""
    return read(of.symbols, words_of(" ".join(of.words[: of.own]), of.words[of.own :]), CATALOGUE).subtasks


def said(start: Example) -> set[str]:
    """Return all that it may become."""
    return {reworded(start, chance(seed), share=1.0).text for seed in range(60)}


@settings(deadline=None, max_examples=100)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_plan_stays(examples: list[Example], data: st.DataObject, seed: int) -> None:
    """Whatever is said in other words has the very same plan, and it is exact over the new words."""
    start = data.draw(st.sampled_from(examples))
    made = reworded(start, chance(seed), share=1.0)
    assert is_exact(made, CATALOGUE)
    assert plan(made) == plan(start)


def test_all_forms_of_a_verb() -> None:
    """The verb keeps its form: "films" becomes "records a video of", "filming" becomes "recording a video of"."""
    third = example("Kit films the drill .", "perception record_video w0 w0 target: w3 w3")
    assert "kit records a video of the drill." in said(third)
    going_on = example("Kit is filming the drill .", "perception record_video w0 w0 target: w4 w4")
    assert "kit is recording a video of the drill." in said(going_on)


@pytest.mark.parametrize(
    ("text", "plan"),
    [
        ("kit takes off and waits", "navigation takeoff w0 w0"),
        ("clean up", "manipulation clean any object: w0 w0"),
        ("the count of cows", "perception count any target: w3 w3"),
        ("what is love ?", "none question"),
    ],
)
def test_what_is_left_alone(text: str, plan: str) -> None:
    """A verb is not changed apart from its parameter, as a noun, where the plan points at it, or without a plan."""
    start = example(text, plan)
    changed = said(start) - {start.text}
    assert all("take" not in each or each == start.text for each in changed)
    if "takes off" not in text:
        assert not changed


def test_words_of_order() -> None:
    """Words of order become others of the same order, without a verb being there."""
    start = example(
        "Rex opens the gate , then Max closes the door .",
        "manipulation open w0 w0 object: w3 w3 | close w6 w6 object: w9 w9 < 1",
    )
    assert any(". once that is done, max" in each for each in said(start))
