"""What is typed ahead, and what is typed into fields."""

import asyncio
from typing import TYPE_CHECKING

import pytest
from textual.events import Key
from textual.widgets import Input

from appliance.tui.actions import SCREENS
from appliance.tui.app import SwiftbotApp
from appliance.tui.screens.submit import SubmitDialog
from appliance.tui.settings import TuiConfig
from appliance.tui.widgets.dialogs import ConfirmDialog

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio


async def test_keys_typed_ahead_belong_to_the_command(view: "FakeView") -> None:
    """A whole line that comes at once, as over a slow link, is written into the prompt; none of its letters acts."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.pause()
        app.post_message(Key("colon", ":"))
        for letter in "resume-robots":
            app.post_message(Key("minus" if letter == "-" else letter, letter))
        app.post_message(Key("enter", "\r"))
        async with asyncio.timeout(60):
            while not isinstance(app.screen, ConfirmDialog):
                await pilot.pause(0.02)
        assert [call for call in view.orders.asked if call != ("site",)] == []


async def test_colon_and_slash_can_be_written(view: "FakeView") -> None:
    """In a field they are text, in a dialog nothing."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press("s")
        await pilot.pause()
        await pilot.press("a", "colon", "slash", "b")
        await pilot.pause()
        assert isinstance(app.screen, SubmitDialog)
        assert app.screen.query_one(Input).value == "a:/b"


async def test_names_are_completed_and_history_comes_back(view: "FakeView") -> None:
    """Tab completes robots and places of the site; the arrows bring back what was submitted before."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press("s")
        await app.workers.wait_for_complete()
        await pilot.press(*"rov", "tab", "colon", "space", *"to cold", "tab")
        field = app.screen.query_one(Input)
        assert field.value == "rover-1: to cold store"
        await pilot.press("enter")
        await app.workers.wait_for_complete()
        await pilot.press("enter")
        await app.workers.wait_for_complete()
        await pilot.pause()
        assert [call[0] for call in view.orders.of("submit")] == ["rover-1: to cold store"]
        await pilot.press("s")
        await pilot.pause()
        await pilot.press("x", "up")
        await pilot.pause()
        assert app.screen.query_one(Input).value == "rover-1: to cold store"
        await pilot.press("down")
        await pilot.pause()
        assert app.screen.query_one(Input).value == "x"


@pytest.mark.thorough
async def test_every_screen_can_be_left_by_its_keys(view: "FakeView") -> None:
    """From each screen, also one without a table, the number keys lead to each other one."""
    app = SwiftbotApp(view)
    async with app.run_test(size=(80, 24)) as pilot:
        seen: list[str] = []
        for key in "0123456780":
            await pilot.press(key)
            await pilot.pause(0.1)
            seen.append(app.current_mode)
        assert seen == [*SCREENS, next(iter(SCREENS))]
