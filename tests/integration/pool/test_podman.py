"""The pool on real rootless Podman: what only real containers can show.

Runs as a user with a Podman API socket; anywhere else it fails and says why. Images that are missing are built.
"""

import asyncio
import contextlib
import os
import shutil
import signal
import sys
from pathlib import Path

import pytest
from pool_bench import Bench, engine_ids

from appliance.errors import PoolError, PrerequisiteError, UnreachableError
from appliance.model import ContainerState, Phase, RunEvent, RunEventKind
from appliance.pool import images
from appliance.pool.engine import PodmanEngine, remove_fleet
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import Catalogue, ImageSpec, load_catalogue

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]


async def test_cold_then_warm(bench: Bench) -> None:
    """A run has a container started; the next begins in that one, which is warm, and has none started."""
    pool = await bench.pool(floor={})
    cold: list[RunEvent] = []
    first = await bench.run(pool, "call", seen=cold)
    assert (first.kind, first.phase, first.result) == (RunEventKind.SUCCEEDED, Phase.COLD, {"answer": True})
    await bench.ready(pool)
    started = await engine_ids(bench.fleet)
    warm: list[RunEvent] = []
    second = await bench.run(pool, "echo", seen=warm)
    assert (second.phase, second.container) == (Phase.LOCAL_WARM, first.container)
    assert await engine_ids(bench.fleet) == started
    assert second.kind is RunEventKind.SUCCEEDED
    for begin, phase in ((cold[0], Phase.COLD), (warm[0], Phase.LOCAL_WARM)):
        assert (begin.kind, begin.phase) == (RunEventKind.STARTED, phase)
        assert begin.startup_ms is not None
        assert begin.startup_ms > 0


async def test_runs_leave_nothing(bench: Bench) -> None:
    """Files in /tmp and /dev/shm and processes that left their group are gone before the next run."""
    pool = await bench.pool(capacity=1)
    await bench.ready(pool)
    assert (await bench.run(pool, "leave")).kind is RunEventKind.SUCCEEDED
    await bench.ready(pool)
    result = (await bench.run(pool, "look", 2)).result
    assert result is not None
    assert [name for name in result["files"] if not name.startswith("run-")] == []
    assert result["processes"] == [1, result["me"]]


async def test_cancel(bench: Bench) -> None:
    """A run in a container can be cancelled, and the container serves on."""
    pool = await bench.pool(capacity=1)
    await bench.ready(pool)
    seen: list[RunEvent] = []
    task = asyncio.create_task(bench.run(pool, "sleep", seen=seen))
    async with asyncio.timeout(10):
        while not any(event.kind is RunEventKind.PROGRESS for event in seen):
            await asyncio.sleep(0.01)
    assert await pool.cancel("t/s1/1")
    final = await task
    assert final.failure is not None
    assert final.failure.code == "cancelled"
    await bench.ready(pool)
    again = await bench.run(pool, "echo", 2)
    assert again.container == final.container


async def test_killed_from_outside(bench: Bench) -> None:
    """A container that somebody kills fails its run as retryable, and is replaced."""
    pool = await bench.pool(capacity=1)
    await bench.ready(pool)
    task = asyncio.create_task(bench.run(pool, "sleep"))
    async with asyncio.timeout(10):
        while not any(each.state is ContainerState.BUSY for each in pool.containers()):
            await asyncio.sleep(0.01)
    (victim,) = await engine_ids(bench.fleet)
    engine = PodmanEngine(threads=1)
    await engine.remove(victim)
    engine.close()
    final = await task
    assert final.failure is not None
    assert (final.failure.code, final.failure.retryable) == ("pool", True)
    await bench.ready(pool)
    assert victim not in await engine_ids(bench.fleet)


async def test_adoption_after_a_kill(bench: Bench) -> None:
    """A gateway process killed in mid-run leaves its containers; its run is ended; the next start adopts them."""
    script = f"""
import asyncio, sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from appliance.model import *
from appliance.pool.pool import Pool
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue
async def main():
    async def none(*_): return []
    pool = Pool(PoolConfig(floor={{"base": 2}}, capacity=2, mode="local"), gateway="g1", fleet={bench.fleet!r},
        run_dir=Path({str(bench.folder / "run" / bench.fleet / "g1")!r}),
        data_dir=Path({str(bench.folder / "data" / bench.fleet / "g1")!r}),
        catalogue=load_catalogue([Path({str(bench.folder / "skills")!r})]),
        site=Site(), find_remote=none, on_call=none, on_change=lambda c: None)
    await pool.start()
    while sum(c.state == "ready" for c in pool.containers()) < 2:
        await asyncio.sleep(0.02)
    need = Need(image="base", cpu=0.2, memory_mb=64)
    request = RunRequest(task="t", subtask="s", attempt=1, skill="probe", need=need, params={{"do": "sleep"}})
    def tell(event):
        if event.kind == "progress":
            print("asleep", flush=True)
    await pool.run(request, await pool.select(need, allow_remote=False), tell)
asyncio.run(main())
"""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", script, stdout=asyncio.subprocess.PIPE, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    )
    try:
        assert process.stdout is not None
        async with asyncio.timeout(60):
            while b"asleep" not in (line := await process.stdout.readline()):
                assert line, "the gateway ended early"
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)
        await process.wait()
    left = set(await engine_ids(bench.fleet))
    assert len(left) == 2
    pool = await bench.pool(floor={"base": 2}, capacity=2)
    assert sum(each.state is ContainerState.READY for each in pool.containers()) == len(left)
    assert set(await engine_ids(bench.fleet)) == left
    results = [await bench.run(pool, "look", number) for number in range(4)]
    for final in results:
        assert final.phase is Phase.LOCAL_WARM
        assert final.result is not None
        assert final.result["processes"] == [1, final.result["me"]]


async def test_fleets_are_apart(bench: Bench) -> None:
    """Two fleets and two gateways on one Podman: none adopts, counts or removes what is another's."""
    other = f"{bench.fleet}-b"
    try:
        pools = [await bench.pool(), await bench.pool(gateway="g2"), await bench.pool(fleet=other)]
        for pool in pools:
            await bench.ready(pool)
        ids = [set(await engine_ids(*where)) for where in ((bench.fleet, "g1"), (bench.fleet, "g2"), (other, "g1"))]
        assert all(ids)
        assert not ids[0] & ids[1]
        assert not ids[0] & ids[2]
        await pools[0].stop(keep_containers=False)
        assert await engine_ids(bench.fleet) == []
        assert (await remove_fleet(other, volumes=True)).containers == 1
        assert set(await engine_ids(bench.fleet, "g2")) == ids[1]
        assert (await bench.run(pools[1], "echo")).kind is RunEventKind.SUCCEEDED
    finally:
        await remove_fleet(other, volumes=True)


async def test_socket_absent(bench: Bench) -> None:
    """Without an API socket the pool starts, says what is missing and how to mend it, and refuses runs."""
    pool = await bench.pool(podman_url=f"unix://{bench.folder}/none.sock")
    assert "none.sock is not there" in pool.problem
    assert "podman.socket" in pool.problem
    with pytest.raises(PoolError, match=r"none\.sock"):
        await pool.select(bench.request("echo").need, allow_remote=False)
    with pytest.raises(UnreachableError, match=r"none\.sock"):
        await images.list_images(bench.catalogue, PoolConfig(podman_url=f"unix://{bench.folder}/none.sock"))


async def test_an_image_that_is_not_built(bench: Bench) -> None:
    """A container of an image that was never built is refused with the remedy, and the image is left alone."""
    spec = bench.folder / "images" / "ghost"
    spec.mkdir(parents=True)
    (spec / "image.toml").write_text('name = "ghost"\npackages = ["python3"]\n# never built\n')
    skill = bench.folder / "skills" / "haunt"
    shutil.copytree(bench.folder / "skills" / "probe", skill)
    text = (skill / "skill.toml").read_text().replace('"probe"', '"haunt"').replace('"base"', '"ghost"')
    (skill / "skill.toml").write_text(text)
    ghost = ImageSpec(name="ghost", packages=("python3",), folder=spec)
    whole = bench.catalogue
    bench.catalogue = Catalogue(whole.domains, whole.skills, {**whole.images, "ghost": ghost})
    pool = await bench.pool(floor={"ghost": 1})
    async with asyncio.timeout(30):
        while "is not on g1" not in pool.problem:
            await asyncio.sleep(0.05)
    assert "swiftbot images build" in pool.problem


async def test_an_image_that_does_not_build(podman: Path, folder: Path) -> None:
    """A build that fails says what failed, with the end of its log and what to look at."""
    (folder / "image.toml").write_text('name = "bad"\npackages = ["no-such-package-anywhere"]\n')
    bad = ImageSpec(name="bad", packages=("no-such-package-anywhere",), folder=folder)
    lines: list[str] = []
    with pytest.raises(PrerequisiteError) as caught:
        await images.build("bad", Catalogue((), {}, {"bad": bad}), progress=lines.append)
    assert "building bad from Debian packages failed" in caught.value.message
    assert "no-such-package-anywhere" in caught.value.message
    assert "check that each of no-such-package-anywhere" in caught.value.remedy
    assert lines


async def test_images_that_are_there_are_kept(built: None) -> None:
    """Building again is a look at the list."""
    catalogue = load_catalogue()
    lines: list[str] = []
    always = [name for name, spec in catalogue.images.items() if not spec.on_demand]
    for name in always:
        assert (await images.build(name, catalogue, progress=lines.append)).startswith(f"localhost/swiftbot/{name}:")
    assert all(line.endswith("is there") for line in lines)
    there = {each.name: each for each in await images.list_images(catalogue)}
    assert all(there[name].present and there[name].size_bytes > 2**20 for name in always)
