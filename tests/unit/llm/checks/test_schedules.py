"""The command that a refused time, delay or repeat is answered with."""

# pyright: reportPrivateUsage=false

import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.llm.checks.schedules import GENERIC
from appliance.llm.checks.wording import _scheduled


@pytest.mark.parametrize(
    ("text", "arguments"),
    [
        ("Rover_1: go to dock 1 every 10 minutes", ["Rover_1: go to dock 1", "--every", "10m"]),
        ("every hour rover_1: film the aisle", ["rover_1: film the aisle", "--every", "1h"]),
        ("go to dock 1 every other day", ["go to dock 1", "--every", "2d"]),
        ("go to dock 1 every half hour.", ["go to dock 1", "--every", "30m"]),
        ("go to dock 1 at 5 pm", ["go to dock 1", "--at", "17:00"]),
        ("at 17:30, go to dock 1", ["go to dock 1", "--at", "17:30"]),
        ("go to dock 1 at 12 am", ["go to dock 1", "--at", "00:00"]),
        ("go to dock 1 in 20 minutes", ["go to dock 1", "--in", "20m"]),
        ("in two hours go to dock 1 and film it", ["go to dock 1 and film it", "--in", "2h"]),
        ("go to dock 1 every day at 7:05", ["go to dock 1", "--cron", "5 7 * * *"]),
        ("every monday at 7 am go to dock 1", ["go to dock 1", "--cron", "0 7 * * mon"]),
        ("say 'it's time' at 18:00", ["say 'it's time'", "--at", "18:00"]),
    ],
)
def test_a_known_form_becomes_a_command(text: str, arguments: list[str]) -> None:
    """The order without its time, quoted for a shell, and the option that says when."""
    found = _scheduled(text)
    assert shlex.split(found.split("`")[1]) == ["swiftbot", "schedule", "add", *arguments]


@pytest.mark.parametrize(
    "text",
    ["go to dock 1 every few minutes", "go to dock 1 twice a day", "go at 5 pm and at 6 pm",
     "every day go to dock 1 in 5 minutes", "every 5 seconds go", "at 25 pm go to dock 1", "at 5 pm"],
)  # fmt: skip
def test_any_other_form_names_the_command(text: str) -> None:
    """Nothing is guessed."""
    assert _scheduled(text) == GENERIC


@given(st.text(max_size=40), st.sampled_from(("every 10 minutes", "at 5 pm", "in 2 hours", "")), st.text(max_size=40))
def test_no_text_breaks_it(before: str, when: str, after: str) -> None:
    """Whatever is written, it is a hint of one command."""
    assert "swiftbot schedule add" in _scheduled(f"{before} {when} {after}")
