"""A gateway of the version before beside this one, each a process of its own program, in one fleet.

The program before is in tests/data/before. Both run with the packages of this one.
"""

import asyncio
import contextlib
import os
import signal
import sys
import tarfile
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleets import fleet_in

from appliance.client import FleetClient
from appliance.connection import Endpoint, FleetState
from appliance.errors import SwiftbotError
from appliance.model import Plan, Subtask, TaskRecord, TaskRequest, TaskState, keyspace
from appliance.model.plane_api import RecordAsk, RecordChange, SealedAsk
from workshop.local_fleet import end, spawn

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400), pytest.mark.long]

NEW, OLD = "gw-1", "gw-2"
WRONG = ("malformed", "incompatible", "misplaced", "forged", "unsound")
"""Kinds of bad input that one program would find in what the other says."""
MANIFEST = """
id = "pause"
domain = "coordination"
summary = "Wait."
runs = "compute"
image = "base"
timeout_s = 120

[params.seconds]
type = "number"
required = true
"""
HANDLER = """
import time

def run(ctx):
    for _ in range(int(10 * ctx.params["seconds"])):
        time.sleep(0.1)
    return {"waited": ctx.params["seconds"]}
"""
LOOK = """
from appliance.pool import images
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue
print(images.reference(load_catalogue().images["base"], PoolConfig()))
"""


class Mixed:
    """A fleet of two programs."""

    def __init__(self, state: FleetState, before: Path) -> None:
        self.state, self.before = state, before
        self.processes = {each.name: each for each in state.processes}

    async def run(self, name: str) -> None:
        """Start a gateway, `OLD` with the program before."""
        config = Path(self.state.directory) / name / "gateway.toml"
        program = [sys.executable, "-P", "-m", "appliance.cli", "gateway", "--config", str(config)]
        if name == OLD:
            program = ["env", f"PYTHONPATH={self.before}", *program]
        self.processes[name] = spawn(name, program, Path(self.state.directory) / "logs" / f"{name}.log")
        async with self.client(name) as client:
            while len(client.plane.members()) < len(self.state.gateways):
                await asyncio.sleep(0.1)

    def client(self, name: str) -> FleetClient:
        """A client of one gateway."""
        endpoint = self.state.endpoints[self.state.gateways.index(name)]
        return FleetClient(Endpoint(fleet=self.state.fleet, connect=(endpoint,)))

    async def end(self, name: str, *, power: bool = True) -> None:
        """End a gateway: it drains, or where the power goes is gone at once."""
        if not power:
            os.kill(self.processes[name].pid, signal.SIGKILL)
        await end([self.processes[name]], grace_s=20.0)


async def reference(program: Path) -> str:
    """Return what a program calls the image of the skills."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-P", "-c", LOOK, env=os.environ | {"PYTHONPATH": str(program)}, stdout=asyncio.subprocess.PIPE
    )
    out, _ = await process.communicate()
    assert process.returncode == 0
    return out.decode().strip()


@pytest.fixture
async def mixed(
    anyio_backend: str, built: None, tmp_path: Path, data: Path, project_root: Path
) -> AsyncIterator[Mixed]:
    """A gateway of each program, and a robot; both programs use the image that this one has built."""
    before = tmp_path / "before"
    with tarfile.open(data / "before" / "swiftbot.tar.xz") as archive:
        archive.extractall(before)  # noqa: S202 - it is our own
    skill = tmp_path / "skills" / "pause"
    skill.mkdir(parents=True)
    (skill / "skill.toml").write_text(MANIFEST)
    (skill / "handler.py").write_text(HANDLER)
    old, new = await reference(before), await reference(project_root)
    tag = await asyncio.create_subprocess_exec("podman", "tag", new, old)
    assert await tag.wait() == 0
    async with fleet_in(tmp_path, gateways=2, zenoh=1, sim_rate=4.0, skills=(skill.parent,)) as state:
        it = Mixed(state, before)
        await it.end(OLD)
        try:
            await it.run(OLD)
            yield it
        finally:
            for name in (NEW, OLD):
                await it.end(name)
    if old != new:
        untag = await asyncio.create_subprocess_exec("podman", "untag", new, old)
        await untag.wait()


async def finished(client: FleetClient, task: str) -> TaskRecord:
    """Wait for a task's end."""
    while True:
        with contextlib.suppress(SwiftbotError):  # its coordinator was ended a moment ago
            record = await client.task(task)
            if record.state.final:
                return record
        await asyncio.sleep(0.1)


def pause(number: str, seconds: float, *, at: str = "") -> TaskRequest:
    """A task that waits, where it may run at one gateway only."""
    plan = Plan(domain="coordination", subtasks=(Subtask(id="s1", skill="pause", params={"seconds": seconds}),))
    return TaskRequest(instruction="wait", id=number, plan=plan, group=(at,) if at else ())


async def coordinated_by(client: FleetClient, gateway: str, what: str, seconds: float, at: str) -> TaskRecord:
    """Submit a task whose coordinator is a gateway, and wait until it runs."""
    for number in range(100):
        name = f"{what}-{number}"
        if client.plane.ring.owner(f"{keyspace.TASK_RECORD.prefix}{name}") == gateway:
            await client.submit(pause(name, seconds, at=at))
            while True:
                record = await client.task(name)
                if record.subtasks and record.subtasks[0].state.value in ("running", "succeeded"):
                    assert record.coordinator == gateway
                    return record
                await asyncio.sleep(0.05)
    raise AssertionError(f"no key of {gateway}'s")


async def test_two_programs_are_one_fleet(mixed: Mixed) -> None:
    """Records, tasks and stops go both ways, and each finishes what the other had begun when it is gone."""
    async with mixed.client(NEW) as client, mixed.client(OLD) as other:
        for each in (client, other):
            while each.plane.members() != {NEW, OLD}:
                await asyncio.sleep(0.05)
        with pytest.raises(SwiftbotError):  # it is the program before: it does not know this verb
            await client.plane.rpc.call(OLD, keyspace.PARTS, SealedAsk(number=0))

        for number in range(20):
            change = RecordChange(key=f"note/{number}", value=f"of {number}".encode())
            await client.plane.rpc.call((NEW, OLD)[number % 2], keyspace.RECORD_WRITE, change)
        for number in range(20):
            found = await client.plane.rpc.call(
                (OLD, NEW)[number % 2], keyspace.RECORD_READ, RecordAsk(f"note/{number}")
            )
            assert found.record is not None
            assert found.record.value == f"of {number}".encode()

        for coordinator in (NEW, OLD):
            for at in (NEW, OLD):
                begun = await coordinated_by(client, coordinator, f"by-{coordinator}-at-{at}", 0.2, at)
                record = await finished(other, begun.id)
                assert (record.state, record.subtasks[0].result) == (TaskState.SUCCEEDED, {"waited": 0.2}), record
                assert record.subtasks[0].gateway == at

        for at in (NEW, OLD):
            driven = await client.submit(TaskRequest(instruction="rover_1 go to dock 1", group=(at,)))
            assert (await finished(other, driven.id)).state is TaskState.SUCCEEDED

        for giver, heard in ((client, other), (other, client)):
            stop = await giver.stop(("rover_1",))
            assert {each.id for each in (await heard.standing()).active} >= {each.id for each in stop.stops}
            await heard.resume_robots(("rover_1",))
            while (await giver.standing()).active:
                await asyncio.sleep(0.05)

        for gateway in (NEW, OLD):
            refused = client.plane.registry.gateways[gateway].refused
            assert not [
                kind for kind in refused if kind.startswith(("malformed", "incompatible", "misplaced", "forged"))
            ]

    async with mixed.client(OLD) as other:
        begun = await coordinated_by(other, NEW, "taken-over-by-the-old", 8.0, OLD)
        await mixed.end(NEW, power=False)
        record = await finished(other, begun.id)
        assert (record.state, record.coordinator) == (TaskState.SUCCEEDED, OLD)
    await mixed.run(NEW)
    async with mixed.client(NEW) as client:
        begun = await coordinated_by(client, OLD, "taken-over-by-the-new", 8.0, NEW)
        await mixed.end(OLD, power=False)
        record = await finished(client, begun.id)
        assert (record.state, record.coordinator) == (TaskState.SUCCEEDED, NEW)
        assert [each.id for each in client.plane.registry.gateways.values() if each.protocol != 1] == []
