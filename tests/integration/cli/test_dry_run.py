"""A plan that waits is run on simulated robots by the real command: nothing of the real fleet moves or changes."""

import asyncio
import json
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import INTERRUPTIBLE, command, fleet_in, where
from terminal import Terminal

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Approval, RobotInfo, TaskRequest, TaskState
from appliance.pool.engine import remove_fleet

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
FETCH = "rover_1: fetch the red box from dock 3 and place it at dock 2"


@pytest.fixture(scope="module")
async def fleet(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[FleetState]:
    """One gateway and two rovers as processes."""
    async with fleet_in(tmp_path_factory.mktemp("fleet"), gateways=1, zenoh=2) as state:
        yield state


def standing(client: FleetClient) -> dict[str, tuple[float, float]]:
    """Return where the real robots are."""

    def at(info: RobotInfo) -> tuple[float, float]:
        assert info.pose is not None
        return info.pose.x, info.pose.y

    return {name: at(info) for name, info in client.known_robots().items()}


async def proposed(client: FleetClient, instruction: str) -> str:
    """Submit an instruction whose plan waits for approval; returns the task."""
    accepted = await client.submit(TaskRequest(instruction=instruction, approval=Approval.ALWAYS))
    assert (await client.planned(accepted.id)).state is TaskState.PROPOSED
    return accepted.id


async def test_a_plan_is_played_before_it_is_approved(fleet: FleetState, client: FleetClient) -> None:
    """It ends as it would, and says that it is a simulation; the real robots stand, and the plan still waits."""
    task, before = await proposed(client, FETCH), standing(client)
    code, out, err = await command("task", "simulate", task, "--json", "--rate", "8", *where(fleet))
    assert code == 0, err
    found = json.loads(out)
    assert found["simulation"] is True
    assert found["state"] == "succeeded"
    assert [each["state"] for each in found["steps"]] == ["succeeded"] * len(found["steps"])
    ended = {each["robot"]: each for each in found["robots"]}
    dock = (await client.site()).find("dock 2")
    assert dock is not None
    assert abs(ended["rover_1"]["pose"]["x"] - dock.x) + abs(ended["rover_1"]["pose"]["y"] - dock.y) < 3.0
    assert ended["rover_1"]["battery_used_percent"] > 0
    assert "simulation:" in err
    assert standing(client) == before
    assert (await client.task(task)).state is TaskState.PROPOSED


async def test_what_would_fail_fails_there_first(fleet: FleetState, client: FleetClient) -> None:
    """A thing that is nowhere is found missing without a robot having driven; exit code 1."""
    task = await proposed(client, "rover_1: pick up the purple piano")
    code, out, _ = await command("task", "simulate", task, "--json", "--rate", "8", *where(fleet))
    found = json.loads(out)
    assert (code, found["state"]) == (1, "failed")
    assert found["problem"]


async def test_it_is_watched_in_the_terminal_ui(fleet: FleetState, client: FleetClient, tmp_path: Path) -> None:
    """In a real terminal: what is simulated, marked so, to its end."""
    task = await proposed(client, "rover_1: go to dock 1")
    terminal = Terminal(tmp_path, size=(120, 40))
    home = {"XDG_STATE_HOME": str(tmp_path / "state"), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    command = (sys.executable, "-m", "appliance.cli", "tui", *where(fleet))
    await terminal.start(command, home | {"PYTHONPATH": os.environ.get("PYTHONPATH", "")})
    try:
        await terminal.see("gw-1", "rover_1")
        await terminal.write(f":simulate {task}")
        await terminal.press("Enter")
        await terminal.see("no real robot moves", "SIMULATION", "in the simulation: succeeded", timeout_s=120.0)
        await terminal.press("Escape")
        await terminal.see("rover_1", without=("no real robot moves",))
    finally:
        await terminal.close()
    assert (await client.task(task)).state is TaskState.PROPOSED


async def test_ctrl_c_ends_it_and_leaves_nothing(fleet: FleetState, client: FleetClient, tmp_path: Path) -> None:
    """Its processes, containers and files are gone."""
    task = await proposed(client, FETCH)
    process = await asyncio.create_subprocess_exec(
        *INTERRUPTIBLE, sys.executable, "-m", "appliance.cli", "task", "simulate", task, *where(fleet),
        stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE, env=os.environ | {"TMPDIR": str(tmp_path)},
    )  # fmt: skip
    assert process.stderr is not None
    name = ""
    async for line in process.stderr:
        if b"of fleet" in line:
            name = line.decode().split()[-1]
        if b"the fleet is ready" in line:
            break
    process.send_signal(signal.SIGINT)
    await process.stderr.read()
    assert await process.wait() == 130
    assert name.startswith("dry-run-")
    assert not list(tmp_path.glob("swiftbot-dry-run-*"))
    assert not (await remove_fleet(name, volumes=True)).containers
