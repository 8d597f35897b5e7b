"""How the screens of tasks, robots, the log and replay look at 80x24 and 160x48, in three themes."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from appliance.model import Enquiry, Notice, Pose, RobotInfo, SoftStop, Word
from appliance.model.closures import Closure
from appliance.model.schedules import Schedule, ScheduleList, ScheduleShown, ScheduleSpec
from appliance.model.task_api import Line, LineKind, PlanChecked
from appliance.tui.replay import LogFile
from appliance.tui.screens import replay as replay_screen

from .pictures import NOW_NS, OTHER_SIZES, SIZES, compare_screen, never_refused, universal_time
from .test_review import WAITING

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = [pytest.mark.anyio, pytest.mark.thorough]

SCREENS = {
    "tasks": ("2", "down"),
    "task": ("2", "down", "enter", "down"),
    "review": ("2", "a"),
    "submit": ("W", "s", *"rover-1 looks", "enter"),
    "robots": ("3",),
    "robot": ("3", "down", "enter"),
    "schedules": ("S",),
    "log": ("7",),
    "replay": ("8",),
}


@pytest.fixture
def rooms(view: "FakeView", monkeypatch: pytest.MonkeyPatch) -> Iterator["FakeView"]:
    """Return a fleet with a plan that waits, robots that stand, ask and are stopped, and lines of the log."""
    view.store.take_task(replace(WAITING, created_ns=NOW_NS, submitter="olga"))
    others = {
        f"rover-{number}": RobotInfo(
            id=f"rover-{number}", kind="zenoh", mode="idle", battery_percent=90.0 - 30 * number,
            pose=Pose(x=-3.0 + 4 * number, y=1.0 + number, heading_deg=90.0 * number),
        )
        for number in (2, 3)
    }  # fmt: skip
    view.store.take_robots(dict(view.store.robots) | others)
    view.store.take_stops((SoftStop(id="o-1", robots=("rover-2",), by="olga", why="somebody in the aisle"),))
    question = Enquiry(id="q-1", question="Is the door open?", choices=("yes", "no"), robot="rover-3", at_ns=NOW_NS)
    view.store.enquiries.put("q-1", question)
    view.store.take_notice(Notice(id="n", to="ops", text="inspection done \x1b[2J[red]", at_ns=NOW_NS))
    view.store.add(NOW_NS, kind="log", level="error", source="gw-b", text="podman.socket is absent")
    view.orders.answers["check_plan"] = PlanChecked(problems=(), hash="ffff")
    view.orders.lines = [
        Line(kind=LineKind.LOG, task="t-running", at_ns=NOW_NS, gateway="gw-b", subtask="s2", text="at leg 1")
    ]
    logs = [LogFile(path=Path("/logs/fleet-0001.mcap"), size=3 * 2**20, written_s=NOW_NS / 1e9)]
    monkeypatch.setattr(replay_screen, "find_logs", lambda _own, _fleet: logs)
    schedule = Schedule(
        spec=ScheduleSpec(id="round", instruction="rover-2: patrol the hall", every_s=600.0),
        added=Word(by="olga", why="night watch"), fired=7, fired_ns=NOW_NS, task="t-done", missed=1,
        missed_why="the task before had not ended",
    )  # fmt: skip
    shown = ScheduleShown(schedule=schedule, owner="gw-a")
    view.orders.answers["schedules"] = ScheduleList(schedules=(shown,))
    view.store.take_closure(Closure(kind="place", name="gate", by=Word(by="olga", why="ice")))
    with universal_time(monkeypatch):
        yield view


@SIZES
@pytest.mark.parametrize("screen", SCREENS)
async def test_screen_looks_as_it_did(rooms: "FakeView", screen: str, size: tuple[int, int]) -> None:
    """Characters and styles are those of the snapshot, in each of the themes."""
    await compare_screen(rooms, screen, SCREENS[screen], size)


@pytest.mark.parametrize("screen", ["tasks", "task", "review", "robots", "robot", "schedules", "log", "replay"])
@OTHER_SIZES
async def test_other_sizes_are_never_refused(rooms: "FakeView", screen: str, size: tuple[int, int]) -> None:
    """Narrower and wider than usual, a screen still shows what comes first in it."""
    await never_refused(rooms, SCREENS[screen], size)
