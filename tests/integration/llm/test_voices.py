"""The models of a planner asked as one: tiny ones with random weights, by the library that runs them."""

import importlib
import importlib.util
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.errors import PrerequisiteError
from appliance.llm.decoder import ROOM, Card, Question, TooLongError, Voice, Voices, read_card
from appliance.llm.language import read, shapes
from appliance.llm.local import LocalTier
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.llm.words import MAX_WORDS, words_of
from appliance.llm.worker import Worker
from appliance.skills.catalogue import load_catalogue
from workshop.train.card import write_card
from workshop.train.tokens import Tokens

CATALOGUE = load_catalogue()
WORDS = ("rex", "fetches", "the", "drill", "from", "bay", "2", "rex")
OWN = 7
QUESTION = Question(
    text="Rex fetches the drill from bay 2 and films it", robots=("rex",), skills=shapes(CATALOGUE), deadline_s=60.0
)

Make = Callable[..., Path]


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Make:
    """Make the folder of a planner: its seed, those of the models beside it, and changes of its card."""
    spec = importlib.util.spec_from_file_location("tiny_model", project_root / "tests" / "tiny_model.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def made(seed: int, *beside: int, **changes: Any) -> Path:
        folder: Path = module.build(tmp_path_factory.mktemp("planner"), seed=seed, speaks=CATALOGUE)
        for number in beside:
            module.build(folder / f"other{number}", seed=number, speaks=CATALOGUE)
        card = read_card(folder)
        assert card is not None
        write_card(folder, msgspec.structs.replace(card, beside=tuple(f"other{each}" for each in beside), **changes))
        return folder

    return made


def card_in(folder: Path) -> Card:
    """Return the card of a folder that has one."""
    card = read_card(folder)
    assert card is not None
    return card


def voice_of(folder: Path, *, twice: bool = False, context: int = 1024) -> Voice:
    """Return a folder's own model."""
    og: Any = importlib.import_module("onnxruntime_genai")
    model = og.Model(str(folder))
    return Voice(og, model, og.Tokenizer(model), card_in(folder).tokens, twice=twice, context=context)


def test_a_model_that_was_set_back_says_the_same(make: Make) -> None:
    """The library's own promise, which another try rests on: after a rewind, as if the rest had never been said."""
    folder = make(7)
    fresh, again = voice_of(folder), voice_of(folder)
    for voice in (fresh, again):
        voice.begin(WORDS, OWN)
    fresh.go_on([5])
    again.go_on([7, 8])
    again.go_on([9])
    again.set_back(0)
    again.go_on([5])
    assert fresh.likely(range(20)) == pytest.approx(again.likely(range(20)), abs=1e-4)


def test_together_they_say_the_mean_of_what_each_says(make: Make) -> None:
    """At each place of an answer, also after it was gone back in: the mean of the logarithms of their shares."""
    folders = make(7), make(8)
    alone = [voice_of(each) for each in folders]
    together = Voices([voice_of(each) for each in folders])
    assert together.begin(WORDS, OWN) == min([voice.begin(WORDS, OWN) for voice in alone])
    assert together.prompt == sum(voice.prompt for voice in alone)

    def agree() -> None:
        each = [voice.likely(range(30)) for voice in alone]
        assert each[0] != pytest.approx(each[1], abs=1e-3)
        mean = [(one + two) / 2 for one, two in zip(*each, strict=True)]
        assert together.likely(range(30)) == pytest.approx(mean, abs=1e-4)

    agree()
    for token in (11, 12, 13):
        together.go_on(token)
        for voice in alone:
            voice.go_on([token])
        agree()
    together.say([11, 14, 15])
    for voice in alone:
        voice.set_back(1)
        voice.go_on([14, 15])
    agree()
    # What is said without being asked in between is read all at once, and what was taken back is not.
    for token in (16, 17, 18):
        together.go_on(token)
    together.say([11, 14])
    for token in (19, 20):
        together.go_on(token)
    for voice in alone:
        voice.set_back(2)
        voice.go_on([19, 20])
    agree()


def test_a_planner_answers_with_all_its_models(make: Make) -> None:
    """Its answer is a plan, the same each time, and what one model says twice is what it says once."""
    both, twins, alone = (Worker(make(7, *beside)).speaker for beside in ((8,), (7,), ()))
    assert both is not None
    assert twins is not None
    assert alone is not None
    said = both.answer(QUESTION)
    assert read(said.symbols, words_of(QUESTION.text, QUESTION.robots or ()), CATALOGUE).domain
    assert both.answer(QUESTION).symbols == said.symbols
    assert said.confidence != pytest.approx(alone.answer(QUESTION).confidence, abs=1e-9)
    assert twins.answer(QUESTION).symbols == alone.answer(QUESTION).symbols
    assert twins.answer(QUESTION).confidence == pytest.approx(alone.answer(QUESTION).confidence, abs=1e-6)


@pytest.mark.parametrize("twice", [False, True])
def test_the_prompt_is_that_of_the_training(make: Make, twice: bool) -> None:
    """Token by token, once or twice: a model is asked as it was taught."""
    folder = make(7)
    voice = voice_of(folder, twice=twice)
    assert voice.read(WORDS, OWN) == Tokens.load(folder).prompt(WORDS, OWN, twice=twice)


def test_a_long_instruction_is_read_once_and_a_longer_one_not_at_all(make: Make) -> None:
    """Where there is no room to read it twice it is read as it was taught to be then; past that it is refused."""
    folder = make(7)
    voice, once = voice_of(folder, twice=True), voice_of(folder)
    lengths = [len(voice.read(["go"] * count, count)) for count in range(1, MAX_WORDS)]
    plain = [len(once.read(["go"] * count, count)) for count in range(1, MAX_WORDS)]
    steps = {two - one for one, two in itertools.pairwise(lengths)}
    assert len([each for each in steps if each < 0]) == 1, "from twice to once, at one length"
    assert all(each + ROOM <= 1024 or each == short for each, short in zip(lengths, plain, strict=True))
    with pytest.raises(TooLongError, match=f"more than {MAX_WORDS}"):
        voice.begin(["go"] * (MAX_WORDS + 1), 1)
    with pytest.raises(TooLongError, match="leave room for"):
        voice.begin(["unutterable" * 20] * 20, 20)


@pytest.mark.anyio
@pytest.mark.parametrize("fault", ["absent", "tokens", "outside", "model"])
async def test_a_model_beside_that_is_none_is_named(make: Make, fault: str) -> None:
    """An absent or damaged one, one with other tokens, and a name that leads out of the folder: with the remedy."""
    folder = make(7, 8)
    card = card_in(folder)
    if fault == "absent":
        write_card(folder, msgspec.structs.replace(card, beside=("nothing",)))
    elif fault == "outside":
        write_card(folder, msgspec.structs.replace(card, beside=("../other",)))
    elif fault == "tokens":
        other = dict(card.tokens)
        other["goto"], other["pick"] = other["pick"], other["goto"]
        write_card(folder / "other8", msgspec.structs.replace(card, tokens=other, beside=()))
    else:
        (folder / "other8" / "model.onnx").write_bytes(b"no model")
    tier = LocalTier(LlmConfig(tiers=("local",), local_model=str(folder)), CATALOGUE)
    await tier.start()
    try:
        with pytest.raises(PrerequisiteError, match=r"nothing|other8|not in its folder") as caught:
            await tier.propose(PlanContext(instruction="go home", robots=()))
        assert "copy" in (caught.value.remedy or "")
    finally:
        await tier.close()
