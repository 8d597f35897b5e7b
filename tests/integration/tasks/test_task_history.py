"""Task history of a real fleet by the real command: filtered, paged over gateways, exported, duplicated."""

import csv
import io
import json
from pathlib import Path

import pytest
from fleets import swiftbot

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import TaskRequest

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
FLEET = {"gateways": 2, "zenoh": 1}


async def test_tasks_are_found_paged_exported_and_duplicated(fleet: FleetState, tmp_path: Path) -> None:
    """Seven tasks on two gateways: two a page are all of them once; filters, CSV and JSON lines agree."""
    async with FleetClient(fleet.endpoint, operator="ann") as client:
        for number in range(7):
            by = "ann" if number % 2 else "bob"
            await client.submit(TaskRequest(instruction=f"dance {number}", id=f"t-{number}", submitter=by))
            async for record in client.watch(f"t-{number}"):
                assert record.coordinator
    seen: list[str] = []
    before: tuple[str, ...] = ()
    while True:
        code, out, _ = await swiftbot(fleet, "task", "list", "--json", "--limit", "2", *before)
        assert code == 0
        page = [each["id"] for each in json.loads(out)]
        seen += page
        if len(page) < 2:
            break
        before = ("--before", page[-1])
    assert seen == [f"t-{number}" for number in range(6, -1, -1)]
    code, out, _ = await swiftbot(fleet, "task", "list", "--json", "--by", "Ann", "--state", "failed", "--since", "1h")
    assert [each["id"] for each in json.loads(out)] == ["t-5", "t-3", "t-1"]
    code, out, _ = await swiftbot(fleet, "task", "list", "--json", "--text", "DANCE 4")
    assert [each["id"] for each in json.loads(out)] == ["t-4"]
    code, out, err = await swiftbot(fleet, "task", "list", "--limit", "3")
    assert "--before t-4" in err
    code, out, _ = await swiftbot(fleet, "task", "export", "--robot", "nobody")
    assert (code, out) == (0, "")
    code, out, _ = await swiftbot(fleet, "task", "export")
    assert [json.loads(line)["id"] for line in out.splitlines()] == seen
    file = tmp_path / "tasks.csv"
    code, _, err = await swiftbot(fleet, "task", "export", str(file), "--csv")
    assert code == 0
    assert "7 tasks written" in err
    assert [row["id"] for row in csv.DictReader(io.StringIO(file.read_text()))] == seen
    code, out, _ = await swiftbot(fleet, "task", "duplicate", "t-3", "--json")
    assert code == 0
    found = json.loads(out)
    assert (found["instruction"], found["submitter"]) == ("dance 3", "cora")
    assert found["id"] not in seen
    code, _, err = await swiftbot(fleet, "task", "duplicate", "t-none")
    assert code == 4
    assert "t-none" in err
