"""Files of handlers on real gateways: copied to another, read after their maker was killed, gone with their task."""

import asyncio
import json
import os
import signal
import time
from collections.abc import AsyncIterator, Callable
from contextlib import aclosing
from pathlib import Path

import pytest

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import Endpoint, FleetState
from appliance.llm.settings import LlmConfig
from appliance.model import Plan, Subtask, TaskRecord, TaskRequest
from appliance.pool.settings import PoolConfig
from appliance.tasks.settings import TasksConfig
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(240)]

MANIFEST = """
id = "{name}"
domain = "coordination"
summary = "A test's own skill."
runs = "compute"
image = "base"

[params.ref]
type = "string"
required = false
"""
KEEPS = """
def run(ctx):
    return {"file": ctx.put_artifact("report.txt", b"read me" * 300_000, "text/plain")}
"""
READS = """
import hashlib
import json

def run(ctx):
    data = ctx.get_artifact(json.loads(ctx.params["ref"]))
    return {"digest": hashlib.sha256(data).hexdigest()}
"""


LINGERS = """
import time

def run(ctx):
    while True:
        ctx.alive()
        time.sleep(0.1)
"""


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """Return a fleet of three gateways, that trim finished tasks at once."""
    for name, handler in (("keeps", KEEPS), ("reads", READS), ("lingers", LINGERS)):
        folder = tmp_path / "skills" / name
        folder.mkdir(parents=True)
        (folder / "skill.toml").write_text(MANIFEST.format(name=name))
        (folder / "handler.py").write_text(handler)
    order = Order(
        fleet=f"a{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=tmp_path / "fleet",
        gateways=3,
        mavlink=0,
        zenoh=0,
        pool=PoolConfig(floor={"base": 1}),
        base=GatewayConfig(
            id="base",
            skills=(str(tmp_path / "skills"),),
            llm=LlmConfig(tiers=("rules",)),
            tasks=TasksConfig(keep_finished=0, retention_s=1.0),
        ),
    )
    yield await local_fleet.up(order, progress=print, timeout_s=120.0)
    await local_fleet.down(order.directory, progress=print, volumes=True)


async def follow(client: FleetClient, task: str, *, until: Callable[[TaskRecord], bool]) -> TaskRecord:
    """Wait until a task's record is so."""
    async with asyncio.timeout(90), aclosing(client.watch(task, silence_s=0.3)) as changes:
        async for record in changes:
            if until(record):
                return record
    raise AssertionError("the task ended before that")


async def submit(client: FleetClient, *subtasks: Subtask) -> str:
    """Submit a plan and return the task's id."""
    plan = Plan(domain="coordination", subtasks=subtasks)
    return (await client.submit(TaskRequest(instruction="try", plan=plan))).id


def holding(fleet: FleetState, digest: str) -> set[str]:
    """The gateways on whose disks a file lies."""
    return {path.parts[-5] for path in Path(fleet.directory).glob(f"*/data/artifacts/??/{digest}")}


async def until_held(fleet: FleetState, digest: str, *, by: int) -> set[str]:
    """Wait until so many gateways hold a file; returns which."""
    async with asyncio.timeout(60):
        while len(found := holding(fleet, digest)) != by:
            await asyncio.sleep(0.1)
    return found


async def test_a_file_outlives_its_gateway_and_goes_with_its_task(fleet: FleetState) -> None:
    """A file lies on two gateways; when its maker is killed another task reads it; when its task is trimmed it goes."""
    async with FleetClient(fleet.endpoint) as client:
        keeps = await submit(client, Subtask(id="s1", skill="keeps"), Subtask(id="s2", skill="lingers", after=("s1",)))
        record = await follow(client, keeps, until=lambda record: bool(record.subtasks and record.subtasks[0].result))
        reference = (record.subtasks[0].result or {})["file"]
        digest, maker = reference["artifact"], reference["gateway"]
        assert maker in await until_held(fleet, digest, by=2)
        os.kill(client.plane.registry.gateways[maker].pid, signal.SIGKILL)
    names = [f"gw-{number}" for number in range(1, len(fleet.endpoints) + 1)]
    other = next(endpoint for name, endpoint in zip(names, fleet.endpoints, strict=True) if name != maker)
    async with FleetClient(Endpoint(fleet=fleet.fleet, connect=(other,))) as client:
        reads = await submit(client, Subtask(id="s1", skill="reads", params={"ref": json.dumps(reference)}))
        read = await follow(client, reads, until=lambda record: record.state.final)
        assert (read.subtasks[0].result or {})["digest"] == digest
        await client.cancel(keeps)
        async with asyncio.timeout(60):
            while holding(fleet, digest) - {maker}:
                await asyncio.sleep(0.2)
