"""Choosing and going on, with real gateways: checkpoints outlive their gateway, vanished and lying peers do no harm."""

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
from msgspec.structs import replace

from appliance.client import Endpoint, FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.model import (
    ContainerState,
    Need,
    Phase,
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
    Way,
    keyspace,
)
from appliance.model.plane_api import FactsAsk, KeyAsk
from appliance.model.task_api import TaskAsk
from appliance.pool.settings import PoolConfig
from appliance.tasks.checkpoints import checkpoint_key
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]

MANIFEST = """
id = "{name}"
domain = "coordination"
summary = "A test's own skill."
runs = "compute"
image = "{image}"
volumes = {volumes}
timeout_s = 120
retries = 1
"""
COUNT = """
import time

def run(ctx):
    begun = at = (ctx.resume or {}).get("at", 0)
    while at < 60:
        at += 1
        ctx.checkpoint({"at": at})
        ctx.partial({"at": at})
        time.sleep(0.1)
    return {"begun": begun, "at": at, "attempt": ctx.attempt}
"""
QUICK = """
def run(ctx):
    return {"attempt": ctx.attempt}
"""
DIARY = """
from pathlib import Path

def run(ctx):
    diary = Path("/volumes/diary/lines")
    lines = diary.read_text().splitlines() if diary.exists() else []
    diary.write_text("".join(line + chr(10) for line in [*lines, ctx.robot or "nobody"]))
    return {"lines": len(lines) + 1}
"""


@pytest.fixture
def skills(tmp_path: Path) -> Path:
    """A folder with skills of the tests' own: one counts and saves how far it is, one ends at once, one has state."""
    for name, handler in (("count_up", COUNT), ("quick", QUICK), ("diary", DIARY), ("look", QUICK)):
        folder = tmp_path / "skills" / name
        folder.mkdir(parents=True)
        volumes = '["diary"]' if name == "diary" else "[]"
        image = "vision" if name == "look" else "base"
        (folder / "skill.toml").write_text(MANIFEST.format(name=name, image=image, volumes=volumes))
        (folder / "handler.py").write_text(handler)
    return tmp_path / "skills"


Up = Callable[..., Any]


@pytest.fixture
async def up(tmp_path: Path, skills: Path) -> AsyncIterator[Up]:
    """Return a function that starts a fleet without robots; ended and cleaned up afterwards."""
    started: list[Path] = []

    async def start(*, gateways: int = 3, **more: Any) -> FleetState:
        directory = tmp_path / "fleet"
        started.append(directory)
        order = Order(
            fleet=f"c{os.getpid()}-{time.monotonic_ns() % 100000}",
            directory=directory,
            gateways=gateways,
            mavlink=0,
            zenoh=0,
            base=GatewayConfig(id="base", llm=RULES, skills=(str(skills),)),
            **more,
        )
        return await local_fleet.up(order, progress=print, timeout_s=120.0)

    yield start
    for directory in started:
        await local_fleet.down(directory, progress=print, volumes=True)


def one(skill: str) -> TaskRequest:
    """A task of one subtask."""
    return TaskRequest(instruction=skill, plan=Plan(domain="coordination", subtasks=(Subtask(id="s1", skill=skill),)))


async def follow(client: FleetClient, task: str, *, until: Callable[[TaskRecord], bool]) -> TaskRecord:
    """Wait until a task's record is so."""
    async with asyncio.timeout(120), aclosing(client.watch(task, silence_s=0.3)) as changes:
        async for record in changes:
            if until(record):
                return record
    raise AssertionError("the task ended before that")


async def end(client: FleetClient, task: str) -> TaskRecord:
    """Wait for a task's end."""
    return await follow(client, task, until=lambda record: record.state.final)


def cli(state: FleetState, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run the command line against a fleet, at 80 columns."""
    return subprocess.run(
        [sys.executable, "-m", "appliance.cli", *arguments, "--fleet", state.fleet, "--dir", state.directory],
        capture_output=True, text=True, timeout=90, check=False, env={**os.environ, "COLUMNS": "80"},
    )  # fmt: skip


async def kept(client: FleetClient, task: str) -> int:
    """On how many gateways the checkpoint of a task's s1 lies."""
    key = checkpoint_key(task, "s1")
    answers = [
        await client.plane.rpc.call(each, keyspace.DHT_READ, KeyAsk(key)) for each in sorted(client.plane.members())
    ]
    return sum(each.record is not None and not each.record.deleted for each in answers)


async def test_work_goes_on_from_its_checkpoint_when_its_gateway_is_killed(up: Up) -> None:
    """SIGKILL of the executing gateway: the next attempt elsewhere goes on from what was saved and not from zero."""
    fleet = await up(pool=PoolConfig(floor={"base": 1}))
    async with FleetClient(fleet.endpoint) as client:
        accepted = await client.submit(one("count_up"))
        record = await follow(
            client,
            accepted.id,
            until=lambda record: any(
                each.state is SubtaskState.RUNNING and each.checkpoint_ns and each.partial for each in record.subtasks
            ),
        )
        running = record.of("s1")
        assert running.partial is not None
        assert await kept(client, accepted.id) >= 1
        process = next(each for each in fleet.processes if each.name == running.gateway)
        os.kill(process.pid, signal.SIGKILL)
        ended = await end(client, accepted.id)
        assert ended.state is TaskState.SUCCEEDED, ended.failure
        done = ended.of("s1")
        assert done.gateway != running.gateway
        assert done.result is not None
        print(f"was killed on {running.gateway}; {done.result} on {done.gateway}")
        assert done.result["at"] == 60
        assert done.result["attempt"] == done.attempt >= 2
        assert done.result["begun"] >= 1, "it began from zero"
        assert done.partial is None
        async with asyncio.timeout(60):
            while await kept(client, accepted.id):
                await asyncio.sleep(0.5)
        first = done.attempts[0]
        assert first.placed
        assert done.attempts[-1].choice is not None


async def test_a_plan_has_its_next_containers_warmed(up: Up) -> None:
    """While the first subtask runs, a container of the second one's image is started because the plan will need it."""
    fleet = await up(gateways=2, pool=PoolConfig(floor={"base": 1}))
    plan = Plan(
        domain="coordination",
        subtasks=(Subtask(id="s1", skill="count_up"), Subtask(id="s2", skill="look", after=("s1",))),
    )
    async with FleetClient(fleet.endpoint) as client:
        accepted = await client.submit(TaskRequest(instruction="count, then look", plan=plan))
        ended = await end(client, accepted.id)
        assert ended.state is TaskState.SUCCEEDED, ended.failure
        found, silent = await client.pool_decisions(100)
    assert not silent
    reasons = [
        each.why
        for answer in found.values()
        for each in answer.decisions
        if each.what == "start" and each.image == "vision"
    ]
    print(reasons, ended.of("s2").phase, ended.of("s2").startup_ms)
    assert any("plan" in each for each in reasons), reasons


async def test_the_command_line_explains_attempts_and_steers_pools(up: Up) -> None:
    """`pool why`, `warm`, `decisions`, `evict` and `release` on real gateways, with what is wrong told clearly."""
    fleet = await up(gateways=2, pools={"gw-1": PoolConfig(floor={"base": 1}), "gw-2": PoolConfig(floor={})})
    async with FleetClient(fleet.endpoint) as client:
        accepted = await client.submit(one("quick"))
        assert (await end(client, accepted.id)).state is TaskState.SUCCEEDED
    asked = await asyncio.to_thread(cli, fleet, "pool", "why", f"{accepted.id}/s1", "--json")
    assert asked.returncode == 0, asked.stderr
    found = json.loads(asked.stdout)
    choice = found["subtasks"][0]["attempts"][0]["choice"]
    assert choice["by"] in ("gw-1", "gw-2")
    assert choice["considered"][0]["taken"]
    shown = await asyncio.to_thread(cli, fleet, "pool", "why", accepted.id)
    assert "decided:" in shown.stdout
    for arguments, said in (
        (("pool", "why", "t-none"), "there is no task"),
        (("pool", "why", f"{accepted.id}/s9"), "it has: s1"),
        (("pool", "warm", "nothing"), "known: "),
        (("pool", "warm", "base", "--gateway", "gw-9"), "gw-1, gw-2"),
        (("pool", "evict", "nothing"), "known: "),
        (("pool", "release", "base"), "not in quarantine"),
    ):
        wrong = await asyncio.to_thread(cli, fleet, *arguments)
        assert wrong.returncode == 4, (arguments, wrong.stdout, wrong.stderr)
        assert said in " ".join(wrong.stderr.split()), wrong.stderr
    warmed = await asyncio.to_thread(cli, fleet, "pool", "warm", "base", "--gateway", "gw-2", "--json")
    assert warmed.returncode == 0, warmed.stdout + warmed.stderr
    assert json.loads(warmed.stdout)["ready"] >= 1
    decisions = await asyncio.to_thread(cli, fleet, "pool", "decisions", "--gateway", "gw-2", "--json")
    assert any(each["what"] == "start" and each["gateway"] == "gw-2" for each in json.loads(decisions.stdout))
    evicted = await asyncio.to_thread(cli, fleet, "pool", "evict", "base", "--gateway", "gw-2", "--json")
    assert evicted.returncode == 0, evicted.stderr
    assert json.loads(evicted.stdout)[0]["evicted"]


PEER = """
import asyncio, os, signal, sys
from pathlib import Path
from appliance import logs
from appliance.errors import RefusedError
from appliance.model import ContainerInfo, ContainerState, GatewayStatus, Phase, RunAccepted, keyspace
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig
from appliance.model.task_api import ContainerList

logs.configure(level="warning", style="text")
fleet, endpoint, folder, behaviour = sys.argv[1:]
NAME = "gw-peer"
GHOST = ContainerInfo(
    id="ghost", gateway=NAME, image="base", state=ContainerState.READY, cpu=8.0, memory_mb=8192
)

async def find(need):
    return ContainerList(containers=(GHOST,))

async def run(request):
    print("ordered", request.run_id, flush=True)
    if behaviour == "refuses":
        raise RefusedError("there is no such container")
    if behaviour == "dies unanswered":
        os.kill(os.getpid(), signal.SIGKILL)
    asyncio.get_running_loop().call_later(0.3, os.kill, os.getpid(), signal.SIGKILL)
    return RunAccepted(gateway=NAME, container="ghost", phase=Phase.REMOTE_WARM)

async def main():
    plane = await Plane.open(PlaneConfig(connect=(endpoint,)), fleet=fleet, gateway=NAME, data_dir=Path(folder))
    plane.rpc.register(keyspace.FIND_CONTAINERS, find)
    plane.rpc.register(keyspace.RUN, run)
    # Draining, so that no task is sent there first: it is found by its container.
    plane.registry.publish_status(GatewayStatus(id=NAME, fleet=fleet, draining=True, capacity=1))
    plane.registry.publish_containers((GHOST,))
    # Keys of tasks that the real gateway owns: this one would not drive them.
    mine = (f"t-{number}" for number in range(1000))
    print("ready", next(each for each in mine if plane.ring.owner(f"task/{each}") != NAME), flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""
"""A member of a fleet, as a process: it announces a container it does not have, and treats orders as the test says."""


async def end_at_gw_1(client: FleetClient, task: str) -> TaskRecord:
    """Wait for a task's end, asking the one gateway that knows of tasks."""
    async with asyncio.timeout(120):
        while True:
            record = await client.plane.rpc.call("gw-1", keyspace.TASK, TaskAsk(id=task))
            if record.state.final:
                return record
            await asyncio.sleep(0.2)


@pytest.mark.parametrize("behaviour", ["refuses", "dies unanswered", "dies accepted"])
async def test_a_container_that_is_not_there_or_vanishes_costs_a_try_only(
    up: Up, tmp_path: Path, behaviour: str
) -> None:
    """A peer that lies, or is killed between reservation and start: the subtask ends right, with the reason."""
    fleet = await up(gateways=1, pool=PoolConfig(floor={}, cold_ms=5000.0))
    (tmp_path / "peer").mkdir()
    peer = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PEER, fleet.fleet, fleet.endpoints[0], str(tmp_path / "peer"), behaviour,
        stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert peer.stdout is not None
    try:
        async with FleetClient(fleet.endpoint) as client:
            word, task = (await asyncio.wait_for(peer.stdout.readline(), 60)).decode().split()
            assert word == "ready"
            async with asyncio.timeout(30):
                while "ghost" not in client.plane.registry.containers.get("gw-peer", {}):
                    await asyncio.sleep(0.05)
            await client.plane.rpc.call("gw-1", keyspace.SUBMIT, replace(one("quick"), id=task))
            ended = await end_at_gw_1(client, task)
            assert ended.state is TaskState.SUCCEEDED, ended.failure
            done = ended.of("s1")
            ordered = (await asyncio.wait_for(peer.stdout.readline(), 60)).decode().split()
            assert ordered == ["ordered", f"{task}/s1/1"]
            assert (done.gateway, done.phase) == ("gw-1", Phase.COLD)
            status = (await client.plane.rpc.call("gw-1", keyspace.FACTS, FactsAsk())).status
            assert status is not None
            print(behaviour, [(each.number, each.gateway, each.failure) for each in done.attempts], status.refused)
            choice = done.attempts[-1].choice
            assert choice is not None
            if behaviour == "refuses":
                assert len(done.attempts) == 1
                told = next(each for each in choice.considered if each.gateway == "gw-peer")
                assert told.verdict.startswith("had none when asked: there is no such container")
            elif behaviour == "dies unanswered" and len(done.attempts) == 1:
                # Seen to be gone before it answered; a slower machine repeats the attempt.
                assert any(each.gateway == "gw-peer" for each in choice.considered), choice
            elif behaviour == "dies accepted":
                first = done.attempts[0]
                assert first.choice is not None
                assert (first.choice.way, first.choice.gateway) == (Way.RUN_THERE, "gw-peer")
                assert first.failure is not None
                assert first.failure.code == "unreachable"
            async with asyncio.timeout(30):
                while behaviour == "refuses" and not client.plane.registry.gateways["gw-1"].refused.get("stale offer"):
                    await asyncio.sleep(0.1)
    finally:
        if peer.returncode is None:
            peer.kill()
        await peer.wait()


async def test_a_gateway_killed_with_its_warm_container_is_no_loss(up: Up) -> None:
    """The only gateway with a ready container is killed as a task is handed in: the task ends right elsewhere."""
    fleet = await up(
        gateways=3,
        pool=PoolConfig(floor={}, cold_ms=5000.0),
        pools={"gw-3": PoolConfig(floor={"base": 1})},
    )
    async with FleetClient(Endpoint(fleet=fleet.fleet, connect=fleet.endpoints[:2])) as client:
        async with asyncio.timeout(60):
            while not any(
                each.state is ContainerState.READY for each in client.plane.registry.containers.get("gw-3", {}).values()
            ):
                await asyncio.sleep(0.05)
        process = next(each for each in fleet.processes if each.name == "gw-3")
        os.kill(process.pid, signal.SIGKILL)
        accepted = await client.submit(one("quick"))
        ended = await end(client, accepted.id)
        assert ended.state is TaskState.SUCCEEDED, ended.failure
        assert ended.of("s1").gateway in ("gw-1", "gw-2")


async def run_at(client: FleetClient, gateway: str, number: int, *, hops: int = 0) -> tuple[RunAccepted, RunEvent]:
    """Order a run of the skill with state at one gateway; returns where it went and how it ended."""
    heard: asyncio.Queue[RunEvent] = asyncio.Queue()
    task = f"t-state-{number}"
    client.on_run(task, heard)
    await asyncio.sleep(0.3)
    need = Need(image="base", volumes=("diary",))
    request = RunRequest(task=task, subtask="s1", attempt=1, skill="diary", need=need, hops=hops)
    accepted = await client.plane.rpc.call(gateway, keyspace.RUN, request, timeout_s=30.0)
    async with asyncio.timeout(60):
        while (event := await heard.get()).kind not in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            if event.kind is RunEventKind.STARTED:
                print(f"{task} began on {event.gateway} after {event.startup_ms:.0f} ms")
    return accepted, event


async def newest(client: FleetClient, gateway: str, generation: int) -> None:
    """Wait until both gateways have told where the newest state is."""
    async with asyncio.timeout(30):
        while not any(
            each.generation >= generation
            for each in client.plane.registry.gateways[gateway].volumes
            if each.name == "diary"
        ):
            await asyncio.sleep(0.05)
    await asyncio.sleep(0.5)  # the other gateway hears it as the client does


async def test_a_subtask_never_runs_on_state_that_is_out_of_date(up: Up) -> None:
    """Wherever it is ordered, it goes to the newest state or that is brought: each run finds what the last one left."""
    fleet = await up(gateways=2, pool=PoolConfig(floor={"base": 1}))
    async with FleetClient(fleet.endpoint) as client:
        accepted, ended = await run_at(client, "gw-1", 1)
        assert (accepted.gateway, ended.result) == ("gw-1", {"lines": 1}), ended.failure
        await newest(client, "gw-1", 1)
        # Passed on already, so it cannot go where the state is: the state must come.
        accepted, ended = await run_at(client, "gw-2", 2, hops=1)
        assert (ended.gateway, ended.result) == ("gw-2", {"lines": 2}), ended.failure
        assert accepted.choice is not None
        assert accepted.choice.way is Way.BRING_HERE
        await newest(client, "gw-2", 2)
        accepted, ended = await run_at(client, "gw-1", 3)
        assert ended.result == {"lines": 3}, ended.failure
        assert accepted.choice is not None
        assert accepted.choice.way is (Way.RUN_THERE if ended.gateway == "gw-2" else Way.BRING_HERE)
        assert {each.way for each in accepted.choice.considered} == {Way.RUN_THERE, Way.BRING_HERE}
