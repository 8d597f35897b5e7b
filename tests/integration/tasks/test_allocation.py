"""Which of several robots a task gets, with real gateways and simulated rovers: charge counts before nearness."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from fleets import PLAIN, fleet_in
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.errors import RefusedError
from appliance.llm.settings import SafetyConfig
from appliance.model import RobotWork, TaskRequest, TaskState
from appliance.model.gateways import queues
from appliance.pool.settings import PoolConfig
from appliance.tasks.settings import BatteryConfig, TasksConfig
from tests.integration.tasks.test_floor import RADIUS_M, Distances, until_ended
from tests.integration.tasks.test_partition import process

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
LONG_S = 90.0
BATTERY = BatteryConfig(auto_charge=True, reserve_percent=20.0, charged_percent=40.0)


@asynccontextmanager
async def rovers(
    folder: Path, *, rate: int, battery: BatteryConfig, **of: tuple[str, int]
) -> AsyncGenerator[FleetClient]:
    """Two gateways that choose robots by themselves; `of`: where each rover stands at first, and its charge."""
    base = replace(PLAIN, safety=SafetyConfig(choose_robot="auto"), tasks=TasksConfig(battery=battery))
    async with contextlib.AsyncExitStack() as stack:
        fleet = await stack.enter_async_context(
            fleet_in(folder, gateways=2, zenoh=0, pool=PoolConfig(floor={"base": 2}), base=base)
        )
        for name, (start, percent) in of.items():
            where = ("--fleet", fleet.fleet, "--connect", fleet.endpoints[0])
            rover = ("--name", name, "--start", start, "--battery", str(percent), "--rate", str(rate))
            await stack.enter_async_context(process(folder, name, "sim", "zenoh", *rover, *where))
        client = await stack.enter_async_context(FleetClient(fleet.endpoint, operator="ann"))
        async with asyncio.timeout(LONG_S):
            while set(client.plane.registry.robots) != set(of):
                await asyncio.sleep(0.1)
        yield client


@pytest.fixture
async def client(tmp_path: Path) -> AsyncIterator[FleetClient]:
    """One rover with little charge near dock 1, the other far away."""
    where = {"rover_1": ("dock 2", 15), "rover_2": ("charger", 90)}
    async with rovers(tmp_path, rate=4, battery=BatteryConfig(), **where) as client:
        yield client


async def test_the_nearer_robot_with_low_charge_is_not_taken(client: FleetClient) -> None:
    """`task why` says what it would end with; a plan that names it waits for approval with that reason."""
    low = "rover_1 would end with 14"
    await client.submit(TaskRequest(instruction="go to dock 1", id="t-any"))
    told = False
    async with asyncio.timeout(LONG_S):
        while not (record := await client.task("t-any")).state.final:
            told |= any(
                each.task == "t-any" and each.robot == "rover_2"
                for status in client.plane.registry.gateways.values()
                for each in status.work
            )
            await asyncio.sleep(0.05)
    assert record.state is TaskState.SUCCEEDED, record
    assert [each.bound_robot for each in record.subtasks] == ["rover_2"]
    assert told, "no gateway tells the fleet what its task has for rover_2"
    (why,) = (await client.why("t-any")).subtasks
    assert "took rover_2" in why.attempts[0].placed
    assert low in why.attempts[0].placed
    assert "below the reserve of 20 %" in why.attempts[0].placed

    await client.submit(TaskRequest(instruction="rover_1: go to dock 3", id="t-named"))
    async with asyncio.timeout(LONG_S):
        while (proposal := (await client.task("t-named")).proposal) is None:
            await asyncio.sleep(0.1)
    assert proposal.waits
    assert low in proposal.note
    await client.cancel("t-named")


async def test_tasks_of_one_robot_go_one_after_another_and_are_put_in_another_order(tmp_path: Path) -> None:
    """A task that has begun goes on to its end; the others wait and say for whom; one is put before another."""
    async with rovers(tmp_path, rate=4, battery=BatteryConfig(), rover_1=("dock 2", 90)) as client:
        orders = {"t-1": "go to dock 1, then go to dock 4", "t-2": "go to dock 2", "t-3": "go to dock 3"}
        for task, words in orders.items():
            await client.submit(TaskRequest(instruction=f"rover_1: {words}", id=task))
            async with asyncio.timeout(LONG_S):
                while task not in {each.task for each in queue_of(client)}:
                    await asyncio.sleep(0.05)
        async with asyncio.timeout(LONG_S):
            while [each.task for each in queue_of(client)] != ["t-1", "t-2", "t-3"]:
                await asyncio.sleep(0.05)
        why = await client.why("t-3")
        assert "waits for rover_1: task t-1 goes first" in why.subtasks[0].note
        await client.first("t-3", before="t-2", why="it is urgent")
        async with asyncio.timeout(LONG_S):
            while [each.task for each in queue_of(client)] != ["t-1", "t-3", "t-2"]:
                await asyncio.sleep(0.05)
        with pytest.raises(RefusedError, match="does not wait for a robot"):
            await client.first("t-3", before="t-none")
        await until_ended(client, "t-1", "t-2", "t-3")
        records = [await client.task(each) for each in ("t-1", "t-3", "t-2")]
        assert {each.state for each in records} == {TaskState.SUCCEEDED}
        ends = [each.updated_ns for each in records]
        assert ends == sorted(ends)
        async with asyncio.timeout(LONG_S):
            while queue_of(client):
                await asyncio.sleep(0.05)


def queue_of(client: FleetClient) -> list[RobotWork]:
    """Return what tasks have for robots, in order."""
    return queues(client.plane.registry.gateways.values())


async def test_robots_charge_by_themselves_one_after_the_other(tmp_path: Path) -> None:
    """The first makes room when it has charged enough and the other waits: by tasks that everybody sees."""
    places = {"rover_1": ("dock 2", 16), "rover_2": ("dock 4", 12)}
    async with rovers(tmp_path, rate=20, battery=BATTERY, **places) as client:
        seen, robots = Distances(client), client.plane.registry.robots
        async with asyncio.timeout(LONG_S):
            while not all((robots[each].battery_percent or 0.0) > BATTERY.reserve_percent for each in places):
                await asyncio.sleep(0.2)
        tasks = sorted((await client.tasks(50)).tasks, key=lambda each: each.created_ns)
        by_itself = [each.id.rsplit("-", 1)[0] for each in tasks if each.submitter == "swiftbot"]
        first = by_itself[0].removeprefix("charge-")
        (other,) = places.keys() - {first}
        assert by_itself[:3] == [f"charge-{first}", f"leave-{first}", f"charge-{other}"]
        assert seen.least >= 2 * RADIUS_M
        seen.close()
