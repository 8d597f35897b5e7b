"""Hostile strings, unknown states and fields of the future: everything is shown as text, and no screen breaks."""

import math
import unicodedata
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    LogLine,
    Notice,
    Plan,
    RunEvent,
    RunEventKind,
    TaskRecord,
    encode,
)
from appliance.model.gateways import PlannerStatus, SlotStatus, TierFigures
from appliance.model.pool_api import PoolDecision
from appliance.model.recorder_api import RecorderStatus
from appliance.tui.app import SwiftbotApp
from appliance.tui.screens import fleet, models
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Gateway, Start, Store
from appliance.tui.subscriptions import Hearing
from appliance.tui.widgets import dialogs
from appliance.tui.widgets.grid import Column, fit, widths

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
HOSTILE = (
    "[red]x[/] [/nope] [@click=app.quit]y[/]",
    "\x1b[2J\x1b]0;title\x07\x1b[31mred",
    "\x00\x08\x7f\x9b31m\r\n\tend",
    "\u202eevil\u202c \u2066x\u2069 \u200b\u200d\ufeff",
    "漢字" * 300,
    "שלום עולם مرحبا",
    "e" + "\u0301" * 500,
    "x" * 2**20,
    "\ud800 lone",
    "",
)
QUICKLY = {1, 3, 4, 8}
"""Those that are enough for quick feedback: commands to the terminal, directions, wide characters, half a character."""
TEXTS = st.one_of(st.sampled_from(HOSTILE), st.text(max_size=80))


def shown(cells: Any) -> str:
    """Return all text of cells or of a Text."""
    if isinstance(cells, Text):
        return cells.plain
    return "".join(cell if isinstance(cell, str) else cell[0] for cell in cells)


def harmless(text: str) -> bool:
    """Whether a terminal shows a text and obeys nothing in it."""
    return all(each == "\n" or unicodedata.category(each) not in ("Cc", "Cf", "Cs") for each in text)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(text=TEXTS, number=st.one_of(st.integers(-(2**60), 2**60), st.floats()))
def test_rows_are_harmless(text: str, number: float) -> None:
    """Whatever gateways, containers, planners, pools, recorders say, rows and sentences made of it are harmless."""
    planner = PlannerStatus(
        tiers={text: TierFigures(asked=int(number) if math.isfinite(number) else 1)},
        slot=SlotStatus(model=text, state=text, problem=text, tokens_s=float(number)),
        thresholds={text: float(number)},
        planned=1,
    )
    status = GatewayStatus(
        id=text, fleet="f", version=text, load=float(number), cpu_percent=float(number), memory_mb=float(number),
        pool_problem=text, overloaded=text, drain=text, models=(text,), robots=(text,), refused={text: 1},
        planner=planner, started_ns=int(number) if abs(number) < 2**60 else 0,
    )  # fmt: skip
    each = Gateway(status=status, latency_ms=float(number), arc=float(number))
    container = ContainerInfo(
        id=text, gateway=text, image=text, state=ContainerState.BUSY, run=text, cold_ms=float(number)
    )
    store = Store()
    store.gateways.put("g", each)
    decision = ("g", PoolDecision(at_ns=status.started_ns, what=text, image=text, container=text, why=text))
    parts = [
        fleet.gateway_cells(each),
        *fleet.gateway_notes([each]),
        *fleet.recorder_notes([RecorderStatus(id=text, fleet="f", state=text, problem=text, dropped={text: 1})]),
        fleet.about(each, store),
        models.model_cells(each),
        models.about(each),
        models.confidences([Plan(domain=text, subtasks=(), confidence=float(number))]),
        fleet.pool_cells(container),
        fleet.container_cells(container),
        fleet.starts_text([Start(None, float(number))], 80),
        *fleet.decision_lines([decision], 3),
    ]
    for part in parts:
        assert harmless(shown(part))
        assert len(shown(part)) < 10_000


@settings(deadline=None)
@given(text=TEXTS, width=st.integers(1, 60), right=st.booleans())
def test_a_cell_has_its_width(text: str, width: int, right: bool) -> None:
    """A text of any script is cut and filled to exactly the cells of its column."""
    clean = "".join(each for each in text[:300] if unicodedata.category(each)[0] != "C")
    assert cell_len(fit(clean, width, right=right)) == width


@settings(deadline=None)
@given(
    columns=st.lists(
        st.builds(Column, title=st.just("t"), width=st.integers(1, 40), grow=st.booleans(), drop=st.integers(0, 3)),
        min_size=1,
        max_size=12,
    ),
    room=st.integers(0, 300),
)
def test_columns_fit_the_window(columns: list[Column], room: int) -> None:
    """Columns with their gaps never need more than there is, down to the first alone."""
    found = widths(columns, room)
    here = [each for each in found if each]
    assert found[0] >= 1
    assert len(here) == 1 or sum(here) + len(here) - 1 <= room


@settings(deadline=None)
@given(
    data=st.one_of(st.binary(max_size=60), st.recursive(st.none() | st.integers() | st.text(), st.lists).map(encode))
)
def test_any_message_is_taken_or_counted(data: bytes) -> None:
    """Whatever comes on a key is taken or counted as refused; nothing is raised."""
    store = Store()
    hearing = Hearing(store, "f")
    for key in ("gw/a/status", "gw/a/pool/c", "task/t/record", "task/t/run/s", "robot/r/state", "notice/x", "gw/a/log"):
        before = sum(hearing.refused.values())
        taken = hearing.hear(f"swiftbot/f/{key}", data, 1)
        assert taken or sum(hearing.refused.values()) == before + 1
    assert not hearing.hear("swiftbot/other/notice/x", data, 1)


def test_fields_of_the_future_are_passed_over() -> None:
    """A message with fields that this version does not know is taken for what it does know."""
    store = Store()
    hearing = Hearing(store, "f")
    future = msgspec.json.decode(encode(GatewayStatus(id="gw-a", fleet="f", load=0.5))) | {"colour": {"of": "hope"}}
    assert hearing.hear("swiftbot/f/gw/gw-a/status", encode(future), 1)
    assert store.gateways["gw-a"].status.load == 0.5
    state = msgspec.json.decode(encode(TaskRecord(id="t", instruction="x"))) | {"state": "dreaming"}
    assert not hearing.hear("swiftbot/f/task/t/record", encode(state), 1)
    assert hearing.refused == {"TaskRecord": 1}


@settings(deadline=None, max_examples=50)
@given(text=st.one_of(st.sampled_from(HOSTILE[:7]), st.text(max_size=80)), width=st.integers(1, 120))
def test_what_is_to_be_read_is_harmless(text: str, width: int) -> None:
    """A text, table or group of a dialog holds nothing that a terminal would obey."""
    table = Table()
    table.add_column(Text(text))
    table.add_row(Text(text))
    found = dialogs.harmless(Group(Text(text), Padding(Text(text), (0, 0, 0, 4)), table), width)
    assert harmless(found.plain)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(text, id=str(number), marks=() if number in QUICKLY else pytest.mark.thorough)
        for number, text in enumerate(HOSTILE)
    ],
)
async def test_screens_live_with_it(view: "FakeView", text: str) -> None:
    """On every screen of the whole UI no control character reaches the terminal, and the screens go on."""
    store = view.store
    status = GatewayStatus(id="gw-x", fleet="f", version=text, pool_problem=text, robots=(text,), models=(text,))
    store.take_gateways({"gw-x": status}, 1)
    container = ContainerInfo(id="cx", gateway="gw-x", image=text, state=ContainerState.BUSY, run=text)
    store.take_containers({"gw-x": {"cx": container}})
    store.take_notice(Notice(id="n", to=text, text=text, at_ns=1))
    store.take_log(LogLine(at_ns=1, level=text, source=text, event=text, fields={text: text}))
    store.take_run(RunEvent(task=text, subtask=text, attempt=1, kind=RunEventKind.LOG, note=text), 1)
    store.take_task(TaskRecord(id="t-x", instruction=text, submitter=text, created_ns=9))
    app = SwiftbotApp(view, TuiConfig(refresh_hz=0.2))
    async with app.run_test(size=(80, 24)) as pilot:
        for keys in (("1",), ("enter",), ("4",), ("5",), ("6",), ("7",)):
            await pilot.press(*keys)
            await app.workers.wait_for_complete()
            await pilot.pause()
            app.draw(force=True)
            await pilot.pause()
            lines = app.screen._compositor.render_strips()
            assert harmless("".join(part.text for strip in lines for part in strip))
            assert all(strip.cell_length == 80 for strip in lines)
        assert app.is_running


def test_a_text_that_was_laid_out_keeps_its_blanks() -> None:
    """Columns of a table stand apart in a dialog; what is hostile in one is shown all the same and not obeyed."""
    table = Table(box=None, pad_edge=False)
    table.add_column("gateway")
    table.add_column("verdict")
    table.add_row("gw-1", "taken")
    table.add_row(Text("gw\x1b[31m"), Text("a  b"))
    laid = dialogs.harmless(Group(Text("  attempt 1"), table), 60).plain
    lines = [line.rstrip() for line in laid.splitlines()]
    assert lines[:3] == ["  attempt 1", "gateway  verdict", "gw-1     taken"]
    assert lines[3].startswith("gw␛[31m")
    assert lines[3].endswith("a  b")
