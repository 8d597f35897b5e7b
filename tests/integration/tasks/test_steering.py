"""Operators steer a real fleet of processes: approval, pauses, soft stop over restarts, lease, audit; and its log."""

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import ConflictError, PayloadError, PlanError, RefusedError, SwiftbotError
from appliance.model import (
    Act,
    Approval,
    GatewayStatus,
    Plan,
    RobotInfo,
    Subtask,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
)
from appliance.record.reader import read
from appliance.tasks.replay import replay

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
FLEET = {"zenoh": 1, "sim_rate": 2.0}

TOUR = "Rover_1: go to dock 3, then go to dock 2, then go to dock 1"
LONG = f"{TOUR}, then go to dock 3, then go to dock 2, then go to dock 1, then go to dock 3"


async def until(client: FleetClient, task: str, holds: Callable[[TaskRecord], bool], limit_s: float = 60) -> TaskRecord:
    """Wait until a task's record is so."""
    async with asyncio.timeout(limit_s):
        while not holds(record := await client.task(task)):
            await asyncio.sleep(0.1)
    return record


def runs(record: TaskRecord) -> bool:
    """Whether a subtask of it is under way."""
    return any(each.state is SubtaskState.RUNNING for each in record.subtasks)


def idle(record: TaskRecord) -> bool:
    """Whether no subtask of it has a run anywhere, or is on its way to one."""
    return not any(each.state in (SubtaskState.RUNNING, SubtaskState.DISPATCHED) for each in record.subtasks)


def rover(client: FleetClient) -> RobotInfo:
    """The rover as it tells itself."""
    return client.plane.registry.robots["rover_1"]


async def stands(client: FleetClient) -> None:
    """Wait until the rover does not move between two looks half a second apart."""
    async with asyncio.timeout(20):
        before = None
        while before is None or before != rover(client).pose:
            before = rover(client).pose
            await asyncio.sleep(0.5)


async def test_operators_steer_a_fleet(fleet: FleetState) -> None:
    """One after the other on one fleet: approve an edited plan, pause, soft stop over a kill, lease, retry, audit."""
    async with FleetClient(fleet.endpoint, operator="ann") as ann, FleetClient(fleet.endpoint, operator="bob") as bob:
        await approve_an_edited_plan(ann, bob)
        await pause_and_resume(ann, bob)
        await stop_and_resume(fleet, ann, bob)
        await take_over(ann, bob)
        await cancel_and_retry(ann)
        await ask_and_answer(ann, bob)
        with pytest.raises(SwiftbotError):
            await ann.swap_model("gw-1", "/nowhere", why="to see")
        acts, silent = await bob.acts(100)
        assert not silent
        told = {(each.by, each.verb, each.outcome) for each in acts}
        assert {("ann", "approve", "done"), ("bob", "approve", "conflict"), ("ann", "soft_stop", "done")} <= told
        assert {("bob", "answer", "done"), ("ann", "answer", "conflict")} <= told
        assert any(each.verb == "llm_swap" and each.outcome != "done" and each.problem for each in acts)
        assert {("bob", "control_take", "conflict"), ("ann", "control_give", "done"), ("ann", "retry", "done")} <= told
        await asyncio.sleep(1.5)  # the recorder writes what it has heard
    reports = [replay(path) for path in sorted(Path(fleet.record_dir).glob("*.mcap"))]
    assert all(report.same for report in reports), [each.differences for one in reports for each in one.tasks]
    logged = [
        msgspec.json.decode(message.payload, type=Act)
        for path in sorted(Path(fleet.record_dir).glob("*.mcap"))
        for message in read(path)
        if "/operator/act/" in message.key
    ]
    assert {"approve", "pause", "soft_stop", "soft_resume", "control_take"} <= {each.verb for each in logged}
    assert any(each.why == "a person in the aisle" and each.by == "ann" for each in logged)


async def approve_an_edited_plan(ann: FleetClient, bob: FleetClient) -> None:
    """A plan waits; what is wrong with an edited one is reported; one operator wins, the other hears who."""
    record = await ann.submit(TaskRequest(instruction=TOUR, id="edited", approval=Approval.ALWAYS))
    record = await until(ann, "edited", lambda record: record.state is not TaskState.ACCEPTED)
    assert record.state is TaskState.PROPOSED
    assert record.proposal is not None
    given, plan = record.proposal.hash, record.proposal.plan
    broken = replace(plan, subtasks=(replace(plan.subtasks[0], params={"place": "the far side of the moon"}),))
    checked = await ann.check_plan(broken, task="edited")
    assert checked.problems
    with pytest.raises(PlanError):
        await ann.approve("edited", plan_hash=given, plan=broken)
    shorter = replace(plan, subtasks=plan.subtasks[:1])
    assert not (await ann.check_plan(shorter, task="edited")).problems
    await ann.approve("edited", plan_hash=given[:12], plan=shorter, why="the docks beyond are closed")
    with pytest.raises(ConflictError, match="ann has approved"):
        await bob.approve("edited", plan_hash=given)
    ended = await until(ann, "edited", lambda record: record.state.final)
    assert ended.state is TaskState.SUCCEEDED
    assert len(ended.subtasks) == 1
    assert ended.decision is not None
    assert (ended.decision.by, ended.decision.edited) == ("ann", True)


async def pause_and_resume(ann: FleetClient, bob: FleetClient) -> None:
    """What runs goes on to its end and nothing follows, until somebody resumes."""
    await ann.submit(TaskRequest(instruction=LONG, id="paused"))
    await until(ann, "paused", runs)
    await ann.pause("paused", why="a visitor")
    with pytest.raises(ConflictError, match="paused by ann: a visitor"):
        await bob.pause("paused")
    record = await until(ann, "paused", idle)
    waiting = next(each for each in record.subtasks if each.state is SubtaskState.READY)
    assert waiting.note == "paused by ann: a visitor"
    assert "a visitor" in (await bob.why("paused")).waits
    await asyncio.sleep(1.0)
    assert idle(await bob.task("paused"))
    await bob.resume("paused")
    await until(ann, "paused", lambda record: record.of(waiting.subtask.id).attempt > 0)


async def stop_and_resume(fleet: FleetState, ann: FleetClient, bob: FleetClient) -> None:
    """The rover stands, its task waits with the reason, over the death and return of a gateway; then it goes on."""
    await until(ann, "paused", runs)
    answer = await ann.stop(["rover_1"], why="a person in the aisle")
    assert answer.robots == ("rover_1",)
    assert not answer.problems
    await stands(ann)
    record = await until(ann, "paused", lambda record: bool(record.pauses) and idle(record))
    assert record.paused == "rover_1 stopped by ann: a person in the aisle"
    assert record.failure is None
    victim = next(each for each in fleet.processes if each.name == record.coordinator)
    os.kill(victim.pid, signal.SIGKILL)
    await until(bob, "paused", lambda now: now.coordinator != record.coordinator)
    config = Path(fleet.directory) / victim.name / "gateway.toml"
    again = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli", "gateway", "--config", str(config)
    )
    try:
        await recorded(fleet, victim.name, again.pid)
        await go_on_after_the_return(ann, bob, victim.name, again.pid)
    finally:
        again.terminate()
        await again.wait()


async def recorded(fleet: FleetState, name: str, pid: int) -> None:
    """Wait until the recorder is linked to the gateway that has come back: what is said before is in no log."""

    def heard() -> bool:
        return any(
            msgspec.json.decode(message.payload, type=GatewayStatus).pid == pid
            for path in sorted(Path(fleet.record_dir).glob("*.mcap"))[-1:]
            for message in read(path, keys=f"swiftbot/{fleet.fleet}/gw/{name}/status")
        )

    async with asyncio.timeout(60):
        while not await asyncio.to_thread(heard):
            await asyncio.sleep(0.5)


async def go_on_after_the_return(ann: FleetClient, bob: FleetClient, name: str, pid: int) -> None:
    """The gateway that comes back knows the stop and keeps it; then it is lifted."""
    async with asyncio.timeout(60):
        while not ((status := bob.plane.registry.gateways.get(name)) and status.pid == pid and status.stops):
            await asyncio.sleep(0.2)
    assert [each.why for each in (await bob.standing()).active] == ["a person in the aisle"]
    record = await bob.task("paused")
    assert record.paused
    assert idle(record)
    with pytest.raises(RefusedError, match="goes on when the stop is lifted"):
        await bob.resume("paused")
    await bob.resume_robots(why="gone")
    ended = await until(ann, "paused", lambda record: record.state.final, limit_s=120)
    assert ended.state is TaskState.SUCCEEDED
    held = [each for one in ended.subtasks for each in one.attempts if each.left]
    assert held
    assert all(each.failure is None for each in held)


async def take_over(ann: FleetClient, bob: FleetClient) -> None:
    """Only its operator moves the rover, by commands that end by themselves; a task waits until it is given back."""
    lease = await ann.take_over("rover_1", lease_s=5.0, why="to see behind it")
    with pytest.raises(ConflictError, match="taken over by ann"):
        await bob.take_over("rover_1")
    await bob.submit(TaskRequest(instruction="Rover_1: go to dock 2", id="waits"))
    record = await until(bob, "waits", lambda record: bool(record.subtasks) and "taken over" in record.subtasks[0].note)
    assert not runs(record)
    before = rover(ann).pose
    assert before is not None
    for _ in range(6):
        lease = await ann.renew(lease)
        await ann.drive(lease, "velocity", forward_mps=0.5, for_s=0.5)
    await stands(ann)
    after = rover(ann).pose
    assert after is not None
    assert (after.x, after.y) != (before.x, before.y)
    await ann.give_back(lease)
    ended = await until(bob, "waits", lambda record: record.state.final)
    assert ended.state is TaskState.SUCCEEDED


async def cancel_and_retry(ann: FleetClient) -> None:
    """A task that was cancelled with a reason goes on where it was: what has succeeded is kept."""
    await ann.submit(TaskRequest(instruction=TOUR, id="again"))
    await until(ann, "again", lambda record: any(each.state is SubtaskState.SUCCEEDED for each in record.subtasks))
    await ann.cancel("again", why="wrong rover")
    record = await until(ann, "again", lambda record: record.state.final)
    assert record.state is TaskState.CANCELLED
    assert record.cancelled_by is not None
    assert record.cancelled_by.why == "wrong rover"
    done = {each.subtask.id: each.attempt for each in record.subtasks if each.state is SubtaskState.SUCCEEDED}
    await ann.retry("again", why="it was the right one")
    ended = await until(ann, "again", lambda record: record.state.final)
    assert ended.state is TaskState.SUCCEEDED
    assert all(ended.of(name).attempt == attempt for name, attempt in done.items())


async def ask_and_answer(ann: FleetClient, bob: FleetClient) -> None:
    """A skill asks, the question is listed everywhere, one answer counts and the skill goes on with it."""
    wait = Subtask(id="s1", skill="wait_for", robot="rover_1", params={"event": "the gate is open"})
    await ann.submit(TaskRequest(instruction="wait", id="asks", plan=Plan(domain="interaction", subtasks=(wait,))))
    async with asyncio.timeout(60):
        while not (found := await ann.enquiries()).enquiries:
            await asyncio.sleep(0.2)
    asked = found.enquiries[0]
    assert (asked.task, asked.robot, asked.choices) == ("asks", "rover_1", ("yes", "no"))
    assert "the gate is open" in asked.question
    with pytest.raises(PayloadError, match="none of the answers"):
        await ann.answer(asked.id, "perhaps")
    await bob.answer(asked.id, "yes", why="I see it")
    with pytest.raises(ConflictError, match="bob has answered 'yes'"):
        await ann.answer(asked.id, "no")
    ended = await until(ann, "asks", lambda record: record.state.final)
    assert ended.state is TaskState.SUCCEEDED
    assert (ended.subtasks[0].result or {})["confirmed"] is True
    assert not (await bob.enquiries()).enquiries
