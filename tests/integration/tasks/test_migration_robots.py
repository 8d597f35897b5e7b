"""Skills of the catalogue that command robots, moved in the middle of their work: nothing is filmed or driven twice."""

import asyncio
from collections import Counter
from contextlib import aclosing
from pathlib import Path

import msgspec
import pytest
from moving_bench import ended, fleet_of, pretty, until_running

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import RefusedError
from appliance.model import Plan, RobotCommand, Subtask, SubtaskRecord, SubtaskState, TaskRequest, TaskState
from appliance.model.task_api import MigrateAsk
from appliance.pool.settings import PoolConfig
from appliance.record.reader import read
from appliance.tasks.replay import replay
from appliance.tasks.settings import MigrationConfig

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

PIECES = 6
"""Of ten seconds each: `record_video` films them one after the other, and each is a robot command."""
LAPS = 12


async def move(client: FleetClient, task: str) -> str:
    """Move a task's first subtask between two of its commands; returns what it went on from."""
    async with asyncio.timeout(120):
        while True:
            try:
                moved = await client.migrate(MigrateAsk(task=task, subtask="s1"))
            except RefusedError as error:
                if "robot command" not in error.message:
                    raise
                await asyncio.sleep(0.1)
                continue
            if moved.started:
                return moved.checkpoint


async def until_done(client: FleetClient, task: str, share: float) -> None:
    """Wait until a run has told that a part of its work is done."""
    # Progress is pushed and not written: only the task's coordinator knows it.
    async with asyncio.timeout(120), aclosing(client.watch(task, silence_s=0.3)) as records:
        async for record in records:
            # A record that was accepted has no subtasks until its plan is made.
            found = record.of("s1") if record.subtasks else None
            if found is not None and found.state is SubtaskState.RUNNING and found.progress >= share:
                return
    raise AssertionError(f"{task} ended before that")


def done_of(log: Path, *verbs: str) -> Counter[tuple[str, str]]:
    """How often robots did each command of those verbs, by task and the command's id."""
    return Counter(
        (command.task, command.id)
        for message in read(log)
        if message.key.endswith("/commanded")
        and (command := msgspec.json.decode(message.payload, type=RobotCommand)).verb in verbs
    )


def log_of(state: FleetState) -> Path:
    """The fleet's log."""
    return max(Path(state.record_dir).glob("*.mcap"), key=lambda each: each.stat().st_size)


@pytest.mark.long
async def test_a_film_and_a_patrol_go_on_at_another_gateway(tmp_path: Path) -> None:
    """Both are moved at the same time, by hand: from their checkpoints, with no retry, and each command done once.

    The film has every piece: pictures taken from it, one a second, are as many as the seconds that were asked for.
    """
    film = Plan(
        domain="perception",
        subtasks=(
            Subtask(
                id="s1", skill="record_video", robot="rover_1",
                params={"target": "aisle", "duration_s": 10.0 * PIECES},
            ),
            Subtask(id="s2", skill="extract_frames", params={"fps": 0.5}, after=("s1",)),
        ),
    )  # fmt: skip
    patrol = Plan(
        domain="navigation",
        subtasks=(Subtask(id="s1", skill="patrol", robot="rover_2", params={"area": "maintenance pit", "laps": LAPS}),),
    )
    # Most of what a hold may take is for the checkpoint: ten seconds of film are encoded before it.
    config = MigrationConfig(command_wait_s=0.8, checkpoint_wait_s=5.0)
    pool = PoolConfig(floor={"base": 1, "vision": 1})
    async with (
        fleet_of(tmp_path, rovers=2, sim_rate=4.0, pool=pool, migration=config) as state,
        FleetClient(state.endpoint) as client,
    ):
        await client.submit(TaskRequest(instruction="film the aisle", id="t-film", plan=film))
        await client.submit(TaskRequest(instruction="patrol the pit", id="t-patrol", plan=patrol))
        befores = [await until_running(client, task) for task in ("t-film", "t-patrol")]
        # A piece or a lap is done by then, so that there is something to carry over.
        await asyncio.gather(until_done(client, "t-film", 0.14), until_done(client, "t-patrol", 0.07))
        went_on = await asyncio.gather(move(client, "t-film"), move(client, "t-patrol"))
        assert went_on[0] == "fresh", went_on
        assert went_on[1] in ("fresh", "last"), went_on
        records = [await ended(client, task) for task in ("t-film", "t-patrol")]
        for record, before in zip(records, befores, strict=True):
            assert record.state is TaskState.SUCCEEDED, record.failure
            found = record.of("s1")
            assert found.attempts[0].left.startswith(f"moved from {before.gateway}"), pretty(found)
            assert found.gateway != before.gateway
            assert (found.attempt, any(each.failure for each in found.attempts)) == (2, False), pretty(found)
        filmed, frames = (records[0].of(name).result or {} for name in ("s1", "s2"))
        assert filmed["frames_recorded"] == PIECES * 50, filmed
        assert abs(frames["count"] - PIECES * 5) <= 1, frames
        walked = records[1].of("s1").result or {}
        assert walked["laps"] == LAPS, walked
    log = log_of(state)
    done = done_of(log, "record", "goto")
    assert set(done.values()) == {1}, done
    assert Counter(task for task, _ in done) == {"t-film": PIECES, "t-patrol": LAPS}, done
    report = replay(log)
    assert report.same, [each.differences for each in report.tasks]


async def until_told(client: FleetClient, task: str) -> SubtaskRecord:
    """Wait until the record has a partial result of a task's first subtask, which runs."""
    async with asyncio.timeout(120), aclosing(client.watch(task, silence_s=0.3)) as records:
        async for record in records:
            # A record that was accepted has no subtasks until its plan is made.
            found = record.of("s1") if record.subtasks else None
            if found is not None and found.state is SubtaskState.RUNNING and found.partial is not None:
                return found
    raise AssertionError(f"{task} ended before that")


@pytest.mark.long
async def test_a_search_goes_on_at_another_gateway_with_what_it_has_seen(tmp_path: Path) -> None:
    """Moved when its first view has shown nothing: the record keeps that, and no view is taken a second time.

    From (10, 16) and from the point to the north a rack hides the pallet; to the east one cannot stand; from the point
    to the south it is seen.
    """
    search = Plan(
        domain="perception",
        subtasks=(
            Subtask(id="s1", skill="find", robot="rover_1", params={"target": "yellow pallet", "area": "10, 16"}),
        ),
    )
    # At half the real speed there are seconds between two views.
    pool = PoolConfig(floor={"base": 1, "vision": 1})
    async with (
        fleet_of(tmp_path, rovers=1, sim_rate=0.5, pool=pool) as state,
        FleetClient(state.endpoint) as client,
    ):
        await client.submit(TaskRequest(instruction="find the yellow pallet", id="t-find", plan=search))
        before = await until_told(client, "t-find")
        told = before.partial or {}
        assert (told["found"], told["views"]) == (False, len(told["looked_from"])), pretty(before)
        assert await move(client, "t-find") in ("fresh", "last")
        now = await until_running(client, "t-find", attempt=2)
        kept = now.partial or {}
        assert now.gateway != before.gateway
        assert kept["looked_from"][: told["views"]] == told["looked_from"], pretty(now)
        record = await ended(client, "t-find")
        assert record.state is TaskState.SUCCEEDED, record.failure
        found = record.of("s1")
        assert (found.attempt, any(each.failure for each in found.attempts)) == (2, False), pretty(found)
        result = found.result or {}
        assert (result["found"], result["count"], result["views"], found.partial) == (True, 1, 3, None), result
        assert result["looked_from"][: kept["views"]] == kept["looked_from"], result
        assert [round(each["y"] - result["looked_from"][0]["y"], 1) for each in result["looked_from"]] == [0, 1.5, -1.5]
    log = log_of(state)
    for verb in ("capture", "goto"):
        done = done_of(log, verb)
        assert (set(done.values()), len(done)) == ({1}, 3), done
    report = replay(log)
    assert report.same, [each.differences for each in report.tasks]
