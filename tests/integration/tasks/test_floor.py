"""Three rovers, one dock, through real gateways: they wait in line with the reason, and never come too near."""

import asyncio
import contextlib
import math
import os
import signal
import time
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from itertools import combinations
from pathlib import Path

import msgspec
import pytest
from fleets import PLAIN, fleet_in
from msgspec.structs import replace
from relays import Relay, router

from appliance import config as configuration
from appliance.client import Endpoint, FleetClient
from appliance.connection import FleetState
from appliance.floor.decisions import WayCase
from appliance.model import Plan, RobotInfo, Subtask, TaskRequest, TaskState, keyspace
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import remove_fleet
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from appliance.record.reader import read
from appliance.tasks.replay import check
from appliance.tasks.settings import MigrationConfig, TasksConfig
from tests.integration.tasks.test_partition import LEASE_MS, process, until_seen

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
RADIUS_M = 0.4
"""Of a rover that says nothing of its size."""
DRONE_M = 0.5
LONG_S = 90.0


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """Three gateways and three rovers, four times as fast as real ones."""
    pool = PoolConfig(floor={"base": 3})
    async with fleet_in(tmp_path, gateways=3, zenoh=3, sim_rate=4.0, pool=pool, base=PLAIN) as state:
        yield state


class Distances:
    """The least distance that two rovers were ever seen at."""

    def __init__(self, client: FleetClient) -> None:
        self.at: dict[str, tuple[float, float]] = {}
        self.least = math.inf
        session = client.plane.session
        self.close = session.subscribe_typed(keyspace.ROBOT, self._heard).close

    def _heard(self, _key: str, info: RobotInfo | None) -> None:
        if info is None or info.pose is None:
            return
        self.at[info.id] = (info.pose.x, info.pose.y)
        for one, other in combinations(self.at.values(), 2):
            self.least = min(self.least, math.dist(one, other))


async def until_ended(client: FleetClient, *tasks: str) -> dict[str, TaskState]:
    """Wait until tasks have ended."""
    async with asyncio.timeout(LONG_S):
        while True:
            states = {each: (await client.task(each)).state for each in tasks}
            if all(state.final for state in states.values()):
                return states
            await asyncio.sleep(0.2)


async def notes(client: FleetClient, task: str) -> str:
    """Return what a task's subtasks wait for."""
    return "; ".join(each.note for each in (await client.task(task)).subtasks)


async def test_three_rovers_and_one_dock(fleet: FleetState) -> None:
    """One gets the dock, the others say for whom they wait, and go one by one when it is left.

    The log gives the same ways, waits and grants again.
    """
    async with FleetClient(fleet.endpoint, operator="ann") as client:
        seen = Distances(client)
        names = ("rover_1", "rover_2", "rover_3")
        for robot in names:
            await client.submit(TaskRequest(instruction=f"{robot}: go to dock 1", id=f"t-{robot}"))
        left = set(names)
        for _ in names:
            async with asyncio.timeout(LONG_S):
                while not (there := {each for each in left if (await client.task(f"t-{each}")).state.final}):
                    await asyncio.sleep(0.2)
            (first,) = there
            left -= there
            assert (await client.task(f"t-{first}")).state is TaskState.SUCCEEDED
            assert math.dist(seen.at[first], (36.0, 6.0)) < 0.5
            for other in left:
                async with asyncio.timeout(LONG_S):
                    while f"waits for {first} to leave dock 1" not in await notes(client, f"t-{other}"):
                        await asyncio.sleep(0.2)
                assert "leave dock 1" in (await client.why(f"t-{other}")).waits
            await client.submit(TaskRequest(instruction=f"{first}: go to the gate", id=f"away-{first}"))
            assert await until_ended(client, f"away-{first}") == {f"away-{first}": TaskState.SUCCEEDED}
        assert seen.least >= 2 * RADIUS_M
        seen.close()
    report = check(sorted(Path(fleet.record_dir).glob("*.mcap")))
    assert report.same, report.divergences
    assert min(report.checked["way"], report.checked["grant"]) > len(names)


async def test_a_cancelled_task_gives_its_place_up(fleet: FleetState) -> None:
    """A rover that is called back on its way leaves the dock to the next one, and keeps the ground it stands on."""
    async with FleetClient(fleet.endpoint, operator="ann") as client:
        seen = Distances(client)
        async with asyncio.timeout(LONG_S):
            while "rover_1" not in seen.at:
                await asyncio.sleep(0.1)
            start = seen.at["rover_1"]
            await client.submit(TaskRequest(instruction="rover_1: go to dock 1", id="t-1"))
            while (
                math.dist(seen.at["rover_1"], start) < 0.3
            ):  # it has the dock: who comes first is not what this is about
                await asyncio.sleep(0.05)
            await client.submit(TaskRequest(instruction="rover_2: go to dock 1", id="t-2"))
            while "dock 1" not in await notes(client, "t-2"):
                await asyncio.sleep(0.05)
        await client.cancel("t-1")
        assert await until_ended(client, "t-2") == {"t-2": TaskState.SUCCEEDED}
        assert math.dist(seen.at["rover_2"], (36.0, 6.0)) < 0.5
        assert seen.least >= 2 * RADIUS_M
        seen.close()


@pytest.mark.long
async def test_a_gateway_dies_meanwhile(fleet: FleetState) -> None:
    """Gateways that die while rovers move and wait let no two come too near, and no task is lost."""
    names = ("rover_1", "rover_2", "rover_3")
    endpoint = fleet.endpoint
    async with FleetClient(endpoint, operator="ann") as client:
        seen = Distances(client)
        for robot in names:
            await client.submit(TaskRequest(instruction=f"{robot}: go to dock 1, then go to the gate", id=f"t-{robot}"))
        await asyncio.sleep(4.0)
        victim = next(each for each in fleet.processes if each.name == fleet.gateways[-1])
        os.kill(victim.pid, signal.SIGKILL)
        began = time.monotonic()
        states = await until_ended(client, *(f"t-{each}" for each in names))
        assert set(states.values()) == {TaskState.SUCCEEDED}, states
        assert seen.least >= 2 * RADIUS_M, time.monotonic() - began
        seen.close()


@pytest.mark.long
async def test_a_rover_follows_another_past_a_third(tmp_path: Path) -> None:
    """It keeps up, never comes too near to either, and its time is over when it was asked to be."""
    async with fleet_in(tmp_path, gateways=3, zenoh=3, pool=PoolConfig(floor={"base": 2}), base=PLAIN) as state:
        async with FleetClient(state.endpoint, operator="ann") as client:
            seen = Distances(client)
            follow = Subtask(id="s1", skill="follow", robot="rover_2", params={"target": "rover_1", "duration_s": 12.0})
            lead = Subtask(
                id="s1", skill="goto", robot="rover_1", params={"place": "inspection point", "speed_mps": 1.0}
            )
            for name, subtask in (("t-lead", lead), ("t-follow", follow)):
                while "rover_1" not in seen.at:
                    await asyncio.sleep(0.05)
                start = seen.at["rover_1"]
                plan = Plan(domain="navigation", subtasks=(subtask,))
                await client.submit(TaskRequest(instruction="try", id=name, plan=plan))
                while name == "t-lead" and math.dist(seen.at["rover_1"], start) < 0.3:
                    await asyncio.sleep(0.05)  # else the follower may reserve the ground before it first
            states = await until_ended(client, "t-lead", "t-follow")
            assert set(states.values()) == {TaskState.SUCCEEDED}, states
            assert seen.least >= 2 * RADIUS_M
            assert 2 * RADIUS_M < math.dist(seen.at["rover_1"], seen.at["rover_2"]) < 5.0
            seen.close()
        report = check(sorted(Path(state.record_dir).glob("*.mcap")))
        assert report.same, report.divergences


@pytest.mark.long
async def test_two_drones_cross(tmp_path: Path) -> None:
    """Who comes second flies up to the other's way, hovers, and goes on when it has passed: by stretches."""
    pool = PoolConfig(floor={"base": 2})

    async def fly(client: FleetClient, **goals: str) -> None:
        for drone, goal in goals.items():
            goto = Subtask(id="s1", skill="goto", robot=drone, params={"place": goal, "speed_mps": 4.0})
            plan = Plan(domain="navigation", subtasks=(goto,))
            await client.submit(TaskRequest(instruction="try", id=f"t-{drone}-{goal[1]}", plan=plan))
        states = await until_ended(client, *(f"t-{drone}-{goal[1]}" for drone, goal in goals.items()))
        assert set(states.values()) == {TaskState.SUCCEEDED}, states

    async with fleet_in(tmp_path, gateways=3, zenoh=0, mavlink=2, pool=pool, base=PLAIN) as state:
        async with FleetClient(state.endpoint, operator="ann") as client:
            seen = Distances(client)
            await fly(client, drone_1="(6, 25, 8)", drone_2="(36, 27, 8)")
            seen.least = math.inf
            await fly(client, drone_1="(37, 13, 8)", drone_2="(5, 13, 8)")
            assert seen.least >= 2 * DRONE_M
            seen.close()
        logs = sorted(Path(state.record_dir).glob("*.mcap"))
        report = check(logs)
        assert report.same, report.divergences
        decided = [each for log in logs for each in read(log) if each.key.endswith("/decided/way")]
        cases = [msgspec.json.decode(each.payload, type=WayCase) for each in decided]
        assert any(case.trip.flies and case.wants for case in cases)


@asynccontextmanager
async def cut_in_two(folder: Path) -> AsyncGenerator[tuple[Relay, FleetClient, FleetClient]]:
    """Two gateways and two rovers at one router, one of each at another, all gateways granting; a client at each."""
    fleet = f"f{os.getpid()}-{time.monotonic_ns() % 100000}"
    one, other, between = free_port(), free_port(), free_port()
    relay = Relay(between, one)
    ends = [f"tcp/127.0.0.1:{port}" for port in (one, other)]
    names = ("gw-1", "gw-2", "gw-3")
    async with contextlib.AsyncExitStack() as stack:
        stack.push_async_callback(partial(remove_fleet, fleet, volumes=True))
        await relay.mend()
        stack.push_async_callback(relay.cut)
        await stack.enter_async_context(router(ends[0], lease_ms=LEASE_MS))
        await stack.enter_async_context(router(ends[1], f"tcp/127.0.0.1:{between}", lease_ms=LEASE_MS))
        for number, name in enumerate(names):
            plane = PlaneConfig(mode="client", connect=(ends[number // 2],), lease_ms=LEASE_MS, voters=names)
            config = replace(
                PLAIN, id=name, fleet=fleet, data_dir=str(folder / name), drain_s=1.0, keep_containers=False,
                plane=plane, pool=PoolConfig(floor={"base": 2}),
                tasks=TasksConfig(migration=MigrationConfig(cpu_high=0.0)),
            )  # fmt: skip
            path = folder / f"{name}.toml"
            path.write_text(configuration.dump(config))
            await stack.enter_async_context(process(folder, name, "gateway", "--config", str(path)))
        for number in range(3):
            where = ("--fleet", fleet, "--connect", ends[number // 2])
            rover = ("--name", f"rover_{number + 1}", "--spot", str(number), "--rate", "4")
            await stack.enter_async_context(process(folder, f"rover_{number + 1}", "sim", "zenoh", *rover, *where))
        clients = [await stack.enter_async_context(FleetClient(Endpoint(fleet=fleet, connect=(end,)))) for end in ends]
        for client in clients:
            await until_seen(client, set(names), ready=1)
            async with asyncio.timeout(LONG_S):
                while len(client.plane.registry.robots) < 3:
                    await asyncio.sleep(0.1)
        yield relay, clients[0], clients[1]


@pytest.mark.long
@pytest.mark.timeout(600)
async def test_a_partition_of_thirty_seconds(tmp_path: Path) -> None:
    """The side without a majority moves nothing, the other goes on; afterwards the dock is waited for and reached."""
    async with cut_in_two(tmp_path) as (relay, here, there):
        seen = Distances(here)
        also = Distances(there)
        also.at = seen.at  # what either side sees
        await here.submit(TaskRequest(instruction="rover_1: go to dock 1", id="t-1"))
        await asyncio.sleep(1.0)
        await relay.cut()
        began = time.monotonic()
        await until_seen(there, {"gw-3"})
        await there.submit(TaskRequest(instruction="rover_3: go to dock 1", id="t-3"))
        assert await until_ended(here, "t-1") == {"t-1": TaskState.SUCCEEDED}
        await here.submit(TaskRequest(instruction="rover_2: go to dock 2", id="t-2"))
        assert await until_ended(here, "t-2") == {"t-2": TaskState.SUCCEEDED}
        async with asyncio.timeout(LONG_S):
            while "waits for the gateways that grant ways" not in await notes(there, "t-3"):
                await asyncio.sleep(0.2)
        stood = seen.at["rover_3"]
        await asyncio.sleep(max(0.0, 30.0 - (time.monotonic() - began)))
        assert math.dist(seen.at["rover_3"], stood) < 0.01
        await relay.mend()
        async with asyncio.timeout(LONG_S):
            while "waits for rover_1 to leave dock 1" not in await notes(there, "t-3"):
                await asyncio.sleep(0.2)
        await here.submit(TaskRequest(instruction="rover_1: go to the gate", id="t-away"))
        assert await until_ended(here, "t-away", "t-3") == {"t-away": TaskState.SUCCEEDED, "t-3": TaskState.SUCCEEDED}
        assert min(seen.least, also.least) >= 2 * RADIUS_M
        assert math.dist(seen.at["rover_3"], (36.0, 6.0)) < 0.5
