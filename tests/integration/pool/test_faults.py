"""What handlers and containers can do wrong, in real containers: each ends with a clear error and takes nothing along.

All cases share one pool of one container: after each the next run must work, in a container that is swept.
"""

import asyncio
import itertools
import os
import shutil
import signal
import socket
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from pool_bench import Bench, engine_ids, write_probe

from appliance.model import ContainerState, RunEvent, RunEventKind
from appliance.pool import images
from appliance.pool.engine import remove_fleet
from appliance.pool.pool import Pool
from appliance.pool.settings import TransferConfig
from appliance.skills.catalogue import load_catalogue

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(240)]

MOST_FORKS = 600
HANDLER = f"""
import os, signal, socket, sys, time
from pathlib import Path

STATE = {{"runs": 0}}

def preload(ctx):
    path = ctx.volume("keep") / "preloaded"
    path.write_bytes(b"weights")
    return {{"weights": bytes(ctx.map(path)), "site": ctx.site.get("name")}}

def run(ctx):
    do = ctx.params["do"]
    STATE["runs"] += 1
    if do == "look":
        umask = os.umask(0o22)
        return {{"files": sorted(os.listdir("/tmp") + os.listdir("/dev/shm")), "me": os.getpid(), "umask": umask,
                "processes": sorted(int(each) for each in os.listdir("/proc") if each.isdigit()),
                "runs": STATE["runs"], "home": os.environ["HOME"], "here": os.getcwd(), "scratch": str(ctx.scratch),
                "preloaded": ctx.preloaded["weights"].decode(), "resume": ctx.resume}}
    if do == "segv":
        os.kill(os.getpid(), signal.SIGSEGV)
    if do == "exit":
        os._exit(3)
    if do == "raise":
        raise ValueError("bad value")
    if do == "hang":
        ctx.progress(0.1, "asleep")
        time.sleep(60)
    if do == "hang deaf":
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        while True:
            pass
    if do == "bomb":
        forked = 0
        try:
            while forked < {MOST_FORKS}:
                if os.fork() == 0:
                    time.sleep(60)
                    os._exit(0)
                forked += 1
        except OSError as error:
            return {{"forked": forked, "error": error.strerror}}
        return {{"forked": forked}}
    if do == "memory":
        kept = []
        while True:
            kept.append(bytearray(2**20))
    if do == "fill scratch":
        for number in range(1000):
            (ctx.scratch / str(number)).write_bytes(bytes(4 * 2**20))
    if do == "fill volume":
        path = ctx.volume("keep") / "x"
        try:
            with open(path, "wb") as file:
                while True:
                    file.write(bytes(2**20))
        finally:
            path.unlink()
    if do == "fill volume with files":
        # Bounded for the disk's sake: 256 MB, then it only looks as if it went on.
        for number in range(64):
            (ctx.volume("keep") / str(number)).write_bytes(bytes(4 * 2**20))
        time.sleep(60)
    if do == "fill volume deaf":
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        for number in range(64):
            (ctx.volume("keep") / str(number)).write_bytes(bytes(4 * 2**20))
        while True:
            pass
    if do == "fill beside the socket":
        for number in range(64):
            Path(f"/run/swiftbot/{{number}}").write_bytes(bytes(2**18))
            time.sleep(0.02)
        time.sleep(60)
    if do == "replace the socket":
        os.unlink("/run/swiftbot/runner.sock")
        os.symlink(ctx.params["to"], "/run/swiftbot/runner.sock")
        return {{}}
    if do == "write a little":
        (ctx.volume("keep") / "little").write_bytes(bytes(2**20))
        return {{"left": sorted(os.listdir(ctx.volume("keep")))[:1]}}
    if do == "tick":
        number = 0
        while True:
            number += 1
            ctx.progress(0.5, str(number))
            time.sleep(0.02)
    if do == "print":
        for _ in range(100):
            print("x" * 2**20)
        return {{}}
    if do == "lines":
        for number in range(30000):
            print(number)
        return {{}}
    if do == "1 GB":
        return {{"x": "y" * 2**30}}
    if do == "5 MB":
        return {{"x": "y" * (5 * 2**20)}}
    if do == "class":
        return {{"x": object()}}
    if do == "list":
        return [1]
    if do == "nan":
        return {{"x": float("nan")}}
    if do == "no text":
        return {{"x": os.fsdecode(b"caf\\xe9")}}
    if do == "large checkpoint":
        ctx.checkpoint({{"x": "y" * 2**21}})
    if do == "garbage":
        ctx._link._socket.sendall(b"\\x00\\x00\\x00\\x03abc")
        time.sleep(60)
    if do == "endless frame":
        ctx._link._socket.sendall(b"\\x00\\xff\\xff\\xff" + bytes(2**20))
        os.kill(os.getpid(), signal.SIGKILL)
    if do == "flood":
        for number in range(3000):
            ctx.progress(number / 3000, str(number))
            ctx.partial({{"number": number}})
            ctx.checkpoint({{"number": number}})
        return {{"number": number}}
    if do == "daemon":
        for _ in range(3):
            if os.fork() == 0:
                os.setsid()
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                if os.fork() == 0:
                    while True:
                        time.sleep(1)
                os._exit(0)
        Path("/dev/shm/left").write_text("x")
        return {{}}
    if do == "kill all":
        os.kill(1, signal.SIGKILL)
        os.kill(1, signal.SIGSTOP)
        os.kill(-1, signal.SIGKILL)
        return {{}}
    if do == "close":
        os.closerange(0, 256)
        return {{}}
    if do == "spoil":
        os.chdir("/")
        os.umask(0o777)
        os.environ.clear()
        sys.path.clear()
        sys.modules.clear()
        return {{}}
"""
MANIFEST = 'volumes = ["keep"]\npreload_mb = 16\nfile_mb = 8\n'
NUMBERS = itertools.count(1)


def _processes_of_mine() -> int:
    """Return how many processes this user has, threads included: what RLIMIT_NPROC counts, or more."""
    count = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if folder.stat().st_uid == os.getuid():
                count += sum(1 for _ in (folder / "task").iterdir())
        except OSError:
            continue
    return count


@pytest.fixture(scope="module")
async def bench(podman: Path) -> AsyncIterator[Bench]:
    """Return a fleet whose skill does every wrong thing; afterwards nothing of it may be left."""
    folder = Path(tempfile.mkdtemp(prefix="swiftbot-test-"))
    catalogue = load_catalogue([write_probe(folder, HANDLER, MANIFEST)])
    await images.build("base", catalogue)
    it = Bench(folder, catalogue)
    try:
        yield it
        for pool in it.pools:
            await pool.stop(keep_containers=False)
        assert await engine_ids(it.fleet) == []
        assert list((folder / "run" / it.fleet / "g1").iterdir()) == []
    finally:
        await remove_fleet(it.fleet, volumes=True)
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
async def pool(bench: Bench) -> Pool:
    """Return a pool of one container; what a bomb may fork there is bounded, for this user's sake."""
    return await bench.pool(capacity=1, user_processes=_processes_of_mine() + 200, probe_s=1.0, start_timeout_s=60.0)


async def _next_run_works(bench: Bench, pool: Pool) -> RunEvent:
    """Run once more, as if nothing had been; what the run before did must not be seen."""
    await bench.ready(pool)
    final = await bench.run(pool, "look", next(NUMBERS), resume={"step": 4})
    assert final.kind is RunEventKind.SUCCEEDED, final.failure
    result: dict[str, Any] = final.result or {}
    assert result["processes"] == [1, result["me"]]
    assert result["files"] == [Path(result["scratch"]).name]
    assert result["here"] == result["home"] == result["scratch"]
    assert (result["runs"], result["umask"], result["preloaded"]) == (1, 0o22, "weights")
    assert result["resume"] == {"step": 4}
    await bench.ready(pool)
    assert len(pool.containers()) == len(await engine_ids(bench.fleet)) == 1
    return final


@pytest.mark.parametrize(
    ("do", "code", "text"),
    [
        ("segv", "crashed", "killed by SIGSEGV"),
        ("exit", "crashed", "ended by itself with status 3"),
        ("raise", "skill", "ValueError: bad value"),
        ("hang", "deadline", "deadline"),
        ("hang deaf", "deadline", "did not end within 1 s"),
        ("memory", "memory", "ran out of its memory"),
        ("fill scratch", "skill", "No space left on device"),
        ("fill volume", "skill", "File too large"),
        ("1 GB", "memory", "ran out of its memory"),
        ("5 MB", "payload", "at most 49,152 (48 KiB)"),
        ("class", "skill", "object cannot be sent"),
        ("list", "skill", "returned list, not a dict"),
        ("nan", "skill", "Out of range float"),
        ("no text", "skill", "surrogates not allowed"),
        ("large checkpoint", "payload", "at most 262,144 (256 KiB)"),
        ("close", "crashed", "no result"),
        ("garbage", "payload", "garbage"),
        ("endless frame", "payload", "cut off within a message"),
    ],
)
async def test_what_fails(bench: Bench, pool: Pool, do: str, code: str, text: str) -> None:
    """A run that goes wrong ends once, with a code and a message that say how, and the next one works."""
    await bench.ready(pool)
    deadline_s = 1.0 if do.startswith("hang") else 60.0
    final = await bench.run(pool, do, next(NUMBERS), deadline_s=deadline_s)
    assert final.kind is RunEventKind.FAILED
    assert final.failure is not None
    assert (final.failure.code, text in final.failure.message) == (code, True), final.failure
    assert final.failure.remedy
    after = await _next_run_works(bench, pool)
    # Only a runner whose word cannot be trusted any more costs its container.
    assert (after.container == final.container) == (do not in ("garbage", "endless frame"))


async def test_a_fork_bomb(bench: Bench, pool: Pool) -> None:
    """What forks without end is stopped by the limit of processes, and all it forked is gone afterwards."""
    await bench.ready(pool)
    final = await bench.run(pool, "bomb", next(NUMBERS))
    if final.kind is RunEventKind.SUCCEEDED:
        assert final.result is not None
        assert 0 < final.result["forked"] < MOST_FORKS
        assert "unavailable" in final.result["error"]
    else:
        assert final.failure is not None
        assert final.failure.message
        assert final.failure.remedy
    after = await _next_run_works(bench, pool)
    assert after.container == final.container


@pytest.mark.parametrize(("do", "most"), [("print", 300), ("lines", 2001)])
async def test_output_without_end(bench: Bench, pool: Pool, do: str, most: int) -> None:
    """100 MB of output, or lines without number, end in a bounded log that says so; the run is not harmed."""
    await bench.ready(pool)
    seen: list[RunEvent] = []
    final = await bench.run(pool, do, next(NUMBERS), seen=seen)
    assert final.kind is RunEventKind.SUCCEEDED
    lines = [event.note for event in seen if event.kind is RunEventKind.LOG]
    assert len(lines) <= most
    assert sum(map(len, lines)) < 2**20
    assert any("the rest is dropped" in line for line in lines)
    await _next_run_works(bench, pool)


async def test_news_without_end(bench: Bench, pool: Pool) -> None:
    """Progress, partial results and checkpoints without end are thinned out, and the last of each arrives."""
    await bench.ready(pool)
    seen: list[RunEvent] = []
    final = await bench.run(pool, "flood", next(NUMBERS), seen=seen)
    assert final.kind is RunEventKind.SUCCEEDED
    for kind in (RunEventKind.PARTIAL, RunEventKind.CHECKPOINT):
        told = [event.result for event in seen if event.kind is kind]
        assert len(told) < 1500
        assert told[-1] == {"number": 2999}
    await _next_run_works(bench, pool)


@pytest.mark.parametrize("do", ["daemon", "kill all", "spoil"])
async def test_what_leaves_its_bounds(bench: Bench, pool: Pool, do: str) -> None:
    """Daemons, signals to every process and a spoilt environment touch neither the runner nor the next run."""
    await bench.ready(pool)
    final = await bench.run(pool, do, next(NUMBERS))
    after = await _next_run_works(bench, pool)
    assert after.container == final.container


@pytest.mark.parametrize("do", ["fill volume with files", "fill volume deaf"])
async def test_a_volume_is_filled_without_end(bench: Bench, do: str) -> None:
    """A run that goes on writing files while the disk is short is ended, be it deaf; what writes little is served."""
    # More than any disk has is to be left free: it is short from the beginning.
    short = TransferConfig(reserve_mb=2**40)
    pool = await bench.pool(gateway=f"full{next(NUMBERS)}", capacity=1, transfer=short)
    await bench.ready(pool)
    final = await bench.run(pool, do, next(NUMBERS), deadline_s=60.0)
    assert final.failure is not None
    assert (final.failure.code, final.failure.retryable) == ("disk", True), final.failure
    assert "into its volumes, whose disk is nearly full" in final.failure.message
    assert "make room on the disk" in final.failure.remedy
    await bench.ready(pool)
    after = await bench.run(pool, "write a little", next(NUMBERS))
    assert after.kind is RunEventKind.SUCCEEDED, after.failure
    assert after.container == final.container
    await pool.stop(keep_containers=False)


async def test_what_is_written_beside_the_socket(bench: Bench, pool: Pool) -> None:
    """The folder of the runner's socket is the gateway's: who fills it is ended, and what was written there is gone."""
    await bench.ready(pool)
    final = await bench.run(pool, "fill beside the socket", next(NUMBERS), deadline_s=60.0)
    assert final.failure is not None
    assert final.failure.code == "disk", final.failure
    after = await _next_run_works(bench, pool)
    assert after.container == final.container
    (folder,) = (bench.folder / "run" / bench.fleet / "g1").iterdir()
    assert {each.name for each in folder.iterdir()} == {"runner.sock", "spec.json"}


async def test_a_link_in_the_place_of_the_socket(bench: Bench, pool: Pool) -> None:
    """A handler that links its runner's socket to another one costs its container; nobody speaks to that one."""
    await bench.ready(pool)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        where = bench.folder / "other.sock"
        other.bind(str(where))
        other.listen()
        other.setblocking(False)
        request = bench.request("replace the socket", next(NUMBERS))
        request = replace(request, params=request.params | {"to": str(where)})
        decision = await pool.select(request.need, allow_remote=False)
        final = await pool.run(request, decision, lambda _: None)
        assert final.kind is RunEventKind.SUCCEEDED, final.failure
        after = await _next_run_works(bench, pool)
        assert after.container != final.container
        with pytest.raises(BlockingIOError):
            other.accept()


async def test_a_neighbour_is_not_touched(bench: Bench) -> None:
    """While one run crashes, loops, forks and fills what it can, the one in the next container works on undisturbed."""
    pool = await bench.pool(
        gateway="pair", floor={"base": 2}, capacity=2, user_processes=_processes_of_mine() + 200, start_timeout_s=60.0
    )
    await bench.ready(pool, 2)
    ticks: list[RunEvent] = []
    request = bench.request("tick", next(NUMBERS), deadline_s=200.0)
    decision = await pool.select(request.need, allow_remote=False)
    neighbour = asyncio.create_task(pool.run(request, decision, ticks.append))
    for do in ("segv", "hang deaf", "memory", "bomb", "fill scratch", "print", "kill all", "garbage"):
        await bench.ready(pool)
        await bench.run(pool, do, next(NUMBERS), deadline_s=1.0 if do.startswith("hang") else 60.0)
        before = len(ticks)
        async with asyncio.timeout(60):
            while len(ticks) < before + 3:
                assert not neighbour.done(), (do, neighbour.result())
                await asyncio.sleep(0.02)
    assert await pool.cancel(request.run_id)
    final = await neighbour
    assert final.failure is not None
    assert final.failure.code == "cancelled"
    assert {each.container for each in ticks} == {final.container}
    await pool.stop(keep_containers=False)


async def _in_mid_run(bench: Bench, pool: Pool, deadline_s: float) -> asyncio.Task[RunEvent]:
    await bench.ready(pool)
    seen: list[RunEvent] = []
    task = asyncio.create_task(bench.run(pool, "hang", next(NUMBERS), seen=seen, deadline_s=deadline_s))
    async with asyncio.timeout(30):
        while not any(event.kind is RunEventKind.PROGRESS for event in seen):
            assert not task.done(), task.result()
            await asyncio.sleep(0.02)
    return task


async def _process_1(container: str) -> int:
    process = await asyncio.create_subprocess_exec(
        "podman", "inspect", "--format", "{{.State.Pid}}", container, stdout=asyncio.subprocess.PIPE
    )
    return int((await process.communicate())[0])


async def test_killed_by_podman(bench: Bench, pool: Pool) -> None:
    """A container that `podman kill` ends in mid-run fails its run as retryable; another takes its place."""
    task = await _in_mid_run(bench, pool, 60.0)
    (victim,) = await engine_ids(bench.fleet)
    process = await asyncio.create_subprocess_exec("podman", "kill", victim, stdout=asyncio.subprocess.DEVNULL)
    assert await process.wait() == 0
    final = await task
    assert final.failure is not None
    assert (final.failure.code, final.failure.retryable) == ("pool", True)
    assert "was killed by SIGKILL in mid-run" in final.failure.message
    await _next_run_works(bench, pool)
    assert victim not in await engine_ids(bench.fleet)


async def test_frozen_in_mid_run(bench: Bench, pool: Pool) -> None:
    """A container whose process 1 stands still is given up: its run ends as retryable, and another takes its place."""
    task = await _in_mid_run(bench, pool, 2.0)
    (victim,) = await engine_ids(bench.fleet)
    pid = await _process_1(victim)
    os.kill(pid, signal.SIGSTOP)
    final = await task
    assert final.failure is not None
    assert (final.failure.code in ("hung", "deadline"), final.failure.retryable) == (True, True)
    assert "did not answer for" in final.failure.message
    assert "watchdog" in final.failure.message
    await _next_run_works(bench, pool)
    async with asyncio.timeout(30):
        while Path(f"/proc/{pid}").exists():
            await asyncio.sleep(0.05)
    assert victim not in await engine_ids(bench.fleet)


async def test_frozen_at_rest(bench: Bench, pool: Pool) -> None:
    """A ready container that stands still is found out by its probes and replaced."""
    await bench.ready(pool)
    (victim,) = await engine_ids(bench.fleet)
    os.kill(await _process_1(victim), signal.SIGSTOP)
    async with asyncio.timeout(60):
        while victim in await engine_ids(bench.fleet) or not any(
            each.state is ContainerState.READY for each in pool.containers()
        ):
            await asyncio.sleep(0.1)
    await _next_run_works(bench, pool)
