"""The screen of alerts and the count in the header of every screen."""

# pyright: reportArgumentType=false

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import pytest
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.errors import DeadlineError
from appliance.model import Enquiry, SoftStop, Word
from appliance.model.alerts import Alert, AlertLevel, AlertList, AlertsAcked, Subject
from appliance.model.closures import Closure, ClosureList
from appliance.model.robot_api import Standing
from appliance.model.task_api import EnquiryList
from appliance.plane.settings import PlaneConfig
from appliance.tui.actions import SCREENS
from appliance.tui.app import SwiftbotApp
from appliance.tui.screens.alerts import AlertsScreen
from appliance.tui.screens.fleet import GatewayScreen
from appliance.tui.screens.review import ReviewScreen
from appliance.tui.screens.robots import RobotScreen
from appliance.tui.screens.tasks import TaskScreen
from appliance.tui.settings import TuiConfig
from appliance.tui.subscriptions import FleetView
from appliance.tui.widgets.grid import Grid

from .pictures import settle

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
SIZE = (80, 24)


def alert(kind: str, subject: Subject, name: str, *, level: AlertLevel = AlertLevel.CRITICAL) -> Alert:
    """Return one."""
    return Alert(
        id=f"{kind}.{name}", kind=kind, level=level, what=f"{kind} it is", subject=subject, name=name,
        remedy="do [this]", since_ns=1, changed_ns=1,
    )  # fmt: skip


ROBOT = alert("robot-offline", Subject.ROBOT, "rover-1")
GATEWAY = alert("pool", Subject.GATEWAY, "gw-b")
FAILED = alert("task-failed", Subject.TASK, "t-done")
PLAN = alert("plan-waits", Subject.TASK, "t-running", level=AlertLevel.WARNING)
RECORDER = alert("recorder", Subject.RECORDER, "rec", level=AlertLevel.WARNING)
ALL = (ROBOT, GATEWAY, FAILED, PLAN, RECORDER)


@pytest.mark.parametrize("size", [(80, 24), (160, 48)])
async def test_the_header_of_every_screen_counts_alerts(view: "FakeView", size: tuple[int, int]) -> None:
    """Red what is critical, amber what warns, with the key to them; what is acknowledged or over counts no more."""
    view.store.take_alerts(ALL)
    app = SwiftbotApp(view)
    async with app.run_test(size=size) as pilot:
        for number in range(len(SCREENS)):
            await pilot.press(str(number))
            assert "! ✘3  ▲2 " in (await settle(app, pilot)).splitlines()[0]
        acked = replace(ROBOT, acked=Word(by="ann"))
        view.store.take_alert(acked)
        view.store.take_alert(replace(PLAN, cleared_ns=9))
        assert "! ✘2  ▲1 " in (await settle(app, pilot)).splitlines()[0]
        view.store.take_alerts(())
        assert "✘" not in (await settle(app, pilot)).splitlines()[0]


@pytest.mark.parametrize(
    ("one", "screen"),
    [(ROBOT, RobotScreen), (GATEWAY, GatewayScreen), (FAILED, TaskScreen), (PLAN, ReviewScreen)],
)
async def test_two_keys_lead_to_what_an_alert_is_about(view: "FakeView", one: Alert, screen: type[object]) -> None:
    """`!` from any screen, Enter on the alert: its object; Esc leads back to the list, and from there on."""
    view.store.take_alerts((one,))
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("7", "exclamation_mark")
        shown = await settle(app, pilot)
        assert "do [this]" in shown
        await pilot.press("enter")
        await settle(app, pilot)
        assert isinstance(app.screen, screen)
        await pilot.press("escape")
        await settle(app, pilot)
        assert isinstance(app.screen, AlertsScreen)
        await pilot.press("escape")
        await settle(app, pilot)
        assert app.current_mode == "log"
        assert not isinstance(app.screen, AlertsScreen)


async def test_the_same_two_keys_lead_to_the_next_alert(view: "FakeView") -> None:
    """Whatever was looked at before: a recorder leaves no list behind, and in an open list `!` is the most urgent."""
    view.store.take_alerts((RECORDER,))
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("7", "exclamation_mark", "enter")
        await settle(app, pilot)
        assert app.current_mode == "fleet"
        await pilot.press("7")
        await settle(app, pilot)
        assert not isinstance(app.screen, AlertsScreen)
        await pilot.press("exclamation_mark")
        await settle(app, pilot)
        view.store.take_alert(ROBOT)  # above the one that the cursor is on
        await settle(app, pilot)
        await pilot.press("exclamation_mark", "enter")
        await settle(app, pilot)
        assert isinstance(app.screen, RobotScreen)


async def test_alerts_are_acknowledged_by_key(view: "FakeView") -> None:
    """`a` the selected one, only while unlocked; `A` all, after a question, with the reason."""
    view.store.take_alerts((ROBOT, PLAN))
    view.orders.answers["acknowledge"] = AlertsAcked(alerts=(ROBOT,))
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("exclamation_mark")
        await settle(app, pilot)
        await pilot.press("a")
        await settle(app, pilot)
        assert view.orders.of("acknowledge") == []
        await pilot.press("W", "a")
        await settle(app, pilot)
        assert view.orders.of("acknowledge") == [(["robot-offline.rover-1"],)]
        grid = app.screen.query_one(Grid)
        assert list(grid.keys) == ["robot-offline.rover-1", "plan-waits.t-running"]
        await pilot.press("A")
        await settle(app, pilot)
        view.store.take_alert(FAILED)  # it begins while the question is open, and was not listed
        await pilot.press("y")
        await settle(app, pilot)
        assert view.orders.of("acknowledge")[1:] == [(["robot-offline.rover-1", "plan-waits.t-running"],)]


async def test_lines_that_were_acknowledged_leave_the_fleet_screen(view: "FakeView") -> None:
    """A condition of the machine that somebody has taken note of is no yellow line for ever."""
    app = SwiftbotApp(view, TuiConfig())
    async with app.run_test(size=(160, 48)) as pilot:
        await pilot.press("1")
        assert "container limits are not enforced" in await settle(app, pilot)
        for name in view.store.gateways:
            known = alert("no-limits", Subject.GATEWAY, name, level=AlertLevel.WARNING)
            view.store.take_alert(replace(known, acked=Word(by="a")))
        assert "container limits are not enforced" not in await settle(app, pilot)


async def test_a_gateway_that_was_lost_before_is_on_the_fleet_screen(view: "FakeView") -> None:
    """A terminal UI that was opened later lists it with since when, as one that has seen it go does."""
    view.store.take_alerts((alert("gateway-lost", Subject.GATEWAY, "gw-gone"),))
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("1")
        line = next(each for each in (await settle(app, pilot)).splitlines() if "gw-gone" in each)
        assert "✘ lost" in line


async def test_a_question_is_answered_from_its_alert(view: "FakeView") -> None:
    """Enter opens the line in which the answer is written."""
    view.store.take_alerts((alert("question", Subject.QUESTION, "t-1:s1:1", level=AlertLevel.WARNING),))
    app = SwiftbotApp(view, TuiConfig(write=True))
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("exclamation_mark", "enter")
        assert "answer t-1:s1:1" in await settle(app, pilot)


class Operators:
    """Answers for what waits for operators; `missing` are not answered."""

    def __init__(self, *, missing: str, meanwhile: Callable[[], None]) -> None:
        self.missing = missing
        self.meanwhile = meanwhile

    def _answer(self, verb: str) -> None:
        if verb == self.missing:
            raise DeadlineError(f"no answer to {verb}")

    async def standing(self) -> Standing:
        """Return a stop of the fleet."""
        self._answer("standing")
        return Standing(stops=(SoftStop(id="stop-1", by="ann", at_ns=1),))

    async def alerts(self) -> AlertList:
        """Return one; another one is raised before the answer comes."""
        self._answer("alerts")
        self.meanwhile()
        return AlertList(alerts=(ROBOT,))

    async def enquiries(self) -> EnquiryList:
        """Return a question."""
        self._answer("enquiries")
        return EnquiryList(enquiries=(Enquiry(id="t-1:s1:1", question="left?", at_ns=1),))

    async def closures(self) -> ClosureList:
        """Return a robot in maintenance."""
        self._answer("closures")
        return ClosureList(closures=(Closure(kind="robot", name="rover-1", by=Word(by="ann")),))


class Answered(FleetView):
    """A view whose operators' questions are answered so."""

    def __init__(self, missing: str) -> None:
        super().__init__(PlaneConfig(mode="client"), "f")
        self._operators: Any = Operators(missing=missing, meanwhile=lambda: self.store.take_alert(GATEWAY))

    @property
    def orders(self) -> FleetClient:
        """What answers."""
        return self._operators

    async def ask(self) -> None:
        """Ask as at each connection."""
        await self._ask_standing()


@pytest.mark.parametrize("missing", ["standing", "alerts", "enquiries", "closures"])
async def test_what_is_not_answered_hides_nothing_else(missing: str) -> None:
    """Stops, alerts and questions are shown each though another is not answered; also an alert that came meanwhile."""
    view = Answered(missing)
    view.store.take_alert(FAILED)
    await view.ask()
    assert bool(view.store.stops.active) == (missing != "standing")
    assert set(view.store.alerts) == ({FAILED.id} if missing == "alerts" else {ROBOT.id, GATEWAY.id})
    assert bool(list(view.store.enquiries)) == (missing != "enquiries")
    assert bool(list(view.store.closures)) == (missing != "closures")


@pytest.mark.parametrize(
    ("signals", "written"),
    [
        ((), []),
        (("bell",), ["\a", "\a"]),
        (
            ("bell", "notification"),
            [
                "\a",
                "\x1b]9;SwiftBot test: rover_1 is lost␛]0;x and 1 more\a",
                "\a",
                "\x1b]9;SwiftBot test: gw-b is lost\a",
            ],
        ),
    ],
)
async def test_the_terminal_signals_critical_alerts_that_are_new(
    view: "FakeView", signals: tuple[Literal["bell", "notification"], ...], written: list[str]
) -> None:
    """Once for all that are new, not again while they last, and nothing in an alert is obeyed by the terminal."""
    app = SwiftbotApp(view, TuiConfig(signals=signals))
    sent: list[str] = []
    app.write_terminal = sent.append
    lost = Alert(id="1", kind="k", level=AlertLevel.CRITICAL, what="rover_1 is lost\x1b]0;x", subject="robot", name="r")
    other = replace(lost, id="2")
    late = replace(lost, id="3", what="gw-b is lost")
    mild = replace(lost, id="4", level=AlertLevel.WARNING)
    for alerts in ([], [lost, other, mild], [lost, other], [lost, other, late], [late]):
        view.store.take_alerts(alerts)
        app.signal_alerts()
    assert sent == written
