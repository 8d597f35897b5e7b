"""Places and robots out of use in a real fleet, by the real command: plans are refused, tasks wait."""

import asyncio
import json

import pytest
from fleets import alerts_until, kill, swiftbot

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Approval, TaskRequest, TaskState

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
FLEET = {"gateways": 2, "zenoh": 2}
LONG_S = 60.0


@pytest.mark.long
async def test_a_closed_place_is_obeyed(fleet: FleetState, client: FleetClient) -> None:
    """A new plan is refused with who and why; one that was made before waits, and goes on once the place is open."""
    await client.submit(TaskRequest(instruction="rover_1: go to dock 2", id="t-before", approval=Approval.ALWAYS))
    async with asyncio.timeout(LONG_S):
        while (record := await client.task("t-before")).proposal is None:
            await asyncio.sleep(0.1)
    code, _, _ = await swiftbot(fleet, "place", "close", "dock 2", "--why", "wet floor")
    assert code == 0
    code, _, err = await swiftbot(fleet, "plan", "rover_1: go to dock 2")
    assert code == 4
    assert "closed by cora: wet floor" in " ".join(err.split())
    code, _, _ = await swiftbot(fleet, "plan", "rover_1: go to dock 1")
    assert code == 0
    await client.approve("t-before", plan_hash=record.proposal.hash)
    async with asyncio.timeout(LONG_S):
        while "wet floor" not in (record := await client.task("t-before")).subtasks[0].note:
            assert not record.state.final
            await asyncio.sleep(0.1)
    code, out, _ = await swiftbot(fleet, "place", "--json")
    assert [each["name"] for each in json.loads(out) if each["closed"]] == ["dock 2"]
    code, _, _ = await swiftbot(fleet, "place", "open", "dock 2")
    assert code == 0
    async with asyncio.timeout(LONG_S):
        while not (record := await client.task("t-before")).state.final:
            await asyncio.sleep(0.1)
    assert record.state is TaskState.SUCCEEDED


async def test_a_robot_in_maintenance_is_left_alone(fleet: FleetState, client: FleetClient) -> None:
    """No plan names it, another is chosen, its loss is no alert; ended, it works again."""
    code, _, _ = await swiftbot(fleet, "robots", "maintain", "rover_1", "--why", "tyres")
    assert code == 0
    code, _, err = await swiftbot(fleet, "plan", "rover_1: go to dock 1")
    assert code == 4
    assert "in maintenance by cora: tyres" in " ".join(err.split())
    kill(fleet, "rover_1")
    kill(fleet, "rover_2")
    await alerts_until(client, lambda found: "robot-offline.rover_2" in found)
    assert "robot-offline.rover_1" not in {each.id for each in (await client.alerts()).alerts}
    code, out, _ = await swiftbot(fleet, "robots", "list", "--json")
    assert {each["id"]: bool(each["maintenance"]) for each in json.loads(out)} == {"rover_1": True, "rover_2": False}
    code, _, _ = await swiftbot(fleet, "robots", "maintain", "rover_1", "--end")
    assert code == 0
    await alerts_until(client, lambda found: "robot-offline.rover_1" in found)
