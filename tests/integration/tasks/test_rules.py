"""Standing rules in a real fleet: added on one gateway, obeyed by all, kept over the death and start of gateways."""

import asyncio
import json
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from fleets import kill, swiftbot

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Approval, TaskRequest, TaskState, keyspace
from appliance.model.closures import CloseAsk, ClosuresAsk, Rule

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.long]
FLEET = {"gateways": 2, "zenoh": 2}
LONG_S = 60.0


async def test_a_rule_of_another_gateway_is_obeyed(fleet: FleetState, client: FleetClient) -> None:
    """A plan is refused with it, a subtask of an earlier plan waits, `task why` names it; removed, the task goes on."""
    await client.submit(TaskRequest(instruction="rover_1: go to dock 2", id="t-before", approval=Approval.ALWAYS))
    async with asyncio.timeout(LONG_S):
        while (record := await client.task("t-before")).proposal is None:
            await asyncio.sleep(0.1)
    other = next(name for name in ("gw-1", "gw-2") if name != record.coordinator)
    rule = Rule(robots=("rover_1",), places=("dock 2",))
    ask = CloseAsk(kind="rule", name=rule.id, rule=rule, by="cora", why="wet floor")
    added = await client.plane.rpc.call(other, keyspace.CLOSE, ask)
    code, _, err = await swiftbot(fleet, "plan", "rover_1: go to dock 2")
    assert code == 4
    assert f"rover_1 is kept from it by standing rule {added.name}" in " ".join(err.split())
    code, _, _ = await swiftbot(fleet, "plan", "rover_2: go to dock 2")
    assert code == 0

    await client.approve("t-before", plan_hash=record.proposal.hash)
    async with asyncio.timeout(LONG_S):
        while added.name not in (record := await client.task("t-before")).subtasks[0].note:
            assert not record.state.final
            await asyncio.sleep(0.1)
    code, out, _ = await swiftbot(fleet, "task", "why", "t-before")
    assert code == 0
    assert added.name in out
    assert "wet floor" in " ".join(out.split())

    kill(fleet, other)
    async with asyncio.timeout(LONG_S):
        while other in client.plane.members():
            await asyncio.sleep(0.1)
    config = Path(fleet.directory) / other / "gateway.toml"
    again = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli", "gateway", "--config", str(config)
    )
    try:
        async with asyncio.timeout(LONG_S):
            while other not in client.plane.members():
                await asyncio.sleep(0.1)
        async with asyncio.timeout(LONG_S):
            while (await client.plane.rpc.call(other, keyspace.CLOSURES, ClosuresAsk())).rules != (added,):
                await asyncio.sleep(0.1)
        code, out, _ = await swiftbot(fleet, "rules", "list", "--json")
        assert [each["name"] for each in json.loads(out)] == [added.name]
        assert not (await client.task("t-before")).state.final
        code, out, _ = await swiftbot(fleet, "rules", "remove", added.name)
        assert code == 0
        assert "never go to dock 2" in " ".join(out.split())
        async with asyncio.timeout(LONG_S):
            while not (record := await client.task("t-before")).state.final:
                await asyncio.sleep(0.1)
        assert record.state is TaskState.SUCCEEDED
    finally:
        again.terminate()
        await again.wait()


async def test_a_rule_with_hours_holds_then_only(fleet: FleetState) -> None:
    """Outside them plans pass, inside them none does; a rule that cannot be is refused by the command."""
    now = datetime.now(UTC)
    later, sooner = (f"{now + timedelta(hours=hours):%H:%M}" for hours in (2, -2))
    hours = ("--from", later, "--to", sooner, "--zone", "UTC")
    code, _, _ = await swiftbot(fleet, "rules", "add", "--place", "dock 2", *hours)
    assert code == 0
    code, _, _ = await swiftbot(fleet, "plan", "rover_1: go to dock 2")
    assert code == 0
    hours = ("--from", sooner, "--to", later, "--zone", "UTC")
    code, out, _ = await swiftbot(fleet, "rules", "add", "--place", "dock 2", *hours, "--why", "people at work")
    assert code == 0
    assert "all robots: never go to dock 2 from" in " ".join(out.split())
    code, _, err = await swiftbot(fleet, "plan", "rover_1: go to dock 2")
    assert code == 4
    assert "people at work" in " ".join(err.split())
    for words, says in ((("--place", "dock 99"), "dock 99"), (("--robot", "rover_9", "--thing", "glass"), "rover_9")):
        code, _, err = await swiftbot(fleet, "rules", "add", *words)
        assert code == 4
        assert says in err
