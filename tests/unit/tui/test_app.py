"""The terminal UI under Textual's pilot, 80 columns by 24 lines, on a fake view."""
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportUnknownMemberType=false, reportUnknownArgumentType=false

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import pytest
from msgspec.structs import replace

from appliance.errors import PlanError, RefusedError, UnreachableError
from appliance.model import LogLine, Notice, RunEvent, RunEventKind, TaskRecord, TaskState, encode
from appliance.model.recorder_api import RecorderStatus
from appliance.model.roles import Role
from appliance.tui.actions import ACTIONS
from appliance.tui.app import OperationProvider, SwiftbotApp
from appliance.tui.screens.submit import SubmitDialog
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Connection
from appliance.tui.subscriptions import Hearing
from appliance.tui.widgets.dialogs import ConfirmDialog, HelpDialog
from appliance.tui.widgets.grid import Grid

from .pictures import characters, settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
SIZE = (80, 24)
UNLOCKED = TuiConfig(write=True)


async def test_fleet_is_shown_at_80_by_24(view: "FakeView") -> None:
    """The first screen has gateways with load and pool, and what is wrong, in whole sentences."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("1")
        text = await settle(app, pilot)
        for expected in ("gw-a", "42%", "3/4", "test · 2 gw · 2 robots · 1 active", "[R] read-only"):
            assert expected in text
        assert "gw-b: podman.socket is absent" in text
        assert "limits are not enforced" in text
        assert "2 bad inputs refused (payload 2)" in text


async def test_robots_are_shown_at_80_by_24(view: "FakeView") -> None:
    """Robots stand with kind, mode, battery, place and whether they are there."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("3")
        text = await settle(app, pilot)
        for expected in ("drone-1", "GUIDED armed", "81%", "1.0 2.0 10.0", "✘ offline"):
            assert expected in text


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (
            RecorderStatus(id="r", fleet="t", state="recording", file="a.mcap", messages=7),
            "✔ recorder r: 7 messages in",
        ),
        (
            RecorderStatus(id="r", fleet="t", state="paused", problem="the disk is full", missed={"gw/*/log": 3}),
            "✘ recorder r: the disk is full, missed 3 messages of keys gw/*/log 3",
        ),
        (
            RecorderStatus(id="r", fleet="t", state="recording", missed={"gw/*/log": 3, "robot/*/mavlink/*": 1500}),
            "missed 1,503 messages of keys robot/*/mavlink/*",
        ),
        (RecorderStatus(id="r", fleet="t", state="recording", missed={"gw/*/log": 3}), "▲ log misses 3"),
        (RecorderStatus(id="r", fleet="t", state="silent"), "▲ recorder r: not heard any more"),
    ],
)
async def test_recorder_is_shown(view: "FakeView", status: RecorderStatus, expected: str) -> None:
    """Whether the recorder records, has lost something, or is gone, stands on the first screen."""
    view.store.recorders.put(status.id, status)
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("1")
        assert expected in await settle(app, pilot)


async def test_tasks_are_shown_with_the_plan_graph(view: "FakeView") -> None:
    """The task screen draws the selected task's plan with state, place, phase, times, progress and failure."""
    app = SwiftbotApp(view)
    async with app.run_test(size=(80, 40)) as pilot:
        await pilot.press("2")
        text = await settle(app, pilot)
        for expected in (
            "t-running",
            "✔ s1 takeoff",
            "└─▶ ● s2 goto drone-1",
            "50%",
            "local warm · start 3.2 ms · took 1.5 s",
            "gw-b · remote warm · start 9.5 ms · attempt 2 · leg 1 of 2",
            "after s2, s3",
            "coordinated by gw-a",
            "the camera does not answer → switch rover-1 on",
        ):
            assert expected in text
        await pilot.press("down")
        assert "greet" in (await settle(app, pilot)).split("t-done")[-1]


async def test_pool_is_shown(view: "FakeView") -> None:
    """The pool screen has the containers of all gateways with what they run."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("4")
        text = await settle(app, pilot)
        for expected in ("c1", "base:1", "busy", "c2", "vision:1", "ready"):
            assert expected in text


async def test_log_grows_and_is_filtered(view: "FakeView") -> None:
    """The log screen adds lines as they come, and shows only those with the filter's text."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("7")
        view.store.take_notice(Notice(id="n1", to="ops", text="inspection done", at_ns=10**18))
        assert "inspection done" in await settle(app, pilot)
        view.store.take_notice(Notice(id="n2", to="ops", text="battery low", at_ns=10**18))
        text = await settle(app, pilot)
        assert text.count("inspection done") == 1
        assert "battery low" in text
        await pilot.press("slash", *"battery")
        text = await settle(app, pilot)
        assert "inspection done" not in text
        assert "battery low" in text
        await pilot.press("escape")
        assert "inspection done" in await settle(app, pilot)


async def test_log_begins_at_its_newest_line(view: "FakeView") -> None:
    """Shown for the first time, with more lines than the window has, the log stands at the newest and follows."""
    for number in range(100):
        view.store.add(10**18, kind="log", level="info", source="gw-a", text=f"line {number}.")
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("7")
        text = await settle(app, pilot)
        assert "line 99." in text
        assert "line 0." not in text


async def test_log_has_whose_lines_it_is_and_no_signs_of_life(view: "FakeView") -> None:
    """A line that names nobody is its gateway's, by the key it came on; that a run is alive is no line."""
    hearing = Hearing(view.store, "test")
    line = LogLine(at_ns=1, level="info", source="", event="container ready")
    assert hearing.hear("swiftbot/test/gw/gw-b/log", encode(line), 1)
    for kind in (RunEventKind.ALIVE, RunEventKind.STARTED):
        view.store.take_run(RunEvent(task="t", subtask="s", attempt=1, kind=kind, gateway="gw-b"), 1)
    assert [(each.source, each.kind) for each in view.store.entries] == [("gw-b", "log"), ("gw-b", "run")]


async def test_rows_are_filtered_per_screen(view: "FakeView") -> None:
    """A filter hides the rows without its text, on its own screen only; Enter keeps it, Escape ends it."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2", "slash", *"greet", "enter")
        await settle(app, pilot)
        table = app.screen.query_one("#tasks", Grid)
        assert list(table.keys) == ["t-done"]
        assert "greet" in characters(app).split("\n")[-2]
        await pilot.press("4")
        await settle(app, pilot)
        assert len(app.screen.query_one("#containers", Grid).keys) == 2
        await pilot.press("2", "escape")
        await settle(app, pilot)
        assert len(table.keys) == 2


async def test_submit_shows_the_plan_first(view: "FakeView") -> None:
    """Enter plans and shows the plan; only a second Enter runs it, with that very plan, and the task is selected."""
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("s", *"look", "enter")
        text = await settle(app, pilot)
        assert view.orders.of("plan") == [("look",)]
        assert view.orders.of("submit") == []
        assert "inspection: 4 subtasks, 2 at once" in text
        assert "└─▶ s2 goto drone-1" in text
        await pilot.press("enter")
        text = await settle(app, pilot)
        assert [(instruction, plan.domain) for instruction, plan, _ in view.orders.of("submit")] == [
            ("look", "inspection")
        ]
        assert app.current_mode == "tasks"
        assert app.screen.query_one("#tasks", Grid).selected == view.orders.of("submit")[0][2]


async def test_editing_withdraws_the_plan(view: "FakeView") -> None:
    """A plan that was shown is not run for an instruction edited since: it is replanned."""
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("s", *"a", "enter")
        await settle(app, pilot)
        await pilot.press("b", "enter")
        await settle(app, pilot)
        assert view.orders.of("plan") == [("a",), ("ab",)]
        assert view.orders.of("submit") == []
        await pilot.press("escape")
        await pilot.pause()
        assert not isinstance(app.screen, SubmitDialog)
        assert view.orders.of("submit") == []


async def test_no_plan_is_explained(view: "FakeView") -> None:
    """An instruction without a plan shows every problem and the remedy, and nothing runs."""
    view.orders.error = PlanError("no valid plan", remedy="name the robot", problems=("s1: no robot 'bob'",))
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("s", *"x", "enter")
        text = await settle(app, pilot)
        for expected in ("no valid plan", "s1: no robot 'bob'", "name the robot"):
            assert expected in text
        await pilot.press("enter")
        await settle(app, pilot)
        assert view.orders.of("submit") == []


async def test_submitting_again_is_the_same_task(view: "FakeView") -> None:
    """After an answer that did not come, Enter submits again under the same task id."""
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("s", *"x", "enter")
        await settle(app, pilot)
        view.orders.error = UnreachableError("no gateway answered", remedy="start one")
        await pilot.press("enter")
        assert "no gateway answered" in await settle(app, pilot)
        view.orders.error = None
        await pilot.press("enter")
        await settle(app, pilot)
        assert len(view.orders.of("submit")) == 2
        assert view.orders.of("submit")[0][2] == view.orders.of("submit")[1][2]


async def test_empty_instruction_is_refused(view: "FakeView") -> None:
    """Enter on nothing asks for an instruction instead of a plan."""
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("s", "space", "enter")
        assert "Write an instruction first" in await settle(app, pilot)
        assert view.orders.of("plan") == []


async def test_cancel_asks_first(view: "FakeView") -> None:
    """`c` asks; n leaves the task alone, y cancels it."""
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2")
        await settle(app, pilot)
        await pilot.press("c")
        await pilot.pause()
        assert isinstance(app.screen, ConfirmDialog)
        assert "Cancel task t-running?" in characters(app)
        await pilot.press("n")
        await settle(app, pilot)
        assert view.orders.of("cancel") == []
        await pilot.press("c", "y")
        await settle(app, pilot)
        assert view.orders.of("cancel") == [("t-running",)]


async def test_cancel_elsewhere_does_nothing(view: "FakeView") -> None:
    """On other screens the key of an action is none."""
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("c")
        await pilot.pause()
        assert not isinstance(app.screen, ConfirmDialog)


async def test_read_only_changes_nothing(view: "FakeView") -> None:
    """Locked, no key and no command changes anything, and it is said how to unlock; unlocked they work."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press("2", "c")
        text = await settle(app, pilot)
        assert "`:write` unlocks" in text
        await pilot.press("s")
        await pilot.press("colon", *"cancel t-running", "enter")
        await settle(app, pilot)
        assert not isinstance(app.screen, ConfirmDialog | SubmitDialog)
        await pilot.press("colon", *"write", "enter")
        assert "[W] unlocked" in await settle(app, pilot)
        await pilot.press("c", "y")
        await settle(app, pilot)
        assert view.orders.of("cancel") == [("t-running",)]
        await pilot.press("R")
        assert "[R] read-only" in await settle(app, pilot)


async def test_what_the_certificate_does_not_allow_is_locked(view: "FakeView") -> None:
    """A viewer's: nothing is asked of the fleet, and the role that it needs is said; an operator's lets it through."""
    view.role = Role.VIEWER
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press("colon", *"cancel t-running", "enter")
        assert "cancel needs the role operator" in await settle(app, pilot)
        assert not isinstance(app.screen, ConfirmDialog | SubmitDialog)
        view.role = Role.OPERATOR
        await pilot.press("colon", *"drain gw-a", "enter")
        assert "drain needs the role engineer" in await settle(app, pilot)
        await pilot.press("colon", *"cancel t-running", "enter")
        await settle(app, pilot)
        await pilot.press("y")
        await settle(app, pilot)
    assert view.orders.of("cancel") == [("t-running",)]
    assert view.orders.of("drain") == []


async def test_a_viewer_may_stop_the_fleet(view: "FakeView") -> None:
    """By the key and in words: the soft stop is open to every role."""
    view.role = Role.VIEWER
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press("f8")
        await settle(app, pilot)
        await pilot.press("colon", *"submit stop", "enter")
        await settle(app, pilot)
    assert len(view.orders.of("stop")) == 2


async def test_refusal_is_shown_with_its_remedy(view: "FakeView") -> None:
    """What a gateway refuses is shown with cause and remedy, and the UI goes on."""
    view.orders.error = RefusedError("gateway is draining", remedy="ask another")
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press("2")
        await settle(app, pilot)
        await pilot.press("c", "enter")
        text = await settle(app, pilot)
        assert "gateway is draining" in text
        assert "ask another" in text


async def test_lost_connection_has_a_banner(view: "FakeView") -> None:
    """Without a connection a banner names cause and remedy; it goes when the connection is back."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        assert "✘" not in (await settle(app, pilot)).split("\n")[1]
        view.store.tell(
            Connection(
                problem="no gateway of fleet test at tcp/x:1",
                remedy="start one with `swiftbot up`",
                since_ns=10**18,
            )
        )
        text = await settle(app, pilot)
        assert "no gateway of fleet test at tcp/x:1, since " in text
        assert "→ start one with `swiftbot up`" in " ".join(text.split())
        view.store.tell(Connection(connected=True))
        assert "no gateway of fleet" not in await settle(app, pilot)


async def test_what_is_typed_outlives_the_connection(view: "FakeView") -> None:
    """An instruction, its plan and a command line stay while the connection is lost and made again, and go on then."""
    lost = Connection(problem="no gateway", remedy="start one")
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("colon", *"drain gw")
        for connection in (lost, Connection(connected=True)):
            view.store.tell(connection)
            assert "drain gw" in await settle(app, pilot)
        await pilot.press("escape", "s", *"look")
        for connection in (lost, Connection(connected=True)):
            view.store.tell(connection)
            assert "look" in await settle(app, pilot)
        await pilot.press("enter")
        await settle(app, pilot)
        view.store.tell(lost)
        assert "inspection: 4 subtasks" in await settle(app, pilot)
        view.store.tell(Connection(connected=True))
        await pilot.press("enter")
        await settle(app, pilot)
        assert [call[0] for call in view.orders.of("submit")] == ["look"]


async def test_screens_that_are_not_seen_are_idle(view: "FakeView") -> None:
    """A screen behind another draws nothing, asks nothing, whatever comes, and is up to date when it is shown."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2")
        await settle(app, pilot)
        grid = app.screen.query_one("#tasks", Grid)
        await pilot.press("4")
        await settle(app, pilot)
        await pilot.press("1")
        await settle(app, pilot)
        drawn, asked = grid.drawn, len(view.orders.of("pool_decisions"))
        view.store.take_task(TaskRecord(id="t-new", instruction="x", created_ns=9))
        await settle(app, pilot)
        assert (grid.drawn, len(grid.keys)) == (drawn, 2)
        assert len(view.orders.of("pool_decisions")) == asked
        await pilot.press("2")
        assert "t-new" in await settle(app, pilot)


async def test_unchanged_rows_are_not_drawn(view: "FakeView") -> None:
    """Only rows whose thing is another are drawn again: one gateway's new load is one line."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await settle(app, pilot)
        grid = app.screen.query_one("#gateways", Grid)
        before = grid.drawn
        await settle(app, pilot)
        assert grid.drawn == before
        statuses = {name: each.status for name, each in view.store.gateways.items()}
        view.store.take_gateways(statuses | {"gw-a": replace(statuses["gw-a"], load=0.9)}, 2)
        assert "90%" in await settle(app, pilot)
        assert grid.drawn == before + 1


async def test_selection_stays_when_tasks_come(view: "FakeView") -> None:
    """A new task comes to the top and the selection stays on the task it was on."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2", "down")
        await settle(app, pilot)
        table = app.screen.query_one("#tasks", Grid)
        assert table.selected == "t-done"
        view.store.take_task(TaskRecord(id="t-new", instruction="x", state=TaskState.ACCEPTED, created_ns=9))
        await settle(app, pilot)
        assert table.selected == "t-done"
        assert len(table.keys) == 3


async def test_help_lists_every_action(view: "FakeView") -> None:
    """The help shows each action of the one list."""
    app = SwiftbotApp(view)
    async with app.run_test(size=(120, 210)) as pilot:
        await pilot.press("question_mark")
        await pilot.pause()
        assert isinstance(app.screen, HelpDialog)
        text = characters(app)
        for action in ACTIONS:
            assert action.help.split(",")[0][:40] in text
        await pilot.press("escape")
        await pilot.pause()
        assert not isinstance(app.screen, HelpDialog)


async def test_palette_offers_every_action(view: "FakeView") -> None:
    """The command palette is fed by the same list, and running an entry does the action."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        provider = OperationProvider(app.screen)
        commands = {str(hit.display): hit.command async for hit in provider.discover()}
        assert {action.title for action in ACTIONS} == commands.keys()
        assert "Uncordon" in {str(hit.text) async for hit in provider.search("cordon")}
        commands["Pool"]()
        await pilot.pause()
        assert app.current_mode == "pool"


async def test_quit_leaves(view: "FakeView") -> None:
    """`q` ends the UI and closes the view."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("q")
        await pilot.pause()
    assert view.closed
    assert app.return_code == 0


async def test_markup_in_foreign_text_is_text(view: "FakeView") -> None:
    """Brackets in an instruction or a log line are shown as they are, not taken for markup."""
    view.store.take_task(TaskRecord(id="t-x", instruction="[red]go[/] [/bad]", created_ns=9))
    view.store.add(10**18, kind="log", level="info", source="[b]", text="[/nope] done")
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2")
        assert "[red]go[/] [/bad]" in await settle(app, pilot)
        await pilot.press("7")
        assert "[/nope] done" in await settle(app, pilot)


async def test_picture_is_an_svg_of_the_screen(view: "FakeView", tmp_path: Path) -> None:
    """The picture is well-formed SVG with the screen's text and no reference to another machine's fonts."""
    app = SwiftbotApp(view)
    async with app.run_test(size=(100, 30)) as pilot:
        await pilot.press("2")
        await settle(app, pilot)
        app.export_svg(tmp_path / "tui.svg")
    text = (tmp_path / "tui.svg").read_text()
    ET.fromstring(text)  # noqa: S314 - our own file
    assert "t-running" in text
    assert "font-face" not in text
