"""Container pools that broke in OpenWhisk and Ray, as their users reported; the table is in tests/reports."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import RefusedError
from appliance.model import Phase, RunEventKind
from tests.unit.pool.bench import COLD

pytestmark = pytest.mark.anyio


async def test_a_container_whose_run_was_too_long_is_not_used_again(bench: Any, tmp_path: Path) -> None:
    """The next run does not meet what the first one left behind in it (apache/openwhisk#1554)."""
    pool = await bench.pool(capacity=1)
    order = bench.request(1, do="stubborn", pid=str(tmp_path / "pid"), deadline_s=0.3)
    first, _ = await bench.run(pool, order)
    assert first.failure.code == "deadline"
    pid = int((tmp_path / "pid").read_text())
    second, _ = await bench.run(pool, bench.request(2))
    assert second.kind is RunEventKind.SUCCEEDED
    assert second.result["pid"] != pid
    await bench.until(lambda: not Path(f"/proc/{pid}").exists(), "the handler of the first run is gone")


async def test_what_an_earlier_life_left_is_taken_or_removed(bench: Any) -> None:
    """Containers of before a restart serve or go, those that have ended too, and others' are left alone.

    Reported as apache/openwhisk#2858.
    """
    before = await bench.pool(floor={"base": 2})
    await bench.ready(before, 2)
    other = await bench.pool(floor={"base": 1}, gateway="g2")
    await bench.ready(other, 1)
    await before.stop(keep_containers=True)
    dead = next(name for name, spec in bench.engine.specs.items() if spec.labels["swiftbot.gateway"] == "g1")
    dead_label = bench.engine.specs[dead].labels["swiftbot.id"]
    await bench.engine.kill(dead)
    after = await bench.pool(floor={"base": 1})
    await bench.ready(after, 1)
    assert dead_label not in {spec.labels["swiftbot.id"] for spec in bench.engine.specs.values()}
    assert dead_label not in {each.id for each in after.containers()}
    assert {each.id for each in other.containers()} <= {
        spec.labels["swiftbot.id"] for spec in bench.engine.specs.values()
    }
    final, _ = await bench.run(after, bench.request())
    assert final.phase is Phase.LOCAL_WARM


async def test_a_pool_that_stops_leaves_no_container(bench: Any, tmp_path: Path) -> None:
    """Not one that is at work either (apache/openwhisk#1982)."""
    pool = await bench.pool(floor={"base": 2})
    await bench.ready(pool, 2)
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    await pool.stop(keep_containers=False)
    final, _ = await task
    assert final.kind is RunEventKind.FAILED
    assert bench.engine.specs == {}


async def test_ready_containers_that_nobody_uses_go(bench: Any) -> None:
    """They do not stay for ever once a burst is over (apache/openwhisk#4871)."""
    pool = await bench.pool(mode="federated", keep="fixed", prewarm=(), floor={"base": 1}, idle_s=0.2)
    await asyncio.gather(*(bench.run(pool, bench.request(number)) for number in range(4)))
    await bench.until(lambda: len(pool.containers()) == 1, "only the floor is left")


async def test_a_ready_container_that_is_taken_is_replaced(bench: Any, tmp_path: Path) -> None:
    """While one works another is made ready, so that the next start is warm again (apache/openwhisk#4725)."""
    pool = await bench.pool(floor={"base": 1}, capacity=3)
    await bench.ready(pool, 1)
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    await bench.ready(pool, 1)
    final, _ = await bench.run(pool, bench.request(2))
    assert final.phase is Phase.LOCAL_WARM
    await pool.cancel("t/s1/1")
    await task


async def test_a_run_that_waits_can_be_cancelled(bench: Any, tmp_path: Path) -> None:
    """It never begins, and its place in the queue is free (ray-project/ray#12080)."""
    pool = await bench.pool(capacity=1)
    first = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    begun = tmp_path / "never"
    waiting = asyncio.create_task(bench.run(pool, bench.request(2, do="sleep", pid=str(begun))))
    await bench.until(lambda: pool.queue == 1, "the other waits")
    assert await pool.cancel("t/s2/1")
    final, events = await waiting
    assert (final.failure.code, pool.queue) == ("cancelled", 0)
    assert not [each for each in events if each.kind is RunEventKind.STARTED]
    await pool.cancel("t/s1/1")
    await first
    assert not begun.exists()


async def test_a_handler_that_sleeps_is_cancelled(bench: Any, tmp_path: Path) -> None:
    """Without being forced to (ray-project/ray#32954)."""
    pool = await bench.pool()
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    assert await pool.cancel("t/s1/1")
    final, _ = await task
    assert final.failure.code == "cancelled"


async def test_what_has_ended_cannot_be_cancelled(bench: Any) -> None:
    """The asker hears that there is nothing, and the next run is not touched (ray-project/ray#39145)."""
    pool = await bench.pool()
    await bench.run(pool, bench.request(1))
    assert not await pool.cancel("t/s1/1")
    final, _ = await bench.run(pool, bench.request(1))
    assert final.kind is RunEventKind.SUCCEEDED


@pytest.mark.parametrize("do", ["segv", "exit", "half frame"])
async def test_a_worker_that_dies_ends_its_run(bench: Any, do: str) -> None:
    """Nobody waits for ever for what it would have returned (ray-project/ray#1224)."""
    pool = await bench.pool()
    async with asyncio.timeout(60):
        final, events = await bench.run(pool, bench.request(1, do=do))
    assert final.kind is RunEventKind.FAILED
    assert sum(each.kind is RunEventKind.FAILED for each in events) <= 1
    final, _ = await bench.run(pool, bench.request(2))
    assert final.kind is RunEventKind.SUCCEEDED


async def test_whoever_waits_is_told_why_a_worker_died(bench: Any, tmp_path: Path) -> None:
    """By a reason and whether it may be tried again (ray-project/ray#419)."""
    pool = await bench.pool()
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    await bench.engine.kill("engine-1")
    final, _ = await task
    assert (final.failure.code, final.failure.retryable) == ("pool", True)
    assert final.failure.message


async def test_a_pool_does_not_begin_a_run_a_second_time(bench: Any, tmp_path: Path) -> None:
    """Neither beside the first nor by itself after a crash, which it may have survived (ray-project/ray#2635)."""
    pool = await bench.pool(capacity=2)
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    with pytest.raises(RefusedError, match="in progress"):
        await pool.run(bench.request(1), COLD, lambda _: None)
    (tmp_path / "pid").unlink()
    await bench.engine.kill("engine-1")
    final, _ = await task
    assert final.kind is RunEventKind.FAILED
    await bench.until(lambda: not pool.containers(), "it is forgotten")
    assert not (tmp_path / "pid").exists()
