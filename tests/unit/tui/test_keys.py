"""Every control key has a name under which it is given another key: terminal multiplexers take many of them."""

from typing import TYPE_CHECKING

import pytest
from textual.command import CommandPalette

from appliance.errors import ConfigError
from appliance.tui.actions import DIALOG_KEYS, SCREENS, keymap, names
from appliance.tui.app import SwiftbotApp
from appliance.tui.screens.submit import SubmitDialog
from appliance.tui.settings import TuiConfig
from appliance.tui.widgets import Field, PromptInput

from .pictures import characters, settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
SIZE = (80, 24)


def nameless(app: SwiftbotApp) -> list[str]:
    """Return the control keys that do something just now and have no name."""
    return [
        key for key, active in app.screen.active_bindings.items() if "ctrl" in key and active.binding.id not in names()
    ]


async def test_every_control_key_has_a_name(view: "FakeView") -> None:
    """On every screen, in the line and where an instruction is written, each can be given another key."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        for number in range(len(SCREENS)):
            await pilot.press(str(number))
            await pilot.pause()
            assert nameless(app) == []
        assert "ctrl+p" in app.screen.active_bindings
        await pilot.press("colon")
        await pilot.pause()
        assert isinstance(app.focused, PromptInput)
        assert nameless(app) == []
        assert "ctrl+w" in app.screen.active_bindings
        await pilot.press("escape", "s")
        await settle(app, pilot)
        assert isinstance(app.screen, SubmitDialog)
        # What Textual's dialogs copy with is theirs; an input field has a name for it, and is what has the focus.
        assert nameless(app) == []


async def test_own_keys_take_the_place_of_the_usual_ones(view: "FakeView") -> None:
    """The palette, a dialog and editing obey the keys of a person's own and no others; hints say those keys."""
    own = {"palette": "f4", "edit-first": "f3", "line-home": "f5", "cancel": "ctrl+p"}
    view.orders.answers["cancel"] = None
    app = SwiftbotApp(view, TuiConfig(write=True, keys=own))
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2")
        await settle(app, pilot)
        await pilot.press("ctrl+p")
        await pilot.pause()
        assert "Cancel task t-running?" in characters(app)
        await pilot.press("n", "f4")
        await pilot.pause()
        assert isinstance(app.screen, CommandPalette)
        await pilot.press("escape", "s", *"look", "ctrl+a", "x")
        await pilot.pause()
        field = app.screen.query_one("#instruction", Field)
        assert field.value == "lookx"
        await pilot.press("f5", "y")
        await pilot.pause()
        assert field.value == "ylookx"
        await pilot.press("enter")
        assert "F3 edits it first" in await settle(app, pilot)
        await pilot.press("f2")
        await settle(app, pilot)
        assert view.orders.of("submit") == []
        await pilot.press("f3")
        await settle(app, pilot)
        assert len(view.orders.of("submit")) == 1


async def test_an_interrupt_says_how_to_leave(view: "FakeView") -> None:
    """^c with nothing marked ends nothing, and says which key does."""
    app = SwiftbotApp(view, TuiConfig(keys={"quit": "f10"}))
    async with app.run_test(size=SIZE, notifications=True) as pilot:
        await pilot.press("ctrl+c")
        assert "F10 or :quit leaves" in await settle(app, pilot)


def test_editing_keys_are_checked() -> None:
    """Two editing keys may not be the same, and a dialog's has to be one."""
    assert keymap({"line-home": "f5", **DIALOG_KEYS})["line-home"] == "f5"
    with pytest.raises(ConfigError, match="is both"):
        keymap({"line-home": "ctrl+e"})
    with pytest.raises(ConfigError, match="no key"):
        keymap({"edit-first": " "})
    with pytest.raises(ConfigError, match="no action"):
        keymap({"line-fly": "f5"})
