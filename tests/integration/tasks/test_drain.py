"""Ending in order: a gateway that has to stop in mid-run, and a person who interrupts what they asked for."""

import asyncio
import os
import signal
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import INTERRUPTIBLE, PLAIN

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman]

FETCH = "Rover_1: go to dock 3, pick the red box, then go to dock 2 and place the red box at dock 2"


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """Three gateways, a recorder and a robot as processes; ended and cleaned up afterwards."""
    order = Order(
        base=PLAIN,
        fleet=f"d{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=tmp_path / "fleet",
        mavlink=0,
        sim_rate=4.0,
        pool=PoolConfig(floor={"base": 1}),
    )
    state = await local_fleet.up(order, progress=print, timeout_s=90.0)
    try:
        yield state
    finally:
        await local_fleet.down(order.directory, progress=print, volumes=True)


async def running(client: FleetClient, task: str, *, skill: str) -> TaskRecord:
    """Wait until a subtask of a skill runs."""
    async with asyncio.timeout(60):
        async for record in client.watch(task, silence_s=0.3):
            if any(each.subtask.skill == skill and each.state is SubtaskState.RUNNING for each in record.subtasks):
                return record
    raise AssertionError(f"{skill} never ran")


async def ended(client: FleetClient, task: str) -> TaskRecord:
    """Wait for a task's end."""
    last = None
    async with asyncio.timeout(90):
        async for record in client.watch(task):
            last = record
    assert last is not None
    return last


async def test_a_gateway_told_to_stop_in_mid_run_ends_the_run_and_the_task_goes_on(fleet: FleetState) -> None:
    """SIGTERM of the gateway that runs a subtask: that attempt succeeds there, the rest elsewhere, and it exits 0."""
    async with FleetClient(fleet.endpoint) as client:
        accepted = await client.submit(TaskRequest(instruction=FETCH))
        record = await running(client, accepted.id, skill="goto")
        first = next(each for each in record.subtasks if each.state is SubtaskState.RUNNING)
        process = next(each for each in fleet.processes if each.name == first.gateway)
        os.kill(process.pid, signal.SIGTERM)
        last = await ended(client, accepted.id)
        assert last.state is TaskState.SUCCEEDED, last.failure
        same = last.of(first.subtask.id)
        assert (same.gateway, same.attempt) == (first.gateway, 1), same.attempts
        async with asyncio.timeout(60):
            while local_fleet.alive(process):
                await asyncio.sleep(0.1)
    _, status = await asyncio.to_thread(os.waitpid, process.pid, 0)
    assert os.waitstatus_to_exitcode(status) == 0, Path(process.log).read_text()[-2000:]


async def test_an_interrupted_submit_cancels_its_task(fleet: FleetState) -> None:
    """Ctrl-C in `submit --wait` ends the task as cancelled, and the command with 130."""
    command = await asyncio.create_subprocess_exec(
        *INTERRUPTIBLE, sys.executable, "-m", "appliance.cli", "submit", FETCH, "--wait", "--id", "t-interrupted",
        "--fleet", fleet.fleet, "--dir", fleet.directory,
        stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert command.stderr is not None
    async with asyncio.timeout(60):
        while b"is accepted" not in (line := await command.stderr.readline()):
            assert line, "the command ended before its task was accepted"
    async with FleetClient(fleet.endpoint) as client:
        await running(client, "t-interrupted", skill="goto")
        command.send_signal(signal.SIGINT)
        _, said = await asyncio.wait_for(command.communicate(), 60)
        assert command.returncode == 130, said
        last = await ended(client, "t-interrupted")
    assert last.state is TaskState.CANCELLED
