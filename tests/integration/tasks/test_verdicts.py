"""What operators think of plans counts: two rejections and an edit, and the next such plan waits for them."""

import asyncio
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from fleets import fleet_in
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Approval, TaskRecord, TaskRequest, TaskState
from appliance.model.task_api import ExperienceList

pytestmark = [pytest.mark.anyio, pytest.mark.podman]

TOUR = "Rover_1: go to dock 3, then go to dock 2"


async def _until(client: FleetClient, task: str, holds: Callable[[TaskRecord], bool]) -> TaskRecord:
    async with asyncio.timeout(90):
        while not holds(record := await client.task(task)):
            await asyncio.sleep(0.1)
    return record


async def _command(state: FleetState, *arguments: str) -> str:
    connect = [part for endpoint in state.endpoints for part in ("--connect", endpoint)]
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "appliance.cli", *arguments, "--fleet", state.fleet, *connect),
        stdout=asyncio.subprocess.PIPE,
    )
    out, _ = await process.communicate()
    assert process.returncode == 0
    return out.decode()


async def _proposed(client: FleetClient, task: str) -> TaskRecord:
    await client.submit(TaskRequest(instruction=TOUR, id=task, approval=Approval.ALWAYS))
    return await _until(client, task, lambda record: record.state is not TaskState.ACCEPTED)


@pytest.mark.long
async def test_rejections_and_an_edit_make_the_next_such_plan_wait(tmp_path: Path) -> None:
    """`swiftbot task reject` twice and an edited plan once: `swiftbot skill-stats` shows the higher threshold.

    Before it the same instruction runs unasked. The records keep the plans that were turned down and changed.
    """
    async with fleet_in(tmp_path, gateways=1, zenoh=1, sim_rate=4.0) as state, FleetClient(state.endpoint) as client:
        before = msgspec.json.decode(await _command(state, "skill-stats", "--json"), type=ExperienceList).thresholds
        for task in ("no-1", "no-2"):
            await _proposed(client, task)
            await _command(state, "task", "reject", task)
            ended = await _until(client, task, lambda record: record.state.final)
            assert ended.decision is not None
            assert ended.decision.plan is not None
            assert ended.decision.plan.provenance is not None
            assert ended.decision.note
        record = await _proposed(client, "edit")
        assert record.proposal is not None
        plan = record.proposal.plan
        shorter = replace(plan, subtasks=plan.subtasks[:1])
        file = tmp_path / "plan.json"
        file.write_bytes(msgspec.json.encode(shorter))
        await _command(state, "task", "approve", "edit", "--hash", record.proposal.hash, "--plan", str(file))
        ended = await _until(client, "edit", lambda record: record.state.final)
        assert ended.state is TaskState.SUCCEEDED
        assert ended.plan is not None
        assert ended.plan.provenance is not None
        assert ended.plan.provenance.edited
        tier = ended.plan.provenance.tier.value
        async with asyncio.timeout(30):
            while True:
                shown = await _command(state, "skill-stats", "--json")
                after = msgspec.json.decode(shown, type=ExperienceList).thresholds
                if after[tier] > before[tier]:
                    break
                await asyncio.sleep(0.2)
        assert after[tier] > before[tier]
        await client.submit(TaskRequest(instruction=TOUR, id="next"))
        waits = await _until(client, "next", lambda record: record.state is not TaskState.ACCEPTED)
        assert waits.state is TaskState.PROPOSED
        assert waits.proposal is not None
        assert f"plans run unasked from {after[tier]:.2f}" in waits.proposal.note
