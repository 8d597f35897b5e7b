"""Skills that map, measure and work with tools, in real containers on a real fleet with a simulated rover."""

import asyncio
from pathlib import Path

import pytest
from fleets import PLAIN, fleet_in

from appliance.client import FleetClient
from appliance.model import Plan, Subtask, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.long]


def step(identity: str, skill: str, *after: str, robot: str | None = "rover_1", **params: object) -> Subtask:
    """Return a subtask of the rover."""
    return Subtask(id=identity, skill=skill, robot=robot, params=params, after=after)


PLAN = Plan(
    domain="inspection",
    subtasks=(
        step("split", "split_area", robot=None, area="dock 1", robots=["rover_1", "rover_2"]),
        step("where", "localize", window_ms=200),
        step("map", "map_area", "where", area="charger"),
        step("again", "map_area", "map", area="charger"),
        step("merge", "merge_maps", "map", "again", robot=None),
        step("there", "goto", "again", place="dock 1"),
        step("look", "inspect", "there", asset="blue box"),
        step("far", "measure", "look", quantity="distance", target="blue box"),
        step("warm", "scan_thermal", "look", asset="blue box"),
        step("hear", "record_audio", "there", duration_s=1),
        step("note", "compare", "far", robot=None, baseline="distance to the box"),
        step("wipe", "clean", "look", object="blue box"),
        step("shove", "push", "wipe", object="blue box"),
    ),
)


async def test_a_survey_and_an_inspection_run_in_containers(tmp_path: Path) -> None:
    """Twelve skills: maps are merged, sensors are read, files are kept, a box is cleaned and pushed."""
    async with (
        fleet_in(
            tmp_path, gateways=2, zenoh=2, sim_rate=10.0, pool=PoolConfig(floor={"base": 1, "vision": 2}), base=PLAIN
        ) as fleet,
        FleetClient(fleet.endpoint) as client,
    ):
        task = await client.submit(TaskRequest(instruction="survey the charger, inspect the blue box", plan=PLAN))
        async with asyncio.timeout(150):
            while not (record := await client.task(task.id)).state.final:
                await asyncio.sleep(0.3)
    assert record.state is TaskState.SUCCEEDED, record.failure
    results = {each.subtask.id: each.result or {} for each in record.subtasks}
    assert [each["robot"] for each in results["split"]["zones"]] == ["rover_1", "rover_2"]
    assert results["where"]["spread_m"] < 1.0
    assert results["merge"]["merged"] == 2
    assert results["merge"]["map"]["known_share"] >= results["map"]["map"]["known_share"] > 0.9
    assert results["look"]["judged"]
    assert 0.5 < results["far"]["number"] < 2.0
    assert results["warm"]["highest_c"] < 30.0
    assert (results["hear"]["silent"], results["hear"]["duration_s"]) == (True, 1.0)
    assert [each["kind"] for each in results["note"]["findings"]] == ["baseline"] * 2  # the picture before it, too
    assert results["wipe"]["condition"] == "clean"
    assert results["shove"]["pushed_m"] == 1.0
