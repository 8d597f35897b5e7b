"""`swiftbot robots drive` in a real terminal: robots of both kinds move while a key is held, and no longer."""

import asyncio
import math
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import fleet_in
from terminal import Terminal

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Plan, Pose, Subtask, TaskRequest, TaskState

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
LONG_S = 60.0


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """A gateway, a simulated copter by MAVLink and a simulated rover by Zenoh."""
    async with fleet_in(tmp_path, gateways=1, zenoh=1, mavlink=1) as state:
        yield state


@pytest.fixture
async def terminal(tmp_path: Path) -> AsyncIterator[Terminal]:
    """A terminal of 100 columns."""
    made = Terminal(tmp_path, (100, 24))
    yield made
    await made.close()


def pose(client: FleetClient, robot: str) -> Pose:
    """Return where a robot was heard to be."""
    found = client.known_robots()[robot].pose
    assert found is not None
    return found


def apart(one: Pose, other: Pose) -> float:
    """Return metres between two poses."""
    return math.dist((one.x, one.y, one.z), (other.x, other.y, other.z))


async def at_rest(client: FleetClient, robot: str) -> Pose:
    """Wait until a robot has not moved for a second, a hover's sway aside."""
    async with asyncio.timeout(LONG_S):
        while True:
            before = pose(client, robot)
            await asyncio.sleep(1.0)
            if apart(before, after := pose(client, robot)) < 0.05:
                return after


async def hold(terminal: Terminal, client: FleetClient, robot: str, key: str, metres: float) -> None:
    """Hold a key, as a keyboard repeats it, until the robot has come so far."""
    begun = pose(client, robot)
    async with asyncio.timeout(LONG_S):
        while apart(begun, pose(client, robot)) < metres:
            await terminal.press(key)
            await asyncio.sleep(0.05)


def driver(fleet: FleetState, robot: str) -> list[str]:
    """Return the command."""
    connect = [word for each in fleet.endpoints for word in ("--connect", each)]
    return [sys.executable, "-m", "appliance.cli", "robots", "drive", robot, "--fleet", fleet.fleet, *connect]


def environment() -> dict[str, str]:
    """Return where the project is, for a program that a terminal starts, and who drives."""
    return {"PYTHONPATH": os.environ.get("PYTHONPATH", ""), "USER": "olga"}


async def in_the_air(client: FleetClient) -> None:
    """Have the copter take off, by a task."""
    step = Subtask(id="s1", skill="takeoff", robot="drone_1", params={"altitude_m": 5})
    plan = Plan(domain="navigation", subtasks=(step,))
    await client.submit(TaskRequest(instruction="take off", id="t-up", plan=plan))
    async with asyncio.timeout(LONG_S):
        while not (record := await client.task("t-up")).state.final:
            await asyncio.sleep(0.2)
    assert record.state is TaskState.SUCCEEDED, record.failure


@pytest.mark.timeout(300)
@pytest.mark.parametrize("robot", ["rover_1", "drone_1"])
async def test_a_robot_moves_while_a_key_is_held(fleet: FleetState, terminal: Terminal, robot: str) -> None:
    """It comes to rest when the key is let go, drives back, and is released by `q`."""
    async with FleetClient(fleet.endpoint) as client:
        await client.gateway()
        if robot == "drone_1":
            await in_the_air(client)
        await terminal.start(driver(fleet, robot), environment())
        await terminal.see(robot, "‖ holds", "m/s")
        (lease,) = (await client.standing()).leases
        assert (lease.robot, lease.by) == (robot, "olga")
        await hold(terminal, client, robot, "Up", 0.4)
        away = await at_rest(client, robot)
        await terminal.see("‖ holds")
        await hold(terminal, client, robot, "Down", 0.3)
        assert apart(away, await at_rest(client, robot)) > 0.2
        await terminal.press("q")
        assert await terminal.ended() == 0
        assert not [each for each in (await client.standing()).leases if not each.ended]


@pytest.mark.timeout(300)
async def test_a_robot_stops_when_its_driver_is_killed(fleet: FleetState, terminal: Terminal) -> None:
    """With the key held and the program gone the rover comes to rest, and its lease ends without a word from there."""
    async with FleetClient(fleet.endpoint) as client:
        await client.gateway()
        await terminal.start(["sh", "-c", f"echo pid $$; exec {' '.join(driver(fleet, 'rover_1'))}"], environment())
        text = await terminal.see("pid ", "‖ holds")
        pid = int(text.split("pid ")[1].split()[0])
        await hold(terminal, client, "rover_1", "Up", 0.3)
        os.kill(pid, signal.SIGKILL)
        await at_rest(client, "rover_1")
        async with asyncio.timeout(LONG_S):
            while [each for each in (await client.standing()).leases if not each.ended]:
                await asyncio.sleep(0.5)
