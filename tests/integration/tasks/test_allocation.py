"""Which of several robots a task gets, with real gateways and simulated rovers: charge counts before nearness."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import PLAIN, fleet_in
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.llm.settings import SafetyConfig
from appliance.model import TaskRequest, TaskState
from appliance.pool.settings import PoolConfig
from tests.integration.tasks.test_partition import process

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
LONG_S = 90.0
ROVERS = {"rover_1": ("dock 2", "15"), "rover_2": ("charger", "90")}
"""Where they stand at first, and their charge."""


@pytest.fixture
async def client(tmp_path: Path) -> AsyncIterator[FleetClient]:
    """Two gateways; one rover with little charge near dock 1, the other far away."""
    base = replace(PLAIN, safety=SafetyConfig(choose_robot="auto"))
    order = {"gateways": 2, "zenoh": 0, "pool": PoolConfig(floor={"base": 2}), "base": base}
    async with contextlib.AsyncExitStack() as stack:
        fleet = await stack.enter_async_context(fleet_in(tmp_path, **order))
        for name, (start, battery) in ROVERS.items():
            where = ("--fleet", fleet.fleet, "--connect", fleet.endpoints[0])
            rover = ("--name", name, "--start", start, "--battery", battery, "--rate", "4")
            await stack.enter_async_context(process(tmp_path, name, "sim", "zenoh", *rover, *where))
        client = await stack.enter_async_context(FleetClient(fleet.endpoint, operator="ann"))
        async with asyncio.timeout(LONG_S):
            while set(client.plane.registry.robots) != set(ROVERS):
                await asyncio.sleep(0.1)
        yield client


async def test_the_nearer_robot_with_low_charge_is_not_taken(client: FleetClient) -> None:
    """`task why` says what it would end with; a plan that names it waits for approval with that reason."""
    low = "rover_1 would end with 14"
    await client.submit(TaskRequest(instruction="go to dock 1", id="t-any"))
    told = False
    async with asyncio.timeout(LONG_S):
        while not (record := await client.task("t-any")).state.final:
            told |= any(
                each.task == "t-any" and each.robot == "rover_2"
                for status in client.plane.registry.gateways.values()
                for each in status.work
            )
            await asyncio.sleep(0.05)
    assert record.state is TaskState.SUCCEEDED, record
    assert [each.bound_robot for each in record.subtasks] == ["rover_2"]
    assert told, "no gateway tells the fleet what its task has for rover_2"
    (why,) = (await client.why("t-any")).subtasks
    assert "took rover_2" in why.attempts[0].placed
    assert low in why.attempts[0].placed
    assert "below the reserve of 20 %" in why.attempts[0].placed

    await client.submit(TaskRequest(instruction="rover_1: go to dock 3", id="t-named"))
    async with asyncio.timeout(LONG_S):
        while (proposal := (await client.task("t-named")).proposal) is None:
            await asyncio.sleep(0.1)
    assert proposal.waits
    assert low in proposal.note
    await client.cancel("t-named")
