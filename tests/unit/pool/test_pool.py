"""The pool's books, with real runners but no Podman."""

import asyncio
import contextlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.errors import ConfigError, NotFoundError, PoolError, RefusedError, SwiftbotError
from appliance.model import ContainerInfo, ContainerState, Need, Phase, RunEventKind
from appliance.pool.api import DecisionsAsk
from appliance.pool.pressure import Reading
from appliance.pool.selection import Candidate, Decision
from appliance.pool.settings import PressureConfig

pytestmark = pytest.mark.anyio

COLD = Decision(phase=Phase.COLD, gateway="g1")


async def test_cold_then_warm(bench: Any) -> None:
    """The first run starts a container, the second finds it warm and begins far sooner; each tells all its news."""
    pool = await bench.pool()
    first, _ = await bench.run(pool, bench.request(1))
    await bench.ready(pool, 1)
    second, events = await bench.run(pool, bench.request(2))
    assert (first.kind, first.phase) == (RunEventKind.SUCCEEDED, Phase.COLD)
    assert (second.kind, second.phase) == (RunEventKind.SUCCEEDED, Phase.LOCAL_WARM)
    assert second.container == first.container
    assert second.result["site"] == "yard"
    assert next(event.kind for event in events) is RunEventKind.STARTED
    assert {event.kind for event in events} == {
        RunEventKind.STARTED, RunEventKind.PROGRESS, RunEventKind.LOG, RunEventKind.PARTIAL,
    }  # fmt: skip
    assert events[0].startup_ms > 0
    assert second.duration_ms > 0
    assert bench.engine.created == 1


async def test_floor_is_kept(bench: Any) -> None:
    """As many as the floor says are ready, also while others work and after one has died."""
    pool = await bench.pool(floor={"base": 2, "vision": 1})
    await bench.ready(pool, 2)
    await bench.ready(pool, 1, "vision")
    victim = pool.containers()[0]
    engine_id = next(name for name, spec in bench.engine.specs.items() if spec.labels["swiftbot.id"] == victim.id)
    await bench.engine.kill(engine_id)
    await bench.until(lambda: victim.id not in {each.id for each in pool.containers()}, "the dead one is forgotten")
    await bench.ready(pool, 2)
    await bench.ready(pool, 1, "vision")


async def test_reservations(bench: Any) -> None:
    """Two selections never get the same container, and one that is not used is free again after its lease."""
    pool = await bench.pool(floor={"base": 2}, capacity=2, lease_s=2.0)
    await bench.ready(pool, 2)
    need = Need(image="base", cpu=0.1, memory_mb=64)
    decisions = [await pool.select(need, allow_remote=False) for _ in range(3)]
    assert [each.phase for each in decisions] == [Phase.LOCAL_WARM, Phase.LOCAL_WARM, Phase.COLD]
    assert decisions[0].container != decisions[1].container
    await bench.ready(pool, 2)
    assert pool.refused["lease expired"] == 2
    # A decision whose lease has run out still runs, in whatever is there.
    final = await pool.run(bench.request(), decisions[0], lambda _: None)
    assert final.kind is RunEventKind.SUCCEEDED


async def test_many_at_once(bench: Any) -> None:
    """More runs than containers: all are served in their turn, and no container has two at once."""
    pool = await bench.pool(capacity=2, queue=20)

    async def one(number: int) -> tuple[str, Phase | None]:
        final, _ = await bench.run(pool, bench.request(number))
        assert final.kind is RunEventKind.SUCCEEDED
        return final.container, final.phase

    served = await asyncio.gather(*(one(number) for number in range(12)))
    assert len({container for container, _ in served}) == 2
    # One whose own was starting may have got the other when that came free.
    assert 1 <= sum(phase is Phase.COLD for _, phase in served) <= 2
    for facts in bench.changes:
        assert len(facts) <= 2
        running = [each.run for each in facts if each.run]
        assert len(running) == len(set(running))


async def test_one_that_comes_free_is_taken_not_given_up(bench: Any) -> None:
    """A container that comes free just as a run is about to have another started serves it; it does not make room."""
    pool = await bench.pool(floor={"base": 1}, capacity=1)
    await bench.ready(pool, 1)
    container = await pool._keeper.acquire(bench.request().need)
    assert container.info.state is ContainerState.RESERVED
    pool._keeper.books.give_back(container)

    async def several(first: int) -> None:
        for number in range(first, first + 10):
            final = await pool.run(bench.request(number), COLD, lambda _: None)
            assert final.kind is RunEventKind.SUCCEEDED

    await asyncio.gather(*(several(100 * worker) for worker in range(3)))
    assert bench.engine.created == 1


async def test_queue_is_bounded(bench: Any, tmp_path: Path) -> None:
    """When everything is busy and the queue full a run is refused with the reason; one that waits too long fails."""
    pool = await bench.pool(capacity=1, queue=1, queue_wait_s=3.0)
    sleeper = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the first run")
    waiting = asyncio.create_task(bench.run(pool, bench.request(2)))
    await bench.until(lambda: pool.queue == 1, "one in the queue")
    with pytest.raises(RefusedError, match="1 runs wait"):
        await pool.select(bench.request(3).need, allow_remote=False)
    with pytest.raises(PoolError, match="no container came free"):
        await waiting
    assert (pool.refused["queue full"], pool.refused["queue wait"], pool.queue) == (1, 1, 0)
    await pool.cancel("t/s1/1")
    assert (await sleeper)[0].failure.code == "cancelled"


async def test_idle_ones_of_other_images_make_room(bench: Any) -> None:
    """With every place taken by idle containers of another image, the least valuable of them goes."""
    pool = await bench.pool(capacity=2, floor={"base": 2})
    await bench.ready(pool, 2)
    final, _ = await bench.run(pool, bench.request(1, skill="seeing", image="vision"))
    assert final.result == {"saw": True}
    assert sorted(each.image for each in pool.containers()) == ["base", "vision"]


async def test_a_compatible_image_serves(bench: Any) -> None:
    """A vision container serves a base skill when no base container is there."""
    pool = await bench.pool(floor={"vision": 1}, capacity=1)
    await bench.ready(pool, 1, "vision")
    decision = await pool.select(bench.request().need, allow_remote=False)
    assert decision.phase is Phase.LOCAL_WARM
    final = await pool.run(bench.request(), decision, lambda _: None)
    assert final.kind is RunEventKind.SUCCEEDED


async def test_mode_cold(bench: Any) -> None:
    """In mode cold each run has a container of its own, which is gone afterwards, and nothing is prewarmed."""
    pool = await bench.pool(mode="cold", floor={"base": 2})
    for number in range(2):
        final, _ = await bench.run(pool, bench.request(number))
        assert final.phase is Phase.COLD
    await bench.until(lambda: not pool.containers() and not bench.engine.specs, "both are removed")
    assert bench.engine.created == 2


async def test_remote(bench: Any) -> None:
    """With none ready here, an offer of another gateway is taken; a run for it is not accepted here."""
    pool = await bench.pool(mode="federated")
    there = ContainerInfo(id="far", gateway="g2", image="base", state=ContainerState.READY)
    bench.offers = [Candidate(container=there, round_trip_ms=1.0)]
    need = bench.request().need
    decision = await pool.select(need, allow_remote=True)
    assert (decision.phase, decision.gateway, decision.container) == (Phase.REMOTE_WARM, "g2", "far")
    assert (await pool.select(need, allow_remote=False)).phase is Phase.COLD
    assert (await pool.select(need, allow_remote=True, avoid={"g2": "left out"})).phase is Phase.COLD
    assert bench.avoided == [set(), {"g2"}], "whoever looks is told whose offers do not count"
    with pytest.raises(RefusedError, match="g2"):
        await pool.run(bench.request(), decision, lambda _: None)


async def test_others_that_do_not_answer(bench: Any) -> None:
    """Gateways that are slow to offer, or cannot be asked, only mean a cold start."""
    pool = await bench.pool(mode="federated", remote_timeout_s=0.05)

    async def slow(need: Need, avoid: Collection[str]) -> list[Candidate]:
        await asyncio.sleep(60)
        return []

    async def broken(need: Need, avoid: Collection[str]) -> list[Candidate]:
        raise SwiftbotError("no network")

    for ask in (slow, broken):
        pool._find_remote = ask
        assert (await pool.select(bench.request().need, allow_remote=True)).phase is Phase.COLD


async def test_calls(bench: Any) -> None:
    """A handler's calls are carried out in order with their numbers, files pass as bytes, errors keep their code."""
    pool = await bench.pool()
    final, _ = await bench.run(pool, bench.request(1, do="call"))
    assert final.result["back"] is True
    assert final.result["answer"] == {"at": {"x": 1}, "blobs": {"a.png": 3}}
    assert final.result["reference"] == {"artifact": "abc", "bytes": 2}
    assert [(call.number, call.name) for call in bench.calls] == [
        (1, "command"), (2, "put_artifact"), (3, "get_artifact"),
    ]  # fmt: skip
    final, _ = await bench.run(pool, bench.request(2, do="call error"))
    assert final.result == {"code": "unreachable", "message": "no such robot", "retryable": True}
    final, _ = await bench.run(pool, bench.request(3, do="uncaught call error"))
    assert (final.failure.code, final.failure.remedy, final.failure.retryable) == ("unreachable", "look for it", True)


@pytest.mark.parametrize(
    ("do", "code"),
    [
        ("fail", "skill"),
        ("segv", "crashed"),
        ("half frame", "payload"),
        ("garbage", "payload"),
        ("oversize", "payload"),
        ("unknown event", "payload"),
        ("large", "payload"),
    ],
)
async def test_bad_runs_end_with_one_failure(bench: Any, do: str, code: str) -> None:
    """Whatever a handler does, its run ends as failed with the reason, and the pool serves the next."""
    pool = await bench.pool()
    final, events = await bench.run(pool, bench.request(1, do=do))
    assert (final.kind, final.failure.code) == (RunEventKind.FAILED, code)
    assert all(event.kind not in (RunEventKind.FAILED, RunEventKind.SUCCEEDED) for event in events)
    if do == "segv":
        assert "last words" in {event.note for event in events}
    final, _ = await bench.run(pool, bench.request(2))
    assert final.kind is RunEventKind.SUCCEEDED


async def test_cancel(bench: Any, tmp_path: Path) -> None:
    """A run can be cancelled while it runs and while it waits; one that is not there is not."""
    pool = await bench.pool(capacity=1)
    running = asyncio.create_task(bench.run(pool, bench.request(1, do="stubborn", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    waiting = asyncio.create_task(bench.run(pool, bench.request(2)))
    await bench.until(lambda: pool.queue == 1, "the other waits")
    assert not await pool.cancel("t/s9/1")
    for run_id, task in (("t/s2/1", waiting), ("t/s1/1", running)):
        assert await pool.cancel(run_id)
        final, _ = await task
        assert (final.failure.code, final.failure.retryable) == ("cancelled", False)
    final, _ = await bench.run(pool, bench.request(3))
    assert final.kind is RunEventKind.SUCCEEDED


async def test_cancel_during_a_cold_start(bench: Any) -> None:
    """A run that is cancelled while its container starts ends at once; the container joins the ready ones."""
    pool = await bench.pool()
    task = asyncio.create_task(pool.run(bench.request(), COLD, lambda _: None))
    await bench.until(lambda: len(pool.containers()) == 1, "the start has begun")
    assert await pool.cancel("t/s1/1")
    assert (await task).failure.code == "cancelled"
    await bench.ready(pool, 1)


async def test_deadline(bench: Any, tmp_path: Path) -> None:
    """A run beyond its deadline is ended and says so."""
    pool = await bench.pool()
    order = bench.request(1, do="sleep", pid=str(tmp_path / "pid"), deadline_s=0.2)
    final, _ = await bench.run(pool, order)
    assert (final.failure.code, final.failure.retryable) == ("deadline", True)


async def test_death_in_mid_run(bench: Any, tmp_path: Path) -> None:
    """When a container dies its run fails as retryable at once."""
    pool = await bench.pool()
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    await bench.engine.kill("engine-1")
    final, _ = await task
    assert (final.failure.code, final.failure.retryable) == ("pool", True)
    await bench.until(lambda: not pool.containers(), "it is forgotten")


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
    """A container whose runner has grown beyond what it may is replaced after a run, and the reason is told."""
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
    """A container that has ended, or was made of other code, is removed and not adopted."""
    before = await bench.pool(floor={"base": 3})
    await bench.ready(before, 3)
    await before.stop(keep_containers=True)
    first, second, _ = bench.engine.specs
    await bench.engine.kill(first)
    spec = bench.engine.specs[second]
    spec.labels["swiftbot.made"] = "of something else"
    after = await bench.pool()
    assert len(after.containers()) == 1
    assert len(bench.engine.specs) == 1


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


async def test_bad_orders(bench: Any) -> None:
    """Images, skills, needs and floors that are not of this world are refused with the reason, and counted."""
    pool = await bench.pool(memory_mb=1024)
    with pytest.raises(NotFoundError, match="no image 'x'"):
        await pool.select(Need(image="x"), allow_remote=False)
    with pytest.raises(NotFoundError, match="not implemented"):
        await pool.run(bench.request(skill="dance"), COLD, lambda _: None)
    with pytest.raises(RefusedError, match="1024 MB"):
        await pool.select(Need(image="base", memory_mb=5000), allow_remote=False)
    with pytest.raises(RefusedError, match="no CPU"):
        await pool.select(Need(image="base", cpu=0), allow_remote=False)
    assert dict(pool.refused) == {"unknown image": 1, "unknown skill": 1, "bad need": 2}
    with pytest.raises(ConfigError, match="floor"):
        await bench.pool(floor={"x": 1})
    big = msgspec.structs.replace(bench.request(), params={"x": "y" * (17 * 2**20)})
    with pytest.raises(SwiftbotError, match="cannot be sent"):
        await pool.run(big, COLD, lambda _: None)


async def test_the_same_run_twice(bench: Any, tmp_path: Path) -> None:
    """A run that is in progress is not begun again."""
    pool = await bench.pool()
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    with pytest.raises(RefusedError, match="in progress"):
        await pool.run(bench.request(1), COLD, lambda _: None)
    await pool.cancel("t/s1/1")
    await task
