"""Two simulated rovers of a real fleet act together: both move, a stop of one stops both, the loss of one the other."""

import asyncio
import math
from collections.abc import Callable
from pathlib import Path

import pytest
from fleets import PLAIN, fleet_in, kill

from appliance.client import FleetClient
from appliance.model import Plan, RobotInfo, Subtask, SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.long]
BOTH = ("rover_1", "rover_2")


def meet(place: str) -> TaskRequest:
    """Return the order to meet at a place."""
    step = Subtask(id="s1", skill="rendezvous", robot="rover_1", params={"robots": [*BOTH], "place": place})
    plan = Plan(domain="coordination", subtasks=(step,))
    return TaskRequest(instruction=f"rover_1 and rover_2 meet at {place}", plan=plan)


async def until(holds: Callable[[], bool]) -> None:
    """Wait until what is known of the fleet is so."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.1)


async def end(client: FleetClient, task: str, holds: Callable[[TaskRecord], bool]) -> TaskRecord:
    """Wait until a task's record is so."""
    async with asyncio.timeout(120):
        while not holds(record := await client.task(task)):
            await asyncio.sleep(0.2)
    return record


async def test_two_robots_act_together_or_not_at_all(tmp_path: Path) -> None:
    """Both set off, both stand after a stop of one, both arrive; when one is lost the other stands."""
    pool = PoolConfig(floor={"base": 1})
    async with (
        fleet_in(tmp_path, gateways=2, zenoh=2, sim_rate=1.0, pool=pool, base=PLAIN) as fleet,
        FleetClient(fleet.endpoint, operator="ann") as ann,
    ):

        def robot(name: str) -> RobotInfo:
            return ann.plane.registry.robots[name]

        def at(name: str) -> tuple[float, float]:
            pose = robot(name).pose
            return (pose.x, pose.y) if pose is not None else (math.nan, math.nan)

        async def both_set_off() -> None:
            before = {name: at(name) for name in BOTH}
            await until(lambda: all(math.dist(at(name), before[name]) > 1.0 for name in BOTH))

        async def stands(name: str) -> None:
            async with asyncio.timeout(20):
                before = (math.nan, math.nan)
                while at(name) != before:
                    before = at(name)
                    await asyncio.sleep(1.0)

        await until(lambda: all(name in ann.plane.registry.robots and robot(name).pose for name in BOTH))
        task = await ann.submit(meet("dock 3"))
        await both_set_off()
        await ann.stop(["rover_2"], why="a person")
        for name in BOTH:
            await stands(name)
        record = await end(ann, task.id, lambda record: record.of("s1").state is SubtaskState.READY)
        assert record.paused == "rover_2 stopped by ann: a person"
        assert record.of("s1").robots == BOTH
        await ann.resume_robots(why="gone")
        record = await end(ann, task.id, lambda record: record.state.final)
        assert record.state is TaskState.SUCCEEDED, record.failure
        assert set((record.of("s1").result or {})["robots"]) == {*BOTH}
        assert 1.0 < math.dist(at("rover_1"), at("rover_2")) < 4.0

        before = {name: at(name) for name in BOTH}
        task = await ann.submit(meet("home"))
        # The shared floor may have one of them wait for the other to pass.
        await until(lambda: any(math.dist(at(name), before[name]) > 1.0 for name in BOTH))
        moves = next(name for name in BOTH if math.dist(at(name), before[name]) > 1.0)
        lost = next(name for name in BOTH if name != moves)
        kill(fleet, lost)
        await until(lambda: not robot(lost).online)
        await stands(moves)
        assert math.dist(at(moves), (4.0, 4.0)) > 5.0, "it has stopped on its way, and does not go on alone"
        record = await end(ann, task.id, lambda record: any(each.failure for each in record.of("s1").attempts))
        failure = record.of("s1").attempts[0].failure
        assert failure is not None
        assert lost in failure.message
        assert failure.message.endswith(f"; {moves} holds")
        await ann.cancel(task.id)
