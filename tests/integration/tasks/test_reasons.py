"""What people read when something stands still, in a real fleet: lost robots, a hung Podman, cancels, long plans."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from fleets import PLAIN
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Plan, Subtask, SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig
from appliance.tasks.settings import ReplanConfig
from tests.integration.pool.test_socket import Service
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]

SHOWN_S = 4.0
"""Within how long a Podman that does not answer is to be shown as a problem."""


@pytest.fixture
async def service() -> AsyncIterator[Service]:
    """A Podman of the test's own, which may be stopped without harm to others."""
    with tempfile.TemporaryDirectory(prefix="sb-") as folder:
        found = Service(Path(folder) / "p.sock")
        await found.start()
        yield found
        await found.kill()


@pytest.fixture
async def fleet(tmp_path: Path, service: Service) -> AsyncIterator[FleetState]:
    """One gateway and one robot that speaks Zenoh, as processes."""
    base = replace(PLAIN, tasks=replace(PLAIN.tasks, replan=ReplanConfig(robot_wait_s=2.0)))
    order = Order(
        base=base,
        fleet=f"r{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=tmp_path / "fleet",
        gateways=1,
        mavlink=0,
        sim_rate=4.0,
        pool=PoolConfig(floor={"base": 1}, podman_url=f"unix://{service.socket}"),
    )
    state = await local_fleet.up(order, progress=print, timeout_s=90.0)
    try:
        yield state
    finally:
        await local_fleet.down(order.directory, progress=print)


def cli(state: FleetState, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run the command line against a fleet."""
    return subprocess.run(
        [sys.executable, "-m", "appliance.cli", *arguments, "--fleet", state.fleet, "--dir", state.directory],
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
        env={**os.environ, "COLUMNS": "200"},
    )


async def output(state: FleetState, *arguments: str) -> str:
    """Return what a command prints, in a thread so that the test's own client goes on hearing."""
    done = await asyncio.to_thread(cli, state, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


async def until(client: FleetClient, task: str, holds: Callable[[TaskRecord], Any]) -> TaskRecord:
    """Wait until a task's record is so."""
    async with asyncio.timeout(90):
        async for record in client.watch(task, silence_s=0.3):
            if holds(record):
                return record
    raise AssertionError("it ended before")


def in_state(record: TaskRecord, name: str, state: SubtaskState) -> bool:
    """Whether a subtask is there and in a state."""
    return any(each.subtask.id == name and each.state is state for each in record.subtasks)


def steps(*subtasks: Subtask) -> TaskRequest:
    """Return a task with these subtasks, one after the other."""
    chained = tuple(
        replace(each, id=f"s{number}", after=(f"s{number - 1}",) if number > 1 else ())
        for number, each in enumerate(subtasks, start=1)
    )
    return TaskRequest(instruction="in steps", plan=Plan(domain="navigation", subtasks=chained))


def step(skill: str, **params: Any) -> Subtask:
    """Return a subtask of the fleet's robot."""
    return Subtask(id="s", skill=skill, robot="rover_1", params=params)


async def test_a_task_says_that_its_robot_was_lost_while_it_holds_something(fleet: FleetState) -> None:
    """In `task show`, `task list`, `task why` and their JSON: for which robot it waits, and since when."""
    async with FleetClient(fleet.endpoint) as client:
        accepted = await client.submit(
            steps(step("goto", place="dock 3"), step("pick", object="red box"), step("goto", place="dock 2"))
        )
        await until(client, accepted.id, lambda record: in_state(record, "s2", SubtaskState.SUCCEEDED))
        robot = next(each for each in fleet.processes if each.name == "rover_1")
        os.kill(robot.pid, signal.SIGKILL)
        waiting = await until(
            client, accepted.id, lambda record: any("lost since" in each.note for each in record.subtasks)
        )
        assert waiting.state is TaskState.RUNNING
        said = "robot rover_1, lost since "
        shown = await output(fleet, "task", "show", accepted.id)
        assert f"waits for {said}" in shown
        assert said in " ".join((await output(fleet, "task", "list")).split())
        assert said in await output(fleet, "task", "why", accepted.id)
        told = json.loads(await output(fleet, "task", "show", accepted.id, "--json"))
        assert told["state"] == "running"
        assert told["waits"].startswith(said)
        (listed,) = json.loads(await output(fleet, "task", "list", "--json"))
        assert listed["waits"].startswith(said)
        assert said in json.loads(await output(fleet, "task", "why", accepted.id, "--json"))["waits"]


async def test_a_cancel_answers_with_what_came_of_it(fleet: FleetState) -> None:
    """A task that runs is being cancelled, one that waits is cancelled, and one that had succeeded says that."""
    async with FleetClient(fleet.endpoint) as client:
        running = await client.submit(steps(step("goto", place="dock 3")))
        await until(client, running.id, lambda record: in_state(record, "s1", SubtaskState.RUNNING))
        answer = await client.cancel(running.id)
        assert answer.state in (TaskState.CANCELLING, TaskState.CANCELLED)
        await until(client, running.id, lambda record: record.state is TaskState.CANCELLED)
        waiting = await client.submit(steps(replace(step("goto", place="dock 3"), robot="rover_9")))
        rejected = await until(client, waiting.id, lambda record: record.state.final or record.subtasks)
        if not rejected.state.final:
            assert (await client.cancel(waiting.id)).state is TaskState.CANCELLED
        quick = await client.submit(steps(step("hold", duration_s=0.1)))
        await until(client, quick.id, lambda record: record.state is TaskState.SUCCEEDED)
        done = await asyncio.to_thread(cli, fleet, "task", "cancel", quick.id)
        assert f"task {quick.id} succeeded before the cancel came" in done.stderr


async def test_a_plan_of_more_subtasks_than_a_task_may_have_is_refused(fleet: FleetState) -> None:
    """No task is made of it: the answer names the limit and says to split it, on a robot's key as well."""
    async with FleetClient(fleet.endpoint) as client:
        with pytest.raises(Exception, match="65 subtasks, at most 64") as refused:
            await client.submit(steps(*(step("hold", duration_s=0.1) for _ in range(65))))
        assert "split it" in str(refused.value)
        assert not (await client.tasks(20)).tasks


async def test_a_podman_that_stands_still_is_shown_until_it_answers(fleet: FleetState, service: Service) -> None:
    """In the status that `swiftbot fleet` and the screen of the fleet show: within 4 s, and gone once it answers."""
    process = service._process
    assert process is not None
    async with FleetClient(fleet.endpoint) as client:

        async def problem(there: bool) -> str:
            while True:
                (status,) = [each for each in client.plane.registry.gateways.values() if each.id == "gw-1"]
                if bool(status.pool_problem) is there:
                    return status.pool_problem
                await asyncio.sleep(0.05)

        async with asyncio.timeout(30):
            await problem(there=False)
        process.send_signal(signal.SIGSTOP)
        try:
            async with asyncio.timeout(SHOWN_S):
                text = await problem(there=True)
            assert "Podman has not answered within" in text
            assert "Podman has not answered within" in " ".join((await output(fleet, "fleet")).split())
        finally:
            process.send_signal(signal.SIGCONT)
        async with asyncio.timeout(60):
            await problem(there=False)
