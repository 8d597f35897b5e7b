"""The guide of the plan language: whatever follows it is a plan, and every plan follows it."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm.language import END, Answer, Guide, read, shapes, write
from appliance.llm.words import between, words_of
from appliance.skills.catalogue import load_catalogue
from workshop.corpus import load

CATALOGUE = load_catalogue()
SKILLS = shapes(CATALOGUE)
INSTRUCTIONS = (
    "Rex, fetch the drill from bay two and film it for half a minute.",
    "robots 1 and 2 meet at dock 3",
    "robots 1 to 3 close doors 4 through 7",
    "what is love",
    "?",
    "stop",
)


@settings(deadline=None)
@given(st.data(), st.sampled_from(INSTRUCTIONS), st.sampled_from([None, (), ("rex",), ("robot_1", "robot_2", "kit_3")]))
def test_whatever_follows_it_is_a_plan(data: st.DataObject, instruction: str, robots: tuple[str, ...] | None) -> None:
    """Any walk along what is allowed comes to an end that reads as an answer whose robots are of the roster."""
    words = words_of(instruction, robots or ())
    guide = Guide(words, SKILLS, robots=robots)
    symbols: list[str] = []
    while not guide.ended:
        allowed = guide.allowed()
        assert allowed, symbols
        assert len(set(allowed)) == len(allowed)
        # Long walks show nothing new: an end is taken sooner or later.
        symbol = END if END in allowed and len(symbols) > 12 else data.draw(st.sampled_from(allowed))
        if len(symbols) > 80:
            symbol = next((each for each in (END, "]", "|") if each in allowed), symbol)
        guide.take(symbol)
        symbols += [symbol] if symbol != END else []
    answer = read(symbols, words, CATALOGUE)
    assert answer.refused or answer.subtasks
    for subtask in answer.subtasks:
        manifest = CATALOGUE.skills[subtask.skill]
        # Something that is said, not a mark of the text: an empty value would be as good as none.
        assert all(subtask.params.get(name) for name, param in manifest.params.items() if param.required)
        if robots is not None and subtask.robot is not None and not subtask.robot.startswith("any"):
            assert subtask.robot in robots


def test_a_range_has_all_between_its_ends_and_a_roster_still_decides() -> None:
    """A name may go on with a number that is meant and not said, not begin with one; a robot is of the roster."""
    words = words_of("robots 1 to 4 close doors 5 to 8", ("robot_1", "robot_2", "robot_4"))
    guide = Guide(words, SKILLS, robots=("robot_1", "robot_2", "robot_4"))
    for symbol in ("manipulation", "close", "w0", "w0", "~", "+"):
        assert symbol in guide.allowed()
        guide.take(symbol)
    assert [each for each in guide.allowed() if each.startswith('"')] == ['"2"']
    for symbol in ('"2"', "object:"):
        guide.take(symbol)
    assert not any(each.startswith('"') for each in guide.allowed())
    for symbol in ("w5", "w5", "~", "+"):
        guide.take(symbol)
    assert {'"6"', '"7"'} <= set(guide.allowed())
    guide.take('"6"')
    assert END in guide.allowed()


@pytest.mark.parametrize("step", [60, pytest.param(3, marks=[pytest.mark.long, pytest.mark.timeout(900)])])
def test_the_corpus_follows_it(step: int) -> None:
    """The plans of the corpus may be said, but those that need a literal that no range has."""
    for pair in list(load().values())[::step]:
        words = words_of(pair.instruction, pair.robots)
        answer = Answer(domain=pair.domain, subtasks=pair.subtasks, refused=pair.refused)
        symbols = write(answer, words, CATALOGUE)
        if {each for each in symbols if each.startswith('"')} - {f'"{each}"' for each in between(words)}:
            continue
        guide = Guide(words, SKILLS, robots=pair.robots or None)
        for symbol in (*symbols, END):
            allowed = guide.allowed()
            if symbol not in allowed and symbol.replace(".", "").isdigit():
                break  # a number that no words mean
            assert symbol in allowed, (pair.instruction, symbols, symbol)
            guide.take(symbol)


def test_skills_a_planner_does_not_know_are_not_offered() -> None:
    """A planner is offered only what it has symbols for."""
    guide = Guide(words_of("hold"), SKILLS, robots=None, known=frozenset({"hold", "duration_s:", "navigation"}))
    assert guide.allowed() == ["none", "navigation"]
    guide.take("navigation")
    assert guide.allowed() == ["hold"]
