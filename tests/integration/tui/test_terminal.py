"""The operator's main path in a real terminal, against a real local fleet."""

import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import fleet_in
from terminal import Terminal

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import SubtaskState, TaskState
from appliance.pool.settings import PoolConfig

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """Two gateways, a recorder and two rovers as processes."""
    async with fleet_in(tmp_path, gateways=2, zenoh=2, pool=PoolConfig(floor={"base": 1, "vision": 1})) as state:
        yield state


@pytest.fixture
async def terminal(tmp_path: Path) -> AsyncIterator[Terminal]:
    """A terminal of 80 columns and 24 lines."""
    made = Terminal(tmp_path)
    yield made
    await made.close()


def tui(fleet: FleetState, *more: str) -> list[str]:
    """Return the command that opens the terminal UI on a fleet."""
    connect = [word for each in fleet.endpoints for word in ("--connect", each)]
    return [sys.executable, "-m", "appliance.cli", "tui", "--fleet", fleet.fleet, *connect, *more]


@pytest.mark.timeout(300)
async def test_main_path(fleet: FleetState, terminal: Terminal, tmp_path: Path) -> None:
    """Start, submit, approve an edited plan, watch, drill, cancel, stop, resume, quit: keys in, screen out."""
    home = {"XDG_STATE_HOME": str(tmp_path / "state"), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    await terminal.start(tui(fleet), home | {"PYTHONPATH": os.environ.get("PYTHONPATH", ""), "USER": "olga"})
    await terminal.see("SwiftBot", "2 gw", "2 robots", "[R] read-only", "gw-1", "gw-2")

    # Nothing is changed before it is unlocked.
    await terminal.press("s")
    await terminal.see("read-only: W or")
    await terminal.press("W")
    await terminal.see("[W] unlocked")

    # Submit: names are completed, the plan is shown, and it is edited before it runs.
    await terminal.press("s")
    # The example in the empty field is of the site's places: from now on Tab completes them.
    await terminal.see("Instruction", "go to dock 3")
    await terminal.write("rover_1: go to doc")
    await terminal.press("Tab")
    await terminal.see("rover_1: go to dock ")
    await terminal.write("3, photograph the red box")
    await terminal.press("Enter")
    await terminal.see("Enter runs this plan", "goto", "photograph")
    await terminal.press("F2")
    await terminal.see("waits for approval", "Approve", "photograph")
    async with FleetClient(fleet.endpoint) as client:
        (waiting,) = (await client.tasks(10)).tasks
        assert waiting.state is TaskState.PROPOSED

        await terminal.press("r")
        await terminal.see("edit-robot s1")
        await terminal.write("rover_2")
        await terminal.press("Enter")
        await terminal.see("robot: rover_1 → rover_2", "checked")
        await terminal.press("Down", "d")
        await terminal.see("taken out", "✔ checked: it may run")
        await terminal.press("a")
        await terminal.see("Approve the edited plan", "rover_2")
        await terminal.press("y")

        # Watch and drill.
        await terminal.see("running", without=["? approve"])
        await terminal.press("Enter")
        await terminal.see("s1", "goto", "rover_2", "running", "log")
        record = await client.task(waiting.id)
        assert [each.subtask.robot for each in record.subtasks] == ["rover_2"]
        assert record.decision is not None
        assert (record.decision.by, record.decision.edited) == ("olga", True)
        await terminal.press("Escape")

        # Stop: one key, no question; and let go again, which asks.
        await terminal.press("F8", "3")
        await terminal.see("rover_1", "rover_2", "■ stopped")
        assert (await client.standing()).active
        await terminal.press("1")
        await terminal.see("gw-1", "gw-2")
        # Typed ahead: every key after the colon belongs to the command.
        await terminal.write(":resume-robots")
        await terminal.press("Enter")
        await terminal.see("Lift the soft stop of all robots")
        await terminal.press("y")
        await terminal.see("all robots may move again")
        await terminal.press("3")
        await terminal.see("rover_1", "rover_2", without=["■ stopped"])
        assert not (await client.standing()).active

        # Cancel.
        await terminal.press("2", "c")
        await terminal.see(f"Cancel task {waiting.id}?")
        await terminal.press("y")
        await terminal.see("cancelled")
        ended = await client.task(waiting.id)
        assert ended.state in (TaskState.CANCELLED, TaskState.CANCELLING)
        assert all(each.state is not SubtaskState.SUCCEEDED for each in ended.subtasks)

    await terminal.press("q")
    assert await terminal.ended() == 0
