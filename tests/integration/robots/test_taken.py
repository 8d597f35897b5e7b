"""A pilot takes a vehicle of a real fleet: its subtask waits with the reason, and goes on when it is given back."""

import asyncio
import os
import re
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from fleets import PLAIN
from pymavlink import mavutil

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import RobotInfo, SubtaskState, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
LOITER, GUIDED = 5, 4


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """A gateway and a copter as processes; ended and cleaned up afterwards."""
    order = Order(
        base=PLAIN,
        fleet=f"t{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=tmp_path / "fleet",
        gateways=1,
        sim_rate=3.0,
        zenoh=0,
        mavlink=1,
        pool=PoolConfig(floor={"base": 1}),
    )
    state = await local_fleet.up(order, progress=print, timeout_s=90.0)
    try:
        yield state
    finally:
        await local_fleet.down(order.directory, progress=print, volumes=True)


def take(url: str, number: int) -> None:
    """Change the vehicle's mode as a ground station does, until it says that it is so."""
    ground = mavutil.mavlink_connection(url, source_system=255, source_component=190)
    try:
        for confirmation in range(20):
            ground.mav.heartbeat_send(6, 8, 0, 0, 4)
            ground.mav.command_long_send(1, 1, 176, confirmation, 1, number, 0, 0, 0, 0, 0)
            changed = f"HEARTBEAT.autopilot==3 and HEARTBEAT.custom_mode=={number}"
            if ground.recv_match(type="HEARTBEAT", condition=changed, blocking=True, timeout=2):
                return
        raise AssertionError(f"the vehicle did not change to mode {number}")
    finally:
        ground.close()


async def test_a_taken_vehicle_is_waited_for(fleet: FleetState) -> None:
    """The run ends, the task goes on running, its subtask waits and says for whom; GUIDED gives the vehicle back."""
    text = (Path(fleet.directory) / fleet.gateways[0] / "gateway.toml").read_text()
    port = re.search(r"udp://127\.0\.0\.1:(\d+)", text)
    assert port is not None
    url = f"udpout:127.0.0.1:{port.group(1)}"
    async with FleetClient(fleet.endpoint) as client:

        def drone() -> RobotInfo:
            return client.plane.registry.robots["drone_1"]

        async def until(holds: Callable[[], object], limit_s: float = 60.0) -> None:
            async with asyncio.timeout(limit_s):
                while not holds():
                    await asyncio.sleep(0.1)

        await client.submit(TaskRequest(instruction="Drone_1: go to dock 3", id="taken"))
        await until(lambda: drone().mode == "AUTO" and drone().speed_mps)
        await asyncio.to_thread(take, url, LOITER)
        await until(lambda: drone().seized)
        async with asyncio.timeout(60):
            while (record := await client.task("taken")).subtasks[0].state is not SubtaskState.READY:
                await asyncio.sleep(0.1)
        assert record.state is TaskState.RUNNING
        assert "LOITER" in record.subtasks[0].attempts[0].left
        await asyncio.sleep(3.0)  # longer than the pause before a new attempt: nobody commands it meanwhile
        record = await client.task("taken")
        assert record.subtasks[0].state is SubtaskState.READY
        assert "taken at the vehicle" in record.subtasks[0].note
        assert drone().mode == "LOITER"
        await asyncio.to_thread(take, url, GUIDED)
        async with asyncio.timeout(90):
            while not (record := await client.task("taken")).state.final:
                await asyncio.sleep(0.2)
        assert record.state is TaskState.SUCCEEDED, record.subtasks
        assert len(record.subtasks[0].attempts) == 2
