"""A task id that is used again after its record was trimmed: through the command line, on a fleet with a robot."""

import asyncio
import json
import sys
from pathlib import Path

import pytest
from fleets import PLAIN, fleet_in
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import RunEvent, TaskRecord, TaskState
from appliance.tasks.settings import TasksConfig

pytestmark = [pytest.mark.anyio, pytest.mark.podman]

DRIVE = "Rover_1: go to dock 3"


async def swiftbot(fleet: FleetState, *arguments: str) -> str:
    """What a command says; it must succeed."""
    run = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli", *arguments, "--dir", fleet.directory, stdout=asyncio.subprocess.PIPE
    )
    out, _ = await run.communicate()
    assert run.returncode == 0, (arguments, out)
    return out.decode()


async def trimmed(client: FleetClient, task: str) -> TaskRecord:
    """Wait until only the outcome of a task is kept."""
    async with asyncio.timeout(60):
        while (record := await client.task(task)).remembered is None:
            await asyncio.sleep(0.1)
    return record


async def test_an_id_that_was_done_is_not_done_again(tmp_path: Path) -> None:
    """Submitted, finished, pushed out of what is kept, submitted again: the outcome, and nothing moves.

    `task show` and `task why` say when it was done and in which log that stands, and the log is there.
    """
    base = replace(PLAIN, tasks=TasksConfig(keep_finished=0, retention_s=0.3))
    async with (
        fleet_in(tmp_path, base=base, gateways=2, sim_rate=4.0, zenoh=1) as fleet,
        FleetClient(fleet.endpoint) as client,
    ):
        runs: asyncio.Queue[RunEvent] = asyncio.Queue()
        client.on_run("order-17", runs)
        submit = ("submit", DRIVE, "--id", "order-17", "--yes")
        await swiftbot(fleet, *submit, "--wait")
        record = await trimmed(client, "order-17")
        assert (record.state, record.subtasks, record.plan) == (TaskState.SUCCEEDED, (), None)
        assert record.remembered is not None
        assert (tmp_path / "fleet" / "record" / record.remembered.log).exists()
        while not runs.empty():
            assert runs.get_nowait().subtask == "s1"
        where = client.plane.registry.robots["rover_1"].pose
        for again in (submit, (*submit, "--wait"), ("submit", "Rover_1: go to dock 1", "--id", "order-17", "--yes")):
            told = json.loads(await swiftbot(fleet, *again, "--json"))
            assert (told["state"], told["updated_ns"]) == ("succeeded", record.updated_ns)
        assert any("nothing was begun" in each for each in told["notes"]), "of the last, which was another request"
        for command in ("show", "why"):
            text = " ".join((await swiftbot(fleet, "task", command, "order-17")).split())
            assert "done on " in text
            assert f"details are in the log {record.remembered.log}" in text
        # What is begun after it is done, and of the first nothing has run or moved again.
        await swiftbot(fleet, "submit", "Rover_1: stay for 1 s", "--id", "order-18", "--yes", "--wait")
        assert (await client.task("order-17")) == record
        assert runs.empty()
        assert client.plane.registry.robots["rover_1"].pose == where
        listed = json.loads(await swiftbot(fleet, "task", "list", "--json"))
        assert "order-17" not in [each["id"] for each in listed]
