"""The overview: all that goes on at once, in a window of any size, and from each row to what it stands for."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import RobotInfo, TaskRecord
from appliance.model.alerts import Alert, AlertLevel, Subject
from appliance.tui.app import SwiftbotApp
from appliance.tui.formatting import sparkline
from appliance.tui.replay import ReplayView
from appliance.tui.robot_view import Ground
from appliance.tui.screens.overview import OverviewScreen, heights
from appliance.tui.screens.robots import RobotScreen
from appliance.tui.screens.tasks import TaskScreen
from appliance.tui.store import LOADS, Store
from appliance.tui.widgets.grid import Grid

from .pictures import settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
ALERT = Alert(
    id="robot-lost.rover-1", level=AlertLevel.CRITICAL, kind="robot-lost", subject=Subject.ROBOT, name="rover-1",
    what="rover-1 is offline", since_ns=1,
)  # fmt: skip


@given(st.lists(st.integers(1, 60), max_size=6), st.integers(0, 100))
def test_parts_share_the_room_evenly(wanted: list[int], room: int) -> None:
    """None has more than it wants; what is there is used; a part lacks lines only where no other has two more."""
    given_ = heights(wanted, room)
    assert all(min(want, 2) <= got <= want for want, got in zip(wanted, given_, strict=True))
    assert sum(given_) <= max(room, sum(min(want, 2) for want in wanted))
    if sum(given_) < room:
        assert given_ == wanted
    for want, got in zip(wanted, given_, strict=True):
        assert got == want or got >= max(given_) - 1


async def test_it_is_the_first_screen_and_shows_all_that_goes_on(view: "FakeView") -> None:
    """At 80x24: alert, robots, the task in work and no other, gateways; the map as far as there is room."""
    view.store.take_alert(ALERT)
    app = SwiftbotApp(view)
    async with app.run_test(size=(80, 24)) as pilot:
        text = await settle(app, pilot)
        for expected in ("✘ critical", "drone-1", "✘ offline", "t-running", "gw-b", "✘ pool", "+gate"):
            assert expected in text
        assert "t-done" not in text
        await pilot.press("1", "0")
        assert "t-running" in await settle(app, pilot)


async def test_a_full_fleet_leaves_each_part_its_share(view: "FakeView") -> None:
    """With more than there is room for, each part has its first rows at 80x24, and a wide window has the map beside."""
    view.store.take_robots({f"r{n}": RobotInfo(id=f"r{n}", kind="zenoh") for n in range(40)})
    for number in range(30):
        view.store.take_task(TaskRecord(id=f"t-{number:02}", instruction="look", created_ns=100 + number))
        view.store.take_alert(replace(ALERT, id=f"a-{number}", name=f"name{number:02}"))
    app = SwiftbotApp(view)
    async with app.run_test(size=(80, 24)) as pilot:
        text = await settle(app, pilot)
        for expected in ("name0", "r0 ", "t-29", "gw-a"):
            assert expected in text
        assert not app.screen.query_one(Ground).display
        await pilot.resize_terminal(160, 48)
        await settle(app, pilot)
        assert app.screen.query_one(Ground).size.width > 50


async def test_enter_opens_what_a_row_stands_for(view: "FakeView") -> None:
    """Tab goes from part to part; Enter opens the robot of an alert, a robot, a task, a gateway."""
    view.store.take_alert(ALERT)
    app = SwiftbotApp(view)
    async with app.run_test(size=(160, 48)) as pilot:
        await settle(app, pilot)
        for keys, kind, name in (
            (("enter",), RobotScreen, "rover-1"),
            (("tab", "enter"), RobotScreen, "drone-1"),
            (("tab", "enter"), TaskScreen, "t-running"),
        ):
            await pilot.press(*keys)
            await settle(app, pilot)
            assert isinstance(app.screen, kind)
            assert app.screen.title_of() == name
            await pilot.press("escape")
            await settle(app, pilot)
        await pilot.press("tab", "enter")
        assert "› gw-a" in await settle(app, pilot)


async def test_commands_take_the_selected_row_of_the_focused_part(view: "FakeView") -> None:
    """`:cancel` is about the selected task while the tasks have the focus, and asks which one elsewhere."""
    app = SwiftbotApp(view)
    async with app.run_test(size=(80, 24)) as pilot:
        await settle(app, pilot)
        screen = app.screen
        assert isinstance(screen, OverviewScreen)
        assert screen.chosen() == {}
        screen.set_focus(screen.query_one("#tasks", Grid))
        assert screen.chosen() == {"task": "t-running", "subtask": "t-running/s2"}
        screen.set_focus(screen.query_one("#gateways", Grid))
        assert screen.chosen() == {"gateway": "gw-a"}


async def test_a_recorded_log_is_shown_too(view: "FakeView") -> None:
    """The overview has the robots, tasks and gateways of the moment of the log."""
    app = SwiftbotApp(view)
    async with app.run_test(size=(160, 48)) as pilot:
        app.do_open({"file": str(Path(__file__).parents[2] / "replay" / "logs" / "demo.mcap")})
        while not isinstance(app.view, ReplayView):
            await pilot.pause(0.05)
        await pilot.press("0", "J", *"50%", "enter")
        while not app.view.store.gateways:
            await pilot.pause(0.05)
        text = await settle(app, pilot)
        assert "RECORDED" in text
        for name in app.view.store.gateways:
            assert name in text


def test_loads_are_those_of_the_last_reports(view: "FakeView") -> None:
    """Each report counts once, a bounded number is kept, and a recorded log that starts again has none."""
    store = Store()
    status = view.store.gateways["gw-a"].status
    for number in range(LOADS + 10):
        report = replace(status, load=number / 100)
        for _ in range(2):
            store.take_gateways({"gw-a": report}, 1)
    assert list(store.loads["gw-a"]) == [number / 100 for number in range(10, LOADS + 10)]
    store.forget_all()
    assert not store.loads


def test_a_bar_of_a_fixed_span_means_the_same_for_all() -> None:
    """Of gateways side by side half a load is as high for each, whatever they had before."""
    assert sparkline([0.5], 8, span=(0.0, 1.0)) == sparkline([0.0, 0.5], 8, span=(0.0, 1.0))[1]
    assert sparkline([0.0, 1.0, 7.0], 8, span=(0.0, 1.0)) == "▁██"
