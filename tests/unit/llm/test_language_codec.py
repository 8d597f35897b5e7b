"""The plan language: it says every plan, and only plans."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import PlanError
from appliance.llm.language import MAX_SUBTASKS, Answer, read, write
from appliance.llm.words import MAX_WORDS, words_of
from appliance.model import Subtask
from appliance.skills.catalogue import load_catalogue
from workshop.corpus import load

CATALOGUE = load_catalogue()


def test_a_plan_points_at_words() -> None:
    """Names and quantities are runs of words, dependencies numbers; what the skill settles is left out."""
    words = words_of("Rex, fetch the drill from bay two and film it for half a minute.")
    plan = (
        Subtask(id="s1", skill="goto", robot="rex", params={"place": "bay 2"}),
        Subtask(id="s2", skill="pick", robot="rex", params={"object": "drill"}, after=("s1",)),
        Subtask(
            id="s3", skill="record_video", robot="rex", params={"target": "drill", "duration_s": 30}, after=("s2",)
        ),
    )
    symbols = write(Answer(domain="manipulation", subtasks=plan), words, CATALOGUE)
    assert " ".join(symbols) == (
        "manipulation goto w0 w0 place: w6 w7 | pick w0 w0 object: w4 w4 < 1 | "
        "record_video w0 w0 target: w4 w4 duration_s: w12 w14 < 2"
    )


@pytest.mark.parametrize("step", [40, pytest.param(1, marks=[pytest.mark.long, pytest.mark.timeout(900)])])
def test_the_corpus_comes_back(step: int) -> None:
    """What is written of a pair of the training corpus is read as the same plan, and its words suffice."""
    for pair in list(load().values())[::step]:
        words = words_of(pair.instruction, pair.robots)
        assert len(words) <= MAX_WORDS
        answer = Answer(domain=pair.domain, subtasks=pair.subtasks, refused=pair.refused)
        assert read(write(answer, words, CATALOGUE), words, CATALOGUE) == answer


TEXTS = st.text(min_size=1, max_size=20)


@st.composite
def plans(draw: st.DrawFn) -> Answer:
    """Plans of the catalogue whose values stand in no instruction."""
    subtasks: list[Subtask] = []
    for number in range(1, draw(st.integers(1, 5)) + 1):
        skill = draw(st.sampled_from(sorted(CATALOGUE.skills)))
        manifest = CATALOGUE.skills[skill]
        params: dict[str, Any] = {}
        for name, param in manifest.params.items():
            if param.type == "array":
                params[name] = draw(st.lists(TEXTS.filter(lambda each: each != "operator"), min_size=1, max_size=3))
            elif param.type == "string":
                params[name] = draw(TEXTS)
            else:
                params[name] = draw(st.integers(1, 10**6) | st.floats(0.001, 1e6))
        robot = None if manifest.runs == "compute" else draw(TEXTS)
        if "robots" in params and manifest.runs != "compute":
            robot = params["robots"][0]
        after = draw(st.sets(st.integers(1, number - 1), max_size=3)) if number > 1 else set[int]()
        subtasks.append(
            Subtask(
                id=f"s{number}",
                skill=skill,
                robot=robot,
                params=params,
                after=tuple(f"s{each}" for each in sorted(after)),
            )
        )
    return Answer(domain="navigation", subtasks=tuple(subtasks))


@settings(deadline=None)
@given(plans(), st.text(max_size=80))
def test_every_plan_comes_back(answer: Answer, instruction: str) -> None:
    """Also a plan that has nothing to do with the instruction is said, by literals, and read as the same."""
    words = words_of(instruction)
    assert read(write(answer, words, CATALOGUE), words, CATALOGUE) == answer


SYMBOLS = st.sampled_from(
    [
        *(
            "navigation",
            "none",
            "goto",
            "place:",
            "w0",
            "w1",
            "w9",
            "w999",
            "|",
            "<",
            "1",
            "2",
            "[",
            "]",
            "+",
            "~",
            "@",
        ),
        *('"x"', '"', "any", "operator", "notify", "to:", "form_up", "robots:", "formation:", "3.5", "", "hold"),
        "duration_s:",
    ]
)


@settings(deadline=None)
@given(st.lists(SYMBOLS, max_size=20))
def test_anything_else_is_refused(symbols: list[str]) -> None:
    """Symbols that are no answer raise PlanError and nothing else."""
    try:
        answer = read(symbols, words_of("Rex, wait for two minutes"), CATALOGUE)
    except PlanError:
        return
    assert len(answer.subtasks) <= MAX_SUBTASKS


def test_an_answer_without_plan() -> None:
    """A refusal is its kind."""
    words = words_of("What is love?")
    assert write(Answer(refused="question"), words, CATALOGUE) == ["none", "question"]
    assert read(["none", "question"], words, CATALOGUE) == Answer(refused="question")
