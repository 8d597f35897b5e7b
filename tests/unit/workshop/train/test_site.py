"""A site's own pairs, and the model card: what is learned from, what is left out and why, what people read."""

import json
from pathlib import Path

import pytest

from appliance.errors import NotFoundError
from appliance.skills.catalogue import load_catalogue
from workshop.train.card import model_card
from workshop.train.site import HELD_OUT, read_pairs
from workshop.train.tokens import Tokens, symbols_of

CATALOGUE = load_catalogue()
STEP = {"id": "s1", "skill": "goto", "robot": "rex", "params": {"place": "bay 2"}}
PLAN = {"domain": "navigation", "subtasks": [STEP]}


def line(text: str, **more: object) -> str:
    """Return a line of a file."""
    return json.dumps({"instruction": text, "robots": ["rex"], **more})


def test_gold_cases_and_tasks_that_succeeded_are_learned_from(tmp_path: Path) -> None:
    """Both forms come in once; what failed, was revised, has no plan or an unknown skill is left out, and why."""
    file = tmp_path / "plans.jsonl"
    unknown = {"domain": "navigation", "subtasks": [{**STEP, "skill": "dance"}]}
    file.write_text(
        "\n".join(
            [
                line("Rex, go to bay 2", gold=PLAN),
                line("rex go to bay 2 now", plan=PLAN, state="succeeded", id="t-1", coordinator="gw-1"),
                line("Rex, go to bay 2", gold=PLAN),
                line("Rex, go to bay 2 again", plan=PLAN, state="failed"),
                line("Rex, off to bay 2", plan=PLAN, state="succeeded", revised=1),
                line("Rex, dance", gold=unknown),
                line("Rex?"),
                "{",
                line('{"a": 1, "b": 2}', gold=PLAN),
            ]
        )
    )
    pairs = read_pairs(file, CATALOGUE)
    assert [each.text for each in pairs.train] == ["rex, go to bay 2", "rex go to bay 2 now"]
    assert [int(each.split(":")[1]) for each in pairs.left_out] == [4, 5, 6, 7, 8, 9]
    assert "--skills" in pairs.left_out[2]
    with pytest.raises(NotFoundError):
        read_pairs(tmp_path / "none", CATALOGUE)


def test_a_tenth_is_held_out_and_learned_nowhere(tmp_path: Path) -> None:
    """What tells whether tuning has helped is not among what is trained on."""
    file = tmp_path / "plans.jsonl"
    file.write_text("\n".join(line(f"Rex, go to bay 2 for the {number}th time", gold=PLAN) for number in range(50)))
    pairs = read_pairs(file, CATALOGUE)
    assert len(pairs.held_out) == 50 // HELD_OUT
    assert len(pairs.train) + len(pairs.held_out) == 50
    assert not {each.words for each in pairs.train} & {each.words for each in pairs.held_out}


def test_new_skills_get_tokens_behind_all_others() -> None:
    """What was learned keeps its tokens; a catalogue without news changes nothing."""
    before = Tokens.learn(["rex", "bay"], CATALOGUE, size=1200)
    assert before.extended(CATALOGUE).size == before.size
    wider = load_catalogue((Path(__file__).resolve().parents[4] / "docs" / "examples" / "skills",))
    news = [each for each in symbols_of(wider) if each not in symbols_of(CATALOGUE)]
    assert "battery_check" in news
    after = before.extended(wider)
    assert after.size == before.size + len(news)
    assert after.of("<goto>") == before.of("<goto>")
    assert after.of("<battery_check>") >= before.size


def test_the_model_card_has_figures_and_the_reliability_curve() -> None:
    """Splits, figures, how it was trained, and for each confidence how many are exact."""
    card = model_card(
        "int4",
        {"width": 64, "seed": 1},
        {"step": 500, "chance": {"cases": 40, "decomposition": 91.5, "exact": None}},
        {
            "megabytes": 12.5,
            "reliability": [
                {"confidence": 0.9, "exact": 0.8, "cases": 10},
                {"confidence": 0.3, "exact": 0.3, "cases": 30},
            ],
        },
        cases=40,
    )
    assert "| chance | 40 | 91.5 | – |" in card
    assert "| 0.90 | 0.80 | 10 |" in card
    assert "Mean distance: 0.025" in card
    assert "500 steps; width 64, seed 1" in card
    assert all(len(row) <= 120 for row in card.splitlines())
