"""Alerts of a real fleet of processes: each fault is in one list, in the header of every screen, and two keys away."""

import asyncio
import json
import os
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from fleets import alerts_until, kill, swiftbot
from terminal import Terminal

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import NotFoundError
from appliance.model import Approval, TaskRequest

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
FLEET = {"gateways": 3, "zenoh": 2}
LONG_S = 60.0


@pytest.fixture
async def terminal(tmp_path: Path) -> AsyncIterator[Terminal]:
    """A terminal of 80 columns and 24 lines."""
    made = Terminal(tmp_path)
    yield made
    await made.close()


async def test_each_fault_has_its_alert_until_it_is_over(fleet: FleetState, client: FleetClient) -> None:
    """A dead robot, gateway and recorder, a failed task and a plan that waits; acknowledged, retried, rejected."""
    await client.submit(TaskRequest(instruction="rover_1: go to dock 3", id="t-late", deadline_s=1.0))
    await client.submit(TaskRequest(instruction="rover_1: go to dock 1", id="t-held", approval=Approval.ALWAYS))
    wanted = {"task-failed.t-late", "plan-waits.t-held"}
    found = await alerts_until(client, lambda found: wanted <= set(found))
    assert found["plan-waits.t-held"].until_ns > found["plan-waits.t-held"].since_ns
    kill(fleet, "rover_2")
    kill(fleet, "gw-2")
    kill(fleet, "recorder")
    wanted |= {"robot-offline.rover_2", "gateway-lost.gw-2", "recorder.recorder"}
    found = await alerts_until(client, lambda found: wanted <= set(found))

    # Every gateway tells the same, and the command line what it hides otherwise.
    code, out, _ = await swiftbot(fleet, "alerts", "--json")
    assert code == 0
    assert wanted <= {each["id"] for each in json.loads(out)}
    assert all(each["remedy"] for each in json.loads(out))
    code, out, _ = await swiftbot(fleet, "fleet")
    assert code == 1
    assert "LOST" in next(line for line in out.splitlines() if line.startswith("gw-2"))
    code, out, _ = await swiftbot(fleet, "fleet", "--json")
    assert {each["id"]: bool(each["lost_ns"]) for each in json.loads(out)} == {
        "gw-1": False, "gw-2": True, "gw-3": False,
    }  # fmt: skip

    # Acknowledged by one, it is so for all; who was first stays, and what is unknown is named.
    code, out, _ = await swiftbot(fleet, "alerts", "ack", "robot-offline.rover_2", "no-such", "--why", "being mended")
    assert code == 1
    assert "no-such is over" in out
    await client.acknowledge(["robot-offline.rover_2"], why="later")
    found = await alerts_until(client, lambda found: found["robot-offline.rover_2"].acked is not None)
    word = found["robot-offline.rover_2"].acked
    assert word is not None
    assert (word.by, word.why) == ("cora", "being mended")
    acts, _ = await client.acts(50)
    assert ("alert_ack", "cora") in {(each.verb, each.by) for each in acts}
    with pytest.raises(NotFoundError, match="no-such"):
        await client.acknowledge(["no-such"])

    # What is mended is over: a plan that was rejected. A gateway that is lost stays so, with who has taken note of it.
    await client.reject("t-held", plan_hash=(await client.task("t-held")).proposal.hash)  # pyright: ignore[reportOptionalMemberAccess]
    await client.acknowledge(["gateway-lost.gw-2"])
    await alerts_until(
        client, lambda found: "plan-waits.t-held" not in found and found["gateway-lost.gw-2"].acked is not None
    )
    code, _, _ = await swiftbot(fleet, "fleet")
    assert code == 1


async def test_alerts_are_watched(fleet: FleetState, client: FleetClient) -> None:
    """`alerts --watch --json` prints an object for each change: begun, acknowledged, over."""
    where = ["--fleet", fleet.fleet, *(word for each in fleet.endpoints for word in ("--connect", each))]
    process = await asyncio.create_subprocess_exec(
        "env", "--default-signal=INT", sys.executable, "-m", "appliance.cli", "alerts", "--watch", "--json", *where,
        stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    stream = process.stdout

    async def seen(holds: Callable[[dict[str, Any]], bool]) -> None:
        async with asyncio.timeout(LONG_S):
            while not holds(json.loads(await stream.readline())):
                pass

    await client.submit(TaskRequest(instruction="rover_1: go to dock 1", id="t-held", approval=Approval.ALWAYS))
    name = "plan-waits.t-held"
    await seen(lambda each: each["id"] == name and each["acked"] is None)
    await client.acknowledge([name], why="seen")
    await seen(lambda each: each["id"] == name and each["acked"] is not None and each["acked"]["by"] == "ann")
    await client.cancel("t-held")
    await seen(lambda each: each["id"] == name and each["cleared_ns"] > 0)
    process.send_signal(signal.SIGINT)
    assert await process.wait() == 0


@pytest.mark.timeout(400)
@pytest.mark.long
async def test_each_fault_is_in_the_header_of_every_screen(
    fleet: FleetState, client: FleetClient, terminal: Terminal, tmp_path: Path
) -> None:
    """In a real terminal of 80 by 24: each is counted on each screen, and `!` and Enter lead to it and its remedy."""
    home = {"XDG_STATE_HOME": str(tmp_path / "state"), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    connect = [word for each in fleet.endpoints for word in ("--connect", each)]
    command = [sys.executable, "-m", "appliance.cli", "tui", "--fleet", fleet.fleet, *connect, "--write"]
    await terminal.start(command, home | {"PYTHONPATH": os.environ.get("PYTHONPATH", ""), "USER": "olga"})
    await terminal.see("3 gw", "2 robots")
    # What the machine itself lacks is taken note of, so that the counts below are those of the faults.
    await asyncio.sleep(2)
    if standing := [each.id for each in (await client.alerts()).alerts]:
        await client.acknowledge(standing)
    await terminal.see("SwiftBot", without=("▲1", "▲2", "▲3"))

    async def waits() -> None:
        await client.submit(TaskRequest(instruction="rover_1: go to dock 1", id="t-held", approval=Approval.ALWAYS))

    async def fails() -> None:
        await client.submit(TaskRequest(instruction="rover_1: go to dock 3", id="t-late", deadline_s=1.0))

    async def dies(name: str) -> None:
        kill(fleet, name)

    faults: list[tuple[Callable[[], Awaitable[None]], str, str]] = [
        (waits, "▲", "plan waits for approval"),
        (fails, "✘1", "failed"),
        (lambda: dies("rover_2"), "✘2", "offline"),
        (lambda: dies("recorder"), "✘3", "not heard"),
        (lambda: dies("gw-2"), "✘4", "does not answer"),
    ]
    for happens, count, words in faults:
        await happens()
        for number in range(1, 9):
            await terminal.press(str(number))
            await terminal.see(count)
        await terminal.press("!")
        await terminal.see("severity", words)
        await terminal.press("Escape")
    await terminal.press("2", "!")
    await terminal.write("/offline")
    await terminal.press("Enter")
    await terminal.see("robots forget rover_2")
    await terminal.press("Enter")
    await terminal.see("› rover_2")
