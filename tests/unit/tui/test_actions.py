"""The registry of actions, the grammar of the `:` line, and each action on a fake fleet."""

import ast
import asyncio
import contextlib
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import ConfigError, SwiftbotError
from appliance.model import Enquiry, SoftStop
from appliance.model.pool_api import Evicted, Released, Warmed
from appliance.model.robot_api import StopAnswer
from appliance.model.task_api import DrainState, Migrated, TaskWhy
from appliance.model.transfer_api import Brought
from appliance.tui import command_line, status_styles
from appliance.tui.actions import ACTIONS, BY_NAME, SCREENS, keymap
from appliance.tui.app import SwiftbotApp
from appliance.tui.command_line import Filter
from appliance.tui.replay import ReplayView
from appliance.tui.screens.submit import SubmitDialog
from appliance.tui.settings import TuiConfig
from appliance.tui.widgets.dialogs import ConfirmDialog, TextDialog
from appliance.tui.widgets.grid import Grid

from .pictures import characters, settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
SIZE = (80, 24)
UNLOCKED = TuiConfig(write=True)


# --- the registry ----------------------------------------------------------------------------------------------


def test_each_action_is_whole() -> None:
    """Names are unique, each does something, what is dangerous writes and says what will happen."""
    assert len(BY_NAME) == len(ACTIONS)
    for action in ACTIONS:
        assert action.help
        assert action.call or action.function is not None, action.name
        assert action.writes or not action.dangerous, action.name
        if action.dangerous:
            sentence = action.sentence({each.name: f"<{each.name}>" for each in action.takes})
            assert "{" not in sentence
            assert "?" in sentence
            assert "{" not in action.sentence({})


def test_keys_do_not_clash() -> None:
    """On every screen a key is one action, and all screens have their number."""
    keymap({})
    for number, name in enumerate(SCREENS):
        assert BY_NAME[name].keys == (str(number),)


def test_own_keys_are_checked() -> None:
    """Keys of a person's own must be of an action that there is, be some, and clash with none."""
    assert keymap({"palette": "f2, ctrl+k"}) == {"palette": "f2,ctrl+k"}
    with pytest.raises(ConfigError, match="no action"):
        keymap({"fly": "f"})
    with pytest.raises(ConfigError, match="no key"):
        keymap({"cancel": ""})
    with pytest.raises(ConfigError, match="is both"):
        keymap({"drain": "u"})


def test_each_action_that_changes_something_is_done_on_a_real_fleet(project_root: Path) -> None:
    """Whatever changes the fleet or a plan under review has a test that says it `does` it, and is held to it there."""
    changing = {
        each.name
        for each in ACTIONS
        if each.writes or ({"review", "takeover"} & set(each.screens) and not each.long)  # that is only read
    }
    folder = project_root / "tests" / "integration" / "tui"
    said = {
        word.value
        for tests in folder.glob("test_orders*.py")
        for test in ast.parse(tests.read_text()).body
        if isinstance(test, ast.AsyncFunctionDef)
        for mark in test.decorator_list
        if isinstance(mark, ast.Call) and isinstance(mark.func, ast.Name) and mark.func.id == "does"
        for word in mark.args
        if isinstance(word, ast.Constant)
    }
    assert changing == said


# --- grammar -----------------------------------------------------------------------------------------------------


def test_command_line_is_read() -> None:
    """Arguments stand in order; those not written come from what is selected; what nobody gave is missing."""
    command = command_line.read("migrate t-1/s2 gw-2", {"gateway": "gw-9"})
    assert (command.action.name, command.given) == ("migrate", {"subtask": "t-1/s2", "gateway": "gw-2"})
    command = command_line.read("cancel", {"task": "t-1"})
    assert command.given == {"task": "t-1"}
    assert not command.missing
    assert [each.name for each in command_line.read("cancel", {}).missing] == ["task"]
    assert command_line.read("sub  go  to 'the gate' ", {}).given == {"instruction": "go  to 'the gate'"}
    assert command_line.read("stop", {"robot": "r1"}).given == {}, "a stop of the fleet is not narrowed by a selection"
    assert command_line.read("resume-robots", {"robot": "r1"}).given == {"robot": "r1"}
    for line in ("", "fly away", "theme a b", "s"):
        with pytest.raises(command_line.UsageError):
            command_line.read(line, {})


def test_completion_knows_the_fleet(view: "FakeView") -> None:
    """Tab completes commands, then what their arguments may be by kind, what begins so first."""
    complete = command_line.complete
    assert "drain " in complete("dr", view.store, {})
    assert complete("drain ", view.store, {}) == ("drain gw-a", "drain gw-b")
    assert complete("migrate t-running/s1 gw", view.store, {}) == (
        "migrate t-running/s1 gw-a",
        "migrate t-running/s1 gw-b",
    )
    assert complete("cancel done", view.store, {}) == ("cancel t-done",)
    assert complete("warm ", view.store, {}) == ("warm base", "warm vision")
    assert complete("theme li", view.store, {"theme": ("light", "dark")}) == ("theme light",)
    assert complete("submit fly", view.store, {}) == ()
    assert complete("nonsense ", view.store, {}) == ()


@settings(deadline=None)
@given(line=st.text(max_size=60))
def test_any_line_is_a_command_or_an_error(line: str) -> None:
    """Whatever is typed is a command or a usage error, and never has more words than were written."""
    assert len(command_line.words(line)) <= len(line)
    with contextlib.suppress(SwiftbotError):
        assert command_line.read(line, {}).action in ACTIONS


def test_filter_is_an_expression() -> None:
    """A filter is a regular expression without regard to case, `!` turns it round, a broken one is plain text."""
    assert Filter("^GW-[ab]$").matches("gw-a")
    assert not Filter("!gw").matches("a gw here")
    assert Filter("!gw").matches("robot")
    assert Filter("").matches("all")
    assert not Filter("")
    broken = Filter("a[")
    assert broken.note
    assert broken.matches("x A[ y")
    assert not broken.matches("a")


@settings(deadline=None)
@given(pattern=st.text(alphabet="a+*(){}[]|\\?.^$0,1", max_size=12), line=st.text(alphabet="ab", max_size=40))
def test_any_filter_answers(pattern: str, line: str) -> None:
    """Any text is a filter, its answer comes, and turned round it is the other one."""
    plain, inverse = Filter(pattern), Filter(f"!{pattern}")
    if plain:
        assert plain.matches(line) is not inverse.matches(line)


@settings(deadline=None)
@given(state=st.text(max_size=100))
def test_unknown_states_have_a_sign(state: str) -> None:
    """A state that this version does not know is shown by its name, with one cell for the glyph."""
    for of in (status_styles.task, status_styles.subtask, status_styles.container, status_styles.level):
        sign = of(state)
        assert len(sign.glyph) == 1
        assert sign.word


# --- each action on a fake fleet ---------------------------------------------------------------------------------


DRAINING = DrainState(gateway="gw-a", draining=True, done=False, moved=0, ended=0, left=())
CASES = [
    ("1", "d", "drain", ("gw-a", 0.0), DRAINING, "gw-a drains: 0 runs moved away, 0 ended there, 0 left"),
    ("1", "u", "undrain", ("gw-a",), replace(DRAINING, draining=False), "gw-a accepts runs"),
    ("4", "e", "pool_evict", ("c1", ""), {"gw-a": Evicted(containers=("c1",))}, "gw-a evicted c1"),
    ("3", "x", "stop", (("drone-1",),), StopAnswer(stops=(), robots=("drone-1",)), "holding: drone-1"),
    ("3", "z", "resume_robots", (("drone-1",),), StopAnswer(stops=()), "drone-1 may move again"),
    ("3", "Z", "resume_robots", ((),), StopAnswer(stops=()), "all robots may move again"),
    ("3", "f8", "stop", ((),), StopAnswer(stops=(), silent=("gw-b",)), "not confirmed by gw-b"),
]


@pytest.mark.parametrize(("screen", "key", "verb", "arguments", "answer", "told"), CASES)
async def test_key_does_its_action(
    view: "FakeView", screen: str, key: str, verb: str, arguments: tuple[object, ...], answer: object, told: str
) -> None:
    """A key orders its action of the row under the cursor, after a yes where it is dangerous, and its end is shown."""
    view.orders.answers[verb] = answer
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press(screen)
        await settle(app, pilot)
        await pilot.press(key)
        await pilot.pause()
        assert app.front is not None
        scope = app.front.scope
        action = next(each for each in ACTIONS if key in each.keys and each.here(scope))
        if action.dangerous:
            assert isinstance(app.screen, ConfirmDialog)
            assert view.orders.of(verb) == []
            await pilot.press("y")
        await settle(app, pilot)
        assert view.orders.of(verb) == [arguments]
        assert told in " ".join(entry.text for entry in view.store.entries)


async def test_only_stops_that_were_seen_are_lifted(view: "FakeView") -> None:
    """One that is given while the question is open is not among those that a yes lifts."""
    view.orders.answers["resume_robots"] = StopAnswer(stops=())
    view.store.take_stops((SoftStop(id="seen", by="ann"),))
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("3")
        await settle(app, pilot)
        await pilot.press("z")
        await pilot.pause()
        assert isinstance(app.screen, ConfirmDialog)
        view.store.take_stops((SoftStop(id="unseen", by="bob"),))
        await pilot.press("y")
        await settle(app, pilot)
        assert view.orders.of("resume_robots") == [(("drone-1",),)]
        assert view.orders.options["resume_robots"] == {"stops": ["seen"], "why": ""}


LINES = [
    (
        "migrate t-running/s2 gw-b",
        "migrate",
        Migrated(task="t", subtask="s2", moved=True, source="gw-a", target="gw-b"),
        "s2 moved from gw-a to gw-b",
    ),
    ("warm base 2 gw-b", "pool_warm", Warmed(image="base", ready=2, starting=0), "gw-b: 2 of base ready"),
    ("fetch localhost/x:1 gw-b", "image_fetch", Brought(what="image/x"), "image/x is on gw-b"),
    ("release base", "pool_release", {"gw-a": Released(image="base", reason="it died")}, "it died"),
]
_KEYS = {" ": "space", "/": "slash", ":": "colon", "-": "minus", ".": "full_stop"}


@pytest.mark.parametrize(("line", "verb", "answer", "told"), LINES)
async def test_line_does_its_action(view: "FakeView", line: str, verb: str, answer: object, told: str) -> None:
    """A command line does the same from any screen."""
    view.orders.answers[verb] = answer
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press("colon", *(_KEYS.get(each, each) for each in line), "enter")
        await settle(app, pilot)
        assert len(view.orders.of(verb)) == 1
        assert told in " ".join(entry.text for entry in view.store.entries)


async def test_another_model_is_asked_about_first(view: "FakeView") -> None:
    """Swapping a gateway's model takes its folder from the line, asks, and tells which model went and came."""
    view.orders.answers["swap_model"] = SimpleNamespace(before="old", after="new", ms=1.0, tests=())
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("5")
        await settle(app, pilot)
        await pilot.press("m", "slash", "m", "enter")
        await pilot.pause()
        assert isinstance(app.screen, ConfirmDialog)
        await pilot.press("y")
        await settle(app, pilot)
        assert view.orders.of("swap_model") == [("gw-a", "/m")]
        assert any("plans with new instead of old" in entry.text for entry in view.store.entries)


async def test_why_is_to_be_read(view: "FakeView") -> None:
    """Why a task was served where it was is shown in a window of its own, also while read-only."""
    view.orders.answers["why"] = TaskWhy(id="t-running", state="running", coordinator="gw-a", subtasks=())
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await settle(app, pilot)
        await pilot.press("2", "y")
        text = await settle(app, pilot)
        assert isinstance(app.screen, TextDialog)
        assert "coordinated by gw-a" in text
        await pilot.press("escape")
        await pilot.pause()
        assert not isinstance(app.screen, TextDialog)


async def test_stop_works_read_only_and_while_writing(view: "FakeView") -> None:
    """F8 stops the fleet at once: locked, in the middle of a command, and behind a dialog; it asks nothing."""
    view.orders.answers["stop"] = StopAnswer(stops=())
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("f8")
        await settle(app, pilot)
        await pilot.press("colon", *"dra", "f8")
        await settle(app, pilot)
        assert app.front is not None
        assert app.front.prompt.field.value == "dra", "what was being written is lost"
        await pilot.press("escape", "question_mark")
        await pilot.pause()
        await pilot.press("f8")
        await settle(app, pilot)
        assert len(view.orders.of("stop")) == 3


async def test_stop_reaches_the_fleet_behind_a_recorded_log(view: "FakeView") -> None:
    """While a log is shown nothing of it can be ordered, and F8 still stops the fleet that is heard behind it."""
    view.orders.answers["stop"] = StopAnswer(stops=())
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        app.do_open({"file": str(Path(__file__).parents[2] / "replay" / "logs" / "demo.mcap")})
        while not isinstance(app.view, ReplayView):
            await pilot.pause(0.05)
        await pilot.press("f8")
        await settle(app, pilot)
        assert len(view.orders.of("stop")) == 1


async def test_what_is_missing_is_asked_for(view: "FakeView") -> None:
    """An action that needs more than is selected opens the line with what is known and says what is missing."""
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("1", "colon", *"fetch", "enter")
        text = await settle(app, pilot)
        assert "reference? :fetch REFERENCE GATEWAY" in text
        assert app.front is not None
        assert app.front.prompt.field.value == "fetch "


async def test_the_waiting_question_is_answered_whichever_robot_is_selected(view: "FakeView") -> None:
    """`A` takes the selected robot's question, else the oldest; who asks what is said, or that nobody asks."""
    answered = Enquiry(id="q-0", robot="rover-1", question="old?", answer="yes", at_ns=1)
    view.store.enquiries.put("q-0", answered)
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("3")
        assert app.front is not None
        robots = app.front.query_one("#robots", Grid)
        await settle(app, pilot)
        assert robots.selected == "drone-1"
        await pilot.press("A")
        await settle(app, pilot)
        assert [each.message for each in app._notifications] == ["nothing is asked"]
        assert not app.front.prompt.display
        view.store.enquiries.put(
            "q-2", Enquiry(id="q-2", robot="rover-1", question="Is the \x1b[31mway clear?", at_ns=3)
        )
        view.store.enquiries.put("q-1", Enquiry(id="q-1", robot="rover-2", question="Which box?", at_ns=2))
        await settle(app, pilot)
        await pilot.press("A")
        assert "rover-2 asks: Which box? · answer?" in await settle(app, pilot)
        assert app.front.prompt.field.value == "answer q-1 "
        await pilot.press("escape", "down")
        await settle(app, pilot)
        assert robots.selected == "rover-1"
        await pilot.press("A")
        assert "rover-1 asks: Is the ␛[31mway clear?" in await settle(app, pilot)
        assert app.front.prompt.field.value == "answer q-2 "
        view.orders.answers["answer"] = replace(answered, id="q-2", answer="no")
        await pilot.press(*"no", "enter")
        await settle(app, pilot)
    assert view.orders.of("answer") == [("q-2", "no")]


async def test_history_and_tab(view: "FakeView") -> None:
    """Tab completes what is written, the arrows bring back lines written before and what was being written."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("colon", *"read", "enter")
        await pilot.press("colon", *(_KEYS.get(each, each) for each in "theme blind-l"))
        await pilot.pause()
        await pilot.press("tab")
        assert app.front is not None
        field = app.front.prompt.field
        assert field.value == "theme blind-light"
        await pilot.press("up")
        assert field.value == "read"
        await pilot.press("down")
        assert field.value == "theme blind-light"
        await pilot.press("enter")
        await settle(app, pilot)
        assert app.theme == "blind-light"


async def test_same_order_twice_is_one(view: "FakeView") -> None:
    """While an order is under way, the same again is not given; the header tells what is under way."""
    asked = SimpleNamespace(count=0, go=asyncio.Event())

    async def drain(*_: object, why: str) -> DrainState:
        assert not why
        asked.count += 1
        await asked.go.wait()
        return DRAINING

    view.orders.drain = drain
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=(100, 24)) as pilot:
        await pilot.press("1")
        await pilot.pause()
        for _ in range(2):
            await pilot.press("d", "y")
            await pilot.pause()
        app.draw(force=True)
        await pilot.pause()
        assert "… drain gw-a" in characters(app)
        asked.go.set()
        await settle(app, pilot)
        assert asked.count == 1


async def test_defect_of_an_order_does_not_end_the_ui(view: "FakeView") -> None:
    """An order that breaks in a way nobody thought of is reported, and the UI goes on."""
    app = SwiftbotApp(view, UNLOCKED)
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await settle(app, pilot)
        await pilot.press("1", "u")
        text = await settle(app, pilot)
        assert "internal error" in text
        assert app.is_running


async def test_mouse_does_the_same(view: "FakeView") -> None:
    """A click on a screen's name shows it, and on a row selects it."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        text = await settle(app, pilot)
        await pilot.click(offset=(text.split("\n")[1].index("2 "), 1))
        await settle(app, pilot)
        assert app.current_mode == "tasks"
        await pilot.press("3")
        await settle(app, pilot)
        assert app.front is not None
        await pilot.click("#robots", offset=(5, 2))
        await settle(app, pilot)
        assert app.front.chosen()["robot"] == "rover-1"


async def test_gateway_is_drilled_into_and_left(view: "FakeView") -> None:
    """Enter shows one gateway whole, Esc goes back, and the number of the screen does as well."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await settle(app, pilot)
        await pilot.press("1", "enter")
        text = await settle(app, pilot)
        for expected in ("› gw-a", "local:tiny, rules", "base:1", "busy", "drone-1"):
            assert expected in text
        await pilot.press("escape")
        assert "›" not in (await settle(app, pilot)).split("\n")[1]
        await pilot.press("down", "enter")
        assert "podman.socket is absent" in await settle(app, pilot)
        await pilot.press("1")
        assert "› gw-b" not in (await settle(app, pilot)).split("\n")[1]


async def test_a_stop_in_words_stops(view: "FakeView") -> None:
    """In the dialog of instructions, and on the command line read-only too, a text that says to stop is the stop."""
    view.orders.answers["stop"] = StopAnswer(stops=(), robots=("drone-1",))
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=(120, 30), notifications=True) as pilot:
        await pilot.press("s")
        await pilot.pause()
        await pilot.press(*"STOP!", "enter")
        await app.workers.wait_for_complete()
        await pilot.pause()
        assert not isinstance(app.screen, SubmitDialog)
        assert view.orders.of("stop") == [((),)]
        assert view.orders.options["stop"] == {"why": "STOP!"}
        assert "holding: drone-1" in characters(app)
        app.unlocked = False
        app.run_line("submit drone 1: stop")
        await app.workers.wait_for_complete()
        assert view.orders.of("stop")[1:] == [(("drone-1",),)]
        app.run_line("submit drone-1: go to gate")
        app.run_line("submit stop drone-7")
        await app.workers.wait_for_complete()
        await pilot.pause()
        assert "NOT STOPPED: no robot 'drone7'" in " ".join(characters(app).split())
        assert len(view.orders.of("stop")) == 2
        assert not view.orders.of("plan")
        assert not view.orders.of("submit")
