# ruff: noqa: ARG002 - fakes take what the real ones take
"""A run that leaves: held at a safe point, saved, let go on again, ended."""

import asyncio
import time
from typing import Any, cast

import pytest

from appliance.errors import NotFoundError, RefusedError
from appliance.model import Need, RunRequest
from appliance.model.task_api import HoldAsk, RunAsk, RunStatus
from appliance.pool.pool import Call
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.handoff import Here, Holds, Source
from appliance.tasks.settings import MigrationConfig

pytestmark = pytest.mark.anyio

REQUEST = RunRequest(task="t-1", subtask="s1", attempt=1, skill="work", need=Need(image="base"))
HOLD = HoldAsk(task="t-1", subtask="s1", attempt=1)
RUN = RunAsk(task="t-1", subtask="s1", attempt=1)


class Runs:
    """An executor with one run, which saves when it is asked to."""

    def __init__(self, *, began: bool = True) -> None:
        self.runs = {RUN.run_id: Here(REQUEST, time.monotonic(), began)}
        self.asked: list[str] = []
        self.fresh = True

    def here(self) -> dict[str, Here]:
        """The run."""
        return self.runs

    async def save(self, ask: RunAsk, *, wait_s: float, may_save: bool) -> bool:
        """Save."""
        self.asked.append(f"save {may_save}")
        return self.fresh

    def saved(self, ask: RunAsk) -> bool:
        """Whether it has."""
        return self.fresh

    async def end(self, ask: RunAsk, *, wait_s: float) -> RunStatus:
        """End it."""
        self.runs.clear()
        return await self.status(ask)

    async def status(self, ask: RunAsk) -> RunStatus:
        """Whether it runs."""
        return RunStatus(running=ask.run_id in self.runs)


def manifest(**fields: Any) -> SkillManifest:
    """The skill's manifest."""
    return SkillManifest(
        **{"id": "work", "domain": "any", "summary": "works", "runs": "compute", "image": "base", **fields}
    )


def source(runs: Runs, skill: SkillManifest | None = None, **settings: Any) -> tuple[Source, Holds]:
    """What gives runs of a gateway away, and what their handlers' calls go through."""
    config = MigrationConfig(**{"command_wait_s": 0.05, "hold_s": 5.0} | settings)
    holds = Holds()
    made = Source("gw-1", cast("Any", runs), holds=holds, skills={"work": skill or manifest()}, config=config)
    return made, holds


class Robot:
    """Counts commands; each waits until it is let through."""

    def __init__(self) -> None:
        self.done = 0
        self.gate = asyncio.Event()

    async def __call__(self, call: Call) -> dict[str, Any]:
        """Do it."""
        await self.gate.wait()
        self.done += 1
        return {}


COMMAND = Call(run=REQUEST, number=1, name="command", args={})


async def test_a_held_run_saves_and_sends_no_commands_until_it_goes_on() -> None:
    """Files and questions go on; a command waits for the end of the hold."""
    runs, robot = Runs(), Robot()
    robot.gate.set()
    it, holds = source(runs, manifest(checkpoints=True))
    held = await it.hold(HOLD)
    assert (held.began, held.fresh, held.saved) == (True, True, True)
    assert runs.asked == ["save True"]
    command = asyncio.create_task(holds.guard(COMMAND, robot))
    await holds.guard(Call(run=REQUEST, number=2, name="get_artifact", args={}), robot)
    await asyncio.sleep(0.01)
    assert robot.done == 1
    assert (await it.resume(RUN)).running
    await command
    assert robot.done == 2


async def test_a_hold_ends_by_itself() -> None:
    """A coordinator that dies costs the run the hold's time and nothing else."""
    runs, robot = Runs(), Robot()
    robot.gate.set()
    it, holds = source(runs, hold_s=0.05)
    await it.hold(HOLD)
    await holds.guard(COMMAND, robot)
    assert robot.done == 1


async def test_a_run_that_moves_between_commands_is_held_after_the_one_it_is_in() -> None:
    """Or refused, if that takes too long, and then it goes on as before."""
    runs, robot = Runs(), Robot()
    skill = manifest(runs="robot", verbs=("goto",), migratable="between commands")
    it, holds = source(runs, skill)
    command = asyncio.create_task(holds.guard(COMMAND, robot))
    await asyncio.sleep(0)
    with pytest.raises(RefusedError, match="in a robot command"):
        await it.hold(HOLD)
    another = asyncio.create_task(holds.guard(COMMAND, robot))
    robot.gate.set()
    await asyncio.gather(command, another)
    robot.gate.clear()
    command = asyncio.create_task(holds.guard(COMMAND, robot))
    await asyncio.sleep(0)
    holding = asyncio.create_task(it.hold(HOLD))
    await asyncio.sleep(0.01)
    robot.gate.set()
    await command
    assert (await holding).began


async def test_a_run_that_commands_a_robot_stays_once_it_has_begun() -> None:
    """One that still waits for its container may go."""
    skill = manifest(runs="robot", verbs=("goto",))
    with pytest.raises(RefusedError, match="commands a robot"):
        await source(Runs(), skill)[0].hold(HOLD)
    runs = Runs(began=False)
    assert not (await source(runs, skill)[0].hold(HOLD)).began
    assert not runs.asked


async def test_a_run_that_is_not_here_cannot_be_held() -> None:
    """It has ended, or moved."""
    runs = Runs()
    await source(runs)[0].leave(RUN)
    with pytest.raises(NotFoundError):
        await source(runs)[0].hold(HOLD)
