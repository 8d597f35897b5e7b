"""A stop typed as an instruction, and plans that wait for approval, by the command line on a fleet of processes."""

import asyncio
import contextlib
import os
import pty
import sys

import msgspec
import pytest

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import Exit, RefusedError
from appliance.model import TaskRecord, TaskRequest, TaskState

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
FLEET = {"gateways": 2, "zenoh": 1}

FAR = "Rover_1: go to dock 3, then go to dock 2, then go to dock 1, then go to dock 3"


async def begun(fleet: FleetState, *words: str) -> asyncio.subprocess.Process:
    """Start a command on the fleet, without a terminal."""
    place = ("--dir", fleet.directory, "--fleet", fleet.fleet)
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli", *words, *place,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
        env=dict(os.environ) | {"SWIFTBOT_OPERATOR": "ann"},
    )  # fmt: skip


async def run(fleet: FleetState, *words: str) -> tuple[int, str]:
    """Run a command; its exit code and what it printed."""
    process = await begun(fleet, *words)
    async with asyncio.timeout(60):
        out, _ = await process.communicate()
    return process.returncode or 0, out.decode()


async def drives(client: FleetClient) -> TaskRecord:
    """Have the rover drive; return the task once it moves."""
    task = (await client.submit(TaskRequest(instruction=FAR))).id
    async with asyncio.timeout(60):
        before = None
        while before is None or at(client) == before:
            before = at(client)
            await asyncio.sleep(0.5)
    return await client.task(task)


def at(client: FleetClient) -> tuple[float, float] | None:
    """Where the rover is."""
    rover = client.plane.registry.robots.get("rover_1")
    return (round(rover.pose.x, 3), round(rover.pose.y, 3)) if rover is not None and rover.pose is not None else None


async def test_what_an_operator_types(fleet: FleetState) -> None:
    """One after the other on one fleet."""
    async with FleetClient(fleet.endpoint, operator="ann") as client:
        await drives(client)
        await no_name(fleet, client)
        await stop(fleet, client)
        await refused_to_others(fleet, client)
        await held(fleet, client)
        await asked_on_a_terminal(fleet, client)


async def no_name(fleet: FleetState, client: FleetClient) -> None:
    """A name that no robot has stops nothing, says so first, and leaves no stop standing."""
    code, out = await run(fleet, "stop", "rover1x")
    assert code == Exit.REFUSED
    assert out.startswith("NOT STOPPED: no robot 'rover1x'; did you mean rover_1?"), out
    assert (await client.standing()).active == ()
    before = at(client)
    async with asyncio.timeout(20):
        while at(client) == before:
            await asyncio.sleep(0.2)


async def stop(fleet: FleetState, client: FleetClient) -> None:
    """The rover stands within seconds, a stop of the fleet is in force, and no task was made."""
    tasks = len((await client.tasks(100)).tasks)
    code, out = await run(fleet, "submit", "STOP!")
    assert code == Exit.DONE, out
    assert "the fleet: stopped by ann: STOP!" in out
    assert "hold: rover_1" in out
    await asyncio.sleep(1.0)
    before = at(client)
    await asyncio.sleep(2.0)
    assert at(client) == before
    (active,) = (await client.standing()).active
    assert active.robots == ()
    assert len((await client.tasks(100)).tasks) == tasks
    await client.resume_robots()
    code, out = await run(fleet, "stop", "rover", "1", "--json")
    assert code == Exit.DONE, out
    (active,) = (await client.standing()).active
    assert active.robots == ("rover_1",)
    await client.resume_robots()


async def refused_to_others(fleet: FleetState, client: FleetClient) -> None:
    """Over the verb and from a robot it is no task, and no stop either; `plan` says what it is."""
    for submitter in ("a script", "rover_1"):
        with pytest.raises(RefusedError, match="this is a stop, not a task") as refused:
            await client.submit(TaskRequest(instruction="rover_1: stop", submitter=submitter))
        assert refused.value.remedy == "swiftbot stop rover_1"
    assert (await client.standing()).active == ()
    code, out = await run(fleet, "plan", "Rover_1 stop", "--json")
    assert (code, msgspec.json.decode(out)) == (Exit.DONE, {"decision": "stop", "robots": ["rover_1"]})


async def held(fleet: FleetState, client: FleetClient) -> None:
    """A plan that waits is printed at once with the command that approves it; rejected, the exit code says so."""
    for approve, code in ((True, Exit.DONE), (False, Exit.REJECTED)):
        task = f"held-{approve}".lower()
        text = 'Rover_1: say "[/red] x"'
        process = await begun(fleet, "submit", text, "--wait", "--id", task, "--approval", "always")
        assert process.stdout is not None
        said = b""
        async with asyncio.timeout(60):
            while b"deadline:" not in said:
                line = await process.stdout.readline()
                assert line, said
                said += line
        record = await client.task(task)
        assert record.state is TaskState.PROPOSED
        assert record.proposal is not None
        short = record.proposal.hash[:12]
        assert f"swiftbot task approve {task} --hash {short}".encode() in said
        assert (await run(fleet, "task", *(("approve", task, "--hash", short) if approve else ("reject", task))))[
            0
        ] == 0
        async with asyncio.timeout(60):
            rest, _ = await process.communicate()
        assert process.returncode == code, (said + rest).decode()
    for words in (("task", "list"), ("task", "show", "held-true"), ("audit",), ("stops",), ("plan", text)):
        code, out = await run(fleet, *words)
        assert code == 0, out
        assert "Traceback" not in out
    assert "[/red] x" in (await run(fleet, "task", "list"))[1]


async def asked_on_a_terminal(fleet: FleetState, client: FleetClient) -> None:
    """There the plan is shown first: y runs it, anything else and Ctrl-C reject it; a stop is not asked about."""
    for number, (key, code) in enumerate(((b"y\n", Exit.DONE), (b"\n", Exit.REJECTED), (b"\x03", Exit.REJECTED))):
        ended, said = await at_terminal(fleet, key, "submit", 'Rover_1: say "hello"', "--id", f"asked-{number}")
        assert ended == code, said
        assert "say" in said
        state = (await client.task(f"asked-{number}")).state
        assert (state is TaskState.CANCELLED) == (code == Exit.REJECTED)
    ended, said = await at_terminal(fleet, b"", "submit", "rover_1, stop!")
    assert ended == Exit.DONE, said
    assert "rover_1: stopped by ann" in said
    await client.resume_robots()


async def at_terminal(fleet: FleetState, key: bytes, *words: str) -> tuple[int, str]:
    """Run a command at a terminal, and press a key when it asks."""
    ours, its = pty.openpty()
    os.set_blocking(ours, False)
    place = ("--dir", fleet.directory, "--fleet", fleet.fleet)
    process = await asyncio.create_subprocess_exec(
        "setsid", "--ctty", "--wait", sys.executable, "-m", "appliance.cli", *words, *place,
        stdin=its, stdout=its, stderr=its, env=dict(os.environ) | {"SWIFTBOT_OPERATOR": "ann", "TERM": "xterm"},
    )  # fmt: skip
    os.close(its)
    said, pressed = b"", not key
    ended = asyncio.create_task(process.wait())
    try:
        for _ in range(1200):
            # Looked at before the last read: what it printed until its end is read.
            over = ended.done()
            with contextlib.suppress(OSError):
                said += os.read(ours, 65536)
            if over:
                return process.returncode or 0, said.decode()
            if not pressed and b"[e]dit: " in said:
                pressed = True
                os.write(ours, key)
            await asyncio.sleep(0.05)
    finally:
        os.close(ours)
    process.kill()
    await ended
    raise AssertionError(f"it does not end: {said.decode()}")
