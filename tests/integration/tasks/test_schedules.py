"""Schedules of a real fleet, by the real command: submitted at their time, once over a takeover; alerts."""

import asyncio
import json
from typing import Any

import pytest
from fleets import alerts_until, kill, swiftbot

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import TaskState
from appliance.model.task_api import TasksAsk

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
FLEET = {"gateways": 3, "zenoh": 2}
LONG_S = 90.0


async def ended(client: FleetClient, text: str, count: int) -> list[Any]:
    """Wait until so many tasks whose id or instruction has a text have succeeded; returns all of them."""
    async with asyncio.timeout(LONG_S):
        while True:
            found = list((await client.tasks(50, wanted=TasksAsk(text=text))).tasks)
            if sum(each.state is TaskState.SUCCEEDED for each in found) >= count:
                return found
            await asyncio.sleep(0.2)


@pytest.mark.long
async def test_an_instruction_is_submitted_at_its_time(fleet: FleetState, client: FleetClient) -> None:
    """Once, in the operator's name; then the schedule is over. What cannot run is refused as it is added."""
    code, out, _ = await swiftbot(
        fleet, "schedule", "add", "rover_1: go to dock 1", "--in", "4s", "--name", "once", "--json"
    )
    assert code == 0
    due_ns = json.loads(out)["next_ns"][0]
    (task,) = await ended(client, "once.", 1)
    assert task.submitter == "cora"
    assert task.created_ns >= due_ns
    code, out, _ = await swiftbot(fleet, "schedule", "list", "--json")
    (shown,) = json.loads(out)
    assert (shown["next_ns"], shown["schedule"]["fired"], shown["schedule"]["task"]) == ([], 1, task.id)
    code, _, err = await swiftbot(fleet, "schedule", "add", "do the impossible thing", "--every", "10m")
    assert code == 4
    assert "--unchecked" in err
    code, _, err = await swiftbot(fleet, "schedule", "add", "stop", "--every", "10m", "--unchecked")
    assert code == 4
    code, _, err = await swiftbot(fleet, "plan", "rover_1: go to dock 1 every 10 minutes")
    assert code == 4
    assert "schedule add 'rover_1: go to dock 1' --every 10m" in " ".join(err.split())
    code, out, _ = await swiftbot(fleet, "audit", "--json")
    assert {"schedule_add", "submit"} <= {each["verb"] for each in json.loads(out)}


@pytest.mark.timeout(300)
@pytest.mark.long
async def test_a_takeover_goes_on_and_submits_nothing_twice(fleet: FleetState, client: FleetClient) -> None:
    """The gateway whose record it is dies: the next one submits at the next time; no time has two tasks."""
    code, out, _ = await swiftbot(fleet, "schedule", "add", "rover_2: go to dock 1", "--every", "10s",
                                  "--name", "patrol", "--overlap", "allow", "--json")  # fmt: skip
    assert code == 0
    owner = json.loads(out)["owner"]
    await ended(client, "patrol.", 1)
    kill(fleet, owner)
    found = await ended(client, "patrol.", 3)
    names = [each.id for each in found]
    assert len(set(names)) == len(names)
    times = sorted(each.id.partition(".")[2] for each in found)
    assert len(set(times)) == len(times)
    code, out, _ = await swiftbot(fleet, "schedule", "show", "patrol", "--json")
    shown = json.loads(out)
    assert shown["owner"] != owner
    assert shown["schedule"]["fired"] >= 3
    code, out, _ = await swiftbot(fleet, "schedule", "pause", "patrol", "--why", "enough")
    assert code == 0
    code, out, _ = await swiftbot(fleet, "schedule", "list")
    assert "paused" in out
    code, out, _ = await swiftbot(fleet, "schedule", "remove", "patrol")
    assert code == 0
    code, out, _ = await swiftbot(fleet, "schedule", "list")
    assert "no schedules" in out


@pytest.mark.long
async def test_what_waits_or_was_missed_is_an_alert(fleet: FleetState, client: FleetClient) -> None:
    """A plan that waits for approval, and times that passed while the task before was running or waiting."""
    code, _, _ = await swiftbot(fleet, "schedule", "add", "rover_1: go to dock 2", "--every", "10s", "--name", "held",
                                "--approval", "always")  # fmt: skip
    assert code == 0
    found = await alerts_until(client, lambda found: any(name.startswith("plan-waits.held.") for name in found))
    found = await alerts_until(client, lambda found: "schedule-missed.held" in found)
    assert "had not ended" in found["schedule-missed.held"].what
    code, _, _ = await swiftbot(fleet, "alerts", "ack", "schedule-missed.held", "--why", "seen")
    assert code == 0
    # Missed again, it waits for an acknowledgement again.
    await alerts_until(
        client, lambda found: "schedule-missed.held" in found and found["schedule-missed.held"].acked is None
    )
    code, _, _ = await swiftbot(fleet, "schedule", "remove", "held")
    assert code == 0


@pytest.mark.long
async def test_saved_instructions_are_run(fleet: FleetState, client: FleetClient) -> None:
    """With parameters, by their name, on any gateway; and by a schedule."""
    code, out, _ = await swiftbot(fleet, "instructions", "save", "visit", "{robot=rover_1}: go to {place}")
    assert code == 0
    assert "place=…" in out
    code, out, _ = await swiftbot(fleet, "instructions", "run", "visit", "place=dock 1", "--json")
    assert code == 0
    assert json.loads(out)["instruction"] == "rover_1: go to dock 1"
    code, _, err = await swiftbot(fleet, "instructions", "run", "visit")
    assert code != 0
    assert "no value for place" in err
    code, _, _ = await swiftbot(fleet, "schedule", "add", "--saved", "visit", "place=dock 2", "robot=rover_2",
                                  "--in", "3s", "--name", "visit")  # fmt: skip
    assert code == 0
    (task,) = await ended(client, "visit.", 1)
    assert task.instruction == "rover_2: go to dock 2"
    code, _, _ = await swiftbot(fleet, "instructions", "remove", "visit")
    assert code == 0
