"""Variations of training pairs: their plans stay exact."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm.language import read
from appliance.llm.words import words_of
from appliance.model import Subtask
from appliance.skills.catalogue import load_catalogue
from workshop.corpus.notation import Pair
from workshop.train.examples import Example, example_of, is_exact, substitute
from workshop.train.lexicon import Lexicon, syllables
from workshop.train.renaming import renamed
from workshop.train.splits import names, shape, split
from workshop.train.tokens import Tokens
from workshop.train.vary import addressed, numbered, rostered, unmarked, vary

pytestmark = pytest.mark.timeout(900)  # to read the whole corpus takes ten seconds of a processor that is free
CATALOGUE = load_catalogue()


@pytest.fixture(scope="module")
def lexicon(examples: list[Example]) -> Lexicon:
    """The words of those examples, by what they may stand for."""
    return Lexicon(examples)


def chance(seed: int) -> random.Random:
    """Return a generator of what is random."""
    return random.Random(seed)  # noqa: S311 - variations to repeat, not secrets


def example(text: str, plan: str, *robots: str) -> Example:
    """An example of a text whose words have blanks between them."""
    words = words_of(text, robots)
    return Example(tuple(words[number].lower() for number in range(len(words))), words.own, tuple(plan.split()))


FETCH = example(
    "Rex , fetch the drill from bay 2 .", "manipulation goto w0 w0 place: w6 w7 | pick w0 w0 object: w4 w4 < 1"
)
FILM = example("Kit films the drill for 30 seconds .", "perception record_video w0 w0 target: w3 w3 duration_s: w5 w6")


def plan(of: Example) -> tuple[Subtask, ...]:
    """The plan of an example."""
    return read(of.symbols, words_of(" ".join(of.words[: of.own]), of.words[of.own :]), CATALOGUE).subtasks


@settings(deadline=None, max_examples=100)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_every_variation_is_exact(examples: list[Example], lexicon: Lexicon, data: st.DataObject, seed: int) -> None:
    """Its symbols are a plan over its words, with as many words as were meant, and what is refused stays refused."""
    start = data.draw(st.sampled_from(examples))
    made = vary(start, examples, lexicon, chance(seed))
    assert is_exact(made, CATALOGUE)
    assert (made.symbols[0] == "none") == (start.symbols[0] == "none")


@settings(deadline=None)
@given(seed=st.integers(0, 2**32))
def test_other_names_are_the_same_everywhere(lexicon: Lexicon, seed: int) -> None:
    """A renamed robot or thing is renamed in every step; nothing else of the plan changes."""
    made = plan(renamed(FETCH, lexicon, chance(seed), share=1.0))
    assert [each.skill for each in made] == ["goto", "pick"]
    assert made[0].robot == made[1].robot
    assert made[1].after == ("s1",)


@pytest.mark.parametrize("seed", range(8))
def test_whom_an_order_is_put_to_has_all_of_it(lexicon: Lexicon, seed: int) -> None:
    """Called by name first, one robot does what any would have done; an order to nobody in particular stays so."""
    order = example(
        "Go to bay 2 and pick the drill .", "manipulation goto any place: w2 w3 | pick any object: w6 w6 < 1"
    )
    made = addressed(order, lexicon, chance(seed))
    assert is_exact(made, CATALOGUE)
    (robot,) = {each.robot for each in plan(made)}
    assert robot not in (None, "any")
    assert [each.params for each in plan(made)] == [each.params for each in plan(order)]
    for other in (
        FETCH,
        example("A robot goes to bay 2 .", "navigation goto any place: w4 w5"),
        example("Hm .", "none chatter"),
    ):
        assert addressed(other, lexicon, chance(seed)) == other


def test_marks_numbers_and_rosters() -> None:
    """Marks go, figures become words, a roster has the robots named; the plan is the same."""
    bare = next(made for seed in range(20) if "." not in (made := unmarked(FETCH, chance(seed))).words)
    worded = next(made for seed in range(20) if "two" in (made := numbered(FETCH, chance(seed))).words)
    known = rostered(FETCH, chance(1))
    assert "rex" in known.words[known.own :]
    assert plan(bare) == plan(worded) == plan(known) == plan(FETCH)


def test_pointers_move_with_their_words() -> None:
    """A run that is replaced by a longer or shorter one moves all pointers behind it."""
    made = substitute(FETCH, [(0, 0, ("big", "rex")), (3, 3, ())])
    assert " ".join(made.symbols) == "manipulation goto w0 w1 place: w6 w7 | pick w0 w1 object: w4 w4 < 1"


@pytest.mark.thorough
def test_splits_are_disjoint(examples: list[Example]) -> None:
    """No plan held out by structure has a trained structure, none by vocabulary a set of names that is all trained."""
    parts = split(examples)
    assert len(parts.train) + len(parts.structure) + len(parts.vocabulary) + len(parts.chance) == len(examples)
    assert not {shape(each) for each in parts.structure} & {shape(each) for each in parts.train}
    trained = {name for each in parts.train for name in names(each)}
    assert all(names(each) - trained for each in parts.vocabulary)
    assert min(map(len, (parts.structure, parts.vocabulary, parts.chance))) >= 20


@pytest.fixture(scope="module")
def tokens(examples: list[Example]) -> Tokens:
    """The tokenizer of the corpus."""
    return Tokens.learn((word for each in examples for word in each.words), CATALOGUE)


def test_tokens_come_back(tokens: Tokens, examples: list[Example]) -> None:
    """The tokens of every answer are its symbols again, wherever the numbers of words begin."""
    for each in examples:
        assert tuple(tokens.symbols(tokens.answer(each.symbols, shift=9), shift=9)) == each.symbols


def test_no_word_is_unknown(tokens: Tokens) -> None:
    """Any text has tokens, made-up words and other scripts among them."""
    for word in ("\u00e9\u4e00\u0634", "\x00", "\U0001f980", *(syllables(chance(seed)) for seed in range(50))):
        pieces = tokens.prompt([word], 1)[2:-1]
        assert tokens.tokenizer.decode(pieces) == word


def test_a_pair_is_an_example() -> None:
    """Lower case, the roster's robots behind the instruction's words."""
    pair = Pair(
        instruction="Both drones: land.",
        robots=("drone_1", "drone_2"),
        domain="navigation",
        subtasks=(Subtask(id="s1", skill="land", robot="drone_1"), Subtask(id="s2", skill="land", robot="drone_2")),
    )
    made = example_of(pair, CATALOGUE)
    assert made.words == ("both", "drones", ":", "land", ".", "drone_1", "drone_2")
    assert (made.own, made.symbols) == (5, ("navigation", "land", "w5", "w5", "|", "land", "w6", "w6"))
