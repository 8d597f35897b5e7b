"""How the screens look at 80x24 and 160x48, in the dark, light and high-contrast themes; and that all can be read."""
# pyright: basic, reportArgumentType=false, reportAttributeAccessIssue=false

from collections.abc import Iterator
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from appliance.model import PlannerStatus, RunEvent, RunEventKind, SlotStatus, TierFigures
from appliance.model.gateways import CacheFigures, UpstreamStatus
from appliance.model.pool_api import DecisionList, PoolDecision
from appliance.model.recorder_api import RecorderStatus
from appliance.model.tasks import Phase
from appliance.tui import formatting, themes
from appliance.tui.app import SwiftbotApp
from appliance.tui.settings import TuiConfig

from .learning_runs import fill
from .pictures import NOW_NS, OTHER_SIZES, SIZES, characters, compare_screen, never_refused, universal_time

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = [pytest.mark.anyio, pytest.mark.thorough]
SCREENS = {
    "overview": ("0",),
    "fleet": ("1",),
    "gateway": ("1", "enter"),
    "pool": ("4",),
    "llm": ("5",),
    "learning": ("6",),
    "run": ("6", "enter", "down"),
    "help": ("1", "question_mark"),
    "confirm": ("1", "d"),
    "command": ("1", "colon", "d", "r"),
}


@pytest.fixture
def fleet(view: "FakeView", monkeypatch: pytest.MonkeyPatch) -> Iterator["FakeView"]:
    """Return a fleet in which much is the case at once, at one moment of universal time."""
    monkeypatch.setattr(formatting, "time", SimpleNamespace(time_ns=lambda: NOW_NS))
    planner = PlannerStatus(
        tiers={"local": TierFigures(asked=40, failed=3, p50_ms=240.0), "rules": TierFigures(asked=10, p50_ms=2.0)},
        slot=SlotStatus(model="plan-en", state="ready", tokens_s=812.0, queue=1, queue_most=8, memory_mb=96.0),
        cache=CacheFigures(entries=12, hits=30, misses=10),
        upstream=UpstreamStatus(state="open", retry_after_s=12.0, requests=7, spent=0.5, budget=2.0),
        planned=50,
        escalated=10,
        thresholds={"local": 0.8},
    )
    statuses = {name: each.status for name, each in view.store.gateways.items()}
    statuses["gw-a"] = replace(statuses["gw-a"], planner=planner, started_ns=NOW_NS - 7200 * 10**9, cores=4)
    statuses["gw-b"] = replace(statuses["gw-b"], drain="gives 2 runs away", draining=True)
    statuses["gw-c"] = replace(statuses["gw-a"], id="gw-c", robots=(), load=0.95, planner=None)
    view.store.take_gateways(statuses, NOW_NS)
    view.store.measured("gw-a", latency_ms=0.42, arc=0.61)
    view.store.take_gateways({name: each for name, each in statuses.items() if name != "gw-c"}, NOW_NS)
    view.store.recorders.put("r", RecorderStatus(id="r", fleet="test", state="recording", file="a.mcap", messages=7))
    for number in range(30):
        phase = Phase.COLD if number % 7 == 0 else Phase.LOCAL_WARM
        event = RunEvent(
            task="t-running", subtask="s1", attempt=1, kind=RunEventKind.STARTED, gateway="gw-a", phase=phase,
            startup_ms=900.0 if phase is Phase.COLD else 3.0 + number,
        )  # fmt: skip
        view.store.take_run(event, NOW_NS)
    decisions = tuple(
        PoolDecision(at_ns=NOW_NS - number * 10**9, what=what, image="base", container="c1", why=why)
        for number, (what, why) in enumerate(
            (("start", "2 of 2 are busy and one more run is expected in 4 s"), ("retire", "idle for 600 s"))
        )
    )
    fill(view)
    view.orders.answers["pool_decisions"] = ({"gw-a": DecisionList(decisions=decisions, counts={})}, {})
    with universal_time(monkeypatch):
        yield view


@SIZES
@pytest.mark.parametrize("screen", SCREENS)
async def test_screen_looks_as_it_did(fleet: "FakeView", screen: str, size: tuple[int, int]) -> None:
    """Characters and styles are those of the snapshot, in each of the themes."""
    await compare_screen(fleet, screen, SCREENS[screen], size, write=screen == "confirm")


@pytest.mark.parametrize("screen", ["overview", "fleet", "gateway", "pool", "llm", "learning", "run"])
@OTHER_SIZES
async def test_other_sizes_are_never_refused(fleet: "FakeView", screen: str, size: tuple[int, int]) -> None:
    """Narrower and wider than usual, a screen still shows what comes first in it, and no line is too long."""
    await never_refused(fleet, SCREENS[screen], size)


@pytest.mark.parametrize("name", sorted(themes.BY_NAME))
def test_theme_can_be_read(name: str) -> None:
    """Every colour stands out from each ground: 4.5 to 1 at least, 7 to 1 in high contrast; what is past 4.5, or 6."""
    look = themes.BY_NAME[name]
    least, past = (7.0, 6.0) if name.startswith("contrast") else (4.5, 4.5)
    for ground in (look.ground, look.panel, look.cursor):
        for part in ("text", "primary", "well", "works", "broken", "next", "leaving", "past"):
            assert themes.contrast(getattr(look, part), ground) >= least, (part, ground)
        assert themes.contrast(look.dimmed(ground), ground) >= past, ground


async def test_no_colour_is_respected(fleet: "FakeView", monkeypatch: pytest.MonkeyPatch) -> None:
    """With NO_COLOR every style is a shade of grey, and glyph and word still tell the states."""
    monkeypatch.setenv("NO_COLOR", "1")
    app = SwiftbotApp(fleet, TuiConfig(refresh_hz=0.2))
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.pause()
        assert app.no_color
        assert "✘" in characters(app)
        assert "◌ draining" in characters(app)
