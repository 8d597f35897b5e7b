"""The screen of tasks: older ones are loaded, one is submitted once more."""

# pyright: reportPrivateUsage=false, reportArgumentType=false

from typing import TYPE_CHECKING

import pytest

from appliance.errors import DeadlineError
from appliance.model import TaskRecord, TaskState
from appliance.model.task_api import TaskList, TasksAsk
from appliance.tui.app import SwiftbotApp
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Store
from appliance.tui.widgets.grid import Grid

from .conftest import DONE, RUNNING
from .pictures import settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
SIZE = (80, 24)


def said(app: SwiftbotApp) -> list[str]:
    """Return the notices that are seen, the oldest first."""
    return [each.message for each in app._notifications]


async def test_older_tasks_are_loaded_below(view: "FakeView") -> None:
    """`o` asks for those older than the last one, remembered ones too, and says whether there are more."""
    view.store = Store(tasks=500)
    view.store.take_tasks([RUNNING, DONE])
    old = TaskRecord(id="t-old", instruction="long ago", state=TaskState.FAILED, created_ns=0, sequence=3)
    view.orders.answers["tasks"] = TaskList(tasks=(old,), more=True, unreachable=("gw-z",))
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2", "o")
        await settle(app, pilot)
        assert list(app.screen.query_one("#tasks", Grid).keys) == ["t-running", "t-done", "t-old"]
        assert said(app) == ["1 older tasks loaded; there are more; gw-z did not answer"]
        assert view.orders.options["tasks"] == {"wanted": TasksAsk(remembered=True), "after": DONE}
        view.orders.error = DeadlineError("no answer to tasks")
        await pilot.press("o")
        await settle(app, pilot)
        assert "no answer to tasks" in said(app)[-1]


async def test_no_more_are_loaded_than_are_kept(view: "FakeView") -> None:
    """Otherwise the newest loading would drop the last one: it says where all of them are."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2", "o")
        await settle(app, pilot)
        assert "swiftbot task list --before" in said(app)[-1]
        assert view.orders.of("tasks") == []


async def test_a_task_is_submitted_once_more_by_key(view: "FakeView") -> None:
    """`D` asks first, only while unlocked, and says the new task."""
    view.orders.answers["duplicate"] = TaskRecord(id="t-new", instruction="greet", created_ns=9)
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2", "D")
        assert "once more" in await settle(app, pilot)
        await pilot.press("y")
        shown = await settle(app, pilot)
        assert view.orders.of("duplicate") == [("t-running",)]
        assert "t-new" in shown
