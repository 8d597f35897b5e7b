"""The screens of federated learning: runs, one run with its clients, what keys do there; live and from a log."""
# pyright: basic, reportArgumentType=false, reportAttributeAccessIssue=false

from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import UnreachableError
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.model.learn_api import LearnShown
from appliance.model.learning import (
    Activity,
    Model,
    Recipe,
    RunRecord,
    RunState,
)
from appliance.model.messages import enums_open
from appliance.operations import learn_start
from appliance.tui.app import SwiftbotApp
from appliance.tui.ascii_terminal import in_ascii
from appliance.tui.screens.learning import LearningScreen, RunScreen, client_cells, curves
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Store
from appliance.tui.subscriptions import FleetView, Hearing
from appliance.tui.widgets.dialogs import ConfirmDialog, TextDialog
from appliance.tui.widgets.grid import Grid
from appliance.tui.widgets.plot import Series, plot

from .learning_runs import ENDED, HISTORY, ROUND, RUN, STATUSES, fill, status
from .pictures import settle

if TYPE_CHECKING:
    from appliance.client import FleetClient

    from .conftest import FakeView

pytestmark = pytest.mark.anyio
SIZES = [(80, 24), (160, 48)]


@pytest.fixture
def learning(view: "FakeView") -> "FakeView":
    """Return a fleet with a run under way and one that has ended."""
    fill(view)
    view.orders.answers["learn_steer"] = replace(RUN, state=RunState.PAUSED, why="paused by ops")
    return view


@pytest.mark.parametrize("size", SIZES)
async def test_runs_are_listed_and_the_selected_one_is_told_whole(learning: "FakeView", size: tuple[int, int]) -> None:
    """Those that go on come first; of the selected one round, coordinator, who is next, what it waits for, curves."""
    app = SwiftbotApp(learning)
    async with app.run_test(size=size) as pilot:
        await pilot.press("6")
        shown = await settle(app, pilot)
        assert isinstance(app.screen, LearningScreen)
        assert app.screen.query_one("#runs", Grid).keys == ["clips-1", "words-1"]
        for expected in (
            "● running", "7/40", "round 7/40, 6.0 s of 13.0 s to the deadline", "coordinator gw-b, next gw-a",
            "waits for 2 of 4 clients: rover_1, rover_2", "loss 0.400", "accuracy 0.700", "⊘ stopped",
        ):  # fmt: skip
            assert expected in shown, expected
        await pilot.press("down")
        shown = await settle(app, pilot)
        assert "no round is closed yet" in shown
        assert "stopped by ann" in shown


@pytest.mark.parametrize("size", SIZES)
async def test_a_run_shows_its_clients(learning: "FakeView", size: tuple[int, int]) -> None:
    """State with progress, gateway, samples, speed, ETA, staleness and reason of each; times beside waiting for all."""
    app = SwiftbotApp(learning)
    async with app.run_test(size=size) as pilot:
        await pilot.press("6", "enter")
        shown = await settle(app, pilot)
        assert isinstance(app.screen, RunScreen)
        row = next(line for line in shown.splitlines() if line.lstrip("› ").startswith("rover_1"))
        for expected in ("● training 40%", "gw-a", "96", "12/s", "4.8 s", "step 3/6"):
            assert expected in row, expected
        late = next(line for line in shown.splitlines() if line.lstrip("› ").startswith("rover_2"))
        assert late.split()[:4] == ["rover_2", "▲", "late", "70%"]
        assert "2" in late.split()
        assert "rover_1 training: step 3/6, loss 0.41" in shown, "the reason of the selected one whole"
        assert "round 10.0 s, all 41.0 s (0.27x)" in shown
        await pilot.press("down", "down", "down")
        assert "drone_2 absent: drone_2 is not there" in await settle(app, pilot)
        await pilot.press("escape")
        assert isinstance(app.screen, LearningScreen)


async def test_news_are_drawn_as_they_come(learning: "FakeView") -> None:
    """A client that is done, a closed round, an end; what is of a round before changes nothing."""
    app = SwiftbotApp(learning)
    async with app.run_test(size=SIZES[1]) as pilot:
        await pilot.press("6", "enter")
        await settle(app, pilot)
        learning.store.take_client(status("rover_1", Activity.DONE))
        learning.store.take_client(replace(status("drone_1", Activity.IDLE), round=6))
        shown = await settle(app, pilot)
        assert "● training" not in shown
        assert "· idle" not in shown
        closed = replace(HISTORY[-1], number=7, loss=0.25)
        learning.store.take_learn_run(replace(RUN, round=8, history=(*HISTORY, closed), updated_ns=10))
        assert "loss 0.250" in await settle(app, pilot)
        learning.store.take_learn_run(replace(RUN, round=8, state=RunState.SUCCEEDED, why="done", updated_ns=11))
        shown = await settle(app, pilot)
        assert "✔ succeeded" in shown
        assert shown.count("· ended") == 4


STEERED = [
    ("p", ("clips-1", "pause"), {}, False),
    ("r", ("clips-1", "resume"), {}, False),
    ("x", ("clips-1", "stop"), {}, True),
    ("e", ("clips-1", "exclude"), {"client": "rover_2"}, True),
    ("i", ("clips-1", "include"), {"client": "rover_2"}, False),
]


@pytest.mark.parametrize(("key", "asked", "options", "asks_first"), STEERED)
async def test_keys_steer_the_run_and_the_selected_client(
    learning: "FakeView", key: str, asked: tuple[str, ...], options: dict[str, str], asks_first: bool
) -> None:
    """Pause, resume, stop, exclude, include; what ends something asks first, and does nothing when it is refused."""
    app = SwiftbotApp(learning, TuiConfig(write=True))
    async with app.run_test(size=SIZES[0]) as pilot:
        await pilot.press("6", "enter", "down", key)
        await pilot.pause()
        assert isinstance(app.screen, ConfirmDialog) is asks_first
        if asks_first:
            await pilot.press("n")
            await settle(app, pilot)
            assert not learning.orders.of("learn_steer")
            await pilot.press(key)
            await pilot.pause()
            await pilot.press("y")
        await settle(app, pilot)
        assert learning.orders.of("learn_steer") == [asked]
        assert learning.orders.options["learn_steer"] == {"why": "", **options}


@pytest.mark.parametrize("key", ["p", "r", "x", "e", "i"])
async def test_nothing_is_steered_while_it_is_read_only(learning: "FakeView", key: str) -> None:
    """The keys say how to unlock, and ask nothing of the fleet."""
    app = SwiftbotApp(learning)
    async with app.run_test(size=SIZES[0]) as pilot:
        await pilot.press("6", "enter", key)
        assert "read-only" in await settle(app, pilot)
        assert not learning.orders.of("learn_steer")


async def test_why_and_models_are_read_at_leisure(learning: "FakeView") -> None:
    """Both work while it is read-only, and show what the commands print."""
    app = SwiftbotApp(learning)
    async with app.run_test(size=SIZES[0]) as pilot:
        await pilot.press("6", "enter", "y")
        shown = await settle(app, pilot)
        assert isinstance(app.screen, TextDialog)
        assert "rover_1: training 40%" in shown
        assert "expected in 4.8 s" in shown
        await pilot.press("escape", "m")
        assert "no models yet" in await settle(app, pilot)


async def test_an_instruction_to_train_shows_what_would_start_and_starts_it_when_confirmed(
    learning: "FakeView",
) -> None:
    """It is not planned: a question says recipe, robots and rounds; no starts nothing, yes starts the run on robots."""
    learning.orders.plane = SimpleNamespace(registry=SimpleNamespace(robots=dict(learning.store.robots), gateways={}))
    learning.orders.answers["learn_start"] = RUN
    app = SwiftbotApp(learning, TuiConfig(write=True))
    async with app.run_test(size=SIZES[0]) as pilot:
        for answer in ("n", "y"):
            await pilot.press("1", "s", *"train clips on all robots for 20 rounds", "enter")
            await pilot.pause()
            await pilot.pause()
            assert isinstance(app.screen, ConfirmDialog)
            shown = " ".join((await settle(app, pilot)).replace("│", " ").split())
            assert "clips, on all robots, rounds: 20?" in shown
            await pilot.press(answer)
            await settle(app, pilot)
            assert len(learning.orders.of("learn_start")) == (answer == "y")
        assert not learning.orders.of("plan")
        ((name, recipe),) = learning.orders.of("learn_start")
        assert name.startswith("clips-")
        assert (recipe.names, recipe.rounds.count) == (("drone-1",), 20), "a robot that is offline is none of them"
        await pilot.press("s", *"train clips on rover_9", "enter")
        await pilot.pause()
        await settle(app, pilot)
        assert learning.orders.of("plan") == [("train clips on rover_9",)], "the planner refuses it, with the command"


async def test_commands_complete_runs_and_clients(learning: "FakeView") -> None:
    """Tab knows the runs, newest first, and their clients."""
    app = SwiftbotApp(learning)
    async with app.run_test(size=SIZES[0]):
        assert app.completions("learn-stop ") == ("learn-stop clips-1", "learn-stop words-1")
        assert app.completions("learn-start cl") == ("learn-start clips",)
        assert app.completions("learn-exclude clips-1 rover")[0] == "learn-exclude clips-1 rover_1"


async def test_without_runs_it_says_how_one_begins(view: "FakeView") -> None:
    """An empty list names the command; a run that is not known is said to be so, keys do no harm."""
    app = SwiftbotApp(view, TuiConfig(write=True))
    view.orders.error = UnreachableError("nobody answers", remedy="wait")
    async with app.run_test(size=SIZES[0]) as pilot:
        await pilot.press("6")
        assert "swiftbot learn start clips" in await settle(app, pilot)
        await pilot.press("p")
        assert "run?" in await settle(app, pilot)
        await pilot.press("escape")
        app.push_screen(RunScreen("gone"))
        assert "run gone is not known" in await settle(app, pilot)
        await pilot.press("e")
        await settle(app, pilot)


async def test_foreign_text_is_shown_as_text(view: "FakeView") -> None:
    """Names and reasons of clients and models are no markup and no control characters."""
    fill(view)
    evil = "[red]\x1b[2Jx"
    view.store.take_learn_run(
        replace(RUN, why=evil, updated_ns=10, model=Model(number=1, digest=evil, gateways=(evil,)))
    )
    view.store.take_round(replace(ROUND, waits=evil, coordinator=evil))
    view.orders.error = UnreachableError("nobody answers", remedy="wait")
    with enums_open():
        view.store.take_client(status("rover_1", Activity("dances"), why=evil, gateway=evil))
    app = SwiftbotApp(view)
    async with app.run_test(size=SIZES[0]) as pilot:
        await pilot.press("6", "enter")
        shown = await settle(app, pilot)
        assert "\x1b" not in shown
        assert "[red]" in shown
        assert "? dances" in shown, "a state of a newer version has its own word"


def test_a_log_fills_the_same_screens() -> None:
    """What is put on the keys of learning is all that the store needs: so a recorded log shows what was."""
    store, keys = Store(), Keys("f")
    hearing = Hearing(store, "f")
    for topic, names, value in (
        (keyspace.LEARN_RUN, ("clips-1",), RUN),
        (keyspace.LEARN_ROUND, ("clips-1",), ROUND),
        *((keyspace.LEARN_CLIENT, ("clips-1", each.client), each) for each in STATUSES),
    ):
        assert hearing.hear(keys(topic, *names), msgspec.json.encode(value), 1)
    assert (store.runs["clips-1"], store.rounds["clips-1"], len(store.clients)) == (RUN, ROUND, 4)
    assert not hearing.hear(keys(keyspace.LEARN_RUN, "x"), b'{"id": 7}', 1)
    assert hearing.refused == {"RunRecord": 1}
    store.forget_all()
    assert not store.runs
    assert not store.rounds
    assert not store.clients


async def test_a_view_asks_for_what_was_put_before_it_came(view: "FakeView") -> None:
    """All runs, and those that go on whole: what has not changed since is not put again."""
    from appliance.plane.settings import PlaneConfig  # noqa: PLC0415 - only here

    fleet = FleetView(PlaneConfig(), "f")
    view.orders.answers["learn_runs"] = ((RUN, ENDED), {})
    view.orders.answers["learn_show"] = LearnShown(run=RUN, round=ROUND, coordinator="gw-b", clients=STATUSES)
    fleet._client = view.orders  # type: ignore[assignment]
    await fleet._ask_runs()
    assert view.orders.of("learn_show") == [("clips-1",)]
    assert set(fleet.store.runs) == {"clips-1", "words-1"}
    assert len(fleet.store.clients) == 4
    view.orders.answers["learn_runs"] = ((ENDED,), {"gw-b": UnreachableError("gone")})
    await fleet._ask_runs()
    assert "clips-1" in fleet.store.runs, "it may be at the gateway that did not answer"
    view.orders.answers["learn_runs"] = ((ENDED,), {})
    await fleet._ask_runs()
    assert set(fleet.store.runs) == {"words-1"}, "the other was removed"
    assert not fleet.store.clients


@given(st.lists(st.one_of(st.none(), st.floats())), st.integers(0, 40), st.integers(0, 6))
def test_any_values_make_a_plot_of_its_size(values: list[float | None], columns: int, rows: int) -> None:
    """Also none, one, huge and not finite ones: as many lines of as many cells as asked for."""
    lines = plot([Series(tuple(values), "")], columns, rows)
    assert [len(line.plain) for line in lines] == [columns] * rows


def test_a_plot_rises_and_falls_with_its_values() -> None:
    """What grows begins below and ends above, in one line without gaps; ASCII terminals see where it runs."""
    lines = [line.plain for line in plot([Series(tuple(map(float, range(10))), "")], 8, 2)]
    assert lines[1].strip() == lines[1][:4]
    assert lines[0].strip() == lines[0][4:]
    flat = [line.plain for line in plot([Series((1.0, 1.0), "")], 4, 1)]
    assert in_ascii(flat[0]) in ("....", "''''", "::::")


def test_curves_of_a_run_without_evaluations_have_no_accuracy() -> None:
    """What is not known is a dash, and draws nothing."""
    history = tuple(replace(line, accuracy=None, all_s=0.0) for line in HISTORY)
    assert "accuracy –" in curves(replace(RUN, history=history), 78, 3).plain


def test_parts_that_others_train_are_told_of_their_client() -> None:
    """Of an offloaded client the reason begins with how many parts are elsewhere."""
    cells = client_cells(status("rover_1", Activity.TRAINING, parts=2, why="step 1/6"))
    assert cells[-1] == "2 parts elsewhere; step 1/6"


@pytest.mark.parametrize("images", [(), ("localhost/swiftbot/base:0123",), ("localhost/swiftbot/learn:0123",)])
async def test_a_run_that_no_gateway_can_train_says_what_to_build(images: tuple[str, ...]) -> None:
    """The terminal UI builds no image: where no gateway has that of training, the answer has the command."""
    gateways = {"gw-a": SimpleNamespace(images=images), "gw-b": SimpleNamespace(images=())}
    robots = {"rover_1": SimpleNamespace(online=True)}

    async def nothing() -> None:
        return None

    async def start(_: str, recipe: Recipe, **__: object) -> RunRecord:
        return replace(RUN, recipe=recipe)

    client = SimpleNamespace(
        gateway=nothing,
        learn_start=start,
        plane=SimpleNamespace(registry=SimpleNamespace(robots=robots, gateways=gateways)),
    )
    outcome = await learn_start(cast("FleetClient", client), "clips")
    assert outcome.text.startswith("run clips-1 started on rover_1")
    assert ("swiftbot images build learn" in outcome.text) == (not any("/learn:" in image for image in images))
