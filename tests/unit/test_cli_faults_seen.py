"""What operators met when they first used the command line: each fault, named, and that it is gone."""

import asyncio
import json
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Struct

from appliance import cli, console
from appliance.cli import alerts as alerts_commands
from appliance.cli import submit
from appliance.cli.common import complete
from appliance.cli.robots import robot_shown
from appliance.client import FleetClient
from appliance.errors import DeadlineError, SwiftbotError
from appliance.llm.preprocessing import as_typed, each_once
from appliance.model import (
    GatewayStatus,
    Lease,
    Lifted,
    RobotInfo,
    SoftStop,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
)
from appliance.model.alerts import MOST_ACKED, Alert, AlertAck, AlertLevel, AlertList, AlertsAcked, Subject
from appliance.model.planner_api import Analysis
from appliance.model.robot_api import Standing
from appliance.tasks.records import clean
from appliance.tasks.views import WAITS, status


def run(*arguments: str) -> int:
    """Run a command in this process and return its exit code."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    assert isinstance(ended.value.code, int)
    return ended.value.code


# --- JSON ------------------------------------------------------------------------------------------------------


class Inner(Struct, frozen=True, omit_defaults=True, rename={"plain": "renamed"}, tag="kind-a", tag_field="kind"):
    """With a field of another name, and a tag."""

    plain: int = 0


class Outer(Struct, omit_defaults=True):
    """With structs wherever one can be."""

    online: bool = True
    inner: Inner = Inner()
    many: tuple[Inner, ...] = ()
    by_name: dict[str, Inner] = {}


def test_json_has_the_fields_that_have_their_default() -> None:
    """`jq 'select(.online)'` finds the robots that are online; so for every field of every struct, however deep."""
    found = complete(RobotInfo(id="r", kind="zenoh"))
    assert found["online"] is True
    assert set(found) == set(RobotInfo.__struct_fields__)
    planner = complete(GatewayStatus(id="g", fleet="f"))
    assert planner["draining"] is False
    shown = complete(Outer(many=(Inner(),), by_name={"a": Inner(plain=2)}))
    inner = {"kind": "kind-a", "renamed": 0}
    assert shown == {"online": True, "inner": inner, "many": [inner], "by_name": {"a": inner | {"renamed": 2}}}


@given(st.builds(Outer, online=st.booleans(), many=st.tuples(st.builds(Inner, plain=st.integers(-9, 9)))))
def test_json_reads_back_as_what_it_was(value: Outer) -> None:
    """What is added are defaults: the same struct is read from it."""
    assert msgspec.json.decode(msgspec.json.encode(complete(value)), type=Outer) == value


@pytest.mark.parametrize(
    ("words", "code", "kind"),
    [
        (("fleet", "--dir", "/nowhere", "--json"), 4, "not-found"),
        (("task", "list", "--json", "--limit", "many"), 2, "usage"),
        (("task", "lst", "--json"), 2, "usage"),
        (("log", "cat", "--json", "--key", "a?", "x.mcap"), 2, "usage"),
    ],
)
def test_errors_are_json_where_json_is_asked_for(
    words: tuple[str, ...], code: int, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """One object on standard error with kind, message, hint and exit code; nothing on standard output."""
    assert run(*words) == code
    said = capsys.readouterr()
    assert said.out == ""
    error = json.loads(said.err.splitlines()[-1])["error"]
    assert (error["code"], error["exit_code"]) == (kind, code)
    assert error["message"]
    assert set(error) == set(cli.ErrorShown.__struct_fields__)


# --- what is hidden ----------------------------------------------------------------------------------------------


class Asked:
    """A fleet of one gateway, and what comes of asking for its alerts."""

    def __init__(self, alerts: AlertList | SwiftbotError) -> None:
        self._alerts = alerts
        self.plane = SimpleNamespace(registry=SimpleNamespace(gateways={"gw-1": GatewayStatus(id="gw-1", fleet="f")}))

    async def __aenter__(self) -> "Asked":
        return self

    async def __aexit__(self, *_: object) -> None:
        return None

    async def gateway(self) -> str:
        """Return the one there is."""
        return "gw-1"

    async def alerts(self) -> AlertList:
        """Return them, or raise."""
        if isinstance(self._alerts, SwiftbotError):
            raise self._alerts
        return self._alerts


@pytest.mark.parametrize(
    ("alerts", "code", "said"),
    [
        (AlertList(), 0, ""),
        (AlertList(unreachable=("gw-2",)), 1, "gw-2 did not answer"),
        (DeadlineError("no answer to alerts"), 1, "no answer to alerts"),
    ],
)
def test_gateways_are_shown_where_alerts_are_not_known(
    alerts: AlertList | SwiftbotError,
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The list is printed, standard error says what is not known, and a script does not take it for all being there."""
    monkeypatch.setattr(cli.common.Where, "client", lambda _: Asked(alerts))
    assert run("fleet", "--json") == code
    shown = capsys.readouterr()
    assert [each["id"] for each in json.loads(shown.out)] == ["gw-1"]
    assert said in shown.err
    assert bool(shown.err) == bool(said)


class Robots(Asked):
    """A fleet with one robot, whose gateways do not say what is stopped."""

    def __init__(self) -> None:
        super().__init__(AlertList())
        self.plane.registry.robots = {"rover_1": RobotInfo(id="rover_1", kind="zenoh")}

    async def standing(self) -> Standing:
        """Answer nothing."""
        raise DeadlineError("no answer to standing")


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_robots_are_listed_where_stops_are_not_known(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They are listed, say that their stops are not known, and exit code and standard error say so too."""
    monkeypatch.setattr(cli.common.Where, "client", lambda _: Robots())
    assert run("robots", "list", *words) == 1
    shown = capsys.readouterr()
    assert "no answer to standing" in shown.err
    if words:
        assert [(each["id"], each["stopped"], each["stops_known"]) for each in json.loads(shown.out)] == [
            ("rover_1", None, False)
        ]
    else:
        assert "stops not known" in " ".join(shown.out.split())


class Acking(Asked):
    """A fleet where alerts are acknowledged; one more begins as soon as they were listed."""

    def __init__(self, count: int) -> None:
        super().__init__(AlertList(alerts=tuple(self.alert(number) for number in range(count))))
        self.acked: list[tuple[str, ...]] = []

    @staticmethod
    def alert(number: int) -> Alert:
        """Return one."""
        return Alert(id=f"pool.gw-{number}", kind="pool", level=AlertLevel.CRITICAL, what="broken",
                     subject=Subject.GATEWAY, name=f"gw-{number}")  # fmt: skip

    async def acknowledge(self, ids: Sequence[str], *, why: str = "") -> AlertsAcked:
        """Note which."""
        del why
        self.acked.append(tuple(ids))
        return AlertsAcked(alerts=tuple(self.alert(int(each.rpartition("-")[2])) for each in ids))


@pytest.mark.parametrize(("answer", "code", "acked"), [("y", 0, 2), ("", 7, 0), (EOFError, 7, 0)])
def test_on_a_terminal_all_alerts_are_listed_before_they_are_acknowledged(
    answer: Any, code: int, acked: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that were listed, and only when a person says yes; nothing is acknowledged unseen."""
    fleet = Acking(2)

    def said(*_: Any, **__: Any) -> str:
        fleet._alerts = AlertList(alerts=tuple(map(fleet.alert, range(3))))  # one more begins meanwhile
        if isinstance(answer, str):
            return answer
        raise answer

    monkeypatch.setattr(cli.common.Where, "client", lambda _: fleet)
    monkeypatch.setattr(alerts_commands, "on_terminal", lambda: True)
    monkeypatch.setattr(console.out, "input", said)
    assert run("alerts", "ack", "--all") == code
    assert "pool.gw-1" in capsys.readouterr().out
    assert fleet.acked == ([("pool.gw-0", "pool.gw-1")] if acked else [])


def test_more_alerts_than_one_request_takes_are_all_acknowledged() -> None:
    """Each part of them is an order of its own; what came of all of them is one answer."""

    class Client(FleetClient):
        """Answers requests itself."""

        def __init__(self) -> None:
            self.operator = "ann"
            self.asks: list[AlertAck] = []

        async def _ask(self, _verb: Any, ask: Any, **_: Any) -> Any:
            self.asks.append(ask)
            return AlertsAcked(alerts=(Acking.alert(1),), unknown=ask.ids[1:])

    client = Client()
    ids = [f"pool.gw-{number}" for number in range(2 * MOST_ACKED + 1)]
    found = asyncio.run(client.acknowledge(ids))
    assert [len(each.ids) for each in client.asks] == [MOST_ACKED, MOST_ACKED, 1]
    assert len({each.act for each in client.asks}) == 3
    assert len(found.alerts) + len(found.unknown) == len(ids)


def test_a_robot_under_a_stop_says_so() -> None:
    """A stop of the fleet or of it, but for one that was lifted for it; and who has taken it over."""
    rover, drone = (RobotInfo(id=name, kind="zenoh") for name in ("rover_1", "drone_1"))
    stop = SoftStop(id="o-1", by="ann", why="people inside")
    lifted = Lifted(id="o-2", stops=("o-1",), robots=("drone_1",))
    standing = Standing(stops=(stop,), lifted=(lifted,), leases=(Lease(id="l", robot="rover_1", by="eve"),))
    assert robot_shown(rover, standing).stopped == "stopped by ann: people inside"
    assert robot_shown(rover, standing).taken_over == "taken over by eve"
    shown = robot_shown(drone, standing)
    assert (shown.stopped, shown.taken_over) == (None, None)
    assert complete(shown)["online"] is True
    table = console.robot_table([rover], {"rover_1": "stopped by ann"})
    assert list(table.columns[-1].cells) == ["online, stopped by ann"]


def record(state: TaskState = TaskState.RUNNING, **more: Any) -> TaskRecord:
    """Return a task of one subtask."""
    at, note = more.pop("at", SubtaskState.READY), more.pop("note", "")
    subtask = SubtaskRecord(subtask=Subtask(id="s1", skill="goto"), state=at, note=note)
    return TaskRecord(id="t-1", instruction="go", state=state, subtasks=(subtask,), **more)


def test_a_task_that_does_not_move_does_not_say_that_it_runs() -> None:
    """Of a stopped robot's task `paused`, of one that waits for a lost robot `blocked`; what has ended says how."""
    assert status(record(note=f"{WAITS}rover_1: offline")) == "blocked"
    assert status(record(note=f"{WAITS}rover_1: offline", at=SubtaskState.RUNNING)) == "blocked"
    assert status(record(at=SubtaskState.RUNNING)) == "running"
    assert status(record()) == "running"
    assert status(record(TaskState.FAILED, note=f"{WAITS}rover_1: offline")) == "failed"


# --- texts -----------------------------------------------------------------------------------------------------


def test_an_error_says_nothing_twice() -> None:
    """Subtasks with the same problem are named together, and a list of what is known stands once, at the end."""
    reasons = ["s1 (goto): no place moon: it knows a, b", "s4 (goto): no place end: it knows a, b",
               "s3 (goto): no place end: it knows a, b"]  # fmt: skip
    assert each_once(reasons) == ("s1 (goto): no place moon", "s4, s3 (goto): no place end: it knows a, b")
    assert each_once(["a", "b", "a"]) == ("a", "b")


@given(st.lists(st.text(max_size=30) | st.sampled_from(["s1 (a): x", "s2 (a): x", "x: it knows y"]), max_size=6))
def test_no_reason_is_lost(reasons: list[str]) -> None:
    """Each is still said; what was said once is as it was."""
    told = "\n".join(each_once(reasons))
    for reason in reasons:
        assert reason.rpartition(": ")[2].partition(": it knows ")[0] in told


@given(st.text(max_size=80), st.integers(1, 60))
def test_what_is_cut_ends_in_an_ellipsis(text: str, limit: int) -> None:
    """No text is longer than it may be, none ends in mid-word without a sign, and a short one is as it was."""
    found = clean(text, limit)
    assert len(found) <= limit
    assert found.endswith("…") if len(text) > limit else len(found) == len(text)


def test_a_cut_is_between_words() -> None:
    """Where the last word does not fit, it is left out whole."""
    assert clean("go to the dock", 12) == "go to the…"
    assert clean("x" * 100, 10) == "x" * 9 + "…"


def test_spoken_words_keep_their_capitals() -> None:
    """A text that is read out is as it was typed, what is quoted first; what does not stand there stays."""
    assert as_typed("hello world", 'rover_1: say "Hello World"') == "Hello World"
    assert as_typed("hello world", "HELLO  world, he said") == "HELLO world"
    assert as_typed("dock", 'Dock: say "DOCK"') == "DOCK"
    assert as_typed("ello", "Hello") == "ello"
    assert as_typed("", "Hello") == ""


def test_a_duration_that_nobody_measured_is_not_told() -> None:
    """Three seconds for any way would be a figure out of the air."""
    assert "30 s" in console.expected_text(Analysis(domain="navigation", expected_s=30.0))
    told = console.expected_text(Analysis(domain="navigation", expected_s=3.0, unmeasured=("goto",)))
    assert "3 s" not in told
    assert "goto" in told


# --- the terminal UI and interrupts --------------------------------------------------------------------------------


def test_the_terminal_ui_needs_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """With a pipe in the place of one it writes no screen, but what is wrong."""
    assert run("tui", "--connect", "tcp/127.0.0.1:1") == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "needs a terminal" in said.err


class Followed(submit.Submitting):
    """A task that is followed until it is interrupted, once or more."""

    def __init__(self, interrupts: int) -> None:
        super().__init__(TaskRequest(instruction="go", id="t-1"), cli.common.HERE, wait=True, quiet=False)
        self._asks = True
        self.interrupts = interrupts
        self.cancelled = 0

    async def _run(self) -> TaskRecord:
        return await self._again()

    async def _again(self) -> TaskRecord:
        self._following = True
        if self.interrupts:
            self.interrupts -= 1
            raise KeyboardInterrupt
        await asyncio.sleep(0)
        return record(TaskState.SUCCEEDED)

    async def _looked(self) -> TaskRecord:
        return record()

    async def _called_off(self) -> None:
        self.cancelled += 1


@pytest.mark.parametrize(
    ("answers", "ends", "cancelled"),
    [
        (["d"], TaskState.RUNNING, 0),
        (["w", ""], TaskState.SUCCEEDED, 0),
        (["w", "c"], None, 1),
        ([KeyboardInterrupt], None, 1),
        ([EOFError], TaskState.RUNNING, 0),
    ],
)
def test_an_interrupt_offers_to_detach(
    answers: list[Any], ends: TaskState | None, cancelled: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Detached (Ctrl-D too), the task continues; waiting follows it again; a second Ctrl-C cancels it."""
    said = iter(answers)

    def answer(*_: Any, **__: Any) -> str:
        found = next(said)
        if isinstance(found, str):
            return found
        raise found

    monkeypatch.setattr(console.err, "input", answer)
    followed = Followed(len(answers))
    if ends is None:
        with pytest.raises(KeyboardInterrupt):
            followed.run()
    else:
        found = followed.run()
        assert isinstance(found, TaskRecord)
        assert found.state is ends
    assert followed.cancelled == cancelled
