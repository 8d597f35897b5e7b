"""`swiftbot schedule …` and `swiftbot instructions …`: what is asked of the fleet, and what is printed."""

# pyright: reportUnknownLambdaType=false, reportUnknownMemberType=false, reportUnknownArgumentType=false

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.cli.common import Where
from appliance.errors import PlanError
from appliance.model import Plan, TaskRecord, TaskRequest, TaskState, Word
from appliance.model.schedules import (
    InstructionList,
    SavedInstruction,
    Schedule,
    ScheduleList,
    ScheduleShown,
    ScheduleSpec,
)
from appliance.schedules import due
from appliance.schedules.records import made_name
from tests.unit.test_cli_faults_seen import run

S = 10**9


class Fleet:
    """A fleet that takes schedules and has one saved instruction."""

    def __init__(self) -> None:
        self.operator = "ann"
        self.specs: list[ScheduleSpec] = []
        self.submitted: list[TaskRequest] = []
        self.shown: tuple[ScheduleShown, ...] = ()
        self.silent: tuple[str, ...] = ()
        self.problem: PlanError | None = None
        self.approval = ""

    async def __aenter__(self) -> "Fleet":
        return self

    async def __aexit__(self, *_: object) -> None:
        return None

    async def plan(self, text: str) -> Any:
        """Plan it, or refuse."""
        if self.problem is not None:
            raise self.problem
        return SimpleNamespace(plan=Plan(domain="any", subtasks=()), text=text)

    async def check_plan(self, _plan: Plan) -> Any:
        """Say whether it would wait."""
        return SimpleNamespace(approval=self.approval)

    async def schedule_add(self, spec: ScheduleSpec, *, why: str = "") -> Schedule:
        """Take one."""
        self.specs.append(spec)
        schedule = Schedule(spec=spec, added=Word(by="ann", why=why, at_ns=1))
        self.shown = (ScheduleShown(schedule=schedule, next_ns=(1_800_000_000 * S,), owner="gw-1"),)
        return schedule

    async def schedules(self) -> ScheduleList:
        """Return what was taken."""
        return ScheduleList(schedules=self.shown, unreachable=self.silent)

    async def instructions(self) -> InstructionList:
        """Return the saved one."""
        saved = SavedInstruction(id="fetch", text="{robot=rover_1}: fetch {thing}", saved=Word(by="ann"))
        return InstructionList(instructions=(saved,))

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Take a task."""
        self.submitted.append(request)
        return TaskRecord(id="t-1", instruction=request.instruction)

    async def planned(self, task: str) -> TaskRecord:
        """Return it planned."""
        return TaskRecord(id=task, instruction=self.submitted[-1].instruction, state=TaskState.RUNNING)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Return it in the place of a connection."""
    made = Fleet()
    monkeypatch.setattr(Where, "client", lambda _: made)  # pyright: ignore[reportUnknownLambdaType]
    monkeypatch.setenv("TZ", "Europe/Zurich")
    return made


@pytest.mark.parametrize(
    ("words", "holds"),
    [
        (("--every", "10m"), lambda spec: spec.every_s == 600 and not spec.cron),
        (("--cron", "0 7 * * mon-fri"), lambda spec: (spec.cron, spec.zone) == ("0 7 * * mon-fri", "Europe/Zurich")),
        (("--cron", "0 7 * * *", "--zone", "UTC"), lambda spec: spec.zone == "UTC"),
        (("--in", "20m"), lambda spec: spec.at_ns > 0),
        (("--at", "2100-01-01T07:30"), lambda spec: spec.at_ns == 4102468200 * S),
        (("--every", "1h", "--late", "run", "--overlap", "allow", "--grace", "5m"),
         lambda spec: (spec.late, spec.overlap, spec.grace_s) == ("run", "allow", 300.0)),
    ],
)  # fmt: skip
def test_a_schedule_is_added(
    words: tuple[str, ...], holds: Callable[[ScheduleSpec], bool], fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    """By interval, expression or time, in the zone of this machine unless another is given; it says when it is due."""
    assert run("schedule", "add", "rover_1: go to Dock 1!", *words) == 0
    (spec,) = fleet.specs
    assert holds(spec)
    assert (spec.id, spec.instruction) == ("rover_1-go-to-dock-1", "rover_1: go to Dock 1!")
    assert "next" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ((), 2, "not said when"), (("--every", "10m", "--cron", "0 7 * * *"), 4, "one of"),
        (("--every", "soon"), 2, "no duration"), (("--every", "1s"), 4, "too short"),
        (("--cron", "0 7 * *"), 4, "5 fields"), (("--at", "2001-01-01"), 4, "is over"),
        (("--at", "17:00", "--in", "5m"), 2, "--at or --in"), (("--every", "5m", "--zone", "Mars"), 4, "time zone"),
        (("x", "--every", "5m"), 2, "follows the instruction"),
        (("--every", "5m", "--saved", "fetch"), 4, "no name=value"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(
    words: tuple[str, ...], code: int, says: str, fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything is asked of the fleet, with a remedy."""
    assert run("schedule", "add", "rover_1: go to dock 1", *words) in (code, 1)
    shown = " ".join(capsys.readouterr().err.split())
    assert says in shown
    assert "hint:" in shown
    assert fleet.specs == []


def test_an_instruction_that_cannot_run_is_refused_at_once(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """And not at night; --unchecked adds it all the same, and a plan that will wait is said."""
    fleet.problem = PlanError("no robot can fly", remedy="name a drone")
    assert run("schedule", "add", "fly", "--every", "10m") == 4
    assert "--unchecked" in capsys.readouterr().err
    assert fleet.specs == []
    assert run("schedule", "add", "fly", "--every", "10m", "--unchecked") == 0
    fleet.problem, fleet.approval = None, "it moves outside"
    assert run("schedule", "add", "go", "--every", "10m", "--name", "b") == 0
    assert "waits for approval" in capsys.readouterr().err


def test_schedules_are_listed_and_shown(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """What was missed, whether it is paused or over; a gateway that did not answer is in the exit code."""
    assert run("schedule", "list") == 0
    assert "no schedules" in capsys.readouterr().out
    spec = ScheduleSpec(id="patrol", instruction="go [/red]", every_s=5400.0)
    schedule = Schedule(spec=spec, added=Word(by="ann", why="nights"), missed=3, missed_ns=S, missed_why="no gateway",
                        fired=2, task="patrol.1", fired_ns=S)  # fmt: skip
    over = replace(schedule, spec=replace(spec, id="once", every_s=0.0, at_ns=S))
    paused = replace(schedule, spec=replace(spec, id="held"), paused=Word(by="bob", why="holidays"))
    fleet.shown = tuple(ScheduleShown(schedule=each, next_ns=(2 * S,) if each is schedule else ())
                        for each in (schedule, over, paused))  # fmt: skip
    fleet.silent = ("gw-2",)
    assert run("schedule", "list") == 1
    said = capsys.readouterr()
    assert all(word in said.out for word in ("patrol", "1h30m", "over", "paused", "[/red]"))
    assert "gw-2 did not answer" in said.err
    assert run("schedule", "show", "held") == 0
    said = capsys.readouterr()
    assert "paused by bob: holidays" in said.out
    assert "missed    3, the last" in said.out
    assert run("schedule", "list", "--json") == 1
    assert [each["schedule"]["spec"]["id"] for each in json.loads(capsys.readouterr().out)] == [
        "patrol",
        "once",
        "held",
    ]
    assert run("schedule", "show", "none") == 4
    assert "gw-2 did not answer" in capsys.readouterr().err


def test_a_saved_instruction_is_run_and_scheduled(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """With its values in their places; a missing one is an error, and nothing is submitted."""
    assert run("instructions", "run", "fetch", "thing=the red box") == 0
    assert fleet.submitted[0].instruction == "rover_1: fetch the red box"
    assert run("instructions", "run", "fetch", "thing=box", "robot=rover_2", "--dry") == 0
    assert "rover_2: fetch box" in capsys.readouterr().out
    for words, says in ((("fetch",), "no value for thing"), (("fetch", "thing"), "name=value"), (("b",), "no saved")):
        assert run("instructions", "run", *words) != 0
        assert says in capsys.readouterr().err
    assert len(fleet.submitted) == 1
    assert run("schedule", "add", "--saved", "fetch", "--every", "1d", "--name", "daily") == 4
    assert fleet.specs == []
    assert run("schedule", "add", "--saved", "fetch", "thing=box", "--every", "1d", "--name", "daily") == 0
    assert fleet.specs[0].instruction == "rover_1: fetch box"
    assert run("instructions", "list") == 0
    assert "{thing}" in capsys.readouterr().out


def test_the_zone_of_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """TZ, else what /etc/localtime is a link to; where neither says it, UTC."""
    monkeypatch.setenv("TZ", ":America/New_York")
    assert due.local_zone() == "America/New_York"
    monkeypatch.delenv("TZ")
    target = tmp_path / "zoneinfo" / "Europe" / "Zurich"
    target.parent.mkdir(parents=True)
    target.touch()
    link = tmp_path / "localtime"
    link.symlink_to(target)
    monkeypatch.setattr(due, "LOCALTIME", link)
    assert due.local_zone() == "Europe/Zurich"
    monkeypatch.setattr(due, "LOCALTIME", tmp_path / "none")
    assert due.local_zone() == "UTC"


def test_names_are_made_of_words() -> None:
    """In what keys may have, and never empty."""
    assert made_name("Rover_1: fetch the red box from dock 3 and bring it here") == (
        "rover_1-fetch-the-red-box-from-dock-3-an"
    )
    assert made_name("日本") == "schedule"
