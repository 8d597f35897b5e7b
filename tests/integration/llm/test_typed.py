"""What is typed is what moves, through real processes: stops, forbidden orders, conditions, places, typing mistakes."""

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import fleet_in

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.errors import PlanError, RefusedError
from appliance.model import RobotInfo, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """A gateway with the planner as shipped, a rover and a drone."""
    async with fleet_in(
        tmp_path, gateways=1, mavlink=1, base=GatewayConfig(id="base"), pool=PoolConfig(floor={"base": 1})
    ) as state:
        yield state


def said(fleet: FleetState, *words: str) -> "subprocess.CompletedProcess[str]":
    """Run a command of the command line on the fleet, without a terminal."""
    command = [sys.executable, "-m", "appliance.cli", *words, "--dir", fleet.directory, "--fleet", fleet.fleet]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=90, check=False, stdin=subprocess.DEVNULL, env=dict(os.environ)
    )


async def rover(client: FleetClient) -> RobotInfo:
    """Return the rover, once the client has heard of it."""
    async with asyncio.timeout(30):
        while "rover_1" not in client.plane.registry.robots:
            await asyncio.sleep(0.1)
    return client.plane.registry.robots["rover_1"]


async def test_what_is_typed_is_what_moves(fleet: FleetState) -> None:
    """Each line as an operator types it, and what a person sees of it; nothing runs that the words do not say."""
    async with FleetClient(fleet.endpoint) as client:
        await rover(client)
        home = client.plane.registry.robots["rover_1"].pose
        assert home is not None
        await refused(fleet)
        await held(client)
        await stopped(fleet, client)


async def refused(fleet: FleetState) -> None:
    """Forbidden orders, times, places off the site: exit code 4 with the reason, and no task has moved anything."""
    for text, why in (
        ("Drone_1: don't take off", "forbids this action"),
        ("Rover_1: go to dock 1 every 10 minutes", "not supported in an instruction"),
        ("Rover_1: go to 500, 500", "outside the fence"),
        ("Drone_1 fly to 47.3979, 8.5457", "latitude and longitude"),
        ("Rover_1: go to dcok 1", "dock 1"),
    ):
        done = await asyncio.to_thread(said, fleet, "submit", text)
        assert done.returncode == 4, (text, done.stdout, done.stderr)
        assert why in " ".join((done.stdout + done.stderr).split()), (text, done.stdout, done.stderr)


async def held(client: FleetClient) -> None:
    """A condition, an alternative, a robot that nobody named: the plan waits, with the reason by the check's name."""
    for text in (
        "Rover_1: go to dock 1 unless the battery is low",
        "Rover_1: go to dock 1 or dock 2, whichever is closer",
        "wait 30 seconds then go to dock 4",
    ):
        record = await client.submit(TaskRequest(instruction=text))
        record = await client.planned(record.id)
        assert record.state is TaskState.PROPOSED or record.failure is not None, (text, record)
        if record.proposal is not None:
            assert record.proposal.plan.provenance is not None
            assert any(each.severity == "hold" for each in record.proposal.plan.provenance.findings)
            await client.reject(record.id)


async def stopped(fleet: FleetState, client: FleetClient) -> None:
    """`stop` while the rover drives is the soft stop of all; a name that no robot has stops nothing and says so."""
    record = await client.submit(TaskRequest(instruction="Rover_1: go to dock 4"))
    async with asyncio.timeout(60):
        while (await client.task(record.id)).state is not TaskState.RUNNING:
            await asyncio.sleep(0.1)
    wrong = await asyncio.to_thread(said, fleet, "stop", "rovr_1")
    assert wrong.stdout.startswith("NOT STOPPED"), wrong.stdout + wrong.stderr
    assert "rover_1" in wrong.stdout
    assert wrong.returncode != 0
    assert (await client.standing()).active == ()
    with pytest.raises((RefusedError, PlanError), match="stop"):
        await client.submit(TaskRequest(instruction="rover_1: stop", submitter="rover_1"))
    done = await asyncio.to_thread(said, fleet, "submit", "STOP", "--json")
    assert json.loads(done.stdout)["stops"], done.stderr
    assert len((await client.standing()).active) == 1
    before = (await rover(client)).pose
    await asyncio.sleep(2.0)
    after = (await rover(client)).pose
    assert before is not None
    assert after is not None
    assert abs(before.x - after.x) + abs(before.y - after.y) < 0.5
    answer = await asyncio.to_thread(said, fleet, "plan", "rover_1: stop", "--json")
    assert json.loads(answer.stdout)["decision"] == "stop"
    await client.resume_robots()
