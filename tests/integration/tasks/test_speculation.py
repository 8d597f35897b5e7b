"""Runs that take far longer than their siblings, in real containers: left once for another gateway, or only noted."""

import asyncio
import os
import time
from collections import Counter
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest
from fleets import RULES
from moving_bench import ended, pretty

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.model import Notice, Plan, RobotCommand, Subtask, SubtaskState, TaskRequest, TaskState, keyspace
from appliance.pool.settings import PoolConfig
from appliance.record.reader import read
from appliance.tasks.replay import replay
from appliance.tasks.settings import DetectionConfig, TasksConfig
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]

STEPS = """
import time

def run(ctx):
    done = list((ctx.resume or {}).get("done", []))
    for step in range(len(done), int(ctx.params["steps"])):
        if ctx.attempt == 1 and step == int(ctx.params.get("lags_at", -1)):
            until = time.monotonic() + float(ctx.params["lags_s"])
            while time.monotonic() < until:
                ctx.progress(step / int(ctx.params["steps"]), "slow, and not stuck")
                time.sleep(0.2)
        ctx.notify("operator", f"{ctx.params['name']} {step}")
        done.append([step, ctx.attempt])
        ctx.checkpoint({"done": done})
    return {"done": done, "resumed_from": len((ctx.resume or {}).get("done", []))}
"""
MANIFEST = """
id = "{name}"
domain = "coordination"
summary = "Steps that an operator hears of, for tests of stragglers."
runs = "compute"
image = "base"
cpu = 0.1
memory_mb = 64
timeout_s = 600
retries = 0
checkpoints = true
speculate = {speculate}

[params.steps]
type = "integer"
required = true

[params.name]
type = "string"
required = true

[params.lags_at]
type = "integer"
required = false

[params.lags_s]
type = "number"
required = false
"""
LONG_S = 3600.0
"""What the straggler would take: nothing that waits for it ends in time."""
SHORT_S = 9.0


def write_skills(folder: Path) -> Path:
    """Write the skill that may be left for another gateway, and the same that may not."""
    for name, speculate in (("steps_anywhere", "true"), ("steps_here", "false")):
        skill = folder / name
        skill.mkdir(parents=True)
        (skill / "handler.py").write_text(STEPS)
        (skill / "skill.toml").write_text(MANIFEST.format(name=name, speculate=speculate))
    return folder


@asynccontextmanager
async def fleet(folder: Path) -> AsyncGenerator[FleetState]:
    """Three gateways and a rover; a run straggles when it takes twice as long as its siblings, and 4 s."""
    order = Order(
        fleet=f"s{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=folder / "fleet",
        gateways=3,
        mavlink=0,
        zenoh=1,
        sim_rate=4.0,
        pool=PoolConfig(floor={"base": 2}),
        base=GatewayConfig(
            llm=RULES,
            id="gw-1",
            skills=(str(write_skills(folder / "skills")),),
            tasks=TasksConfig(check_s=0.5, detection=DetectionConfig(straggler_minimum_s=4.0)),
        ),
    )
    state = await local_fleet.up(order, progress=print, timeout_s=120.0)
    try:
        yield state
    finally:
        await local_fleet.down(order.directory, progress=print, volumes=True)


def task(name: str, skill: str, lags_s: float, *more: Subtask) -> TaskRequest:
    """Four runs that are quick, a fifth that is not, and what comes after all of them."""
    quick = [
        Subtask(id=f"q{number}", skill=skill, params={"steps": 2, "name": f"{name} q{number}"}) for number in range(4)
    ]
    lags = {"steps": 5, "name": f"{name} s1", "lags_at": 3, "lags_s": lags_s}
    slow = Subtask(id="s1", skill=skill, params=lags)
    return TaskRequest(
        instruction="steps", id=name, plan=Plan(domain="coordination", subtasks=(*quick, slow, *more))
    )  # fmt: skip


@pytest.mark.long
async def test_a_straggler_goes_on_elsewhere_and_nothing_is_done_twice(tmp_path: Path) -> None:
    """A run that would take an hour goes on from its checkpoint on another gateway, once; each effect happens once.

    Its old run is ended; what follows in the plan, a robot's drive, is done once; the log replays to the same record.
    A straggler of a skill that must not be left is noted and let be.
    """
    notices = Counter[str]()

    def heard(_: str, notice: Notice | None) -> None:
        if notice is not None:
            notices[notice.text] += 1

    async with fleet(tmp_path) as state, FleetClient(state.endpoint) as client:
        watch = client.plane.session.subscribe_typed(keyspace.NOTICE, heard)
        after = tuple(f"q{number}" for number in range(4))
        drive = Subtask(id="s2", skill="goto", robot="rover_1", params={"place": "home"}, after=("s1", *after))
        await client.submit(task("t-lags", "steps_anywhere", LONG_S, drive))
        record = await ended(client, "t-lags")
        assert record.state is TaskState.SUCCEEDED, record.failure
        found = record.of("s1")
        first, second = found.attempts
        assert first.left.startswith(f"straggling on {first.gateway}"), pretty(found)
        assert first.gateway != second.gateway
        assert not first.failure, pretty(found)
        # The checkpoint had three steps; none of them is done again.
        assert found.result == {"done": [[0, 1], [1, 1], [2, 1], [3, 2], [4, 2]], "resumed_from": 3}, pretty(found)
        assert [each.number for each in record.of("s2").attempts] == [1]

        await client.submit(task("t-stays", "steps_here", SHORT_S))
        conditions = set[str]()
        async for each in client.watch("t-stays"):
            conditions |= {one.condition for one in each.subtasks if one.state is SubtaskState.RUNNING}
            record = each
        assert record.state is TaskState.SUCCEEDED, record.failure
        assert "straggling" in conditions
        assert [one.number for one in record.of("s1").attempts] == [1], pretty(record.of("s1"))
        assert (record.of("s1").result or {})["done"] == [[step, 1] for step in range(5)]

        told = [f"{name} q{number} {step}" for name in ("t-lags", "t-stays") for number in range(4) for step in (0, 1)]
        told += [f"{name} s1 {step}" for name in ("t-lags", "t-stays") for step in range(5)]
        assert notices == Counter(told)
        # The run that was left is over: its gateway does nothing any more.
        async with asyncio.timeout(60):
            while client.plane.registry.gateways[first.gateway].running:
                await asyncio.sleep(0.1)
        watch.close()
    log = max(Path(state.record_dir).glob("*.mcap"), key=lambda each: each.stat().st_size)
    gone = Counter(
        command.id
        for message in read(log)
        if message.key.endswith("/commanded")
        and (command := msgspec.json.decode(message.payload, type=RobotCommand)).task == "t-lags"
        and command.verb == "goto"
    )
    assert list(gone.values()) == [1], gone
    report = replay(log)
    assert report.same, [each.differences for each in report.tasks]
