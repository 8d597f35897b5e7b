"""How long a move takes, and what it is good for: on four real gateways, beside killing a run and starting it cold.

Times of a move are those of the coordinator, from the request to the first line of the handler on the other gateway;
the run works on until its `write` step, so that what it stands still for is `write` and `start`. The alternative ends
the run and hands its task in anew, without warm containers: what it had done is lost besides. What moves by overload
are good for is `overload`'s.
"""

import asyncio
import time
from typing import Any, Literal

from appliance.client import FleetClient
from appliance.pool.settings import PoolConfig
from appliance.tasks.api import MigrateAsk
from workshop.bench import overload
from workshop.bench.figures import ratio, summary
from workshop.bench.moving import GATEWAYS, SKILL, STATEFUL, Progress, ended, fleet, running, task_of

Part = Literal["all", "moves", "overload"]


async def run(
    moves: int = 20, volume_moves: int = 6, megabytes: int = 64, cold: int = 5, *,
    load: overload.Options | None = None, part: Part = "all", progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure moves with checkpoints of 1 kB and 256 kB and with a volume, the alternative, and an overload.

    Args:
        moves: moves with each size of checkpoint.
        volume_moves: moves with the volume; to a gateway that has none of it, and again.
        megabytes: size of the volume.
        cold: runs that are ended and started anew.
        load: what the overload is made of.
        part: only the moves, or only the overload.
        progress: told what is being measured.
    """
    result: dict[str, Any] = {"gateways": GATEWAYS}
    if part != "overload":
        result["megabytes"] = megabytes
        result |= await _all_moves(moves, volume_moves, megabytes, cold, progress)
    if part != "moves":
        result["overload"] = await overload.run(load or overload.Options(), progress=progress)
    return result


async def _all_moves(
    moves: int, volume_moves: int, megabytes: int, cold: int, progress: Progress
) -> dict[str, Any]:  # fmt: skip
    result: dict[str, Any] = {}
    async with fleet(PoolConfig(floor={"base": 2}), progress=progress) as client:
        for name, size in (("1 kB", 1000), ("256 kB", 255_000)):
            progress(f"migrate: {moves} moves with a checkpoint of {name}")
            result[f"move, checkpoint {name}"] = await _moves(client, SKILL, moves, bytes=size)
        progress(f"migrate: {volume_moves} moves with a volume of {megabytes} MB")
        result[f"move, volume {megabytes} MB"] = await _moves(client, STATEFUL, volume_moves, megabytes=megabytes)
    async with fleet(PoolConfig(mode="cold", floor={}), progress=progress) as client:
        progress(f"migrate: {cold} runs ended and started anew")
        result["end, start anew cold"] = summary([await _anew(client, number) for number in range(cold)])
    moved = result["move, checkpoint 1 kB"]["took"]
    result["anew / move, p50"] = ratio(result["end, start anew cold"].get("p50"), moved.get("p50"))
    return result


async def _moves(client: FleetClient, skill: str, count: int, **params: Any) -> dict[str, Any]:
    """Move one run `count` times, wherever is closest."""
    task = f"move-{skill.replace('_', '-')}-{time.monotonic_ns()}"
    await client.submit(task_of(task, skill, seconds=3600.0, **params))
    await running(client, task)
    took: list[float] = []
    steps: dict[str, list[float]] = {}
    checkpoints: dict[str, int] = {}
    for _ in range(count):
        await asyncio.sleep(0.3)
        moved = await client.migrate(MigrateAsk(task=task, subtask="s1"))
        took.append(moved.took_ms if moved.started else float("inf"))
        checkpoints[moved.checkpoint or "none"] = checkpoints.get(moved.checkpoint or "none", 0) + 1
        for step, ms in moved.steps_ms.items():
            steps.setdefault(step, []).append(ms)
    await client.cancel(task)
    await ended(client, task)
    return {
        "took": summary(took),
        **{f"step {step}": summary(times) for step, times in steps.items()},
        "went on from": checkpoints,
    }


async def _anew(client: FleetClient, number: int) -> float:
    """End a run that works, hand its task in anew; milliseconds from the decision to its first line."""
    task = f"cold-{number}-{time.monotonic_ns()}"
    await client.submit(task_of(task, SKILL, seconds=3600.0))
    await running(client, task)
    began = time.monotonic()
    await client.cancel(task)
    await ended(client, task)
    again = f"{task}-again"
    await client.submit(task_of(again, SKILL, seconds=3600.0))
    await running(client, again)
    took_ms = (time.monotonic() - began) * 1e3
    await client.cancel(again)
    await ended(client, again)
    return took_ms
