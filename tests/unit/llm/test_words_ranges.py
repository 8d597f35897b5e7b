"""Ranges in instructions: what lies between their ends is meant, and nothing else."""

import pytest

from appliance.llm.words import between, words_of


@pytest.mark.parametrize(
    ("instruction", "meant"),
    [
        ("Inspect pumps 4 to 7.", ("5", "6")),
        ("Close doors 9 through 11, then doors 20 up to 22.", ("10", "21")),
        ("Photograph bays A to D.", ("b", "c")),
        ("Check pylons 11 – 14.", ("12", "13")),
        ("Go from dock 3 to dock 7.", ()),
        ("Carry crate 2 to 1 Main Street.", ()),
        ("Open valves 4 and 7.", ()),
        ("Print pages 1 to 4000.", ()),
        ("Go to gate 007 to 010.", ()),
        ("Take 5 to bay c.", ()),
        ("to", ()),
        ("", ()),
    ],
)
def test_between(instruction: str, meant: tuple[str, ...]) -> None:
    """Numbers and letters between two that are said with a word for "to" between them; not the ends, nor thousands."""
    assert between(words_of(instruction, ("robot_1", "robot_5"))) == meant
