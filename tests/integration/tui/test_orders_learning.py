"""A run of federated learning at the terminal UI: seen and steered on a real fleet, then in its log."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import fleet_in

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import RecordError, RefusedError
from appliance.learn.datasets.make import Clips, make_clips
from appliance.learn.decisions import all_traced
from appliance.model import TaskRequest
from appliance.model.learning import Clients, Data, Emulation, Evaluation, Mode, Recipe, Rounds, RunState, Training
from appliance.pool.settings import PoolConfig
from appliance.tasks.replay import CheckReport, check
from appliance.tui.replay import ReplayView
from appliance.tui.widgets.dialogs import TextDialog

from .operating import LONG_S, Operator, does
from .ordering import confirm
from .test_by_command import Shell

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.usefixtures("watched"), pytest.mark.timeout(400)]

RECIPE = Recipe(
    model="clips",
    data=Data(share="fleet"),
    clients=Clients(partitions=3, by="even"),
    training=Training(batch=2),
    rounds=Rounds(count=200, mode=Mode.PARTIAL),
    evaluation=Evaluation(every=1),
    emulation=Emulation(nominal_batch_s=0.4, speeds={"part-000": 2.0}),
)


@pytest.fixture(scope="module")
async def fleet(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[FleetState]:
    """Two gateways with a few drawn clips, and a recorder."""
    folder = tmp_path_factory.mktemp("learning")
    make_clips(folder / "data" / "clips", Clips(train_sites=3, test_sites=1, train_clips=1, test_clips=1))
    pool = PoolConfig(floor={"learn": 1}, folders={"learning": str(folder / "data")})
    async with fleet_in(folder, gateways=2, zenoh=2, pool=pool) as state:
        yield state


async def checked(folder: Path) -> CheckReport:
    """Make the decisions of the fleet's logs again, once a round's are in one."""
    async with asyncio.timeout(LONG_S):
        while True:
            try:
                report = await asyncio.to_thread(check, sorted(folder.glob("*.mcap")), traced=all_traced())
            except RecordError:
                report = None
            if report is not None and report.checked.get("round", 0) > 10:
                return report
            await asyncio.sleep(0.5)


@does(
    "learn-pause", "learn-resume", "learn-exclude", "learn-include", "learn-mark", "learn-unmark", "learn-stop"
)  # fmt: skip
@pytest.mark.long
async def test_a_run_is_seen_and_steered_and_its_log_shows_and_decides_the_same(
    fleet: FleetState, ann: Operator, client: FleetClient
) -> None:
    """Screen 6 lists it, Enter shows its clients as they train; keys pause, resume, exclude, include and stop it.

    The recorder's log of it fills the same screens, and each decision of its rounds is made again from it.
    """
    await client.learn_start("clips-1", RECIPE)
    await ann.press("6")
    await ann.see("clips-1", "● running", "coordinator gw-", "next gw-")
    await ann.press("enter")
    await ann.see("part-000", "● training", "gw-", "loss 2", "(0.", "x)")
    await ann.press("y")
    await ann.until(lambda: isinstance(ann.app.screen, TextDialog))
    await ann.see("part-000: ", "counted in")
    await ann.press("escape", "m")
    await ann.until(lambda: isinstance(ann.app.screen, TextDialog))
    await ann.see("digest", "gw-1, gw-2")
    await ann.press("escape", "p")
    await ann.see("◇ paused", "paused by ann")
    assert (await client.learn_show("clips-1")).run.state is RunState.PAUSED
    await ann.press("r")
    await ann.see("● running")
    await ann.press("home", "e")
    await confirm(ann, "Exclude client part-000")
    await ann.see("⊘ excluded", "excluded by ann")
    await ann.press("i")
    await ann.see("part-000", without="⊘ excluded")
    newest = (await client.learn_show("clips-1")).run.models[-1].number
    await ann.line(f"learn-mark clips-1 {newest} good")
    await ann.until_true(lambda: _marks(client, newest))
    await ann.line(f"learn-unmark clips-1 {newest}")
    await ann.until_true(lambda: _unmarked(client, newest))
    await ann.press("x")
    await confirm(ann, "Stop run clips-1 for good?")
    await ann.see("⊘ stopped", "stopped by ann", "· ended")

    folder = Path(fleet.record_dir)
    report = await checked(folder)
    assert report.same, report.divergences[:2]
    newest_log = max(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime)
    await ann.line(f"open {newest_log}")
    await ann.until(lambda: isinstance(ann.app.view, ReplayView))
    await ann.line("seek 100%")
    await ann.press("6")
    await ann.until(lambda: "clips-1" in ann.store.runs)
    await ann.press("6", "enter")
    await ann.see("RECORDED", "clips-1", "part-000", "part-002", "loss ", "round ")
    await ann.press("p")
    await ann.see("a recorded log cannot be steered")
    await ann.press("L")
    await ann.until(lambda: not isinstance(ann.app.view, ReplayView))


@does("learn-start")
async def test_an_instruction_to_train_starts_a_run_on_robots_once_it_is_confirmed(
    fleet: FleetState, ann: Operator, client: FleetClient, tmp_path: Path
) -> None:
    """Typed as an instruction it is shown, then trains rovers with the data at their gateways, to the end.

    Handed in as a task it is refused with the command. The commands tell what the screens tell, and export the model.
    """
    words = "train clips on all robots for 2 rounds"
    with pytest.raises(RefusedError, match="federated learning") as caught:
        await client.submit(TaskRequest(instruction=words))
    assert caught.value.remedy == "swiftbot learn start clips --robots all --rounds 2"
    with pytest.raises(RefusedError, match="federated learning"):
        await client.plan(words)
    await ann.press("s")
    await ann.write(words)
    await ann.press("enter")
    await confirm(ann, "all robots")
    await ann.press("6")
    await ann.until(lambda: any(run.recipe.clients.robots for run in ann.store.runs.values()))
    run = next(run for run in ann.store.runs.values() if run.recipe.clients.robots)
    assert run.recipe.names == ("rover_1", "rover_2")
    await ann.until(lambda: ann.store.runs[run.id].state is RunState.SUCCEEDED)
    counted = [line.clients for line in ann.store.runs[run.id].history]
    assert len(counted) == 2
    assert min(counted) >= 1, "of robots at one gateway, whose data are the same here, the first counts"

    shell = Shell(fleet, "ann")
    assert (await shell("learn", "why", run.id, "rover_1"))["status"]["rounds"] == 2
    kept = await shell("learn", "models", run.id)
    assert kept[-1]["number"] == 2
    judged = await shell("learn", "eval", run.id, "--model", "1")
    assert (judged["model"], judged["items"]) == (1, 10)
    made = await shell("learn", "export", run.id, str(tmp_path / "onnx"), "--format", "onnx")
    assert made["difference"] < 1e-4
    assert (tmp_path / "onnx" / "clips.onnx").stat().st_size > 200_000
    assert "rover_9" in str(await shell("learn", "start", "clips", "--robots", "rover_9", code=2))


async def _marks(client: FleetClient, number: int) -> bool:
    models = (await client.learn_show("clips-1")).run.models
    return any(model.number == number and model.marked for model in models)


async def _unmarked(client: FleetClient, number: int) -> bool:
    return not await _marks(client, number)
