"""Whatever the terminal UI orders, ordered by the command line with --json, of one real fleet that does it."""

import asyncio
import json
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from moving_bench import counting, until_running

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Approval, Plan, Subtask, TaskRecord, TaskRequest
from appliance.pool.images import reference
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue

from .conftest import LAME

pytestmark = [pytest.mark.anyio, pytest.mark.podman]

ENDLESS = 4000
"""Steps of a run that is ended before it has made them."""
PATIENCE_S = 90.0


class Shell:
    """An operator at a command line."""

    def __init__(self, fleet: FleetState, name: str) -> None:
        self._where = ["--fleet", fleet.fleet, *(word for each in fleet.endpoints for word in ("--connect", each))]
        self._environment = os.environ | {"SWIFTBOT_OPERATOR": name}

    async def __call__(self, *words: str, code: int = 0) -> Any:
        """Run a command with --json; what it printed, as long as it ends with this exit code."""
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "appliance.cli", *words, "--json", *self._where,
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, env=self._environment,
        )  # fmt: skip
        async with asyncio.timeout(PATIENCE_S):
            printed, said = await process.communicate()
        assert process.returncode == code, said.decode()
        return json.loads(printed) if printed.strip() else said.decode()


@pytest.fixture
def cora(fleet: FleetState) -> Shell:
    """Return an operator at a command line."""
    return Shell(fleet, "cora")


@pytest.fixture
async def client(fleet: FleetState) -> AsyncIterator[FleetClient]:
    """Return somebody else's eyes on the fleet."""
    async with FleetClient(fleet.endpoint, operator="eve") as made:
        yield made


async def until(client: FleetClient, task: str, holds: Callable[[TaskRecord], object]) -> TaskRecord:
    """Wait until a task's record is so."""
    async with asyncio.timeout(PATIENCE_S):
        while not holds(record := await client.task(task)):
            await asyncio.sleep(0.1)
    return record


async def audited(client: FleetClient, *wanted: tuple[str, str]) -> None:
    """Hold the audit to these verbs and whys, ordered by the operator at the command line and done."""
    acts, silent = await client.acts(500)
    assert not silent
    assert set(wanted) <= {(act.verb, act.why) for act in acts if act.by == "cora" and act.outcome == "done"}


async def test_tasks(cora: Shell, client: FleetClient) -> None:
    """Handed in, listed, shown, explained, paused, resumed, moved, cancelled and tried again."""
    handed = await cora("submit", "rover_1: go to dock 1", "--id", "c-go", "--wait")
    assert (handed["id"], handed["state"], handed["submitter"]) == ("c-go", "succeeded", "cora")
    await client.submit(counting("c-count", steps=ENDLESS, count=2))
    await until_running(client, "c-count", "s1")
    assert {"c-go", "c-count"} <= {each["id"] for each in await cora("task", "list")}
    assert (await cora("task", "why", "c-count"))["id"] == "c-count"
    held = await cora("task", "pause", "c-count", "--hold", "--why", "a visitor")
    assert held["paused"] == "paused by cora: a visitor"
    assert (await cora("task", "resume", "c-count", "--why", "gone"))["paused"] is None
    run = await until_running(client, "c-count", "s1")
    (target,) = {"gw-1", "gw-2"} - {run.gateway}
    moved = await cora("task", "migrate", "c-count/s1", "--to", target, "--why", "to see")
    assert (moved["moved"], moved["target"]) == (True, target)
    ended = await cora("task", "cancel", "c-count", "--why", "enough")
    assert (ended["state"], ended["cancelled_by"]["by"]) == ("cancelled", "cora")
    again = await cora("task", "retry", "c-count/s2", "--why", "one of them")
    assert again["retried_by"]["by"] == "cora"
    await until_running(client, "c-count", "s2")
    assert (await cora("task", "show", "c-count"))["state"] == "running"
    await cora("task", "cancel", "c-count")
    assert "c-none" in await cora("task", "cancel", "c-none", code=4)
    await audited(
        client, ("pause", "a visitor"), ("resume", "gone"), ("migrate", "to see"), ("cancel", "enough"),
        ("retry", "one of them"),
    )  # fmt: skip


async def test_plans(cora: Shell, client: FleetClient, tmp_path: Path) -> None:
    """A plan that waits is checked edited, approved by its hash, and not twice; another one is rejected."""
    handed = await cora("submit", "rover_1: go to dock 3, then go to dock 2", "--id", "c-plan", "--approval", "always")
    assert handed["state"] == "proposed"
    plan, waiting = handed["proposal"]["plan"], handed["proposal"]["hash"]
    shorter, wrong = tmp_path / "shorter.json", tmp_path / "wrong.json"
    shorter.write_text(json.dumps(plan | {"subtasks": plan["subtasks"][:1]}))
    there = plan["subtasks"][0] | {"params": {"place": "the far side of the moon"}}
    wrong.write_text(json.dumps(plan | {"subtasks": [there]}))
    assert (await cora("task", "check", str(wrong), "--task", "c-plan", code=4))["problems"]
    assert not (await cora("task", "check", str(shorter), "--task", "c-plan"))["problems"]
    await cora("task", "approve", "c-plan", "--hash", "0" * 12, code=4)
    approved = await cora(
        "task", "approve", "c-plan", "--hash", waiting, "--plan", str(shorter), "--why", "dock 2 is closed"
    )
    assert (approved["decision"]["by"], approved["decision"]["edited"]) == ("cora", True)
    assert "cora has approved" in await cora("task", "approve", "c-plan", "--hash", waiting, code=4)
    record = await until(client, "c-plan", lambda record: record.state.final)
    assert [each.subtask.id for each in record.subtasks] == ["s1"]
    await client.submit(TaskRequest(instruction="rover_2: go to dock 1", id="c-no", approval=Approval.ALWAYS))
    await until(client, "c-no", lambda record: record.proposal is not None)
    rejected = await cora("task", "reject", "c-no", "--why", "not today")
    assert (rejected["decision"]["approved"], rejected["decision"]["why"]) == (False, "not today")
    await audited(client, ("approve", "dock 2 is closed"), ("reject", "not today"))


async def test_robots(cora: Shell, client: FleetClient) -> None:
    """Stopped and let go, taken over, moved and given back; and a question of one is answered."""
    assert {each["id"] for each in await cora("robots", "list")} == {"rover_1", "rover_2"}
    stopped = await cora("stop", "rover_1", "--why", "a person in the aisle")
    assert stopped["robots"] == ["rover_1"]
    (stop,) = (await cora("stops"))["stops"]
    assert (stop["robots"], stop["by"]) == (["rover_1"], "cora")
    assert not (await cora("resume", "rover_1", "--why", "gone")).get("stops")
    lease = (await cora("robots", "takeover", "rover_1", "--lease", "60", "--why", "to look"))["id"]
    assert "taken over by cora" in await cora("robots", "takeover", "rover_1", code=4)
    assert "pose" in await cora("robots", "move", "rover_1", "--lease", lease, "--forward", "0.3", "--for", "0.3")
    assert (await cora("robots", "renew", "rover_1", "--lease", lease))["robot"] == "rover_1"
    assert (await cora("robots", "release", "rover_1", "--lease", lease, "--why", "seen"))["ended"]
    wait = Subtask(id="s1", skill="wait_for", robot="rover_1", params={"event": "the gate is open"})
    plan = Plan(domain="interaction", subtasks=(wait,))
    await client.submit(TaskRequest(instruction="wait", id="c-ask", plan=plan))
    async with asyncio.timeout(PATIENCE_S):
        while not (asked := [each for each in await cora("questions") if each["task"] == "c-ask"]):
            await asyncio.sleep(0.1)
    await cora("answer", asked[0]["id"], "perhaps", code=4)
    assert (await cora("answer", asked[0]["id"], "yes", "--why", "I see it"))["answer"] == "yes"
    await until(client, "c-ask", lambda record: record.state.final)
    await audited(
        client, ("soft_stop", "a person in the aisle"), ("soft_resume", "gone"), ("control_take", "to look"),
        ("control_give", "seen"), ("answer", "I see it"),
    )  # fmt: skip


async def test_gateways_and_pools(cora: Shell, client: FleetClient, broken: Callable[[], Awaitable[None]]) -> None:
    """Drained and undrained; containers warmed, listed, given up and decided on; an image fetched and released."""
    assert {each["id"] for each in await cora("fleet")} == {"gw-1", "gw-2"}
    assert (await cora("drain", "gw-1", "--why", "its fan is loud", "--wait"))["draining"]
    assert not (await cora("uncordon", "gw-1", "--why", "it was dust")).get("draining")
    warmed = await cora("pool", "warm", "base", "--count", "2", "--gateway", "gw-2", "--why", "a tour")
    assert warmed["ready"] >= 2
    assert {"gw-2"} <= {each["gateway"] for each in await cora("pool", "list")}
    assert sum(len(each["evicted"]) for each in await cora("pool", "evict", "base", "--gateway", "gw-2")) >= 1
    assert "retire" in {each["what"] for each in await cora("pool", "decisions", "--gateway", "gw-2")}
    full = reference(load_catalogue().images["base"], PoolConfig())
    assert "base" in (await cora("images", "fetch", full, "--gateway", "gw-2", "--why", "to be sure"))["what"]
    await cora("pool", "warm", LAME, "--gateway", "gw-1", code=1)
    async with asyncio.timeout(PATIENCE_S):
        while "left alone" not in client.plane.registry.gateways["gw-1"].pool_problem:
            await asyncio.sleep(0.1)
    await broken()
    (released,) = await cora("pool", "release", LAME, "--gateway", "gw-1", "--why", "it is mended")
    assert released["gateway"] == "gw-1"
    await audited(
        client, ("drain", "its fan is loud"), ("undrain", "it was dust"), ("pool_warm", "a tour"),
        ("image_fetch", "to be sure"), ("pool_release_quarantine", "it is mended"),
    )  # fmt: skip
    told = await cora("audit", "--limit", "500")
    assert {"drain", "pool_warm", "image_fetch"} <= {each["verb"] for each in told if each["by"] == "cora"}


async def test_models(cora: Shell, client: FleetClient, toy: Path) -> None:
    """Another model is tested and takes over; a folder without one is refused, and the audit says why."""
    assert "is no model folder" in await cora("llm", "swap", "gw-2", f"{toy}/nothing", code=5)
    assert (await cora("llm", "swap", "gw-2", str(toy), "--why", "it is small"))["after"] == "toy"
    await audited(client, ("llm_swap", "it is small"))
    acts, _ = await client.acts(100)
    refused = [act for act in acts if act.by == "cora" and act.verb == "llm_swap" and act.outcome != "done"]
    assert [bool(act.problem) for act in refused] == [True]
