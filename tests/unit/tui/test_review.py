"""A task whole, and a plan under review, under Textual's pilot on a fake fleet."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace
from textual.pilot import Pilot

from appliance.errors import ConflictError
from appliance.model import Decision, Plan, Proposal, Subtask, TaskRecord, TaskState
from appliance.model.task_api import Line, LineKind, PlanChecked
from appliance.tui.app import SwiftbotApp
from appliance.tui.screens.review import ReviewScreen
from appliance.tui.screens.tasks import TaskScreen
from appliance.tui.settings import TuiConfig
from appliance.tui.widgets.grid import Grid

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio

SIZE = (80, 24)
PLAN = Plan(
    domain="inspection",
    subtasks=(
        Subtask(id="s1", skill="goto", robot="rover-1", params={"place": "gate"}),
        Subtask(id="s2", skill="photograph", robot="rover-1", params={"target": "door"}, after=("s1",)),
    ),
)
PROPOSAL = Proposal(plan=PLAN, waits=True, note="it was asked for", hash="abcdef0123456789", expires_s=600.0)
WAITING = TaskRecord(
    id="t-plan", instruction="look", state=TaskState.PROPOSED, created_ns=9, sequence=2, proposal=PROPOSAL
)


async def until(app: SwiftbotApp, pilot: Pilot[None], *wanted: str | Callable[[], bool]) -> str:
    """Wait until all that is wanted is on the screen, or true; fails with what is there."""
    text = ""
    until_s = time.monotonic() + 60
    while time.monotonic() < until_s:
        await pilot.pause(0.02)
        app.draw()
        strips = app.screen._compositor.render_strips()
        text = "\n".join("".join(segment.text for segment in strip) for strip in strips)
        if all(each in text if isinstance(each, str) else each() for each in wanted):
            return text
    pytest.fail(f"the screen does not show {wanted}:\n{text}")


async def reviewing(app: SwiftbotApp, pilot: Pilot[None], view: "FakeView") -> ReviewScreen:
    """Open the review of the waiting plan."""
    view.store.take_task(WAITING)
    view.orders.answers["check_plan"] = PlanChecked(problems=(), hash="ffff")
    await pilot.press("2")
    await until(app, pilot, "t-plan", "? approve")
    await pilot.press("a")
    await until(app, pilot, "waits for approval: it was asked for", "abcdef0123456789", "photograph")
    screen = app.screen
    assert isinstance(screen, ReviewScreen)
    return screen


async def test_task_is_opened_with_its_lines(view: "FakeView") -> None:
    """Enter opens the task: each subtask with state, gateway and times; below, what is known of the selected one."""
    line = Line(kind=LineKind.LOG, task="t-running", at_ns=10**18, gateway="gw-b", subtask="s2", text="at \x1b[31mgate")
    view.orders.lines = [line]
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("2", "enter")
        await until(app, pilot, lambda: isinstance(app.screen, TaskScreen), "✔ succeeded", "● running 50%")
        await pilot.press("down")
        await until(app, pilot, "leg 1 of 2", "at ␛[31mgate")
        app.screen.query_one("#subtasks").select("s3")  # pyright: ignore[reportAttributeAccessIssue]
        await until(app, pilot, "✘ the camera does not answer → switch rover-1 on")
        await pilot.press("escape")
        await until(app, pilot, lambda: not isinstance(app.screen, TaskScreen))


async def test_plan_is_edited_checked_and_approved(view: "FakeView") -> None:
    """Robot, parameters and removal are edited and checked, the difference is shown; approval carries the hash."""
    view.orders.answers["approve"] = replace(WAITING, state=TaskState.RUNNING, proposal=None, sequence=3)
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        screen = await reviewing(app, pilot, view)
        await pilot.press("r")
        await until(app, pilot, "edit-robot s1")
        await pilot.press(*"rover-2", "enter")
        await until(app, pilot, "robot: rover-1 → rover-2", "✔ checked: it may run")
        await pilot.press("e")
        await until(app, pilot, "edit-params s1 place=gate")
        await pilot.press(*["backspace"] * 4, *"dock", "enter")
        await until(app, pilot, "place=gate → place=dock")
        await pilot.press("down", "d")
        await until(app, pilot, "- s2 photograph  taken out", "✔ checked")
        await pilot.press("a")
        await until(app, pilot, "Approve the edited plan of t-plan? 1 subtask will run", "rover-2")
        await pilot.press("y")
        await until(app, pilot, lambda: app.screen is not screen and not app.screen.is_modal)
    assert view.orders.of("approve") == [("t-plan",)]
    assert view.orders.options["approve"]["plan_hash"] == "abcdef0123456789"
    plan = view.orders.options["approve"]["plan"]
    assert isinstance(plan, Plan)
    assert [(each.id, each.robot, each.params) for each in plan.subtasks] == [("s1", "rover-2", {"place": "dock"})]


async def test_order_is_edited_and_taken_back(view: "FakeView") -> None:
    """`o` writes what a subtask comes after, `[` and `]` exchange neighbours, `u` goes back: each is checked again."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        screen = await reviewing(app, pilot, view)

        def order() -> list[tuple[str, tuple[str, ...]]]:
            return [(each.id, each.after) for each in screen.draft.subtasks] if screen.draft is not None else []

        proposed = order()
        await pilot.press("down")
        await until(app, pilot, lambda: screen.query_one("#steps", Grid).selected == "s2")
        await pilot.press("o")
        await until(app, pilot, "edit-after s2 s1")
        await pilot.press("backspace", "backspace", "minus", "enter")
        await until(app, pilot, "after: s1 → nothing", "✔ checked: it may run")
        assert dict(order()) == {"s1": (), "s2": ()}
        await pilot.press("u")
        await until(app, pilot, "as proposed", lambda: order() == proposed)
        await pilot.press("left_square_bracket")
        await until(app, pilot, "✔ checked: it may run", lambda: dict(order()) == {"s1": ("s2",), "s2": ()})
        screen.query_one("#steps").select("s2")  # pyright: ignore[reportAttributeAccessIssue]
        await pilot.press("right_square_bracket")
        await until(app, pilot, lambda: dict(order()) == dict(proposed))
        assert len(view.orders.of("check_plan")) >= 2


async def test_invalid_edit_is_not_approved(view: "FakeView") -> None:
    """What the validator finds stands below the plan, and approval is refused until it is mended."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        await reviewing(app, pilot, view)
        view.orders.answers["check_plan"] = PlanChecked(problems=("s1: robot ghost is unknown",), hash="")
        await pilot.press("r")
        await until(app, pilot, "edit-robot s1")
        await pilot.press(*"ghost", "enter")
        await until(app, pilot, "✘ invalid plan", "robot ghost is unknown")
        await pilot.press("a")
        await until(app, pilot, "correct it")
        assert view.orders.of("approve") == []


async def test_somebody_was_faster(view: "FakeView") -> None:
    """Of two operators one hears that the other was faster, and who; then what became of the plan."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        await reviewing(app, pilot, view)
        view.orders.error = ConflictError("bea has approved it already")
        await pilot.press("a")
        await until(app, pilot, "Approve the plan")
        await pilot.press("y")
        await until(app, pilot, "another operator was faster: bea has approved it already")
        decision = Decision(approved=True, by="bea")
        view.store.take_task(replace(WAITING, state=TaskState.RUNNING, proposal=None, sequence=3, decision=decision))
        await until(app, pilot, "approved by bea", "Esc leaves")


async def test_another_plan_waits_by_now(view: "FakeView") -> None:
    """When the plan was replaced meanwhile, the one looked at is not approved; reload shows the new one."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        screen = await reviewing(app, pilot, view)
        other = replace(PROPOSAL, hash="9999999999999999", plan=replace(PLAN, subtasks=PLAN.subtasks[:1]))
        view.store.take_task(replace(WAITING, proposal=other, sequence=3))
        await until(app, pilot, "another plan waits by now")
        await pilot.press("a")
        await until(app, pilot, "nothing to approve here any more")
        await pilot.press("colon", *"edit-reload", "enter")
        await until(app, pilot, lambda: screen.draft is not None and screen.draft.ids == ("s1",), "9999999999999999")


async def test_reject_asks_and_read_only_refuses(view: "FakeView") -> None:
    """Rejecting asks first; while the UI is read-only neither word is given."""
    view.orders.answers["reject"] = replace(WAITING, state=TaskState.CANCELLED, proposal=None, sequence=3)
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        screen = await reviewing(app, pilot, view)
        await pilot.press("x")
        await pilot.pause()
        assert app.screen is screen
        await pilot.press("W", "x")
        await until(app, pilot, "Reject the plan of t-plan?")
        await pilot.press("y")
        await until(app, pilot, lambda: bool(view.orders.of("reject")))
