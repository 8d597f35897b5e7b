"""What goes wrong is in the header of every screen of a real terminal, two keys away from its object and remedy."""

import asyncio
import os
import resource
import signal
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import pytest
from fleets import fleet_in
from terminal import Terminal

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Approval, Plan, Subtask, TaskRequest, TaskState
from appliance.model.alerts import AlertLevel
from appliance.tui.actions import SCREENS

from .test_terminal import tui

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.long]
LONG_S = 60.0


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """Two gateways, a recorder and two rovers as processes."""
    async with fleet_in(tmp_path, gateways=2, zenoh=2) as state:
        yield state


@pytest.fixture
async def terminal(tmp_path: Path) -> AsyncIterator[Terminal]:
    """A terminal of 80 columns and 24 lines."""
    made = Terminal(tmp_path)
    yield made
    await made.close()


async def header(terminal: Terminal, *wanted: str, without: Sequence[str] = ()) -> float:
    """Wait until the first line of the screen has some texts; how long that took, seconds."""
    began = time.monotonic()
    while True:
        line = (await terminal.screen()).split("\n", 1)[0]
        if all(each in line for each in wanted) and not any(each in line for each in without):
            return time.monotonic() - began
        if time.monotonic() - began > LONG_S:
            raise AssertionError(f"the header does not show {wanted} (without {tuple(without)}): {line}")
        await asyncio.sleep(0.03)


async def quiet(client: FleetClient, terminal: Terminal) -> None:
    """Acknowledge all alerts, and wait until no header counts one."""
    async with asyncio.timeout(LONG_S):
        while open_ := [each.id for each in (await client.alerts()).alerts if each.acked is None]:
            await client.acknowledge(open_, why="seen")
    await terminal.press("0", "Escape", "Escape")
    await header(terminal, without=[" ! ✘", " ! ▲"])


def process(fleet: FleetState, name: str) -> int:
    """Return the process of a name."""
    return next(each.pid for each in fleet.processes if each.name == name)


@pytest.mark.timeout(600)
async def test_what_goes_wrong_is_two_keys_away(fleet: FleetState, terminal: Terminal, tmp_path: Path) -> None:
    """A plan that waits, a failed task, a full disk, a dead robot, recorder, gateway: header, then `!` and Enter."""
    home = {"XDG_STATE_HOME": str(tmp_path / "state"), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    await terminal.start(tui(fleet), home | {"PYTHONPATH": os.environ.get("PYTHONPATH", ""), "USER": "olga"})
    await terminal.see("2 gw", "2 robots")
    recorder = process(fleet, "recorder")
    limits = resource.prlimit(recorder, resource.RLIMIT_FSIZE)
    figures: dict[str, float] = {}

    async with FleetClient(fleet.endpoint) as client:

        async def shows(what: str, begun: float, sign: str, *seen: str) -> None:
            await header(terminal, f" ! {sign}")
            figures[what] = time.monotonic() - begun
            for number in range(len(SCREENS)):
                await terminal.press(str(number))
                await header(terminal, f" ! {sign}")
            await terminal.press("!", "Enter")
            await terminal.see(*seen)

        def kill(name: str) -> float:
            os.kill(process(fleet, name), signal.SIGKILL)
            return time.monotonic()

        await quiet(client, terminal)
        look = TaskRequest(instruction="rover_1: go to dock 2", id="t-wait", approval=Approval.ALWAYS)
        await client.submit(look)
        await _until(client, "t-wait", TaskState.PROPOSED)
        await shows("plan waits", time.monotonic(), "▲1", "waits for approval", "dock 2", "a Approve")
        await client.reject("t-wait")

        await quiet(client, terminal)
        pick = Subtask(id="s1", skill="pick", robot="rover_1", params={"object": "green crate"})
        plan = Plan(domain="manipulation", subtasks=(pick,))
        await client.submit(TaskRequest(instruction="pick", id="t-fail", plan=plan))
        await _until(client, "t-fail", TaskState.FAILED)
        await shows("task failed", time.monotonic(), "✘1", "t-fail", "✘ failed", "drive to shelf", ":retry t-fail")

        await quiet(client, terminal)
        resource.prlimit(recorder, resource.RLIMIT_FSIZE, (1000, limits[1]))
        await shows("disk full", time.monotonic(), "✘1", "the disk is full", "make room")
        resource.prlimit(recorder, resource.RLIMIT_FSIZE, limits)
        # An acknowledged alert counts again when it becomes worse: what is left is a warning, of what the log misses.
        async with asyncio.timeout(LONG_S):
            while any(
                each.kind == "recorder" and each.level is AlertLevel.CRITICAL for each in (await client.alerts()).alerts
            ):
                await asyncio.sleep(0.1)

        await quiet(client, terminal)
        await shows("recorder dead", kill("recorder"), "✘1", "not heard any more", "is `swiftbot record` running?")

        await quiet(client, terminal)
        await shows("robot dead", kill("rover_2"), "✘1", "rover_2", "nothing is heard of it", "see that it is on")

        await quiet(client, terminal)
        await shows("gateway dead", kill("gw-2"), "✘1", "gw-2", "not reachable since", "check power and network")
    for what, seconds in figures.items():
        print(f"{what}: in the header after {seconds:.1f} s")
    await terminal.press("q")
    assert await terminal.ended() == 0


async def _until(client: FleetClient, task: str, state: TaskState) -> None:
    async with asyncio.timeout(LONG_S):
        while (await client.task(task)).state is not state:
            await asyncio.sleep(0.05)
