"""What a task costs in requests: a coordinator calls its own gateway, a watcher asks only when nothing is pushed."""

import asyncio
from collections import Counter
from pathlib import Path

import msgspec
import pytest
from fleets import fleet_in

from appliance.client import FleetClient
from appliance.model import TaskRequest, TaskState, keyspace
from appliance.plane.rpc import Exchange
from appliance.plane.session import Message

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.fleet]


async def test_a_task_on_one_gateway_is_followed_by_what_is_pushed(tmp_path: Path) -> None:
    """A run of several seconds: one `submit`, one `task` when the watcher begins, and nothing about the run."""
    async with fleet_in(tmp_path, gateways=1, sim_rate=2.0) as fleet, FleetClient(fleet.endpoint) as client:
        seen: Counter[str] = Counter()

        def exchanged(message: Message) -> None:
            seen[msgspec.json.decode(message.payload, type=Exchange).verb] += 1

        keys = client.plane.keys
        closer = client.plane.session.subscribe(keys(keyspace.EXCHANGE), exchanged)
        accepted = await client.submit(TaskRequest(instruction="Rover_1: go to dock 3"))
        last = None
        async with asyncio.timeout(90):
            async for record in client.watch(accepted.id):
                last = record
        closer.close()
        assert last is not None
        assert last.state is TaskState.SUCCEEDED, last.failure
        assert (last.updated_ns - last.created_ns) / 1e9 > 3.0, "too short to tell"
        about_runs = {verb: count for verb, count in seen.items() if verb.startswith("run") or verb == "task"}
        assert about_runs.pop("task", 0) <= 2
        assert about_runs == {}
