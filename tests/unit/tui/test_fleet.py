"""What stands on screens about the condition of gateways, pools, robots and plans: a word for each state, a remedy."""

from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from appliance.model import (
    Approval,
    Enquiry,
    Failure,
    GatewayStatus,
    Lifted,
    Proposal,
    RobotInfo,
    SoftStop,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.model.recorder_api import RecorderStatus
from appliance.tui import robot_view as robots
from appliance.tui.app import SwiftbotApp
from appliance.tui.screens import fleet, models
from appliance.tui.screens import robots as robots_screen
from appliance.tui.screens import tasks as tasks_screen
from appliance.tui.screens.fleet import gateway_notes, gateway_state, notes_of, recorder_notes
from appliance.tui.screens.review import ReviewScreen
from appliance.tui.store import Gateway
from appliance.tui.task_view import reason
from appliance.tui.widgets.grid import Column, widths

from .conftest import PLAN
from .pictures import settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
SIZE = (80, 24)
ROOM = 80 - 2 - 1
"""Cells for columns at 80: beside the cursor's sign and a scroll bar."""


@pytest.mark.parametrize(
    ("columns", "needed"),
    [
        (fleet.GATEWAYS, "gateway state load cpu mem pool runs tasks link ring version"),
        (tasks_screen.TASKS, "task state done % at by instruction"),
        (robots_screen.ROBOTS, "robot kind, link mode batt x y z mission state"),
        (fleet.CONTAINERS, "image container gateway state age runs cpu/mem running now"),
        (models.GATEWAYS, "gateway slot queue tok/s plans escalated share of tiers asked"),
    ],
    ids=["fleet", "tasks", "robots", "pool", "llm"],
)
def test_eighty_columns_have_all_that_is_promised(columns: tuple[Column, ...], needed: str) -> None:
    """No column that a screen is there for is left out at 80 columns, with a scroll bar beside it."""
    shown = [column.title for column, width in zip(columns, widths(columns, ROOM), strict=True) if width]
    assert " ".join(shown) == needed


SICK = [
    GatewayStatus(id="g", fleet="f", pool_problem="3 starts of image base failed in a row, left alone for a while"),
    GatewayStatus(id="g", fleet="f", pool_problem="podman.socket is absent"),
    GatewayStatus(id="g", fleet="f", pool_problem="memory is short: 100 of 900 MB for containers"),
    GatewayStatus(id="g", fleet="f", overloaded="load 1.00 for 5 s"),
    GatewayStatus(id="g", fleet="f", draining=True, drain="gives 2 runs away"),
    GatewayStatus(id="g", fleet="f", limits_enforced=False),
    GatewayStatus(id="g", fleet="f", site_problem="site yard has no fence"),
    GatewayStatus(id="g", fleet="f", keys_problem="its certificate expires in 5 days"),
    GatewayStatus(id="g", fleet="f", parts_problem="not in the list of parts: skill goto"),
]


@pytest.mark.parametrize("status", SICK)
@pytest.mark.parametrize("lost_ns", [0, 10**18])
def test_what_is_wrong_with_a_gateway_has_a_word_and_a_remedy(status: GatewayStatus, lost_ns: int) -> None:
    """Its state is a glyph and a word, and the sentence about it says what helps."""
    gateway = Gateway(status=status, lost_ns=lost_ns)
    glyph, word, *_ = gateway_state(gateway)[0].split()
    assert len(glyph) == 1
    assert word.isalpha()
    (note,) = notes_of(gateway)
    assert note.remedy
    (line,) = gateway_notes([gateway])
    assert line.plain.startswith(f"{note.glyph} g: ")
    assert " → " in line.plain
    assert ("since" in line.plain) == bool(lost_ns)


@pytest.mark.parametrize("state", ["paused", "failed", "silent"])
def test_a_recorder_in_trouble_has_a_remedy(state: str) -> None:
    """Whatever keeps a recorder from writing, the line about it says what to do."""
    problem = "" if state == "silent" else "the disk is full"
    (line,) = recorder_notes([RecorderStatus(id="r", fleet="f", state=state, problem=problem)])
    assert " → " in line.plain


ROBOTS = [
    (RobotInfo(id="r", kind="mavlink", online=False, note="no heartbeat"), {}, "✘ offline no heartbeat"),
    (RobotInfo(id="r", kind="zenoh"), {"stopped": "stopped by ann: a visitor"}, "■ stopped by ann: a visitor"),
    (RobotInfo(id="r", kind="mavlink", failsafe="battery", note="x"), {}, "✘ failsafe: battery"),
    (RobotInfo(id="r", kind="mavlink", seized="a pilot chose LOITER"), {}, "▲ taken: a pilot chose LOITER"),
    (RobotInfo(id="r", kind="mavlink", warnings=("battery low",)), {}, "▲ battery low"),
    (RobotInfo(id="r", kind="mavlink", estimator=("its position",)), {}, "▲ its position"),
    (RobotInfo(id="r", kind="zenoh", note="taking off"), {}, "✔ taking off"),
    (RobotInfo(id="r", kind="zenoh"), {}, "✔ online"),
]


@pytest.mark.parametrize(("info", "around", "told"), ROBOTS)
def test_a_robot_that_cannot_be_ordered_is_not_called_well(info: RobotInfo, around: dict[str, str], told: str) -> None:
    """Offline, stopped, in failsafe, in a pilot's hands, not sure of itself: glyph and words, and what helps."""
    robot = robots.Robot(info=info, **around)  # pyright: ignore[reportArgumentType] - texts
    assert robots.state_cell(robot)[0] == told
    assert bool(robots.troubles(robot)) == (not told.startswith("✔"))
    assert all(each in robots.about(robot).plain for each in robots.troubles(robot))


async def test_the_selected_robot_is_told_whole(view: "FakeView") -> None:
    """What its row has no room for, its whole state and its mission, stands below the list, also at 80 columns."""
    view.store.take_stops((SoftStop(id="o-1", by="ann", why="somebody is in the way"),))
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("3")
        text = await settle(app, pilot)
        assert "drone-1 ■ stopped by ann: somebody is in the way · t-running/s2 goto 50%" in text
        await pilot.press("down")
        assert "rover-1 ✘ offline no heartbeat for 3 s · no mission" in await settle(app, pilot)


async def test_the_pool_screen_says_what_is_left_alone(view: "FakeView") -> None:
    """An image in quarantine has no container that could stand for it: its reason does, and how to end it."""
    view.store.take_gateways({"gw-a": SICK[0], "gw-b": SICK[3]}, 1)
    app = SwiftbotApp(view)
    async with app.run_test(size=(120, 24)) as pilot:
        await pilot.press("4")
        text = " ".join((await settle(app, pilot)).split())
        assert "✘ g: 3 starts of image base failed in a row, left alone for a while → mend the image" in text
        assert "`:release IMAGE g`" in text
        assert "load 1.00" not in text


@pytest.mark.thorough
async def test_what_presses_stands_on_every_screen(view: "FakeView") -> None:
    """Stopped robots, and how many plans and questions wait for a person, are in the header until they are not."""
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        head = (await settle(app, pilot)).split("\n")[0]
        assert "wait" not in head
        assert "STOPPED" not in head
        proposal = Proposal(plan=PLAN, waits=True, hash="abc")
        view.store.take_task(
            TaskRecord(id="t-plan", instruction="x", state=TaskState.PROPOSED, proposal=proposal, created_ns=9)
        )
        view.store.enquiries.put("e1", Enquiry(id="e1", robot="drone-1", question="Is the way clear?"))
        assert "◇ 2 wait · test" in (await settle(app, pilot)).split("\n")[0]
        view.store.take_stops((SoftStop(id="o-1", by="ann"),))
        for key in "12345678":
            await pilot.press(key)
            head = (await settle(app, pilot)).split("\n")[0]
            assert "■ ALL STOPPED · ◇ 2 wait · test" in head
        view.store.take_stops((), (Lifted(id="l-1", stops=("o-1",), robots=("drone-1",)),))
        assert "■ 1 stopped · " in (await settle(app, pilot)).split("\n")[0]
        view.store.take_stops((), (Lifted(id="l-2", stops=("o-1",)),))
        assert "topped" not in (await settle(app, pilot)).split("\n")[0]


async def test_an_expired_plan_says_so(view: "FakeView") -> None:
    """Until when a plan waits is a time of day; once that is past, the review says that it expired, and what to do."""
    proposal = Proposal(plan=PLAN, waits=True, hash="abc", expires_s=600.0, at_ns=10**18)
    waiting = TaskRecord(
        id="t-plan", instruction="x", state=TaskState.PROPOSED, proposal=proposal, created_ns=9, sequence=1,
        approval=Approval.ALWAYS,
    )  # fmt: skip
    view.store.take_task(waiting)
    assert "; expires at " in reason(waiting)
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await settle(app, pilot)
        app.push_screen(ReviewScreen("t-plan"))
        assert "expires at" in await settle(app, pilot)
        failure = Failure(code="refused", message="no operator approved its plan", remedy="hand it in again")
        view.store.take_task(replace(waiting, state=TaskState.FAILED, proposal=None, failure=failure, sequence=2))
        assert "no operator approved its plan → hand it in again" in await settle(app, pilot)


@pytest.mark.parametrize(
    ("state", "gateway", "told"),
    [
        (SubtaskState.DISPATCHED, "gw-b", "s1: starts on gw-b"),
        (SubtaskState.READY, "", "s1: a gateway for it is chosen"),
    ],
)
def test_a_task_between_states_says_what_it_is_about(state: SubtaskState, gateway: str, told: str) -> None:
    """Sent and not yet started, ready and not yet placed: a reason stands there even before a gateway gives one."""
    record = TaskRecord(
        id="t", instruction="x", state=TaskState.RUNNING,
        subtasks=(SubtaskRecord(subtask=PLAN.subtasks[0], state=state, gateway=gateway),),
    )  # fmt: skip
    assert reason(record) == told
