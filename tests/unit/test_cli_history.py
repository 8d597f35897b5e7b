"""`swiftbot task list` with filters and pages, `task export`, `task duplicate`."""

# pyright: reportPrivateUsage=false, reportUnknownArgumentType=false

import asyncio
import csv
import io
import json
from collections.abc import AsyncGenerator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance import cli
from appliance.cli.common import Where
from appliance.cli.completion import offers
from appliance.cli.task import _cell
from appliance.client import FleetClient
from appliance.errors import RefusedError
from appliance.model import Approval, Plan, Remembered, TaskRecord, TaskRequest, TaskState
from appliance.model.task_api import TaskList, TasksAsk
from tests.unit.test_cli_faults_seen import run


def record(number: int, **fields: Any) -> TaskRecord:
    """Return a task."""
    return TaskRecord(id=f"t-{number}", instruction=f"go, to {number}", created_ns=number, **fields)


class Fleet:
    """A fleet of five tasks, two a page; gw-2 answers with the first page only."""

    def __init__(self) -> None:
        self.asked: list[TasksAsk] = []
        self.tasks_of = [record(number) for number in range(5, 0, -1)]
        self.fails_at = 0

    async def __aenter__(self) -> "Fleet":
        return self

    async def __aexit__(self, *_: object) -> None:
        return None

    async def task(self, task: str) -> TaskRecord:
        """Return one."""
        return next(each for each in self.tasks_of if each.id == task)

    async def tasks(self, limit: int, *, wanted: TasksAsk, after: TaskRecord | None = None) -> TaskList:
        """Return a page."""
        del limit
        self.asked.append(wanted)
        if self.fails_at and len(self.asked) >= self.fails_at:
            raise RefusedError("no more")
        found = [each for each in self.tasks_of if after is None or each.created_ns < after.created_ns]
        silent = ("gw-2",) if after is not None else ()
        return TaskList(tasks=tuple(found[:2]), more=len(found) > 2, unreachable=silent)

    def history(self, wanted: TasksAsk) -> AsyncGenerator[TaskList]:
        """Page after page, as the client does it."""
        own: Any = self
        return FleetClient.history(own, wanted)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Return it in the place of a connection."""
    made = Fleet()
    monkeypatch.setattr(Where, "client", lambda _: made)  # pyright: ignore[reportUnknownLambdaType]
    return made


def test_a_list_is_filtered_and_paged(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """The filters are asked of the fleet; below a page stands how to have the next one."""
    assert run("task", "list", "--state", "needs-approval", "--state", "failed", "--robot", "rover_1", "--by", "ann",
               "--since", "2026-11-27", "--text", "dock", "--remembered") == 0  # fmt: skip
    said = capsys.readouterr()
    assert "--before t-4" in said.err
    (ask,) = fleet.asked
    assert (ask.status, ask.robot, ask.by, ask.text) == (("needs approval", "failed"), "rover_1", "ann", "dock")
    assert ask.remembered
    assert ask.since_ns > 0
    assert run("task", "list", "--before", "t-4", "--json") == 0
    said = capsys.readouterr()
    assert [each["id"] for each in json.loads(said.out)] == ["t-3", "t-2"]
    assert "gw-2 did not answer" in said.err


@pytest.mark.parametrize(
    ("words", "says"),
    [(("--state", "runing"), "did you mean running"), (("--since", "soon"), "no time"), (("--limit", "1001"), "1000")],
)
def test_a_filter_that_means_nothing_is_refused(
    words: tuple[str, ...], says: str, fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    """With what is possible; nothing is asked."""
    assert run("task", "list", *words) == 2
    assert says in " ".join(capsys.readouterr().err.split())
    assert fleet.asked == []


def test_all_tasks_are_exported(fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Page after page, as lines of JSON or as a table; a gateway that did not answer is in the exit code."""
    assert run("task", "export") == 1
    said = capsys.readouterr()
    assert [json.loads(line)["id"] for line in said.out.splitlines()] == ["t-5", "t-4", "t-3", "t-2", "t-1"]
    assert "gw-2 did not answer" in said.err
    file = tmp_path / "tasks.csv"
    assert run("task", "export", "--csv", str(file)) == 1
    rows = list(csv.DictReader(io.StringIO(file.read_text())))
    assert [(row["id"], row["instruction"]) for row in rows][:2] == [("t-5", "go, to 5"), ("t-4", "go, to 4")]
    assert list(tmp_path.iterdir()) == [file]


def test_an_export_that_ends_halfway_leaves_the_file_as_it_was(fleet: Fleet, tmp_path: Path) -> None:
    """Neither half a file nor a draft stays; a folder that is not there is an error with its remedy."""
    file = tmp_path / "tasks.jsonl"
    file.write_text("before")
    fleet.fails_at = 2
    assert run("task", "export", str(file)) == 4
    assert file.read_text() == "before"
    assert list(tmp_path.iterdir()) == [file]
    assert run("task", "export", str(tmp_path / "no" / "where")) == 2


@given(st.text(max_size=20))
def test_no_cell_is_a_formula(text: str) -> None:
    """A spreadsheet shows instructions and does not compute them."""
    assert not str(_cell(text)).startswith(("=", "+", "-", "@", "\t", "\r"))


def test_filters_are_completed() -> None:
    """Options of a group are offered as any others, and robots after `--robot`."""
    assert {"--state", "--robot", "--since"} <= set(offers(cli.app, ("task", "list", "--")).words)
    assert offers(cli.app, ("task", "list", "--robot", "")).kind == "robot"
    assert offers(cli.app, ("task", "list", "--before", "")).kind == "task"


class Duplicating(FleetClient):
    """A client whose fleet has one task."""

    def __init__(self, known: TaskRecord) -> None:
        self.known = known
        self.operator = "ann"
        self.submitted: list[TaskRequest] = []

    async def task(self, task: str) -> TaskRecord:
        """Return it."""
        assert task == self.known.id
        return self.known

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Note what is submitted."""
        self.submitted.append(request)
        return TaskRecord(id="t-new", instruction=request.instruction)


def test_a_duplicate_is_a_new_task_of_the_one_who_asks() -> None:
    """Instruction, priority, gateways, deadline and approval are the task's; its plan is made anew."""
    plan = Plan(domain="any", subtasks=())
    known = record(1, submitter="bob", priority=7, deadline_s=60.0, within=("gw-1",), approval=Approval.ALWAYS,
                   state=TaskState.FAILED, plan=plan)  # fmt: skip
    client = Duplicating(known)
    assert asyncio.run(client.duplicate("t-1")).id == "t-new"
    (asked,) = client.submitted
    assert asked == TaskRequest(instruction="go, to 1", submitter="ann", priority=7, deadline_s=60.0, group=("gw-1",),
                                approval=Approval.ALWAYS)  # fmt: skip
    handed_in = Duplicating(replace(known, handed_in=True))
    asyncio.run(handed_in.duplicate("t-1"))
    assert handed_in.submitted[0].plan == plan


@pytest.mark.parametrize(
    "known",
    [
        TaskRecord(id="t-1", instruction="go to a place with…", state=TaskState.FAILED, remembered=Remembered()),
        record(1, handed_in=True), record(1, handed_in=True, revised=1, plan=Plan(domain="any", subtasks=())),
    ],
)  # fmt: skip
def test_what_is_not_kept_as_it_was_is_not_submitted_again(known: TaskRecord) -> None:
    """Half an instruction, or a plan that was changed or is gone, would be another task: refused, with a remedy."""
    client = Duplicating(known)
    with pytest.raises(RefusedError) as refused:
        asyncio.run(client.duplicate("t-1"))
    assert refused.value.remedy
    assert client.submitted == []


def test_the_older_tasks_of_a_client(fleet: Fleet) -> None:
    """A page that says that there are more and has none ends it: nothing is asked for ever."""
    empty: Any = SimpleNamespace(tasks=_no_tasks)

    async def pages() -> int:
        return len([page async for page in FleetClient.history(empty, TasksAsk(limit=2))])

    assert asyncio.run(pages()) == 1


async def _no_tasks(*_: Any, **__: Any) -> TaskList:
    return TaskList(tasks=(), more=True)
