"""Instructions of several lines are read as one sentence."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.llm.words import in_one_line, words_of


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ("1. Drive to tank 6\n2. Read the gauge\n3. Dock", "Drive to tank 6; Read the gauge; Dock"),
        ("a) mow the lawn.\nb) rest", "mow the lawn. rest"),
        ("Jule\n- read the gauge\n- dock\nMax:\n- wait", "Jule: read the gauge; dock; Max: wait"),
        ("Rex, go to bay 2.\n\nThen dock.\n", "Rex, go to bay 2. Then dock."),
        ("go to bay 2\nand dock", "go to bay 2, and dock"),
        ("1. go to bay 4\n2. once 1 is over, dock", "1. go to bay 4; 2. once 1 is over, dock"),
        ("1. go to bay 4\n2. after 5 minutes, dock", "go to bay 4; after 5 minutes, dock"),
        ("go to dock 3", "go to dock 3"),
        ("a. mow the lawn\nb. rest\nc. dock", "mow the lawn; rest; dock"),
        ("A. mow the lawn\nand rest.\nB. dock", "mow the lawn, and rest. dock"),
        ("Jule:\na. read the gauge\nb. dock\nMax:\na. wait\nb. dock", "Jule: read the gauge; dock; Max: wait; dock"),
        ("A. Smith waits\nthen Rex goes to dock 1", "A. Smith waits, then Rex goes to dock 1"),
        ("Rex, go to dock 1\nA. Smith waits", "Rex, go to dock 1; A. Smith waits"),
        ("A. Smith waits\nC. Jones reads the gauge", "A. Smith waits; C. Jones reads the gauge"),
        ("B. Jones waits\nC. Smith reads the gauge", "B. Jones waits; C. Smith reads the gauge"),
        ("A. Smith waits\nA. Jones reads the gauge", "A. Smith waits; A. Jones reads the gauge"),
        ("1. A. Smith waits\n2. B. Jones docks", "A. Smith waits; B. Jones docks"),
        ("b) mow the lawn\n(d) rest", "mow the lawn; rest"),
        ("a.\nb.", "a. b."),
        (" one line, 2. as it is ", " one line, 2. as it is "),
    ],
)
def test_lines_are_one_sentence(lines: str, sentence: str) -> None:
    """Items lose what numbers them, unless they are spoken of by it; lines end with a mark; one line is as it was."""
    assert in_one_line(lines) == sentence


def test_number_of_an_item_is_no_word() -> None:
    """The figure of the next item is not taken for a part of the name before it."""
    words = words_of("1. Drive to tank 6\n2. Dock")
    assert [words[number] for number in range(words.own)] == ["Drive", "to", "tank", "6", ";", "Dock"]


@given(st.text(alphabet="ab 1.-\n\r\u2028)", max_size=40))
def test_any_text_is_one_line_for_good(text: str) -> None:
    """Whatever comes is brought to one line once, and stays as it is when it is read again."""
    once = in_one_line(text)
    assert in_one_line(once) == once
    assert [words_of(text)[n] for n in range(words_of(text).own)] == [
        words_of(once)[n] for n in range(words_of(once).own)
    ]
