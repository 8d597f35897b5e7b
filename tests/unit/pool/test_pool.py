"""The pool's books, with real runners but no Podman: who gets which container, and how runs end."""

import asyncio
import signal
from collections.abc import Collection
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.errors import ConfigError, NotFoundError, PayloadError, PoolError, RefusedError, SwiftbotError
from appliance.model import ContainerInfo, ContainerState, Need, Phase, RunEventKind
from appliance.pool import engine as link_module
from appliance.pool import runs as running_module
from appliance.pool.engine import Exit
from appliance.pool.runner.zygote import MAX_CONNECTIONS
from appliance.pool.selection import Candidate
from tests.unit.pool.bench import COLD

pytestmark = pytest.mark.anyio


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


async def test_many_at_once(bench: Any, tmp_path: Path) -> None:
    """More runs than containers: both containers work, all are served in their turn, and none has two at once."""
    pool = await bench.pool(capacity=2, queue=20, queue_wait_s=100.0, lease_s=100.0)

    async def one(number: int) -> tuple[str, Phase | None]:
        # None ends before two have begun, so that neither container comes free while the other is only starting.
        final, _ = await bench.run(pool, bench.request(number, do="meet", place=str(tmp_path), deadline_s=100.0))
        assert final.kind is RunEventKind.SUCCEEDED, final.failure
        return final.container, final.phase

    served = await asyncio.gather(*(one(number) for number in range(12)))
    assert len({container for container, _ in served}) == bench.engine.created == 2
    assert sum(phase is Phase.COLD for _, phase in served) == 2
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
    assert bench.avoided == [set(), {"g2"}], "the search gets the names of those whose offers do not count"
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


@pytest.mark.parametrize(
    ("result", "told"),
    [
        (None, "output 'number' is missing: expected a number, got a result with nothing in it"),
        ({"findings": []}, "output 'number' is missing: expected a number, got a result with 'findings'"),
        ({"number": None, "findings": 1}, "output 'number' is missing: expected a number, got null"),
        ({"number": "3", "findings": 1}, "output 'number' has the wrong type: expected a number, got the text '3'"),
        ({"number": True, "findings": 1}, "expected a number, got true"),
        ({"number": 3}, "output 'findings' is missing: expected a value"),
        ({"number": 3, "findings": 1, "count": 1.5}, "output 'count' has the wrong type: expected a whole number"),
    ],
)
async def test_a_result_that_is_not_what_the_manifest_promises_fails_its_run(
    bench: Any, result: Any, told: str
) -> None:
    """It names skill, output, what is expected and what came; it is counted, and not tried again."""
    pool = await bench.pool()
    final, _ = await bench.run(pool, bench.request(1, skill="promising", result=result))
    assert final.kind is RunEventKind.FAILED
    assert (final.failure.code, final.failure.retryable) == ("payload", False)
    assert final.failure.message.startswith("the result of promising is not what its manifest promises: ")
    assert told in final.failure.message
    assert "skill.toml" in final.failure.remedy
    assert pool.refused["result"] == 1


@pytest.mark.parametrize("more", [{}, {"count": 3}, {"count": 3.0}, {"count": None}, {"other": "x"}])
async def test_a_result_may_hold_more_than_its_manifest_promises(bench: Any, more: dict[str, Any]) -> None:
    """What is promised is there, what is optional may be left out, and nothing else is looked at."""
    result = {"number": 2.5, "findings": ["x"], **more}
    final, _ = await bench.run(await bench.pool(), bench.request(1, skill="promising", result=result))
    assert (final.kind, final.result) == (RunEventKind.SUCCEEDED, result)


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


async def test_orders_that_cannot_be_sent_cost_nothing(bench: Any) -> None:
    """However many there are, the container that was to have them stays, keeps its connections, and serves the next."""
    pool = await bench.pool(floor={"base": 1}, capacity=1)
    await bench.ready(pool, 1)
    for number in range(2 * MAX_CONNECTIONS):
        with pytest.raises(PayloadError, match="cannot be sent"):
            await bench.run(pool, bench.request(number, x=float("nan")))
    final, _ = await bench.run(pool, bench.request(99))
    assert final.kind is RunEventKind.SUCCEEDED, final.failure
    assert (final.phase, bench.engine.created) == (Phase.LOCAL_WARM, 1)


async def test_the_same_run_twice(bench: Any, tmp_path: Path) -> None:
    """A run that is in progress is not begun again."""
    pool = await bench.pool()
    task = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    with pytest.raises(RefusedError, match="in progress"):
        await pool.run(bench.request(1), COLD, lambda _: None)
    await pool.cancel("t/s1/1")
    await task


@pytest.mark.parametrize(
    ("exit_", "code", "told"),
    [
        (Exit(code=137, oom=True), "memory", "ran out of memory and was killed by the kernel"),
        (Exit(code=137, oom=False), "pool", "was killed by SIGKILL in mid-run"),
        (Exit(code=3, oom=False), "pool", "exited with code 3 in mid-run"),
        (None, "pool", "Podman does not say why"),
    ],
)
async def test_a_container_that_ends_in_mid_run_says_how(
    bench: Any, tmp_path: Path, exit_: Exit | None, code: str, told: str
) -> None:
    """By what Podman knows of its process 1; with Podman away it is reported as lost, and nothing waits for Podman."""
    pool = await bench.pool(reconnect_s=600.0)
    running = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    (victim,) = (name for name in bench.engine.processes if bench.engine.specs[name].labels)
    if exit_ is None:
        bench.engine.away = True
        await bench.until(lambda: pool.problem, "Podman is missed")
    else:
        bench.engine.exits[victim] = exit_
    await bench.engine.kill(victim)
    final, _ = await running
    assert (final.failure.code, final.failure.retryable) == (code, True)
    assert told in final.failure.message
    assert final.failure.remedy


async def test_a_runner_that_stands_still_is_told_as_hung(bench: Any, tmp_path: Path) -> None:
    """Its probes find it out before the run's deadline: the failure says how long it gave no answer."""
    pool = await bench.pool(probe_s=0.05, probe_timeout_s=0.1, probe_failures=2)
    request = bench.request(1, do="sleep", pid=str(tmp_path / "pid"), deadline_s=60.0)
    running = asyncio.create_task(bench.run(pool, request))
    await bench.until((tmp_path / "pid").exists, "the run")
    for process in bench.engine.processes.values():
        process.send_signal(signal.SIGSTOP)
    final, _ = await running
    assert (final.failure.code, final.failure.retryable) == ("hung", True)
    assert "did not answer for 0.2 s (2 probes in a row); the watchdog ended it" in final.failure.message


async def test_a_run_that_its_runner_does_not_end_is_ended_by_the_watchdog(
    bench: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without probes the pool's own bound ends it, and says for how long the handler did not answer."""
    monkeypatch.setattr(running_module, "BACKSTOP_S", 0.2)
    pool = await bench.pool(probe_s=600.0, cancel_grace_s=0.1)
    request = bench.request(1, do="sleep", pid=str(tmp_path / "pid"), deadline_s=1.7)
    running = asyncio.create_task(bench.run(pool, request))
    await bench.until((tmp_path / "pid").exists, "the run")
    for process in bench.engine.processes.values():
        process.send_signal(signal.SIGSTOP)
    final, _ = await running
    assert (final.failure.code, final.failure.retryable) == ("deadline", True)
    assert "did not answer for 2 s" in final.failure.message
    assert "watchdog" in final.failure.message


async def test_a_podman_that_stands_still_is_a_problem_until_it_answers(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is asked of it meanwhile: the watch finds it, the status shows it, and it goes by itself."""
    monkeypatch.setattr(link_module, "WATCH_S", 0.02)
    pool = await bench.pool()
    assert not pool.problem
    bench.engine.silent = True
    await bench.until(lambda: "has not answered within" in pool.problem, "the problem")
    assert "restart it" in pool.problem
    bench.engine.silent = False
    await bench.until(lambda: not pool.problem, "it is gone")
