"""Runs that move between the gateways of a real fleet: by hand, by drain, by overload, and when the target fails."""

import asyncio
import json
import os
import signal
from collections import Counter
from pathlib import Path

import msgspec
import pytest
from fleets import swiftbot
from moving_bench import counting, ended, fleet_of, further_gateway, pretty, until_running

from appliance.client import FleetClient
from appliance.errors import NotFoundError, RefusedError
from appliance.model import Plan, RobotCommand, Subtask, TaskRequest, TaskState
from appliance.model.task_api import MigrateAsk, MigrationRequest
from appliance.pool.settings import PoolConfig, PressureConfig
from appliance.record.reader import read
from appliance.tasks.replay import replay
from appliance.tasks.settings import MigrationConfig
from workshop import local_fleet

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


@pytest.mark.long
async def test_an_operator_moves_a_run_with_its_checkpoint_and_its_volume(tmp_path: Path) -> None:
    """It goes on there from a fresh checkpoint, no step is lost or done twice, and the log replays to the same end."""
    async with fleet_of(tmp_path) as state, FleetClient(state.endpoint) as client:
        await client.submit(counting("t-hand", steps=4000, then=200))
        before = await until_running(client, "t-hand")
        to = next(each for each in state.gateways if each != before.gateway)
        code, out, err = await swiftbot(state, "task", "migrate", "t-hand/s1", "--to", to, "--json")
        assert code == 0, err
        moved = json.loads(out)
        assert (moved["moved"], moved["target"], moved["attempt"], moved["checkpoint"]) == (True, to, 2, "fresh"), out
        now = await until_running(client, "t-hand", attempt=2)
        assert now.gateway == to
        assert now.attempts[0].left.startswith(f"moved from {before.gateway} to {to}"), pretty(now)
        with pytest.raises(RefusedError, match="already"):
            await client.migrate(MigrateAsk(task="t-hand", subtask="s1", to=to))
        with pytest.raises(NotFoundError, match="no subtask"):
            await client.migrate(MigrateAsk(task="t-hand", subtask="s9"))
        with pytest.raises(NotFoundError, match="no gateway"):
            await client.migrate(MigrateAsk(task="t-hand", subtask="s1", to="gw-9"))
        record = await ended(client, "t-hand")
        assert record.state is TaskState.SUCCEEDED, record.failure
        result = record.of("s1").result or {}
        assert result["by"] == [1, 2], result
        assert result["resumed_from"] > 0, result

        await client.submit(counting("t-volume", steps=120, skill="count_in_volume"))
        await until_running(client, "t-volume")
        await asyncio.sleep(1.0)
        moved = await client.migrate(MigrateAsk(task="t-volume", subtask="s1"))
        assert moved.started, moved
        record = await ended(client, "t-volume")
        assert record.state is TaskState.SUCCEEDED, record.failure
        result = record.of("s1").result or {}
        assert [each.split()[0] for each in result["lines"]] == [str(number) for number in range(120)], result
        assert result["found"] > 0, result
        with pytest.raises(RefusedError):
            await client.migrate(MigrateAsk(task="t-volume", subtask="s1"))
    logs = list(Path(state.record_dir).glob("*.mcap"))
    report = replay(max(logs, key=lambda each: each.stat().st_size))
    assert report.same, [each.differences for each in report.tasks]


@pytest.mark.long
async def test_a_drained_gateway_is_empty_and_takes_runs_again(tmp_path: Path) -> None:
    """All its runs go on elsewhere from their checkpoints, at no retry's cost; new ones do not come until undrained."""
    async with fleet_of(tmp_path) as state, FleetClient(state.endpoint) as client:
        await client.submit(counting("t-drain", steps=400, count=4))
        first = [await until_running(client, "t-drain", f"s{number}") for number in range(1, 5)]
        gateway = max(state.gateways, key=lambda name: sum(each.gateway == name for each in first))
        there = [each.subtask.id for each in first if each.gateway == gateway]
        code, out, err = await swiftbot(state, "drain", gateway, "--wait", "--json")
        assert code == 0, err
        assert json.loads(out)["moved"] == len(there), out
        record = await client.task("t-drain")
        for each in record.subtasks:
            assert each.gateway != gateway, pretty(each)
            assert each.attempt == (2 if each.subtask.id in there else 1), pretty(each)
        assert client.plane.registry.gateways[gateway].draining
        await client.submit(counting("t-meanwhile", steps=2))
        assert (await ended(client, "t-meanwhile")).of("s1").gateway != gateway
        code, out, err = await swiftbot(state, "uncordon", gateway, "--json")
        assert (code, json.loads(out)["draining"]) == (0, False), err
        last = await ended(client, "t-drain")
        assert last.state is TaskState.SUCCEEDED, last.failure
        for each in last.subtasks:
            assert (each.result or {})["by"] == list(range(1, each.attempt + 1)), pretty(each)
            assert not any(attempt.failure for attempt in each.attempts), pretty(each)
        requests = [
            MigrationRequest
            for message in read(max(Path(state.record_dir).glob("*.mcap")))
            if message.key.endswith(f"/gw/{gateway}/migration")
        ]
        assert requests, "the request is not in the log"


@pytest.mark.long
async def test_a_gateway_told_to_stop_gives_its_runs_away(tmp_path: Path) -> None:
    """SIGTERM: runs that would take minutes go on elsewhere, and the gateway ends long before its drain's deadline."""
    async with fleet_of(tmp_path, drain_s=100.0) as state, FleetClient(state.endpoint) as client:
        await client.submit(counting("t-stop", steps=500, count=2))
        first = await until_running(client, "t-stop")
        process = next(each for each in state.processes if each.name == first.gateway)
        os.kill(process.pid, signal.SIGTERM)
        async with asyncio.timeout(60):
            while local_fleet.alive(process):
                await asyncio.sleep(0.1)
        last = await ended(client, "t-stop")
        assert last.state is TaskState.SUCCEEDED, last.failure
        moved = last.of("s1")
        assert moved.gateway != first.gateway
        assert moved.attempts[0].left, pretty(moved)
        assert (moved.result or {})["resumed_from"] > 0


async def test_a_target_that_dies_costs_no_retry_and_no_step(tmp_path: Path) -> None:
    """The gateway a run was moved to is killed at once: its skill has no retries, and yet it ends, step by step."""
    async with fleet_of(tmp_path) as state, FleetClient(state.endpoint) as client:
        await client.submit(counting("t-dies", steps=200))
        before = await until_running(client, "t-dies")
        to = next(each for each in state.gateways if each != before.gateway)
        process = next(each for each in state.processes if each.name == to)
        moving = asyncio.create_task(client.migrate(MigrateAsk(task="t-dies", subtask="s1", to=to)))
        await asyncio.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
        await asyncio.gather(moving, return_exceptions=True)
        last = await ended(client, "t-dies")
        assert last.state is TaskState.SUCCEEDED, last.failure
        result = last.of("s1").result or {}
        assert result["by"] == sorted(set(result["by"])), result


@pytest.mark.long
async def test_a_run_that_commands_a_robot_moves_between_commands_and_repeats_none(tmp_path: Path) -> None:
    """Moved again and again in mid-drive: it waits for the command's end, and the robot does each command once."""
    async with fleet_of(tmp_path, rovers=1) as state, FleetClient(state.endpoint) as client:
        plan = Plan(
            domain="navigation", subtasks=(Subtask(id="s1", skill="go_round", robot="rover_1", params={"laps": 24}),)
        )
        await client.submit(TaskRequest(instruction="go round", id="t-round", plan=plan))
        await until_running(client, "t-round")
        moves, refusals = 0, list[str]()
        async with asyncio.timeout(120):
            while moves < 3:
                try:
                    moves += (await client.migrate(MigrateAsk(task="t-round", subtask="s1"))).started
                except RefusedError as error:
                    refusals.append(error.message)
                await asyncio.sleep(0.5)
        assert all("robot command" in each for each in refusals), refusals
        last = await ended(client, "t-round")
        assert last.state is TaskState.SUCCEEDED, last.failure
        found = last.of("s1")
        assert (found.result or {})["laps"] == 24
        assert sum(bool(each.left) for each in found.attempts) == 3, pretty(found)
        assert not any(each.failure for each in found.attempts), pretty(found)
    done = Counter(
        command.id
        for message in read(max(Path(state.record_dir).glob("*.mcap")))
        if message.key.endswith("/commanded")
        and (command := msgspec.json.decode(message.payload, type=RobotCommand)).task == "t-round"
        and command.verb == "goto"
    )
    assert len(done) == 24, done
    assert set(done.values()) == {1}, done


@pytest.mark.long
async def test_a_gateway_short_of_memory_gives_running_work_away(tmp_path: Path) -> None:
    """Its pool is squeezed: its runs go on elsewhere from their checkpoints, each once, and none comes back to it."""
    squeezed = PoolConfig(floor={"base": 2}, pressure=PressureConfig(spare_mb=10_000_000))
    config = MigrationConfig(above_s=0.5, settle_s=2.0)
    async with (
        fleet_of(tmp_path, gateways=2, migration=config) as state,
        FleetClient(state.endpoint) as client,
        further_gateway(state, "gw-short", squeezed),
    ):
        for gateway in ("gw-1", "gw-2"):
            await client.drain(gateway, 0.0)
        async with asyncio.timeout(90):
            while True:
                status = client.plane.registry.gateways.get("gw-short")
                if status is not None and status.ready >= 2 and status.overloaded.startswith("memory is short"):
                    break
                await asyncio.sleep(0.1)
        await client.submit(counting("t-over", steps=400, count=2))
        for subtask in ("s1", "s2"):
            assert (await until_running(client, "t-over", subtask)).gateway == "gw-short"
        for gateway in ("gw-1", "gw-2"):
            await client.undrain(gateway)
        last = await ended(client, "t-over")
        assert last.state is TaskState.SUCCEEDED, last.failure
        for each in last.subtasks:
            assert each.attempts[0].gateway == "gw-short"
            assert each.attempts[0].left.startswith("moved from gw-short"), pretty(each)
            assert "overload" in each.attempts[0].left, pretty(each)
            assert (each.attempt, bool(each.failure)) == (2, False), pretty(each)
            assert (each.result or {})["by"] == [1, 2], pretty(each)
