"""Groups, turns and deadlines with real gateways: a killed root, a flood, a deadline, and what people hear of them."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import aclosing
from pathlib import Path
from typing import Any

import pytest
from fleets import RULES

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.model import (
    Need,
    Plan,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    Subtask,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    keyspace,
)
from appliance.model.task_api import RunAsk
from appliance.pool.settings import PoolConfig
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

MANIFEST = """
id = "{name}"
domain = "coordination"
summary = "A test's own skill."
runs = "compute"
image = "base"
timeout_s = 120
retries = 1

[params.for_s]
type = "number"
required = false
"""
NAP = """
import time

def run(ctx):
    time.sleep(float(ctx.params.get("for_s", 1.0)))
    return {"attempt": ctx.attempt}
"""

Up = Callable[..., Any]


@pytest.fixture
async def up(tmp_path: Path) -> AsyncIterator[Up]:
    """Return a function that starts a fleet with a skill that sleeps; ended and cleaned up afterwards."""
    skill = tmp_path / "skills" / "nap"
    skill.mkdir(parents=True)
    (skill / "skill.toml").write_text(MANIFEST.format(name="nap"))
    (skill / "handler.py").write_text(NAP)
    directory = tmp_path / "fleet"

    async def start(*, gateways: int, **more: Any) -> FleetState:
        order = Order(
            fleet=f"g{os.getpid()}-{time.monotonic_ns() % 100000}",
            directory=directory,
            gateways=gateways,
            mavlink=0,
            zenoh=0,
            base=GatewayConfig(id="base", llm=RULES, skills=(str(tmp_path / "skills"),)),
            **more,
        )
        return await local_fleet.up(order, progress=print, timeout_s=180.0)

    yield start
    await local_fleet.down(directory, progress=print, volumes=True)


def nap(seconds: float, *, subtasks: int = 1, **fields: Any) -> TaskRequest:
    """Return a task whose subtasks sleep one after the other."""
    ids = [f"s{number}" for number in range(1, subtasks + 1)]
    plan = Plan(
        domain="coordination",
        subtasks=tuple(
            Subtask(id=each, skill="nap", params={"for_s": seconds}, after=tuple(ids[:number][-1:]))
            for number, each in enumerate(ids)
        ),
    )
    return TaskRequest(instruction="nap", plan=plan, **fields)


async def follow(client: FleetClient, task: str, until: Callable[[TaskRecord], bool]) -> TaskRecord:
    """Wait until a task's record is so."""
    last: TaskRecord | None = None
    async with asyncio.timeout(200), aclosing(client.watch(task, silence_s=0.3)) as changes:
        async for record in changes:
            last = record
            if until(record):
                return record
    raise AssertionError(f"the task ended before that: {last}")


def cli(state: FleetState, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run the command line against a fleet."""
    return subprocess.run(
        [sys.executable, "-m", "appliance.cli", *arguments, "--fleet", state.fleet, "--dir", state.directory],
        capture_output=True, text=True, timeout=120, check=False, env={**os.environ, "COLUMNS": "80"},
    )  # fmt: skip


async def test_when_the_root_is_killed_its_successor_leads_and_nothing_runs_twice(up: Up) -> None:
    """SIGKILL of the root: the group, priority and submitter stay, another member is root, each runs once."""
    fleet = await up(gateways=3, pool=PoolConfig(floor={"base": 1}))
    async with FleetClient(fleet.endpoint) as client:
        accepted = await client.submit(nap(1.5, subtasks=4, priority=7, submitter="ann", deadline_s=180.0))
        before = await follow(
            client, accepted.id, lambda record: bool(record.subtasks) and record.of("s2").state is SubtaskState.RUNNING
        )
        assert before.group is not None
        assert set(before.group.members) == {"gw-1", "gw-2", "gw-3"}
        assert before.group.root == before.coordinator
        process = next(each for each in fleet.processes if each.name == before.coordinator)
        os.kill(process.pid, signal.SIGKILL)
        ended = await follow(client, accepted.id, lambda record: record.state.final)
    assert ended.state is TaskState.SUCCEEDED, ended.failure
    assert (ended.priority, ended.submitter, ended.deadline_s) == (7, "ann", 180.0)
    assert ended.elapsed_s > before.elapsed_s
    assert ended.group is not None
    assert ended.coordinator == ended.group.root != before.coordinator
    assert before.coordinator not in ended.group.members
    assert ended.group.number > before.group.number
    print(ended.group.why, [each.attempt for each in ended.subtasks])
    done = before.of("s1")
    assert ended.of("s1").result == done.result
    for each in ended.subtasks:
        assert each.result == {"attempt": each.attempt}
        assert len({attempt.number for attempt in each.attempts}) == len(each.attempts)


async def test_a_flood_waits_its_turn_and_a_deadline_ends_what_is_too_late(up: Up) -> None:
    """One gateway, two containers, a flood: the urgent and the other submitter's go before its end; why is reported."""
    fleet = await up(gateways=1, pool=PoolConfig(floor={"base": 2}, capacity=2))
    async with FleetClient(fleet.endpoint) as client:
        flood = [await client.submit(nap(1.0, submitter="flood")) for _ in range(16)]
        late = await client.submit(nap(20.0, submitter="flood", deadline_s=2.0))
        other = await client.submit(nap(1.0, submitter="other"))
        urgent = await client.submit(nap(1.0, submitter="flood", priority=9))
        asked = await asyncio.to_thread(cli, fleet, "task", "why", flood[-1].id, "--json")
        assert asked.returncode == 0, asked.stderr
        told = json.loads(asked.stdout)
        assert told["group"]["root"] == "gw-1"
        shown = await asyncio.to_thread(cli, fleet, "task", "why", flood[-1].id)
        print(shown.stdout)
        assert "root gw-1" in shown.stdout
        order: list[str] = []

        async def end(task: str) -> TaskRecord:
            record = await follow(client, task, lambda record: record.state.final)
            order.append(task)
            return record

        records = await asyncio.gather(*(end(each.id) for each in (*flood, late, other, urgent)))
    *_, too_late, others, first = records
    assert all(each.state is TaskState.SUCCEEDED for each in (*records[: len(flood)], others, first))
    assert too_late.failure is not None
    assert too_late.failure.code == "deadline"
    last = flood[-1].id
    assert order.index(urgent.id) < order.index(last)
    assert order.index(other.id) < order.index(last)
    wrong = await asyncio.to_thread(cli, fleet, "submit", "nap", "--priority", "12")
    assert wrong.returncode != 0


async def test_a_run_that_waits_goes_where_there_is_room_first_and_begins_once(up: Up) -> None:
    """Both gateways are busy; the one that was not asked is free first: the waiting run is passed on to it, once."""
    fleet = await up(gateways=2, pool=PoolConfig(floor={"base": 1}, capacity=1))
    heard: asyncio.Queue[RunEvent] = asyncio.Queue()
    async with FleetClient(fleet.endpoint) as client:
        await client.gateway()
        client.on_run("t-wait", heard)
        await asyncio.sleep(0.5)

        async def order(gateway: str, name: str, seconds: float, hops: int = 0) -> RunAccepted:
            request = RunRequest(
                task="t-wait", subtask=name, attempt=1, skill="nap", need=Need(image="base"), hops=hops,
                params={"for_s": seconds},
            )  # fmt: skip
            return await client.plane.rpc.call(gateway, keyspace.RUN, request, timeout_s=20.0)

        # Passed on already, so that each stays where it is ordered.
        await order("gw-1", "long", 30.0, hops=1)
        await order("gw-2", "short", 3.0, hops=1)
        async with asyncio.timeout(30):
            while not all(client.plane.registry.gateways[each].running for each in ("gw-1", "gw-2")):
                await asyncio.sleep(0.05)
        accepted = await order("gw-1", "waits", 0.1)
        assert accepted.gateway == "gw-1"
        told: list[RunEvent] = []
        async with asyncio.timeout(60):
            while not any(each.subtask == "waits" and each.kind is RunEventKind.SUCCEEDED for each in told):
                told.append(await heard.get())
        mine = [each for each in told if each.subtask == "waits"]
        assert [each.gateway for each in mine if each.kind is RunEventKind.STARTED] == ["gw-2"]
        assert not any(each.subtask == "long" and each.kind is RunEventKind.SUCCEEDED for each in told)
        moved = [each for each in mine if each.choice is not None]
        assert len(moved) == 1
        print(moved[0].note)
        async with asyncio.timeout(30):
            while not client.plane.registry.gateways["gw-1"].searches.get("moved"):
                await asyncio.sleep(0.1)
        # A gateway that stops lets its run come to its end.
        ask = RunAsk(task="t-wait", subtask="long", attempt=1)
        await client.plane.rpc.call("gw-1", keyspace.RUN_CANCEL, ask, timeout_s=20.0)


async def test_a_task_stays_within_the_gateways_that_its_submitter_allows(up: Up) -> None:
    """On any coordinator: no subtask runs elsewhere, and `task why` says why the others are no candidates."""
    fleet = await up(gateways=3, pool=PoolConfig(floor={"base": 1}))
    async with FleetClient(fleet.endpoint) as client:
        for _ in range(4):
            accepted = await client.submit(nap(0.2, subtasks=2, group=("gw-2",)))
            ended = await follow(client, accepted.id, lambda record: record.state.final)
            assert ended.state is TaskState.SUCCEEDED, ended.failure
            assert {each.gateway for each in ended.subtasks} == {"gw-2"}
            assert ended.group is not None
            assert set(ended.group.members) == {"gw-2", ended.coordinator}
