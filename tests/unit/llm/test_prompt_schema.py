"""Prompt, schema, grammar text and the reading of answers."""

import json

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PlanError
from appliance.llm.checks.schema import validate
from appliance.llm.prompt import EXAMPLES, GRAMMAR_SUBTASKS, messages, plan_grammar, plan_schema, read_plan, robot_names
from appliance.llm.settings import PlanContext
from appliance.model import RobotInfo, Site, Tier
from appliance.skills.catalogue import Catalogue


def test_examples_of_the_prompt_are_valid_plans(catalogue: Catalogue) -> None:
    """What a model is shown passes the validator."""
    for _, _, text in EXAMPLES:
        assert validate(read_plan(text, tier=Tier.UPSTREAM), catalogue) == ()


def test_fixed_part_of_the_prompt_does_not_change(
    catalogue: Catalogue, robots: tuple[RobotInfo, ...], site: Site
) -> None:
    """All but the last message is the same for every instruction, so that its computation can be kept."""
    one = messages(PlanContext(instruction="a"), catalogue)
    other = messages(PlanContext(instruction="b", robots=robots, site=site), catalogue)
    assert one[:-1] == other[:-1]
    assert all(f"{skill}(" in one[0]["content"] for skill in catalogue.skills)
    assert "Robots: drone_1 (flies), rover_1\nPlaces: dock 1" in other[-1]["content"]


def test_repair_shows_the_plan_and_its_problems(catalogue: Catalogue) -> None:
    """Asking again shows the model its own plan and what is wrong with it."""
    plan = read_plan(EXAMPLES[0][2], tier=Tier.LOCAL)
    chat = messages(PlanContext(instruction="a"), catalogue, previous=plan, problems=("s1: no",))
    assert json.loads(chat[-2]["content"])["subtasks"][0]["id"] == "s1"
    assert "- s1: no" in chat[-1]["content"]


def test_schema_has_one_alternative_for_each_skill(catalogue: Catalogue) -> None:
    """The JSON schema gives each skill its own parameters, the required ones marked, others forbidden."""
    schema = plan_schema(catalogue)
    items = schema["properties"]["subtasks"]["items"]["anyOf"]
    assert len(items) == len(catalogue.skills)
    goto = next(item for item in items if item["properties"]["skill"]["enum"] == ["goto"])
    assert goto["properties"]["params"]["required"] == ["place"]
    assert goto["properties"]["params"]["additionalProperties"] is False
    json.dumps(schema)


def test_grammar_lets_subtasks_only_look_back(catalogue: Catalogue) -> None:
    """In the grammar subtask 3 may come after 1 and 2 alone, so that no circle can be written."""
    grammar = plan_grammar(catalogue, ("rover_1", "any")).splitlines()
    assert r'd3: "\"s1\"" | "\"s2\""' in grammar
    assert 'after1: ""' in grammar
    assert not any(line.startswith(f"t{GRAMMAR_SUBTASKS + 1}:") for line in grammar)


def test_names_in_the_grammar_cover_unknown_robots(robots: tuple[RobotInfo, ...]) -> None:
    """A robot that the instruction names and the fleet lacks can be written, so that it can be refused."""
    names = robot_names(robots, "Rover_9 and Drone 4 go to dock 1")
    assert names is not None
    assert {"drone_1", "rover_1", "rover_9", "drone_4", "any", "any1", "any2"} <= set(names)
    assert robot_names(None, "x") is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no plan today",
        "{",
        "}{",
        "{}",
        '{"domain": 3, "subtasks": []}',
        '{"domain": "x", "subtasks": [{"id": "s1"}]}',
        '{"domain": "x", "subtasks": {"a": 1}}',
        "[" * 100_000,
        '{"a":' * 50_000 + "}",
        "{" + "x" * 300_000 + "}",
    ],
)
def test_answers_that_are_no_plan(text: str) -> None:
    """Anything but a plan is a PlanError that says what is wrong."""
    with pytest.raises(PlanError):
        read_plan(text, tier=Tier.UPSTREAM)


def test_words_around_the_plan_are_forgiven() -> None:
    """A code fence, a preamble, nulls and missing fields do not spoil a plan."""
    plan_text = '{"domain": "navigation", "subtasks": [{"id": "s1", "skill": "land", "robot": "", "params": null}]}'
    text = f"Sure:\n```json\n{plan_text}\n```"
    plan = read_plan(text, tier=Tier.UPSTREAM)
    assert (plan.subtasks[0].robot, plan.subtasks[0].params, plan.subtasks[0].after) == (None, {}, ())


@given(st.text(max_size=200) | st.binary(max_size=200).map(lambda data: data.decode(errors="replace")))
def test_any_answer_is_a_plan_or_a_plan_error(text: str) -> None:
    """Whatever a model writes, reading it ends in a plan or in a PlanError."""
    try:
        plan = read_plan('{"domain":"x","subtasks":[' + text + "]}", tier=Tier.LOCAL)
    except PlanError:
        return
    msgspec.json.encode(plan)
