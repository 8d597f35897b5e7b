"""Plans are scored as the reference scorer scores them, whatever is wrong with them."""

import copy
import json
import random
import runpy
from typing import Any

import msgspec
import pytest

from appliance.llm.language import read
from appliance.llm.words import words_of
from appliance.skills.catalogue import load_catalogue
from workshop.bench.plan import default_cases
from workshop.corpus import load
from workshop.scoring import mean_figures, score
from workshop.train.examples import example_of

GOLD: dict[str, Any] = {
    "domain": "manipulation",
    "subtasks": [
        {"id": "s1", "skill": "goto", "robot": "rex", "params": {"place": "the bay 2"}, "after": []},
        {"id": "s2", "skill": "pick", "robot": "rex", "params": {"object": "red drill"}, "after": ["s1"]},
        {"id": "s3", "skill": "photograph", "robot": "max", "params": {"count": 2}, "after": []},
    ],
}


def damaged(plan: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """Return a plan with a few things wrong."""
    made = copy.deepcopy(plan)
    for _ in range(rng.randrange(4)):
        subtasks = made["subtasks"]
        if not subtasks:
            break
        one = rng.choice(subtasks)
        match rng.randrange(9):
            case 0:
                subtasks.remove(one)
            case 1:
                subtasks.insert(rng.randrange(len(subtasks) + 1), {**copy.deepcopy(one), "id": f"n{rng.random()}"})
            case 2:
                one["after"] = rng.sample([each["id"] for each in subtasks], rng.randrange(min(3, len(subtasks)) + 1))
            case 3:
                one["robot"] = rng.choice(["rex", None, "", "max"])
            case 4:
                one["params"] = {
                    **one["params"],
                    rng.choice(["place", "object", "count"]): rng.choice([1, 2.0, "The Bay", True, ["a", 2], []]),
                }
            case 5:
                one["skill"] = rng.choice(["goto", "pick", "wait", "goto"])
            case 6:
                rng.shuffle(subtasks)
            case 7:
                one["params"] = {key: f"his {value} thing" for key, value in one["params"].items()}
            case _:
                made["domain"] = "media"
    return made


@pytest.mark.thorough
def test_it_is_the_reference_scorer_s_figures() -> None:
    """Of hand-written plans with things wrong at random every figure is the reference scorer's, of no plan too."""
    theirs: Any = runpy.run_path(str(default_cases().with_name("score.py")))["score_case"]
    catalogue, rng = load_catalogue(), random.Random(5)  # noqa: S311 - what is wrong, not secrets
    pairs = list(load().values())
    # Few of the thousands are made into examples: that takes milliseconds each.
    examples = [example_of(pair, catalogue) for pair in rng.sample(pairs, 450)]
    examples = [each for each in examples if each.symbols[0] != "none"]
    assert len(examples) > 350
    for example in examples:
        words = words_of(" ".join(example.words[: example.own]), example.words[example.own :])
        gold = json.loads(msgspec.json.encode(read(example.symbols, words, catalogue)))
        for _ in range(5):
            said = damaged(gold, rng)
            assert msgspec.to_builtins(score(said, gold)) == pytest.approx(theirs({"gold": gold}, said))


def test_the_right_plan_has_every_figure() -> None:
    """In other words, in another order of independent subtasks: all ones."""
    said = copy.deepcopy(GOLD)
    said["subtasks"][0]["params"]["place"] = "Bay 2"
    said["subtasks"] = [said["subtasks"][2], *said["subtasks"][:2]]
    assert set(msgspec.to_builtins(score(said, GOLD)).values()) == {1.0}


@pytest.mark.parametrize(
    "said",
    [
        {},
        {"subtasks": None},
        {"subtasks": [{"skill": "goto"}]},
        {"subtasks": [{"id": "a", "skill": "goto", "after": ["b"]}, {"id": "b", "skill": "pick", "after": ["a"]}]},
        {"subtasks": [{"id": "a", "skill": "goto", "after": ["z"]}]},
        {"subtasks": [{"id": "a", "skill": "goto"}, {"id": "a", "skill": "pick"}]},
    ],
)
def test_what_is_no_plan_has_no_figure(said: dict[str, Any]) -> None:
    """Nothing, no list, no id, a cycle, an unknown and a repeated id."""
    assert set(msgspec.to_builtins(score(said, GOLD)).values()) == {0.0}


def test_a_mean_leaves_out_who_has_no_figure() -> None:
    """Parallel recall counts only over plans with something independent in them."""
    line = {"domain": "navigation", "subtasks": GOLD["subtasks"][:2]}
    figures = mean_figures([score(line, line), score({}, GOLD)])
    assert figures == {"cases": 2, "parallel_recall": 0.0} | dict.fromkeys(
        ("subtask_f1", "decomposition", "param_f1", "exact", "domain", "valid"), 50.0
    )
