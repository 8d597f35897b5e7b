"""`swiftbot submit --file`: bad lines are named and the others go, ids stand still, nothing is begun twice."""

import json
from pathlib import Path
from typing import Any

import pytest

from appliance.cli.common import Where
from appliance.errors import RefusedError, SwiftbotError, UnreachableError
from appliance.model import PLAIN_PRIORITY, TaskRecord, TaskRequest
from tests.unit.test_cli_faults_seen import run


class Fleet:
    """Takes what it is handed, unless an answer is prepared for an instruction."""

    def __init__(self) -> None:
        self.taken: list[TaskRequest] = []
        self.answers: dict[str, SwiftbotError] = {}

    async def __aenter__(self) -> "Fleet":
        return self

    async def __aexit__(self, *_: object) -> None:
        return None

    async def submit_once(self, request: TaskRequest) -> TaskRecord:
        """Take one."""
        if (error := self.answers.get(request.instruction)) is not None:
            raise error
        self.taken.append(request)
        return TaskRecord(id=request.id, instruction=request.instruction)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Return it in the place of a connection."""
    made = Fleet()
    monkeypatch.setattr(Where, "client", lambda _: made)  # pyright: ignore[reportUnknownLambdaType]
    monkeypatch.setenv("SWIFTBOT_OPERATOR", "ann")
    return made


def test_a_file_is_handed_in_line_by_line(fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Texts and objects; what a line does not say the options say, and the sender is the operator whatever it says."""
    file = tmp_path / "tasks.jsonl"
    file.write_text('"go"\n\n{"instruction": "look", "id": "own", "priority": 9, "submitter": "bob"}\n"look again"')
    assert run("submit", "--file", str(file), "--id", "night", "--deadline", "60", "--json") == 0
    assert [(each.id, each.priority, each.deadline_s, each.submitter) for each in fleet.taken] == [
        ("night-1", PLAIN_PRIORITY - 1, 60.0, "ann"),
        ("own", 9, 60.0, "ann"),
        ("night-4", PLAIN_PRIORITY - 1, 60.0, "ann"),
    ]
    said = json.loads(capsys.readouterr().out)
    assert (said["accepted"], said["problems"], said["id"]) == (3, [], "night")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{", "truncated"),
        ("[1]", "neither an instruction nor an object"),
        ('{"instruction": "x", "colour": 1}', "colour"),
        ('{"id": "x"}', "instruction"),
        ('{"instruction": "x", "priority": 12}', "priority"),
        ('"\\ud800"', "no task"),
        ("[" * 5000, "no task"),
        ('{"instruction": "x", "id": "night-1"}', "line 1 has the same id"),
        ('"halt"', "this is a stop"),
    ],
)
def test_a_bad_line_is_named_and_the_others_go(
    line: str, says: str, fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the file, its number and the reason; exit code 1 says that something was left out."""
    fleet.answers["halt"] = RefusedError("this is a stop, not a task")
    file = tmp_path / "tasks.jsonl"
    file.write_text(f'"first"\n{line}\n"last"\n')
    assert run("submit", "--file", str(file), "--id", "night") == 1
    said = capsys.readouterr()
    assert f"{file}:2: " in said.err
    assert says in said.err
    assert [each.instruction for each in fleet.taken] == ["first", "last"]
    assert "2 tasks" in said.out
    assert "1 lines were not taken" in said.out


def test_a_fleet_that_goes_says_how_to_go_on(fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What was accepted goes on; the same command with the same id hands in the rest."""
    fleet.answers["third"] = UnreachableError("no gateway of fleet local is there")
    file = tmp_path / "tasks.jsonl"
    file.write_text('"first"\n"second"\n"third"\n')
    assert run("submit", "--file", str(file)) == 3
    said = capsys.readouterr().err
    assert "2 tasks are accepted and go on" in said.replace("\n", " ")
    assert f"--id {fleet.taken[0].id.rpartition('-')[0]}" in said


@pytest.mark.parametrize("words", [("submit",), ("submit", "text", "--file", "x"), ("submit", "--file", "x", "--wait")])
def test_what_does_not_go_together_is_refused(
    words: tuple[str, ...], fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither text nor file, both, or waiting for a file's tasks."""
    assert run(*words) == 2
    assert "give TEXT, or --file" in capsys.readouterr().err
    assert not fleet.taken


def test_files_that_are_none(fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One that is not there, and one of a single endless line, which is not read into memory."""
    assert run("submit", "--file", str(tmp_path / "none")) == 2
    assert "cannot be read" in capsys.readouterr().err
    file = tmp_path / "long"
    file.write_text(f'"first"\n"{"x" * (2 << 20)}"\n')
    assert run("submit", "--file", str(file)) == 2
    assert ":2: the line has over" in capsys.readouterr().err


def test_a_file_without_tasks(fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Is no error: there is nothing to do."""
    file: Any = tmp_path / "empty"
    file.write_text("\n\n")
    assert run("submit", "--file", str(file)) == 0
    assert "0 tasks" in capsys.readouterr().out
    assert not fleet.taken
