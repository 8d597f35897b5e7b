"""`stop`, `submit` and `plan` of the command line where the words say to stop, and plans that wait, on a fake fleet."""

import re
from collections.abc import AsyncGenerator
from types import SimpleNamespace, TracebackType
from typing import Any, Self

import msgspec
import pytest
from msgspec.structs import replace

from appliance import cli
from appliance.cli import common, submit
from appliance.client import Named, named
from appliance.errors import UnreachableError
from appliance.model import (
    Approval,
    Decision,
    Failure,
    Place,
    Plan,
    Pose,
    Proposal,
    RobotInfo,
    Site,
    SoftStop,
    Subtask,
    SubtaskRecord,
    TaskRecord,
    TaskRequest,
    TaskState,
)
from appliance.model.robot_api import StopAnswer
from appliance.model.task_api import ExperienceList, PlanAnswer, PlanChecked

ROSTER = ("rover_1", "rover_2", "drone_1")
PLAN = Plan(domain="inspection", subtasks=(Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "dock"}),))
HASH = "0123456789abcdef"


class Fleet:
    """A fleet as far as these commands need one: what it is asked, and what it answers."""

    def __init__(self) -> None:
        self.robots = dict.fromkeys(ROSTER)
        self.plane = SimpleNamespace(registry=SimpleNamespace(robots=self.robots))
        self.known: dict[str, RobotInfo] = {}
        self.operator = "ann"
        self.stops: list[tuple[tuple[str, ...], str]] = []
        self.submitted: list[TaskRequest] = []
        self.approved: list[Plan | None] = []
        self.rejected = 0
        self.gone = False
        self.problems: dict[str, str] = {}
        self.invalid: tuple[str, ...] = ()
        self.holds = False
        self.end = TaskState.SUCCEEDED
        self.failure: Failure | None = None
        self.record = TaskRecord(id="t-1", instruction="")

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open."""

    async def gateway(self) -> str:
        """Return any gateway."""
        if self.gone:
            raise UnreachableError("no gateway of fleet local is there")
        return "gw-1"

    def known_robots(self) -> dict[str, RobotInfo]:
        """Return the robots as they are set."""
        return self.known

    async def experience(self, limit: int) -> ExperienceList:
        """Return that nothing was measured."""
        assert limit
        return ExperienceList(gateway="gw-1", rows=())

    async def site(self) -> Site:
        """Return a map with one place."""
        return Site(places={"dock 3": Place(x=10.0, y=4.0)})

    async def stop(self, robots: tuple[str, ...] = (), *, why: str = "") -> StopAnswer:
        """Keep the stop."""
        self.stops.append((tuple(robots), why))
        if self.gone:
            raise UnreachableError("no gateway confirms the stop")
        stop = SoftStop(id="o-1", robots=tuple(robots), by="ann", why=why)
        held = tuple(each for each in robots or self.robots if each not in self.problems)
        return StopAnswer(stops=(stop,), gateways=("gw-1",), robots=held, problems=self.problems)

    async def plan(self, instruction: str, *, private: bool = False) -> PlanAnswer:
        """Answer with the plan."""
        del instruction, private
        return PlanAnswer(plan=PLAN)

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Accept it; its plan waits when the request or the fleet's policy says so."""
        self.submitted.append(request)
        self.record = TaskRecord(id=request.id, instruction=request.instruction, coordinator="gw-1")
        if self.holds or request.approval is Approval.ALWAYS:
            proposal = Proposal(plan=PLAN, note="it moves a robot that flies", waits=True, hash=HASH, expires_s=600.0)
            self.record = replace(self.record, state=TaskState.PROPOSED, proposal=proposal)
        else:
            self._runs(PLAN)
        return self.record

    def _runs(self, plan: Plan) -> None:
        subtasks = tuple(SubtaskRecord(subtask=each) for each in plan.subtasks)
        self.record = replace(self.record, state=TaskState.RUNNING, plan=plan, proposal=None, subtasks=subtasks)

    async def planned(self, task: str) -> TaskRecord:
        """Return the record."""
        assert task == self.record.id
        return self.record

    async def watch(self, task: str) -> AsyncGenerator[TaskRecord]:
        """Yield the record as it is, then its end."""
        assert task == self.record.id
        yield self.record
        yield self.record
        yield replace(self.record, state=self.end, failure=self.failure, proposal=None)

    async def approve(self, task: str, *, plan_hash: str, plan: Plan | None = None, why: str = "") -> TaskRecord:
        """Run the plan."""
        assert (task, plan_hash, why) == (self.record.id, HASH, "")
        self.approved.append(plan)
        self._runs(plan or PLAN)
        return self.record

    async def reject(self, task: str, *, why: str = "", plan_hash: str = "") -> TaskRecord:
        """Cancel the task."""
        assert (task, plan_hash, why) == (self.record.id, HASH, "")
        self.rejected += 1
        decision = Decision(approved=False, by="ann")
        return replace(self.record, state=TaskState.CANCELLED, proposal=None, decision=decision)

    async def check_plan(self, plan: Plan, *, task: str = "") -> PlanChecked:
        """Find what the test has set."""
        del plan, task
        return PlanChecked(problems=self.invalid, hash="")


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Return the fleet that every command connects to."""
    made = Fleet()
    monkeypatch.setattr(common, "FleetClient", lambda _: made)
    return made


@pytest.fixture
def swiftbot(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> Any:
    """Return what runs a command and gives back its exit code, what it printed, and its errors."""

    def run(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            cli.main([*arguments, "--connect", "tcp/127.0.0.1:1"])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        assert isinstance(ended.value.code, int)
        return int(ended.value.code), said.out, said.err

    return run


# --- stops ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "robots", "unknown"),
    [
        (["rover_1"], ["rover_1"], []),
        (["Rover_1"], ["rover_1"], []),
        (["rover 1"], ["rover_1"], []),
        (["rover", "1"], ["rover_1"], []),
        (["ROVER-1", "drone1"], ["rover_1", "drone_1"], []),
        (["rover_1", "and", "drone_1"], ["rover_1", "drone_1"], []),
        (["rover_1", "now"], ["rover_1"], []),
        (["rovers"], ["rover_1", "rover_2"], []),
        (["the", "drone"], ["drone_1"], []),
        (["all"], [], []),
        (["everything"], [], []),
        (["all", "bob"], [], []),
        (["rovr_1"], [], ["rovr_1"]),
        (["Rover_9"], [], ["Rover_9"]),
        (["rover_2", "Rover_9"], ["rover_2"], ["Rover_9"]),
        (["bob"], [], ["bob"]),
        (["bob", "rover 2"], ["rover_2"], ["bob"]),
        (["bob", "rovr_1", "drone_1"], ["drone_1"], ["bob", "rovr_1"]),
    ],
)
def test_names_as_people_type_them(names: list[str], robots: list[str], unknown: list[str]) -> None:
    """Each word counts once, and a name that no robot has is never dropped."""
    assert named(names, ROSTER) == Named(robots=tuple(robots), unknown=tuple(unknown))


def test_an_unknown_name_is_reported_first_and_stops_nothing(fleet: Fleet, swiftbot: Any) -> None:
    """With the nearest name, and how to stop all."""
    code, out, _ = swiftbot("stop", "rover1x")
    assert code == 4
    assert fleet.stops == []
    first, *others = out.splitlines()
    assert first == "NOT STOPPED: no robot 'rover1x'; did you mean rover_1?"
    assert others == ["no robot was stopped", "to stop all robots: swiftbot stop"]


def test_the_other_names_are_stopped(fleet: Fleet, swiftbot: Any) -> None:
    """What was stopped follows what was not."""
    code, out, _ = swiftbot("stop", "Rover_1", "rover_7", "--why", "a person")
    assert code == 1
    assert fleet.stops == [(("rover_1",), "a person")]
    assert out.startswith("NOT STOPPED: no robot 'rover_7'")
    assert "rover_1: stopped by ann: a person\nhold: rover_1" in out
    assert out.rstrip().endswith("to stop all robots: swiftbot stop")


def test_a_stop_says_where_robots_stand_and_what_they_hold(fleet: Fleet, swiftbot: Any) -> None:
    """After what is confirmed: of those that were named each, of the whole fleet those that hold something."""
    fleet.known = {
        "rover_1": RobotInfo(id="rover_1", kind="zenoh", pose=Pose(x=10.0, y=3.0), holding="red box", verbs=("place",)),
        "rover_2": RobotInfo(id="rover_2", kind="zenoh"),
    }
    code, out, _ = swiftbot("stop")
    assert code == 0
    line = "rover_1 stands at 10.0 3.0 0.0 m (1.0 m from dock 3) and holds the red box → swiftbot resume rover_1"
    assert out.splitlines()[-1] == line
    assert out.index("hold: ") < out.index("stands at")
    assert "rover_2 stands" not in out
    _, out, _ = swiftbot("stop", "rover_2")
    assert out.splitlines()[-1] == "rover_2 stands somewhere and holds nothing → swiftbot resume rover_2"


def test_what_did_not_confirm_comes_first(fleet: Fleet, swiftbot: Any) -> None:
    """In capitals; also when no gateway answers, and the stop is put all the same."""
    fleet.problems = {"rover_2": "it is offline"}
    code, out, _ = swiftbot("stop")
    assert code == 1
    assert out.splitlines()[0] == "NOT CONFIRMED by rover_2: use the switch at a robot that moves"
    fleet.gone = True
    for words in (("stop", "rover_1"), ("submit", "stop"), ("submit", "rover_1: stop")):
        code, out, err = swiftbot(*words)
        assert code == 3
        assert err.splitlines()[0].startswith("NOT CONFIRMED")
    assert [robots for robots, _ in fleet.stops] == [(), ("rover_1",), (), ("rover_1",)]


@pytest.mark.parametrize(
    ("text", "robots"),
    [("stop", ()), ("STOP!", ()), ("Rover_1 stop", ("rover_1",)), ("stop the rovers", ("rover_1", "rover_2"))],
)
def test_a_stop_in_words_is_the_soft_stop(fleet: Fleet, swiftbot: Any, text: str, robots: tuple[str, ...]) -> None:
    """No task; the same text, JSON and exit code as `swiftbot stop`."""
    assert swiftbot("submit", text) == swiftbot("stop", *robots, "--why", text)
    assert swiftbot("submit", text, "--json") == swiftbot("stop", *robots, "--why", text, "--json")
    assert fleet.stops == [(robots, text)] * 4
    assert fleet.submitted == []


def test_unknown_names_in_words(fleet: Fleet, swiftbot: Any) -> None:
    """They are reported as those of `stop` are."""
    code, out, _ = swiftbot("submit", "stop rovr_1")
    assert code == 4
    assert out.startswith("NOT STOPPED: no robot 'rovr1'; did you mean rover_1?")
    code, out, _ = swiftbot("submit", "stop rovr_1 and drone_1", "--json")
    answer = msgspec.json.decode(out)
    assert (code, answer["unknown"], answer["robots"]) == (1, ["rovr1"], ["drone_1"])
    assert [robots for robots, _ in fleet.stops] == [("drone_1",)]


def test_what_only_looks_like_a_stop_is_a_task(fleet: Fleet, swiftbot: Any) -> None:
    """It is submitted as it is."""
    code, _, _ = swiftbot("submit", "rover_1: stop at dock 1")
    assert code == 0
    assert [each.instruction for each in fleet.submitted] == ["rover_1: stop at dock 1"]
    assert fleet.stops == []


def test_a_dry_run_is_an_estimate_and_says_so(fleet: Fleet, swiftbot: Any) -> None:
    """Way and time by the map, and what hinders the plan; as JSON beside the plan."""
    fleet.known = {"rover_1": RobotInfo(id="rover_1", kind="zenoh", pose=Pose(x=10.0, y=3.0))}
    code, out, _ = swiftbot("plan", "rover_1: go to the dock", "--dry-run")
    assert code == 0
    assert "s1 goto: the site has no place 'dock'" in out
    assert "nothing was simulated" in " ".join(out.split())
    code, out, _ = swiftbot("plan", "rover_1: go to the dock", "--dry-run", "--json")
    found = msgspec.json.decode(out)
    assert [each["subtask"] for each in found["estimate"]["steps"]] == ["s1"]
    assert found["plan"]["subtasks"][0]["skill"] == "goto"
    assert not fleet.submitted


def test_plan_says_that_it_is_a_stop(fleet: Fleet, swiftbot: Any) -> None:
    """Nothing is stopped, and no error is shown."""
    said = " (soft stop; `swiftbot submit` or `swiftbot stop` carries it out)\n"
    assert swiftbot("plan", "Rover_1 stop") == (0, f"stop: rover_1{said}", "")
    assert swiftbot("plan", "stop!") == (0, f"stop: all robots{said}", "")
    _, out, _ = swiftbot("plan", "Rover_1 stop", "--json")
    assert msgspec.json.decode(out) == {"decision": "stop", "robots": ["rover_1"]}
    assert fleet.stops == []


# --- plans that wait --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [(), ("--json",)])
@pytest.mark.parametrize(
    ("end", "failure", "code"),
    [
        (TaskState.SUCCEEDED, None, 0),
        (TaskState.FAILED, Failure(code="unapproved", message="no operator approved its plan within 600 s"), 8),
        (TaskState.FAILED, Failure(code="robot", message="it fell"), 1),
        (TaskState.CANCELLED, None, 7),
    ],
)
def test_a_held_plan_is_shown_at_once(
    fleet: Fleet, swiftbot: Any, options: tuple[str, ...], end: TaskState, failure: Failure | None, code: int
) -> None:
    """With why it waits, the command that approves it, and until when; once, while the command waits on."""
    fleet.holds, fleet.end, fleet.failure = True, end, failure
    ended, _, err = swiftbot("submit", "rover_1: go to dock", "--wait", "--id", "t-7", *options)
    assert ended == code
    assert "goto" in err
    assert "task t-7 waits for approval: it moves a robot that flies" in err
    assert err.count("approve: swiftbot task approve t-7 --hash 0123456789ab") == 1
    assert re.search(r"deadline: \d\d:\d\d:\d\d \(in (599|600) s\)", err)


def test_without_wait_it_is_shown_too(fleet: Fleet, swiftbot: Any) -> None:
    """The command ends and says what is to be done."""
    fleet.holds = True
    code, _, err = swiftbot("submit", "rover_1: go to dock")
    assert code == 0
    assert "swiftbot task approve" in err


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the answers that a person at the terminal will give."""
    answers: list[str] = []
    monkeypatch.setattr(submit, "on_terminal", lambda: True)
    monkeypatch.setattr(submit.console.out, "input", lambda _, **__: answers.pop(0))
    return answers


def test_on_a_terminal_the_plan_is_shown_before_it_runs(fleet: Fleet, swiftbot: Any, terminal: list[str]) -> None:
    """It is planned once, and approved as it was shown."""
    terminal += ["y"]
    code, out, err = swiftbot("submit", "rover_1: go to dock", "--wait")
    assert code == 0
    assert "held: it moves a robot that flies" in out
    assert "goto" in out
    assert "swiftbot task approve" not in err
    assert [each.approval for each in fleet.submitted] == [Approval.ALWAYS]
    assert fleet.approved == [None]


@pytest.mark.parametrize("said", ["n", "", "nonsense"])
def test_anything_but_yes_runs_nothing(fleet: Fleet, swiftbot: Any, terminal: list[str], said: str) -> None:
    """The plan is rejected, with an exit code of its own."""
    terminal += [said]
    code, _, _ = swiftbot("submit", "rover_1: go to dock")
    assert (code, fleet.approved, fleet.rejected) == (8, [], 1)


def test_yes_json_and_stops_ask_nothing(fleet: Fleet, swiftbot: Any, terminal: list[str]) -> None:
    """A script's options, and a stop, which must not wait."""
    assert swiftbot("submit", "rover_1: go to dock", "--yes")[0] == 0
    assert swiftbot("submit", "rover_1: go to dock", "--json")[0] == 0
    assert swiftbot("submit", "stop")[0] == 0
    assert [each.approval for each in fleet.submitted] == [Approval.NEVER] * 2
    assert terminal == []


def test_a_plan_is_edited(
    fleet: Fleet, swiftbot: Any, terminal: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    """In the editor of the environment; an invalid one is not taken, and the question is put again."""
    editor = tmp_path / "editor"
    editor.write_text('#!/bin/sh\nsed -i s/dock/gate/ "$1"\n')
    editor.chmod(0o755)
    monkeypatch.setenv("VISUAL", str(editor))
    terminal += ["e", "y"]
    assert swiftbot("submit", "rover_1: go to dock")[0] == 0
    (edited,) = fleet.approved
    assert edited is not None
    assert edited.subtasks[0].params == {"place": "gate"}
    fleet.invalid = ("no place 'gate'",)
    terminal += ["e", "y"]
    _, _, err = swiftbot("submit", "rover_1: go to dock")
    assert "invalid plan: no place 'gate'" in err
    assert fleet.approved[1:] == [None]
