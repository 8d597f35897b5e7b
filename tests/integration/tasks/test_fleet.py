"""A real fleet of processes: instructions to results, lost gateways, adoption, the command line, bad input."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest
import zenoh
from fleets import PLAIN, RULES, fleet_in
from pymavlink import mavutil

from appliance import config as configuration
from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.errors import ConfigError, NotFoundError
from appliance.model import (
    ContainerState,
    Phase,
    RobotCommand,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    keyspace,
)
from appliance.pool.settings import PoolConfig
from appliance.record.reader import read
from appliance.robots.client import TaskClient, TaskRejected
from appliance.robots.mavlink.command_server import task_number
from appliance.robots.settings import RobotsConfig, Template
from appliance.robots.zenoh_client import AsyncZenohTaskClient, ZenohTaskRejected
from appliance.tasks.replay import replay
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman]

LOOK = "Rover_1: go to dock 3, photograph the red box, detect red boxes and report to the operator"
UP_AND_DOWN = {
    "domain": "navigation",
    "subtasks": [
        {"id": "up", "skill": "takeoff", "robot": "drone_1", "params": {"altitude_m": 4.0}},
        {"id": "down", "skill": "land", "robot": "drone_1", "after": ["up"]},
    ],
}
FETCH = "Rover_1: go to dock 3, pick the red box, then go to dock 2 and place the red box at dock 2"


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """Three gateways, a recorder and two robots as processes; ended and cleaned up afterwards."""
    order = Order(
        base=PLAIN,
        fleet=f"t{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=tmp_path / "fleet",
        sim_rate=4.0,
        pool=PoolConfig(floor={"base": 1, "vision": 1}),
    )
    state = await local_fleet.up(order, progress=print, timeout_s=90.0)
    try:
        yield state
    finally:
        await local_fleet.down(order.directory, progress=print, volumes=True)


async def test_a_task_by_zenoh(fleet: FleetState, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot asks by query: the answer comes when the task is durable, asked again it is the same, and it is followed.

    What is refused is reported with its reason.
    """
    monkeypatch.setattr("appliance.robots.zenoh_client.LOOK_S", 0.2)  # so that it is looked at as well as heard of
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps(fleet.endpoints))
    with await asyncio.to_thread(zenoh.open, config) as session:
        client = AsyncZenohTaskClient(session, fleet=fleet.fleet, robot="rover_1")
        for _ in range(2):
            assert await client.submit("Rover_1: go to dock 3", task="by-zenoh") == "by-zenoh"
        states = [record["state"] async for record in client.follow("by-zenoh", timeout_s=90)]
        assert states[-1] == "succeeded"
        with pytest.raises(ZenohTaskRejected, match="1 to") as refused:
            await client.submit(" ")
        assert refused.value.code == "payload"
        with pytest.raises(ZenohTaskRejected, match="this is a stop, not a task") as refused:
            await client.submit("rover_1: stop")
        assert refused.value.remedy == "swiftbot stop rover_1"
    assert set(commands_in(fleet, "by-zenoh").values()) == {1}


async def test_a_task_by_mavlink(tmp_path: Path) -> None:
    """A ground station's button makes a task of the vehicle it addresses: acknowledged when durable, told to its end.

    The repeated command is the same task, and the vehicle flies once. Words through TUNNEL frames make one as well, and
    so does a plan.
    """
    template = Template(id=7, instruction="{robot}: take off, then land")
    order = Order(
        fleet=f"t{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=tmp_path / "fleet",
        sim_rate=4.0,
        zenoh=0,
        pool=PoolConfig(floor={"base": 1}),
        base=GatewayConfig(id="gw-1", llm=RULES, robots=RobotsConfig(templates=(template,))),
    )
    state = await local_fleet.up(order, progress=print, timeout_s=90.0)

    def station() -> tuple[list[tuple[int, int]], list[str]]:
        link = configuration.load(order.directory / "gw-1" / "gateway.toml").robots.mavlink[0]
        ground = mavutil.mavlink_connection(link.listen.replace("udp://", "udpout:"), 255, source_component=190)
        answers: list[tuple[int, int]] = []
        texts: list[str] = []
        try:
            for confirmation in (0, 1):
                ground.mav.heartbeat_send(6, 8, 0, 0, 4)
                ground.mav.command_long_send(1, 191, 31010, confirmation, 7, 0, 0, 0, 0, 0, 0)
                while not answers or answers[-1][0] != 0 or len(answers) < 2 + confirmation:
                    found = ground.recv_match(type=["COMMAND_ACK", "STATUSTEXT"], blocking=True, timeout=30)
                    assert found is not None, (answers, texts)
                    if found.get_type() == "STATUSTEXT":  # the task may end before all answers are read
                        texts.append(found.text)
                    else:
                        answers.append((found.result, found.result_param2))
            while not any("succeeded" in text for text in texts):
                texts.append(ground.recv_match(type="STATUSTEXT", blocking=True, timeout=60).text)
            client = TaskClient(ground, gateway=(1, 191))
            client.submit("drone_1: take off, then land", task="in-words")
            texts.append(list(client.follow("in-words", timeout_s=60))[-1]["state"])
            with pytest.raises(TaskRejected, match="is empty"):
                client.submit(" ")
            with pytest.raises(TaskRejected, match="this is a stop, not a task"):
                client.submit("stop the drone")
            client.submit("up and down", task="by-plan", plan=UP_AND_DOWN, priority=6)
            texts.append(list(client.follow("by-plan", timeout_s=60))[-1]["state"])
            with pytest.raises(TaskRejected, match="not understood"):
                client.submit("up and down", task="no-plan", plan={"subtasks": "all"})
            client.submit("away", task="bad-plan", plan=UP_AND_DOWN | {"subtasks": [{"id": "s1", "skill": "vanish"}]})
            last = list(client.follow("bad-plan", timeout_s=60))[-1]
            texts += [last["state"], last["message"]]
        finally:
            ground.close()
        return answers, texts

    try:
        answers, texts = await asyncio.to_thread(station)
        assert "plan handed in is not valid" in texts.pop()
        assert [texts.pop(), texts.pop(), texts.pop()] == ["failed", "succeeded", "succeeded"]
        task = texts[-1].split()[0]
        assert [result for result, _ in answers] == [5, 0, 0]
        assert answers[1] == answers[2] == (0, task_number(task))
        async with FleetClient(state.endpoint) as client:
            record = await client.task(task)
            planned = await client.task("by-plan")
        assert (record.instruction, record.submitter) == ("drone_1: take off, then land", "mavlink-255-190")
        assert record.state is TaskState.SUCCEEDED
        assert (planned.handed_in, planned.priority, planned.submitter) == (True, 6, "mavlink-255-190")
        assert [each.subtask.id for each in planned.subtasks] == ["up", "down"]
    finally:
        await local_fleet.down(order.directory, progress=print, volumes=True)
    assert set(commands_in(state, task).values()) == {1}
    assert set(commands_in(state, "in-words").values()) == {1}


async def wait_for(client: FleetClient, task: str) -> TaskRecord:
    """Wait for a task's end."""
    record = None
    async with asyncio.timeout(90):
        async for changed in client.watch(task):
            record = changed
    assert record is not None
    return record


async def until(client: FleetClient, task: str, state: SubtaskState, *, skill: str) -> TaskRecord:
    """Wait until a subtask of a skill is in a state."""
    async with asyncio.timeout(60):
        async for record in client.watch(task, silence_s=0.3):
            if any(each.subtask.skill == skill and each.state is state for each in record.subtasks):
                return record
    raise AssertionError(f"{skill} was never {state}")


def commands_in(state: FleetState, task: str) -> Counter[str]:
    """How often each command of a task was taken up by a robot, by the log."""
    found: Counter[str] = Counter()
    for path in sorted(Path(state.record_dir).glob("*.mcap")):
        for message in read(path):
            if message.key.endswith("/commanded"):
                command = msgspec.json.decode(message.payload, type=RobotCommand)
                if command.task == task:
                    found[command.id] += 1
    return found


def cli(state: FleetState, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run the command line against a fleet."""
    return subprocess.run(
        [sys.executable, "-m", "appliance.cli", *arguments, "--fleet", state.fleet, "--dir", state.directory],
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )


async def test_an_instruction_becomes_results_in_warm_containers_and_replays(fleet: FleetState) -> None:
    """A sequential and a parallel instruction succeed on warm containers, and the log replays to the same ends."""
    async with FleetClient(fleet.endpoint) as client:
        look = await client.submit(TaskRequest(instruction=LOOK))
        first = await wait_for(client, look.id)
        assert first.state is TaskState.SUCCEEDED, first.failure
        both = await client.submit(
            TaskRequest(instruction="Drone_1 take off to 10 m, go to goal 2 and land, while Rover_1 goes to dock 1")
        )
        second = await wait_for(client, both.id)
        assert second.state is TaskState.SUCCEEDED, second.failure
        for record in (first, second):
            for each in record.subtasks:
                assert each.phase in (Phase.LOCAL_WARM, Phase.REMOTE_WARM)
                assert each.startup_ms is not None
                assert each.duration_ms is not None
                assert each.container
        photo = next(each for each in first.subtasks if each.subtask.skill == "photograph")
        assert photo.result is not None
        detect = next(each for each in first.subtasks if each.subtask.skill == "detect")
        assert detect.result is not None
        assert detect.result["count"] == 1
        gateways = client.plane.registry.gateways
        assert set(gateways) == set(fleet.gateways)
        # The promise of the idle gateway's footprint, model not loaded.
        assert all(each.memory_mb <= 200 for each in gateways.values()), gateways
    await asyncio.sleep(1.5)  # the recorder flushes every half second
    reports = [replay(path) for path in sorted(Path(fleet.record_dir).glob("*.mcap"))]
    assert reports
    assert all(report.same for report in reports), reports


@pytest.mark.parametrize("victim", ["coordinator", "executor"])
async def test_a_killed_gateway_neither_loses_the_task_nor_doubles_an_effect(fleet: FleetState, victim: str) -> None:
    """SIGKILL of the coordinating or the executing gateway in mid-task: it still succeeds, each command done once."""
    async with FleetClient(fleet.endpoint) as client:
        attached = client.plane.registry.robots["drone_1"].gateway
        accepted = await client.submit(TaskRequest(instruction=FETCH))
        record = await until(client, accepted.id, SubtaskState.RUNNING, skill="goto")
        name = record.coordinator if victim == "coordinator" else record.of("s1").gateway
        process = next(each for each in fleet.processes if each.name == name)
        print(f"killing {name}; drone_1 is at {attached}; s1 runs on {record.of('s1').gateway}")
        os.kill(process.pid, signal.SIGKILL)
        ended = await wait_for(client, accepted.id)
    assert ended.state is TaskState.SUCCEEDED, ended.failure
    assert ended.coordinator != name or victim == "executor"
    await asyncio.sleep(1.5)
    effects = commands_in(fleet, accepted.id)
    assert effects, "the log has no commands"
    verbs = {each for each in effects if effects[each] > 1}
    assert not verbs, f"taken up more than once: {verbs}"


async def test_cancel_stops_the_robot_and_ends_the_task(fleet: FleetState) -> None:
    """A cancelled task ends as cancelled, its run is ended, and the robot stands still."""
    async with FleetClient(fleet.endpoint) as client:
        accepted = await client.submit(TaskRequest(instruction=FETCH))
        await until(client, accepted.id, SubtaskState.RUNNING, skill="goto")
        await client.cancel(accepted.id)
        ended = await wait_for(client, accepted.id)
        assert ended.state is TaskState.CANCELLED
        await asyncio.sleep(1.5)
        before = client.plane.registry.robots["rover_1"].pose
        await asyncio.sleep(1.0)
        assert client.plane.registry.robots["rover_1"].pose == before


async def test_a_restarted_gateway_adopts_its_containers_and_knows_its_tasks(fleet: FleetState) -> None:
    """SIGTERM drains; a second start has the same containers warm, and no accepted task is forgotten."""
    async with FleetClient(fleet.endpoint) as client:
        accepted = await client.submit(TaskRequest(instruction="Rover_1: go to dock 1"))
        await wait_for(client, accepted.id)
        process = next(each for each in fleet.processes if each.name == "gw-2")
        before = {
            each.id for each in client.plane.registry.containers["gw-2"].values() if each.state is ContainerState.READY
        }
        assert before
        os.kill(process.pid, signal.SIGTERM)
        async with asyncio.timeout(30):
            while local_fleet.alive(process):
                await asyncio.sleep(0.1)
        config = Path(fleet.directory) / "gw-2" / "gateway.toml"
        again = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "appliance.cli", "gateway", "--config", str(config)
        )
        try:
            async with asyncio.timeout(30):
                while True:
                    status = client.plane.registry.gateways.get("gw-2")
                    if status is not None and status.pid == again.pid and status.ready >= len(before):
                        break
                    await asyncio.sleep(0.1)
            after = {each.id for each in client.plane.registry.containers["gw-2"].values()}
            assert before <= after
            assert (await client.task(accepted.id)).state is TaskState.SUCCEEDED
        finally:
            again.terminate()
            await again.wait()


async def test_garbage_on_every_key_is_refused_and_counted(fleet: FleetState) -> None:
    """Malformed and oversize payloads on all keys that gateways listen to leave them working, and are counted."""
    async with FleetClient(fleet.endpoint) as client:
        keys = client.plane.keys
        session = client.plane.session
        for payload in (b"", b"\xff\x00garbage", b"[]", b"{}", b'{"id": 3}', b"x" * (9 << 20)):
            for key in (
                keys(keyspace.STATUS, "gw-1"),
                keys(keyspace.CONTAINER, "gw-1", "c"),
                keys(keyspace.RUN_EVENT, "t-none", "s1"),
                keys(keyspace.ROBOT, "rover_9"),
                keys(keyspace.INTAKE, "rover_1"),
                keys(keyspace.TASK_UPDATE, "t-none"),
                keys(keyspace.TRANSITION, "t-none"),
                keys(keyspace.NOTICE, "operator"),
            ):
                session.put(key, payload)
            for verb in (
                "submit",
                "accept",
                "plan",
                "task",
                "tasks",
                "cancel",
                "run",
                "run_status",
                "run_cancel",
                "artifact",
                "artifact_keep",
                "find_containers",
                "no_such_verb",
            ):
                replies = await asyncio.to_thread(_ask_raw, fleet, keys(keyspace.RPC, "gw-1", verb), payload)
                # An empty object is a good question where every field has a default.
                assert not any(replies) or (verb == "tasks" and payload == b"{}"), f"{verb} took {payload[:20]!r}"
        await asyncio.sleep(3.0)
        status = client.plane.registry.gateways["gw-1"]
        assert sum(status.refused.values()) >= 8, status.refused
        accepted = await client.submit(TaskRequest(instruction="Rover_1: go to dock 1"))
        assert (await wait_for(client, accepted.id)).state is TaskState.SUCCEEDED


def _ask_raw(fleet: FleetState, key: str, payload: bytes) -> list[bool]:
    """Query a key with raw bytes; for each reply whether it was a success."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([fleet.endpoints[0]]))
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)
    try:
        return [reply.ok is not None for reply in session.get(key, payload=payload, timeout=3.0)]
    finally:
        session.close()


async def test_the_command_line_tells_what_is_asked(fleet: FleetState) -> None:
    """Submit --json has every promised field; nonsense, strange robots and tasks end with exit 4 and a reason."""
    done = await asyncio.to_thread(cli, fleet, "submit", "Rover_1: go to dock 1", "--wait", "--json")
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert {"id", "instruction", "state", "tier", "confidence", "subtasks"} <= set(record)
    promised = {"id", "skill", "robot", "params", "after", "gateway", "container", "phase", "startup_ms"}
    assert promised | {"duration_ms", "attempts", "result", "error"} <= set(record["subtasks"][0])
    shown = await asyncio.to_thread(cli, fleet, "task", "show", record["id"], "--json")
    assert json.loads(shown.stdout) == record
    nonsense = await asyncio.to_thread(cli, fleet, "submit", "colourless green ideas", "--wait")
    assert nonsense.returncode == 4, nonsense.stdout + nonsense.stderr
    stranger = await asyncio.to_thread(cli, fleet, "submit", "Rover_9: go to dock 1", "--wait")
    assert stranger.returncode == 4
    assert "rover_9" in stranger.stdout + stranger.stderr
    unknown = await asyncio.to_thread(cli, fleet, "task", "show", "t-none")
    assert unknown.returncode == 4
    assert "hint" in unknown.stderr
    for arguments in (("fleet",), ("pool",), ("robots",), ("task", "list"), ("plan", "Rover_1: go to dock 1")):
        shown = await asyncio.to_thread(cli, fleet, *arguments, "--json")
        assert shown.returncode == 0, shown.stderr
        assert json.loads(shown.stdout)


async def test_a_second_fleet_in_the_same_place_is_refused(tmp_path: Path) -> None:
    """`up` over a running fleet is an error that names the remedy; `down` without a fleet too."""
    async with fleet_in(tmp_path, gateways=1, zenoh=0, pool=PoolConfig(floor={})) as fleet:
        with pytest.raises(ConfigError, match="a fleet runs in"):
            await local_fleet.up(Order(fleet=fleet.fleet, directory=Path(fleet.directory)), progress=print)
        with pytest.raises(NotFoundError, match="no fleet runs"):
            await local_fleet.down(Path(fleet.directory) / "elsewhere", progress=print)
