"""Write pictures of the terminal UI's screens to docs/pictures, from a real local fleet and the log that it records.

Run as the user who runs gateways, from the project's root; it takes about three minutes, and needs the image `learn`
(`swiftbot images build learn`):

    scripts/as_user.sh python scripts/write_pictures.py [FOLDER]
"""

import asyncio
import os
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from appliance.client import FleetClient  # noqa: E402
from appliance.connection import FleetState  # noqa: E402
from appliance.learn.datasets.make import Clips, make_clips  # noqa: E402
from appliance.model import Approval, TaskRequest  # noqa: E402
from appliance.model.learning import Clients, Emulation, Mode, Recipe, Rounds, Training  # noqa: E402
from appliance.plane.settings import PlaneConfig  # noqa: E402
from appliance.pool.settings import PoolConfig  # noqa: E402
from appliance.tui.app import SwiftbotApp  # noqa: E402
from appliance.tui.replay import ReplayView  # noqa: E402
from appliance.tui.settings import TuiConfig  # noqa: E402
from appliance.tui.subscriptions import FleetView  # noqa: E402
from workshop import local_fleet  # noqa: E402 - a script finds the project beside itself
from workshop.local_fleet import Order  # noqa: E402

FOLDER = ROOT / "docs" / "pictures"
SIZE = (110, 32)
SCREENS: dict[str, tuple[str, ...]] = {
    "fleet": ("1",),
    "tasks": ("2", "down"),
    "task": ("2", "down", "enter"),
    "review": ("escape", "2", "home", "a", "end", "d"),
    "robots": ("escape", "3"),
    "robot": ("enter",),
    "pool": ("escape", "4"),
    "llm": ("5",),
    "learning": ("6",),
    "run": ("enter",),
    "log": ("7",),
}
"""Pictures in the order in which they are taken, with the keys pressed before each."""


async def settle(app: SwiftbotApp, seconds: float) -> None:
    """Let answers come and be drawn."""
    for _ in range(round(seconds * 10)):
        await asyncio.sleep(0.1)
        app.draw()


RUN = Recipe(
    model="clips",
    clients=Clients(partitions=6, by="site"),
    training=Training(batch=2),
    rounds=Rounds(count=40, target=0.9, mode=Mode.PARTIAL),
    emulation=Emulation(nominal_batch_s=0.3, speeds={"part-001": 4.0, "part-004": 2.0}),
)
"""The run of federated learning that is under way, with two slow clients."""
ROUNDS = 6
"""Closed rounds before its pictures are taken."""


async def trained(client: FleetClient) -> None:
    """Start the run, and wait until some of its rounds are closed and evaluated."""
    await client.learn_start("clips-hall", RUN)
    async with asyncio.timeout(300):
        while True:
            record = (await client.learn_show("clips-hall")).run
            if len(record.history) >= ROUNDS and record.history[-2].accuracy is not None:
                return
            await asyncio.sleep(0.5)


async def of_fleet(state: FleetState, folder: Path) -> None:
    """Write a picture of each screen of a fleet that works."""
    async with FleetClient(state.endpoint) as client:
        await trained(client)
        await client.submit(TaskRequest(instruction="rover_1: go to dock 3, photograph the red box", submitter="olga"))
        look = "rover_2: go to dock 4, photograph the shelf, then go to the gate"
        await client.submit(TaskRequest(instruction=look, submitter="olga", approval=Approval.ALWAYS))
        view = FleetView(PlaneConfig(mode="client", connect=state.endpoints), state.fleet)
        app = SwiftbotApp(view, TuiConfig(write=True))
        async with app.run_test(size=SIZE) as pilot:
            await settle(app, 4.0)
            for name, keys in SCREENS.items():
                for key in keys:
                    await pilot.press(key)
                    await pilot.pause()
                await settle(app, 2.0)
                app.export_svg(folder / f"tui-{name}.svg")
                print(f"wrote tui-{name}.svg")


def newest_log(folder: Path) -> Path:
    """Return the largest log of a folder."""
    return max(folder.glob("*.mcap"), key=lambda path: path.stat().st_size)


async def of_log(state: FleetState, folder: Path) -> None:
    """Write a picture of replay, of the log that the fleet's recorder wrote."""
    log = newest_log(Path(state.record_dir))
    app = SwiftbotApp(await ReplayView.open(log), TuiConfig(logs=(str(log.parent),)))
    async with app.run_test(size=SIZE) as pilot:
        await settle(app, 1.0)
        app.run_line("seek 90%")  # the run of federated learning came first
        await settle(app, 2.0)
        await pilot.press("space")
        await settle(app, 3.0)
        app.export_svg(folder / "tui-replay.svg")
        await pilot.press("2")
        await settle(app, 1.0)
        if not app.view.store.tasks:
            raise RuntimeError("the replayed log shows no task")
        print("wrote tui-replay.svg")


async def main() -> None:
    """Start a fleet, take the pictures, end it."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="swiftbot-pictures-") as directory:
        order = Order(
            fleet=f"hall{os.getpid()}",
            directory=Path(directory) / "fleet",
            gateways=2,
            mavlink=1,
            zenoh=2,
            pool=PoolConfig(floor={"base": 1, "vision": 1, "learn": 1}, folders={"learning": f"{directory}/data"}),
        )
        make_clips(Path(directory) / "data" / "clips", Clips(train_sites=6, test_sites=2, train_clips=1, test_clips=2))
        state = await local_fleet.up(order, progress=print)
        try:
            await of_fleet(state, folder)
            await of_log(state, folder)
        finally:
            await local_fleet.down(order.directory, progress=print)


if __name__ == "__main__":
    asyncio.run(main())
