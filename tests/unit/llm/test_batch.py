"""A file of instructions: every case has a line, nothing written is lost, and what is no case is reported."""
# pyright: basic

import json
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import ConfigError, NotFoundError, RecordError
from appliance.llm import batch
from appliance.llm.settings import LlmConfig
from appliance.skills.catalogue import Catalogue

pytestmark = pytest.mark.anyio

CASES = (
    {"id": "a", "instruction": "Robot_1: go to goal 2, then photograph the shelf", "robots": ["robot_1"]},
    {"id": "b", "instruction": "what is love"},
    {"id": "c", "instruction": "both robots go to dock 1", "robots": ["robot_1", "robot_2"], "source": "x", "gold": {}},
)


def written(path: Path, *lines: object) -> Path:
    """Write lines: text as it is, anything else as JSON."""
    path.write_text("".join((each if isinstance(each, str) else json.dumps(each)) + "\n" for each in lines))
    return path


def rows(path: Path) -> list[dict[str, Any]]:
    """Read a file of JSON lines."""
    return [json.loads(line) for line in path.read_text().splitlines()]


async def test_every_case_gets_a_line(tmp_path: Path, catalogue: Catalogue) -> None:
    """Plans with tier, confidence and latency; a case without plan gets a line with the reason."""
    cases, out = written(tmp_path / "cases.jsonl", *CASES), tmp_path / "out.jsonl"
    told: list[str] = []
    report = await batch.run(cases, out, config=LlmConfig(), catalogue=catalogue, tier="rules", progress=told.append)
    found = {row["id"]: row for row in rows(out)}
    assert (report.cases, report.written, report.planless, report.malformed) == (3, 3, 1, ())
    assert [each["skill"] for each in found["a"]["subtasks"]] == ["goto", "photograph"]
    assert found["a"]["tier"] == "rules"
    assert found["a"]["confidence"] > 0
    assert found["a"]["latency_ms"] > 0
    assert (found["b"]["subtasks"], found["b"]["tier"]) == ([], "none")
    assert "question" in found["b"]["why"]
    assert [each["robot"] for each in found["c"]["subtasks"]] == ["robot_1", "robot_2"]
    assert len(told) == 3


async def test_a_run_of_federated_learning_is_refused_and_the_batch_goes_on(
    tmp_path: Path, catalogue: Catalogue
) -> None:
    """Its line says what it is; the cases behind it get theirs."""
    cases = written(
        tmp_path / "cases.jsonl",
        {"id": "a", "instruction": "train clips on all robots for 20 rounds", "robots": ["rover_1"]},
        {"id": "b", "instruction": "rover_1: go to goal 2", "robots": ["rover_1"]},
    )
    await batch.run(cases, tmp_path / "out.jsonl", config=LlmConfig(), catalogue=catalogue, tier="rules")
    first, second = rows(tmp_path / "out.jsonl")
    assert (first["id"], first["decision"]) == ("a", "refuse")
    assert "federated learning" in str(first)
    assert second["id"] == "b"
    assert second["decision"] == "run"


async def test_an_interrupted_run_goes_on(tmp_path: Path, catalogue: Catalogue) -> None:
    """What is written stays byte for byte, a line that was cut off is done again, and nothing is done twice."""
    cases, out = written(tmp_path / "cases.jsonl", *CASES), tmp_path / "out.jsonl"
    first = json.dumps({"id": "a", "subtasks": [], "kept": True}) + "\n"
    out.write_text(first + '{"id": "b", "subta')
    report = await batch.run(cases, out, config=LlmConfig(), catalogue=catalogue, tier="rules")
    assert (report.before, report.written) == (1, 2)
    assert out.read_text().startswith(first)
    assert [row["id"] for row in rows(out)] == ["a", "b", "c"]
    again = await batch.run(cases, out, config=LlmConfig(), catalogue=catalogue, tier="rules")
    assert (again.before, again.written) == (3, 0)


async def test_lines_that_are_no_case_are_told_with_their_numbers(tmp_path: Path, catalogue: Catalogue) -> None:
    """Not JSON, not a case, an id twice or none, and a line without end: each is named and left out."""
    cases = written(
        tmp_path / "cases.jsonl",
        CASES[0],
        "{not json",
        {"id": "x"},
        CASES[0],
        {"id": "", "instruction": "go home"},
        "",
        {"id": "y", "instruction": 7},
        "[" * 5000,
        CASES[1],
    )
    with cases.open("ab") as file:
        file.write(b'{"id": "z", "instruction": "\xff\xfe"}\n')
        file.write(b'{"id": "long", "instruction": "' + b"x" * (batch.MAX_LINE + 1) + b'"}\n')
    told: list[str] = []
    report = await batch.run(
        cases, tmp_path / "out.jsonl", config=LlmConfig(), catalogue=catalogue, tier="rules", progress=told.append
    )
    assert [each.line for each in report.malformed] == [2, 3, 4, 5, 7, 8, 10, 11]
    assert "line 1 too" in report.malformed[2].why
    assert any(f"{cases}:2: no case" in each for each in told)
    assert report.written == 2


async def test_what_cannot_be_done_is_said_before_anything_is_written(tmp_path: Path, catalogue: Catalogue) -> None:
    """No such cases, no such tier, an output that is something else or cannot be written."""
    cases, out = written(tmp_path / "cases.jsonl", *CASES), tmp_path / "out.jsonl"

    async def run(where: Path = cases, to: Path = out, tier: batch.Choice = "rules") -> batch.Report:
        return await batch.run(where, to, config=LlmConfig(local_model=""), catalogue=catalogue, tier=tier)

    with pytest.raises(NotFoundError, match="no cases"):
        await run(tmp_path / "none.jsonl")
    with pytest.raises(ConfigError, match="no local model"):
        await run(tier="local")
    with pytest.raises(ConfigError, match="no upstream model"):
        await run(tier="upstream")
    assert not out.exists()
    with pytest.raises(RecordError, match="cannot be written"):
        await run(to=tmp_path / "no" / "out.jsonl")
    other = written(tmp_path / "other.jsonl", "this is", "something else")
    with pytest.raises(RecordError, match="is no prediction"):
        await run(to=other)
    assert other.read_text() == "this is\nsomething else\n"


async def test_the_scorer_takes_the_output(tmp_path: Path, catalogue: Catalogue) -> None:
    """Predictions of the rules for a part of the development set are scored without complaint."""
    from workshop.bench.plan.quality import _scorer, default_cases  # noqa: PLC0415 - the scorer is loaded as the benchmark does

    lines = default_cases().read_text().splitlines()[:20]
    cases, out = written(tmp_path / "cases.jsonl", *lines), tmp_path / "out.jsonl"
    await batch.run(cases, out, config=LlmConfig(), catalogue=catalogue, tier="rules")
    score = _scorer(default_cases().with_name("score.py"))
    by_id = {row["id"]: row for row in rows(out)}
    figures = [score.score_case(case, by_id[case["id"]]) for case in map(json.loads, lines)]
    assert all(each["valid"] == 1.0 for each in figures)
    assert sum(each["decomposition"] for each in figures) > 15
