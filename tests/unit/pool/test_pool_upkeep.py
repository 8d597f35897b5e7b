"""What a pool does about its containers, with real runners but no Podman: replaced, let go, adopted, removed."""

import asyncio
import contextlib
import hashlib
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import PoolError, RefusedError
from appliance.model import ContainerState, Phase, RunEventKind
from appliance.model.pool_api import DecisionsAsk
from appliance.pool.container import PooledContainer
from appliance.pool.pressure import Reading
from appliance.pool.settings import PressureConfig
from tests.unit.pool.bench import COLD

pytestmark = pytest.mark.anyio


async def test_a_hung_runner_is_replaced(bench: Any) -> None:
    """A runner that answers no ping is replaced."""
    import signal  # noqa: PLC0415

    pool = await bench.pool(floor={"base": 1}, probe_timeout_s=2.0)
    await bench.ready(pool, 1)
    hung = pool.containers()[0].id
    bench.engine.processes["engine-1"].send_signal(signal.SIGSTOP)
    await bench.until(lambda: hung not in {each.id for each in pool.containers()}, "the hung one is given up")
    await bench.ready(pool, 1)


async def test_used_up_containers_are_replaced(bench: Any) -> None:
    """A container is replaced after so many runs."""
    pool = await bench.pool(max_runs=2, floor={"base": 1}, capacity=1)
    seen = set()
    for number in range(4):
        await bench.ready(pool, 1)
        final, _ = await bench.run(pool, bench.request(number))
        seen.add(final.container)
    assert len(seen) == 2


async def test_one_that_has_grown_is_replaced(growing: Path, bench: Any) -> None:
    """A container whose runner has grown beyond what it may is replaced after a run, and the reason is reported."""
    pool = await bench.pool(floor={"base": 1}, capacity=1, max_growth_mb=64.0)
    await bench.ready(pool, 1)
    first, _ = await bench.run(pool, bench.request(1))
    growing.touch()
    number, last = 1, first
    async with asyncio.timeout(30):
        while last.container == first.container:  # until its probe has seen it
            await bench.ready(pool, 1)
            number += 1
            last, _ = await bench.run(pool, bench.request(number))
            assert last.kind is RunEventKind.SUCCEEDED
    told = await pool.verbs.decisions(DecisionsAsk())
    assert any("its runner has grown by" in each.why for each in told.decisions if each.container == first.container)


async def test_idle_ones_beyond_the_floor_go(bench: Any) -> None:
    """A container that nobody has used for long is removed, down to the floor."""
    pool = await bench.pool(mode="federated", keep="fixed", prewarm=(), floor={"base": 1}, idle_s=0.3)
    await bench.ready(pool, 1)
    await asyncio.gather(*(bench.run(pool, bench.request(number)) for number in range(3)))
    await bench.until(lambda: len(pool.containers()) == 1, "back to the floor")


async def test_memory_pressure(bench: Any) -> None:
    """A machine short of memory: idle containers go until the budget holds, the pool says why, and it grows back."""
    marks = {"every_s": 0.02, "settle_s": 0.05, "calm_s": 0.1, "least_mb": 256}
    pool = await bench.pool(floor={"base": 3}, memory_mb=1024, pressure=PressureConfig(**marks))
    await bench.ready(pool, 3)
    bench.memory = Reading(available_mb=10.0, some=40.0)
    await bench.until(lambda: len(pool.containers()) == 1, "all but what is always allowed are given up")
    await bench.until(lambda: "256 of 1024 MB" in pool.squeeze, "the least that is always allowed")
    assert "40 % of the last 10 s" in pool.squeeze
    assert pool.problem == ""
    final, _ = await bench.run(pool, bench.request(1))
    assert final.kind is RunEventKind.SUCCEEDED
    bench.memory = Reading(available_mb=1000.0, some=0.0)
    await bench.ready(pool, 3)
    await bench.until(lambda: pool.squeeze == "", "all is well again")


async def test_podman_absent(bench: Any) -> None:
    """Without Podman the pool says why and how to mend it, refuses runs, and warms up when it is back."""
    bench.engine.away = True
    pool = await bench.pool(floor={"base": 1}, reconnect_s=0.05)
    assert "socket is not there (start it)" in pool.problem
    with pytest.raises(PoolError, match="socket is not there"):
        await pool.select(bench.request().need, allow_remote=False)
    bench.engine.away = False
    await bench.ready(pool, 1)
    assert pool.problem == ""


async def test_podman_dies(bench: Any) -> None:
    """When Podman dies, warm containers serve on; what could not be removed meanwhile is removed afterwards."""
    pool = await bench.pool(floor={"base": 2}, capacity=2, reconnect_s=0.05)
    await bench.ready(pool, 2)
    bench.engine.away = True
    await bench.engine.kill("engine-1")
    await bench.until(lambda: bool(pool.problem), "the problem is noticed")
    final, _ = await bench.run(pool, bench.request(1))
    assert final.kind is RunEventKind.SUCCEEDED
    bench.engine.away = False
    await bench.ready(pool, 2)
    assert pool.problem == ""
    await bench.until(lambda: len(bench.engine.specs) == 2, "the dead one is removed")


async def test_a_bad_image_is_quarantined(bench: Any) -> None:
    """An image that fails to start three times is left alone for a while, with the reason; then it is tried again."""
    bench.engine.refuse = "exec format error"
    pool = await bench.pool(floor={"base": 1}, quarantine_s=0.5)
    await bench.until(lambda: "exec format error" in pool.problem, "the quarantine")
    assert bench.engine.created == 3
    with pytest.raises(RefusedError, match="3 starts of image base failed"):
        await pool.select(bench.request().need, allow_remote=False)
    bench.engine.refuse = ""
    await bench.ready(pool, 1)
    assert pool.problem == ""


async def test_a_cold_start_that_fails(bench: Any) -> None:
    """A run whose container does not start is given back with the reason, and nothing is left of it."""
    bench.engine.refuse = "exec format error"
    pool = await bench.pool()
    with pytest.raises(PoolError, match="exec format error"):
        await pool.run(bench.request(), COLD, lambda _: None)
    assert pool.containers() == ()
    assert bench.engine.specs == {}


async def test_adoption(bench: Any) -> None:
    """After a restart the pool takes over its own containers, with their facts, and leaves those of others alone."""
    before = await bench.pool(floor={"base": 2})
    other = await bench.pool(floor={"base": 1}, gateway="g2")
    await bench.ready(before, 2)
    await bench.ready(other, 1)
    await before.stop(keep_containers=True)
    after = await bench.pool(floor={"base": 2})
    assert {each.id for each in after.containers()} == {
        spec.labels["swiftbot.id"] for spec in bench.engine.specs.values() if spec.labels["swiftbot.gateway"] == "g1"
    }
    final, _ = await bench.run(after, bench.request())
    assert final.phase is Phase.LOCAL_WARM
    assert len(other.containers()) == 1
    assert bench.engine.created >= 3


async def test_adoption_after_a_kill_in_mid_run(bench: Any, tmp_path: Path) -> None:
    """A run whose gateway is gone is ended by the runner, and its container is adopted."""
    before, noted = await bench.pool(), tmp_path / "pid"
    task = asyncio.create_task(bench.run(before, bench.request(1, do="sleep", pid=str(noted))))
    await bench.until(lambda: noted.exists() and bool(noted.read_text()), "the run")
    pid = int(noted.read_text())
    task.cancel()
    # What a killed process does: its sockets are closed, and it does nothing else.
    keeper = before._keeper
    keeper.retire = lambda *_, **__: None
    with contextlib.suppress(asyncio.CancelledError):
        await task
    await before.stop(keep_containers=True)
    after = await bench.pool()
    assert [each.state for each in after.containers()] == [ContainerState.READY]
    assert not Path(f"/proc/{pid}").exists()


async def test_what_cannot_be_adopted_is_removed(bench: Any) -> None:
    """A container that has ended, was made of other code, or whose labels make no sense is removed and not adopted."""
    before = await bench.pool(floor={"base": 5})
    await bench.ready(before, 5)
    await before.stop(keep_containers=True)
    first, second, third, fourth, _ = bench.engine.specs
    await bench.engine.kill(first)
    bench.engine.specs[second].labels["swiftbot.made"] = "of something else"
    bench.engine.specs[third].labels["swiftbot.size"] = "large"
    bench.engine.specs[fourth].labels["swiftbot.size"] = '{"cpu": "all", "memory_mb": []}'
    after = await bench.pool()
    assert len(after.containers()) == 1
    assert len(bench.engine.specs) == 1


async def test_a_runner_tells_what_it_has_loaded(bench: Any) -> None:
    """Handlers, the runner itself and nothing that is not in the snapshot; broken handlers are problems instead."""
    pool = await bench.pool(floor={"base": 1})
    await bench.ready(pool, 1)
    (container,) = pool._keeper.books
    loaded = await container.hello(timeout_s=5)
    files = pool._keeper._starter._snapshot.files
    assert {"runner/main.py", "runner/zygote.py", "skills-1/probe/handler.py"} <= loaded.keys()
    assert loaded.items() <= files.items()
    assert (
        files["skills-1/probe/handler.py"]
        == hashlib.sha256((bench.folder / "skills" / "probe" / "handler.py").read_bytes()).hexdigest()
    )


async def test_a_runner_that_cannot_say_what_it_has_loaded_is_not_adopted(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of an earlier version does not know the question: it is replaced and counted."""
    before = await bench.pool(floor={"base": 1})
    await bench.ready(before, 1)
    await before.stop(keep_containers=True)

    async def older(self: PooledContainer, *, timeout_s: float) -> dict[str, str]:
        del self, timeout_s
        return {}

    monkeypatch.setattr(PooledContainer, "hello", older)
    after = await bench.pool()
    assert after.containers() == ()
    assert after.refused["loaded code"] == 1
    assert bench.engine.specs == {}


async def test_stop_removes_what_is_not_to_be_kept(bench: Any) -> None:
    """Told not to keep them, stop removes all containers and their folders."""
    pool = await bench.pool(floor={"base": 2})
    await bench.ready(pool, 2)
    await pool.stop(keep_containers=False)
    assert bench.engine.specs == {}
    assert list((bench.folder / "run" / "f1" / "g1").iterdir()) == []


async def test_drain(bench: Any, tmp_path: Path) -> None:
    """Draining refuses new runs, lets those in progress end, and cancels what is left at the deadline."""
    pool = await bench.pool()
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    await pool.drain(0.1)
    assert (await task)[0].failure.code == "cancelled"
    with pytest.raises(RefusedError, match="draining"):
        await pool.select(bench.request().need, allow_remote=False)
