"""What operators met with the real command on a real fleet: each fault, named, and that it is gone."""

import asyncio
import json
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import command, fleet_in, where
from terminal import Terminal

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Approval, TaskRequest, TaskState
from appliance.tui.screens.submit import example

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
LONG_S = 60.0
POISON = 'Rover_1: say "[/red] Hello \x1b[2J"'


@pytest.fixture(scope="module")
async def fleet(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[FleetState]:
    """Two gateways and two rovers as processes."""
    async with fleet_in(tmp_path_factory.mktemp("fleet"), gateways=2, zenoh=2) as state:
        yield state


async def swiftbot(fleet: FleetState, *words: str, code: int = 0) -> str:
    """Run the real command, which ends with an exit code; returns its output."""
    ended_with, out, err = await command(*words, *where(fleet), by="")
    assert ended_with == code, (words, out, err)
    assert "Traceback" not in err
    return out


async def ended(client: FleetClient, task: str) -> TaskState:
    """Wait for the end of a task."""
    async with asyncio.timeout(LONG_S):
        async for record in client.watch(task):
            if record.state.final:
                return record.state
    raise AssertionError(f"{task} has not ended")


async def test_poison_text_crashes_no_command(fleet: FleetState, client: FleetClient) -> None:
    """Markup and escape sequences in an instruction and in a reason are shown as they are, to everybody."""
    await swiftbot(fleet, "submit", POISON, "--id", "t-poison")
    for words in (("task", "list"), ("task", "show", "t-poison"), ("plan", POISON), ("audit",), ("stops",)):
        assert "\x1b" not in await swiftbot(fleet, *words)
    assert "[/red]" in await swiftbot(fleet, "task", "list")
    assert "[/red]" in await swiftbot(fleet, "stop", "--why", "[/red]")
    assert "[/red]" in await swiftbot(fleet, "stops")
    await swiftbot(fleet, "resume")
    await client.cancel("t-poison")


async def test_spoken_words_keep_their_capitals(fleet: FleetState, client: FleetClient) -> None:
    """What a robot says is what was written, also where planners write lower case."""
    await swiftbot(fleet, "submit", 'rover_2: say "Hello World from SwiftBot"', "--id", "t-spoken", "--wait")
    (subtask,) = (await client.task("t-spoken")).subtasks
    assert subtask.subtask.params["text"] == "Hello World from SwiftBot"


async def test_the_command_line_hides_no_state(fleet: FleetState, client: FleetClient) -> None:
    """A stopped robot, a task that is paused by it, an order to a gateway; with all fields in JSON."""
    await swiftbot(fleet, "stop", "rover_1", "--why", "people inside")
    assert "stopped by" in await swiftbot(fleet, "robots")
    robots = {each["id"]: each for each in json.loads(await swiftbot(fleet, "robots", "--json"))}
    assert {name: each["online"] for name, each in robots.items()} == {"rover_1": True, "rover_2": True}
    assert "people inside" in robots["rover_1"]["stopped"]
    assert robots["rover_2"]["stopped"] is None
    await client.submit(TaskRequest(instruction="rover_1: go to dock 1", id="t-paused"))
    async with asyncio.timeout(LONG_S):
        while (await client.task("t-paused")).paused == "":
            await asyncio.sleep(0.1)
    line = next(each for each in (await swiftbot(fleet, "task", "list")).splitlines() if "t-paused" in each)
    assert "paused" in line
    assert "running" not in line
    await client.cancel("t-paused")
    await swiftbot(fleet, "resume")
    await swiftbot(fleet, "drain", "gw-2", "--why", "its fan is loud")
    await swiftbot(fleet, "uncordon", "gw-2")
    acts = json.loads(await swiftbot(fleet, "audit", "--json"))
    assert {"drain", "undrain"} <= {each["verb"] for each in acts if each["target"] == "gw-2"}


async def test_a_wait_for_a_robot_is_no_startup_time(fleet: FleetState, client: FleetClient) -> None:
    """A task whose robot was stopped for seconds says how long its container took, and not the wait."""
    stop = await client.stop(("rover_2",), why="a look")
    assert stop.robots == ("rover_2",)
    await client.submit(TaskRequest(instruction='rover_2: say "hello"', id="t-startup"))
    await asyncio.sleep(4.0)
    await client.resume_robots(("rover_2",))
    assert await ended(client, "t-startup") is TaskState.SUCCEEDED
    (subtask,) = (await client.task("t-startup")).subtasks
    assert subtask.startup_ms is not None
    assert subtask.startup_ms < 3000


async def test_the_example_of_the_dialog_is_planned(fleet: FleetState, client: FleetClient) -> None:
    """What the terminal UI suggests to write is what this fleet can do."""
    await client.gateway()
    async with asyncio.timeout(LONG_S):
        while len(client.plane.registry.robots) < 2:
            await asyncio.sleep(0.1)
    text = example(client.plane.registry.robots.values(), await client.site()).removeprefix("e.g. ")
    answer = await client.plan(text)
    assert answer.plan.subtasks


async def test_the_terminal_ui_writes_no_screen_into_a_pipe(fleet: FleetState) -> None:
    """Without a terminal it ends at once with what is wrong."""
    assert await swiftbot(fleet, "tui", code=2) == ""


async def test_names_are_completed_from_the_fleet(fleet: FleetState, client: FleetClient) -> None:
    """Robots, gateways, tasks, alerts and places as they are now."""
    await client.submit(TaskRequest(instruction="rover_1: go to dock 1", id="t-named", approval=Approval.ALWAYS))
    for words, wanted in (
        (("stop", "rov"), {"rover_1", "rover_2"}), (("drain", ""), {"gw-1", "gw-2"}),
        (("task", "show", "t-na"), {"t-named"}), (("plan", "dock"), {"dock 1", "dock 2"}),
    ):  # fmt: skip
        environment = os.environ | {"SWIFTBOT_FLEET": fleet.fleet, "SWIFTBOT_CONNECT": fleet.endpoints[0]}
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "appliance.cli", "completion", "bash", "--", *words,
            stdout=asyncio.subprocess.PIPE, env=environment,
        )  # fmt: skip
        out, _ = await process.communicate()
        assert wanted <= set(out.decode().splitlines()), words
    await client.cancel("t-named")


async def test_an_interrupt_of_a_wait_offers_to_detach(fleet: FleetState, client: FleetClient, tmp_path: Path) -> None:
    """In a real terminal: Ctrl-C and `d`, or Ctrl-D, leave the task to itself; a script's Ctrl-C cancels it."""
    terminal = Terminal(tmp_path)
    command = [sys.executable, "-m", "appliance.cli", "submit", "rover_1: go to dock 3", "--id", "t-detached", "--wait",
               "--yes", *where(fleet)]  # fmt: skip
    # The shell around it outlives the interrupt, and says how it ended.
    shell = ["sh", "-c", 'trap : INT; "$@"; echo "ended with $?"; sleep 60', "sh", *command]
    await terminal.start(shell, {"PYTHONPATH": os.environ.get("PYTHONPATH", "")})
    try:
        await terminal.see("running on")
        await terminal.press("C-c")
        await terminal.see("[d]etach")
        await terminal.write("d")
        await terminal.press("Enter")
        await terminal.see("task t-detached continues", "ended with 0")
    finally:
        await terminal.close()
    assert not (await client.task("t-detached")).state.final
    terminal = Terminal(tmp_path)
    again = ["t-left" if word == "t-detached" else word.replace("rover_1", "rover_2") for word in shell]
    await terminal.start(again, {"PYTHONPATH": os.environ.get("PYTHONPATH", "")})
    try:
        await terminal.see("running on")
        await terminal.press("C-c")
        await terminal.see("[d]etach")
        await terminal.press("C-d")
        await terminal.see("task t-left continues", "ended with 0")
    finally:
        await terminal.close()
    assert not (await client.task("t-left")).state.final
    await client.cancel("t-left")
    await client.cancel("t-detached")
    process = await asyncio.create_subprocess_exec(
        "env", "--default-signal=INT", sys.executable, "-m", "appliance.cli", "submit", "rover_2: go to dock 3",
        "--id", "t-script", "--wait", *where(fleet), stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    async with asyncio.timeout(LONG_S):
        while b"running" not in await process.stdout.readline():
            pass
    process.send_signal(signal.SIGINT)
    assert await process.wait() == 130
    assert await ended(client, "t-script") is TaskState.CANCELLED


async def test_a_console_without_signs_gets_ascii(fleet: FleetState, tmp_path: Path) -> None:
    """`TERM=linux`: all that is drawn is ASCII."""
    terminal = Terminal(tmp_path)
    command = ["env", "TERM=linux", sys.executable, "-m", "appliance.cli", "tui", *where(fleet)]
    home = {"XDG_STATE_HOME": str(tmp_path / "state"), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    await terminal.start(command, home | {"PYTHONPATH": os.environ.get("PYTHONPATH", "")})
    try:
        text = await terminal.see("2 gw", "gw-1")
        assert text.isascii()
    finally:
        await terminal.close()
