"""What is no instruction is refused with a reason before any planner is asked; what is one never is."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.llm.preprocessing import explained, refused


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        (" \n\t ", "is empty"),
        ("x" * 100_000, "100,000 characters"),
        ("go " * 40_000, "characters"),
        ("\x00\x01\x02PNG\r\n\x1a\n\x00", "binary data"),
        ("\ufffd\ufffd\ufffd\x7f", "binary data"),
        ("?!...", "no words"),
        ('{"domain": "navigation", "subtasks": [{"id": "s1", "skill": "goto"}]}', "data (JSON"),
        ("[1, 2, 3]", "data (JSON"),
        ('{"skill": "goto", "robot": "r", "x": ', "data (JSON"),
        ("<?xml version='1.0'?><order/>", "data (JSON"),
        ("fahre zum Dock 1 und dann hole die Kiste", "looks like German"),
        ("va à la porte puis prends la boîte", "looks like French"),
        ("ve al muelle 1 y luego trae la caja", "looks like Spanish"),
        ("vai al molo e poi prendi la scatola", "looks like Italian"),
        ("idź do doku i potem weź skrzynkę", "looks like Polish"),
        ("иди к доку 1 и возьми коробку", "Cyrillic script"),
        ("去一号码头拿箱子", "Cjk script"),
        ("اذهب إلى الرصيف", "Arabic script"),
        ("what is love", "it is a question"),
        ("Who are you?", "it is a question"),
        ("why", "it is a question"),
    ],
)
def test_what_is_none_is_refused_with_a_reason(text: str, said: str) -> None:
    """A sentence that a person understands, and what to do about it."""
    error = refused(text)
    assert error is not None
    assert said in error.message
    assert error.remedy or "English" in error.message


@pytest.mark.parametrize(
    "text",
    [
        "Robot_1: go to goal 2, then photograph the shelf",
        "go to La Plaza de los Toros and wait",
        "bring the die to Das Lager",
        "[to the drone] go home",
        "What is on shelf 3? Go and look.",
        "how many boxes are in aisle 2",
        'say "Guten Tag, wie geht es Ihnen" to the visitor',
        "Müller's robot goes to Łódź dock",
        "take off",
        "Rover_1 {urgent}: go home",
    ],
)
def test_what_is_an_instruction_is_let_through(text: str) -> None:
    """Foreign names, brackets and questions that a robot can look into are no reason to refuse."""
    assert refused(text) is None


@given(st.text(max_size=300))
def test_any_text_is_judged_without_breaking(text: str) -> None:
    """Whatever comes: an error with a message, or none."""
    error = refused(text)
    assert error is None or error.message
    explained(text)


@given(st.recursive(st.integers() | st.text(max_size=5), lambda each: st.lists(each, min_size=1, max_size=3)))
def test_any_json_list_or_object_is_data(value: object) -> None:
    """JSON is never planned."""
    text = json.dumps(value if isinstance(value, list) else {"a": value})
    error = refused(text)
    assert error is not None


def test_why_nothing_could_be_planned() -> None:
    """What is impossible says so in its own terms."""
    assert "no skill flies forklift" in explained("fly the forklift")
    assert "question" in explained("is the door open?")
    assert explained("colourless green ideas") == ""
