"""What operators met when they first used the terminal UI: each fault, named, and that it is gone."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from msgspec import convert
from rich.cells import cell_len
from textual.events import Paste
from textual.geometry import Region
from textual.screen import ModalScreen
from textual.widget import Widget
from textual.widgets._toast import Toast
from textual.widgets.input import Selection

from appliance.errors import ConfigError, RefusedError
from appliance.model import Place, Plan, Proposal, RobotInfo, Site, SiteObject, Subtask, TaskRecord, TaskState
from appliance.tui.actions import ACTIONS, SCREENS, keymap
from appliance.tui.app import SwiftbotApp
from appliance.tui.ascii_terminal import in_ascii, needs_ascii
from appliance.tui.part_keys import taken
from appliance.tui.replay import ReplayView
from appliance.tui.screens.review import ReviewScreen
from appliance.tui.screens.submit import InstructionInput, example
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Connection
from appliance.tui.widgets import PromptInput
from appliance.tui.widgets.grid import Grid

from .pictures import settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
SIZE = (80, 24)
LOG = Path(__file__).parents[2] / "replay" / "logs" / "demo.mcap"
LONG = "the gateway does not take it since its pool is full and forty runs wait for a container of that image " * 3


def toasts(app: SwiftbotApp) -> list[Region]:
    """Return where the notices stand that are seen."""
    screen = app.screen
    return [each.region for each in screen.query(Toast) if each.region.intersection(screen.region).area]


@pytest.mark.parametrize("keys", [("2", "c"), ("s",)])
async def test_error_toasts_cover_no_dialog(view: "FakeView", keys: tuple[str, ...]) -> None:
    """Errors of several lines, before a dialog and while it is open, leave all of it to be read; the last is seen."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        app.tell(RefusedError(LONG, remedy=LONG))
        await pilot.pause()
        await pilot.press(*keys)
        for number in range(3):
            app.tell(RefusedError(f"error {number}: {LONG}", remedy=LONG))
        shown = await settle(app, pilot)
        assert isinstance(app.screen, ModalScreen)
        dialog = app.screen.query_one(".dialog").region
        assert toasts(app)
        assert not any(dialog.overlaps(each) for each in toasts(app))
        assert "error 2" in shown
        assert "error 1" not in shown


async def test_toasts_leave_the_alarms_above_to_be_read(view: "FakeView") -> None:
    """However many errors there are, header, tabs and banner stay."""
    view.store.tell(Connection(problem="no gateway answers", remedy="wait"))
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        for number in range(9):
            app.tell(RefusedError(f"error {number}: {LONG}", remedy=LONG))
        shown = await settle(app, pilot)
        assert "no gateway answers" in shown
        assert "error 8" in shown
        assert all(each.intersection(app.screen.region).y > 3 for each in toasts(app))


# --- replay ----------------------------------------------------------------------------------------------------


async def test_keys_of_replay_work_on_every_screen() -> None:
    """Space, arrows, rate and seek drive the log from each screen, whose header says that it is recorded."""
    replay = await ReplayView.open(LOG)
    app = SwiftbotApp(replay)
    async with app.run_test(size=SIZE) as pilot:
        for number in range(len(SCREENS)):
            await pilot.press(str(number), "J", "0", "enter")
            await pilot.pause()
            assert replay.head.position_s(0) == 0.0
            await pilot.press("right_square_bracket")
            at_s = replay.head.position_s(0)
            assert at_s == min(10.0, replay.head.length_s), number
            await pilot.press("left_square_bracket", "space")
            assert not replay.head.paused
            await pilot.press("space", "plus")
            assert replay.head.paused
            assert replay.head.rate > 1
            await pilot.press("minus")
            assert "RECORDED ‖" in await settle(app, pilot)


async def test_keys_of_replay_do_nothing_on_a_fleet(view: "FakeView") -> None:
    """On a fleet they are neither offered nor answered."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press("2", "space", "J", "left", "plus")
        shown = await settle(app, pilot)
        assert "Seek" not in shown
        assert "no log is open" not in shown


def test_no_key_is_taken_by_a_part_of_a_screen() -> None:
    """A table has `g` for its first row: an action of that key alone would never be done; own keys are checked too."""
    for action in ACTIONS:
        for scope in action.screens or SCREENS:
            assert not action.keys or set(action.keys) - taken(scope), (action.name, scope)
    with pytest.raises(ConfigError, match="something else on the screen tasks"):
        keymap({"cancel": "g"})


async def test_parts_of_screens_have_the_keys_of_the_table(view: "FakeView") -> None:
    """Whatever has the focus on a screen takes no key that `part_keys` does not know of."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        for number, name in enumerate(SCREENS):
            await pilot.press(str(number))
            await settle(app, pilot)
            for widget in app.screen.query("#body *").results(Widget):
                if widget.focusable:
                    keys = {key for key, _ in widget._bindings}
                    assert keys <= taken(name) | {"ctrl+c", "super+c"}, (name, widget)


# --- help ------------------------------------------------------------------------------------------------------


async def test_help_says_that_the_stop_needs_no_unlock(view: "FakeView") -> None:
    """Before F8 there is no sign that it needs the UI unlocked; before what does, there is."""
    app = SwiftbotApp(view)
    async with app.run_test(size=(100, 60)) as pilot:
        await pilot.press("1", "question_mark")
        lines = (await settle(app, pilot)).splitlines()
    stop = next(line for line in lines if "F8" in line)
    assert " w " not in stop[:20]
    drain = next(line for line in lines if "Drain a gateway" in line)
    assert "!w" in drain[:20]


# --- writing an instruction --------------------------------------------------------------------------------------


async def test_all_lines_of_a_paste_are_kept(view: "FakeView") -> None:
    """Several lines become orders of one instruction, in the place of what was selected; a filter keeps them too."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("s", *"x y")
        field = app.screen.query_one(InstructionInput)
        field.selection = Selection(3, 2)
        field.post_message(Paste("rover_1: go to dock 1\r\n\n  rover_2: go to dock 2.\nthen wait\n"))
        await settle(app, pilot)
        assert field.value == "x rover_1: go to dock 1; rover_2: go to dock 2. then wait"
        await pilot.press("escape", "slash")
        line = app.screen.query_one(PromptInput)
        line.post_message(Paste("rover\n2"))
        await settle(app, pilot)
        assert line.value == "rover 2"


def test_the_example_is_of_this_fleet() -> None:
    """It names a robot that can go and a place that there is; without either it names none."""
    site = Site(
        name="yard",
        places={"gate": Place(x=1, y=1), "dock": Place(x=2, y=2)},
        objects=(SiteObject(name="red box", colour="red", at="dock"),),
    )
    rover = RobotInfo(id="rover_7", kind="zenoh", verbs=("goto",), uses=("base", "camera"))
    drone = RobotInfo(id="drone_1", kind="mavlink", verbs=("goto",), flies=True)
    gone = RobotInfo(id="a", kind="zenoh", verbs=("goto",), online=False)
    assert example([gone, drone, rover], site) == "e.g. rover_7: go to dock, then photograph the red box"
    assert example([drone], site) == "e.g. drone_1: fly to dock"
    for robots, known in (([], site), ([gone], site), ([rover], None)):
        assert "ROBOT" in example(robots, known)


# --- plans that wait -----------------------------------------------------------------------------------------------


async def test_a_plan_that_waits_is_reached_from_any_row(view: "FakeView") -> None:
    """`a` on a task that waits for nothing opens the plan that waits longest; with none it says so."""
    plan = Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="goto", robot="rover-1"),), confidence=0.9)
    proposal = Proposal(plan=plan, hash="abcdef0123456789", waits=True, note="a look")
    for name, created_ns in (("t-old", 5), ("t-new", 9)):
        waiting = TaskRecord(
            id=name, instruction="go", state=TaskState.PROPOSED, proposal=proposal, created_ns=created_ns
        )
        view.store.take_task(waiting)
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press("2")
        await settle(app, pilot)
        app.screen.query_one("#tasks", Grid).select("t-done")
        await pilot.press("a")
        await settle(app, pilot)
        assert isinstance(app.screen, ReviewScreen)
        assert app.screen.task_id == "t-old"
        await pilot.press("escape")
        for name in ("t-old", "t-new"):
            view.store.forget_task(name)
        await pilot.press("a")
        assert "waits for approval" in await settle(app, pilot)
        assert not isinstance(app.screen, ReviewScreen)


# --- terminals with few signs --------------------------------------------------------------------------------------


def test_signs_have_ascii_in_their_place() -> None:
    """All that the UI draws has a sign of its own, as many cells wide; names in other alphabets stay."""
    files = Path(SwiftbotApp.CSS_PATH).parent.rglob("*.py")
    drawn = {each for file in files for each in file.read_text() if ord(each) >= 0x2000 and each.isprintable()}
    assert {each for each in drawn if in_ascii(each) == "?"} == {"◇", "\ufffd"}
    for each in drawn:
        assert in_ascii(each).isascii()
        assert len(in_ascii(each)) == cell_len(each)
    assert in_ascii("Köln ● 東") == "Köln * ??"


@pytest.mark.parametrize(
    ("glyphs", "term", "encoding", "wanted"),
    [
        ("auto", "xterm", "UTF-8", False), ("auto", "linux", "UTF-8", True), ("auto", "xterm", "ANSI_X3.4", True),
        ("unicode", "linux", "ascii", False), ("ascii", "xterm", "utf8", True), ("auto", "tmux", "utf8", False),
    ],
)  # fmt: skip
def test_poor_terminals_are_known(glyphs: str, term: str, encoding: str, wanted: bool) -> None:
    """The console of Linux and other character sets get ASCII; a person's setting has the last word."""
    config = convert({"glyphs": glyphs}, TuiConfig)
    assert needs_ascii(config, {"TERM": term}, encoding) is wanted
