"""Robots in maintenance and closed places in the terminal UI."""

# pyright: reportPrivateUsage=false, reportArgumentType=false

import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace
from textual.widgets import Input

from appliance.model import Word
from appliance.model.closures import Closure, ClosureList, Rule
from appliance.model.schedules import ScheduleList
from appliance.operations import until_and_why
from appliance.plane.settings import PlaneConfig
from appliance.tui.app import SwiftbotApp
from appliance.tui.command_line import read
from appliance.tui.robot_view import places
from appliance.tui.subscriptions import FleetView

from .conftest import SITE
from .pictures import settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
ROBOT = Closure(kind="robot", name="drone-1", by=Word(by="ann", why="tyres", at_ns=5))
PLACE = Closure(kind="place", name="gate", by=Word(by="ann", at_ns=5))
RULE = Closure(kind="rule", name="r-1", rule=Rule(places=("gate",)), by=Word(by="ann", why="wet", at_ns=5))


@pytest.mark.parametrize("size", [(80, 24), (160, 48)])
async def test_the_screen_of_robots_shows_what_is_out_of_use(view: "FakeView", size: tuple[int, int]) -> None:
    """The robot says so in its row, its own screen what ends it; the place in its name on the map; until it is over."""
    app = SwiftbotApp(view)
    async with app.run_test(size=size) as pilot:
        await pilot.press("3")
        view.store.take_closure(ROBOT)
        view.store.take_closure(PLACE)
        shown = await settle(app, pilot)
        assert "◌ in maint" in shown
        assert "gate closed" in shown or size != (80, 24)  # a wide map has other labels where this one would stand
        await pilot.press("enter")
        assert "maintain drone-1 --end" in " ".join((await settle(app, pilot)).split())
        view.store.take_closure(replace(ROBOT, ended_ns=9))
        assert "maint" not in await settle(app, pilot)


async def test_a_rule_is_listed_and_removed_where_closed_places_are(view: "FakeView") -> None:
    """What it says, by whom and why; `R` on its row asks, and then removes it."""
    view.orders.answers |= {"schedules": ScheduleList(), "site": SITE}
    app = SwiftbotApp(view)
    async with app.run_test(size=(120, 30)) as pilot:
        await pilot.press("W", "S")
        view.store.take_closure(RULE)
        shown = await settle(app, pilot)
        assert "◌ rule" in shown
        assert "all robots: never go to gate" in shown
        await pilot.press("tab", "R")
        assert "Remove standing rule r-1?" in " ".join((await settle(app, pilot)).split())


async def test_a_prohibition_that_is_typed_is_read_back(view: "FakeView") -> None:
    """As the rule that it is; it is added once a person says yes, and kept in the words that were read."""
    added = replace(RULE, rule=Rule(places=("gate",), begin_min=18 * 60, zone="UTC"))
    orders: Any = view.orders
    orders.answers |= {"site": SITE, "add_rule": added}
    orders.plane = SimpleNamespace(registry=SimpleNamespace(robots=dict(view.store.robots.items())))
    app = SwiftbotApp(view)
    async with app.run_test(size=(120, 30)) as pilot:
        await pilot.press("W", "s")
        await settle(app, pilot)
        app.screen.query_one(Input).value = "nobody goes to the gate after 18:00"
        await pilot.press("enter")
        shown = await settle(app, pilot)
        assert "all robots: never go to gate" in shown
        assert "18:00 to 24:00" in shown
        assert not [each for each in orders.asked if each[0] == "add_rule"]
        await pilot.press("y")
        await settle(app, pilot)
        ((_, rule),) = (each for each in orders.asked if each[0] == "add_rule")
        assert (rule.places, rule.begin_min) == (("gate",), 18 * 60)


def test_an_older_word_changes_nothing(view: "FakeView") -> None:
    """Puts may come in either order, and an answer may be older than a put."""
    view.store.take_closure(ROBOT)
    view.store.take_closure(replace(ROBOT, by=Word(by="bob", at_ns=1), ended_ns=2))
    assert view.store.out_of_use("robot", 10) == {"drone-1": "in maintenance by ann: tyres"}
    view.store.take_closures((), known=(ROBOT.id,))
    assert view.store.out_of_use("robot", 10) == {}


async def test_what_is_out_of_use_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal UI that is opened later knows it as well."""

    class Orders:
        async def closures(self) -> ClosureList:
            return ClosureList(closures=(ROBOT,), rules=(RULE,))

    made = FleetView(PlaneConfig(), "test")
    monkeypatch.setattr(FleetView, "orders", Orders())
    await made._ask_closures()
    assert set(made.store.closures) == {ROBOT.id, RULE.id}


def test_a_map_calls_a_closed_place_closed() -> None:
    """At its position."""
    assert places(SITE, {"gate"})["gate closed"] == (5.0, 8.0)
    assert set(places(SITE)) == {"gate", "cold store"}


def test_a_reason_may_begin_with_until_when() -> None:
    """A duration or time first is when it ends by itself; any other first word belongs to the reason."""
    until_ns, why = until_and_why("2h new wheels")
    assert (why, abs(until_ns - time.time_ns() - 7200 * 10**9) < 60 * 10**9) == ("new wheels", True)
    assert until_and_why("14:00")[1] == ""
    assert until_and_why("14:00")[0] > time.time_ns()
    for text in ("new wheels", "3rd wheel is loose", "", "99:99 x"):
        assert until_and_why(text) == (0, text)


def test_quotes_keep_a_name_together_before_the_reason() -> None:
    """`:close-place "dock 3" flooded today` is about dock 3."""
    command = read('close-place "dock 3" flooded today', {})
    assert command.given == {"place": "dock 3", "why": "flooded today"}
    assert read("drain gw-a its fan is loud", {}).given == {"gateway": "gw-a", "why": "its fan is loud"}
    assert read('close-place "dock 3', {}).given == {"place": "dock 3"}
    assert read("  drain   gw-a  ", {}).given == {"gateway": "gw-a"}
