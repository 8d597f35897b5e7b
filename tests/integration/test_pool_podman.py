"""The pool on real rootless Podman: what only real containers can show.

Runs as a user with a Podman API socket; anywhere else it fails and says why. Images that are missing are built.
"""

import asyncio
import contextlib
import getpass
import os
import secrets
import shutil
import signal
import sys
import tempfile
import textwrap
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.bench.startup import run as bench_startup
from appliance.errors import PoolError, PrerequisiteError, UnreachableError
from appliance.model import ContainerState, Need, Phase, RunEvent, RunEventKind, RunRequest, Site
from appliance.pool import images
from appliance.pool.engine import PodmanEngine, remove_fleet, socket_path
from appliance.pool.pool import Call, Pool
from appliance.pool.selection import Candidate, Decision
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import Catalogue, ImageSpec, load_catalogue

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

COLD = Decision(phase=Phase.COLD, gateway="g1")
HANDLER = """
import os, socket, time
from pathlib import Path

def attempt(work):
    try:
        work()
    except OSError as error:
        return type(error).__name__ + ": " + str(error.strerror)
    return "done"

def run(ctx):
    do = ctx.params["do"]
    if do == "echo":
        return {"robot": ctx.robot}
    if do == "call":
        return {"answer": ctx.command("goto", x=1)["blobs"]["a"] == b"\\x00\\xff"}
    if do == "sleep":
        ctx.progress(0.1, "asleep")
        time.sleep(60)
    if do == "leave":
        Path("/tmp/left").write_text("x")
        Path("/dev/shm/left").write_text("x")
        if os.fork() == 0:
            os.setsid()
            time.sleep(60)
        return {}
    if do == "look":
        return {"files": sorted(os.listdir("/tmp") + os.listdir("/dev/shm")),
                "processes": sorted(int(each) for each in os.listdir("/proc") if each.isdigit()), "me": os.getpid()}
    if do == "harden":
        lines = Path("/proc/self/status").read_text().splitlines()
        status = dict(line.split(":\\t", 1) for line in lines if ":\\t" in line)
        return {
            "root": attempt(lambda: Path("/x").write_text("x")),
            "usr": attempt(lambda: Path("/usr/x").write_text("x")),
            "skills": attempt(lambda: Path("/skills/x").write_text("x")),
            "runner": attempt(lambda: Path("/runner/x").write_text("x")),
            "tmp": attempt(lambda: Path("/tmp/x").write_text("x")),
            "fill": attempt(lambda: Path("/tmp/y").write_bytes(bytes(80 * 2**20))),
            "net": attempt(lambda: socket.create_connection(("192.0.2.1", 80), 2)),
            "interfaces": [name for _, name in socket.if_nameindex()],
            "caps": [status[key] for key in ("CapEff", "CapPrm", "CapBnd", "CapInh", "CapAmb")],
            "nnp": status["NoNewPrivs"], "seccomp": status["Seccomp"],
            "chown": attempt(lambda: os.chown("/tmp/x", 1, 1)),
            "mount": next(each[3] for each in map(str.split, open("/proc/mounts")) if each[1] == "/"),
        }
"""


@pytest.fixture(scope="module")
def podman() -> Path:
    """Return the API socket's path; fails, with the reason, where this user has no Podman."""
    try:
        path = socket_path()
    except PrerequisiteError as error:
        pytest.fail(f"{getpass.getuser()} has no Podman: {error}")
    if not path.is_socket():
        pytest.fail(f"{getpass.getuser()} has no Podman: {path} is not there; run the tests as the service user")
    return path


@pytest.fixture
def folder(podman: Path) -> Iterator[Path]:
    """Return a folder of the test's own, with a deep name: socket paths must not mind."""
    where = Path(tempfile.mkdtemp(prefix="swiftbot-test-")) / ("deep-" * 20)
    where.mkdir()
    yield where
    shutil.rmtree(where.parent, ignore_errors=True)


@pytest.fixture
def catalogue(folder: Path) -> Catalogue:
    """Return the real catalogue with one skill more, which does what it is told."""
    skill = folder / "skills" / "probe"
    skill.mkdir(parents=True)
    (skill / "handler.py").write_text(textwrap.dedent(HANDLER))
    (skill / "skill.toml").write_text(
        'id = "probe"\ndomain = "coordination"\nsummary = "A test."\nruns = "compute"\n'
        'image = "base"\ncpu = 0.2\nmemory_mb = 64\n'
    )
    return load_catalogue([skill.parent])


@pytest.fixture
async def built(podman: Path) -> None:
    """Build the images that are missing."""
    catalogue = load_catalogue()
    for name in catalogue.images:
        await images.build(name, catalogue)


class Bench:
    """Pools of one fleet of the test's own."""

    def __init__(self, folder: Path, catalogue: Catalogue) -> None:
        self.folder, self.catalogue = folder, catalogue
        self.fleet = f"test-{secrets.token_hex(4)}"
        self.pools: list[Pool] = []

    async def pool(self, *, gateway: str = "g1", fleet: str = "", **settings: Any) -> Pool:
        """Return a started pool."""

        async def nobody(need: Need) -> list[Candidate]:
            return []

        async def answer(call: Call) -> dict[str, Any]:
            return {"blobs": {"a": b"\x00\xff"}}

        fleet = fleet or self.fleet
        pool = Pool(
            PoolConfig(**{"floor": {"base": 1}, "mode": "local", "cancel_grace_s": 0.5} | settings),
            gateway=gateway,
            fleet=fleet,
            run_dir=self.folder / "run" / fleet / gateway,
            catalogue=self.catalogue,
            site=Site(),
            find_remote=nobody,
            on_call=answer,
            on_change=lambda _: None,
        )
        self.pools.append(pool)
        await pool.start()
        return pool

    @staticmethod
    async def ready(pool: Pool, count: int = 1) -> None:
        """Wait for so many ready containers."""
        async with asyncio.timeout(60):
            while sum(each.state is ContainerState.READY for each in pool.containers()) < count:
                assert not pool.problem, pool.problem
                await asyncio.sleep(0.02)

    @staticmethod
    def request(do: str, number: int = 1) -> RunRequest:
        """Return an order."""
        need = Need(image="base", cpu=0.2, memory_mb=64)
        return RunRequest(task="t", subtask=f"s{number}", attempt=1, skill="probe", need=need, params={"do": do})

    async def run(self, pool: Pool, do: str, number: int = 1, *, seen: list[RunEvent] | None = None) -> RunEvent:
        """Select and run; returns the last event."""
        request = self.request(do, number)
        decision = await pool.select(request.need, allow_remote=False)
        return await pool.run(request, decision, (seen if seen is not None else []).append)


@pytest.fixture
async def bench(built: None, folder: Path, catalogue: Catalogue) -> AsyncIterator[Bench]:
    """Return a fleet of the test's own, removed afterwards."""
    it = Bench(folder, catalogue)
    yield it
    for pool in it.pools:
        await pool.stop(keep_containers=False)
    await remove_fleet(it.fleet)


async def _engine_ids(fleet: str, gateway: str = "g1") -> list[str]:
    engine = PodmanEngine(threads=1)
    try:
        found = await engine.containers({"swiftbot.fleet": fleet, "swiftbot.gateway": gateway})
    finally:
        engine.close()
    return [each.id for each in found]


async def test_cold_then_warm(bench: Bench) -> None:
    """A run starts a container, the next finds it warm and begins at least ten times sooner."""
    pool = await bench.pool(floor={})
    cold: list[RunEvent] = []
    first = await bench.run(pool, "call", seen=cold)
    assert (first.kind, first.phase, first.result) == (RunEventKind.SUCCEEDED, Phase.COLD, {"answer": True})
    await bench.ready(pool)
    warm: list[RunEvent] = []
    second = await bench.run(pool, "echo", seen=warm)
    assert (second.phase, second.container) == (Phase.LOCAL_WARM, first.container)
    assert cold[0].startup_ms is not None
    assert warm[0].startup_ms is not None
    assert cold[0].startup_ms > 10 * warm[0].startup_ms > 0


async def test_hardening(bench: Bench) -> None:
    """Inside, nothing can be written but a bounded /tmp, there is no network, no capability and no way to any."""
    pool = await bench.pool()
    await bench.ready(pool)
    result = (await bench.run(pool, "harden")).result
    assert result is not None
    for place in ("root", "usr", "skills", "runner"):
        assert result[place] == "OSError: Read-only file system", place
    assert result["tmp"] == "done"
    assert result["fill"] == "OSError: No space left on device"
    assert "unreachable" in result["net"]
    assert result["interfaces"] == ["lo"]
    assert set(result["caps"]) == {"0000000000000000"}
    assert (result["nnp"], result["seccomp"]) == ("1", "2")
    assert "not permitted" in result["chown"]
    assert "ro" in result["mount"].split(",")


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
    (victim,) = await _engine_ids(bench.fleet)
    engine = PodmanEngine(threads=1)
    await engine.remove(victim)
    engine.close()
    final = await task
    assert final.failure is not None
    assert (final.failure.code, final.failure.retryable) == ("pool", True)
    await bench.ready(pool)
    assert victim not in await _engine_ids(bench.fleet)


async def test_adoption_after_a_kill(bench: Bench) -> None:
    """A gateway process killed in mid-run leaves its containers; its run is ended; the next start adopts them."""
    script = f"""
import asyncio, sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parent)!r})
from appliance.model import *
from appliance.pool.pool import Pool
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue
async def main():
    async def none(x): return []
    pool = Pool(PoolConfig(floor={{"base": 2}}, capacity=2, mode="local"), gateway="g1", fleet={bench.fleet!r},
        run_dir=Path({str(bench.folder / "run" / bench.fleet / "g1")!r}),
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
    left = set(await _engine_ids(bench.fleet))
    assert len(left) == 2
    pool = await bench.pool(floor={"base": 2}, capacity=2)
    assert sum(each.state is ContainerState.READY for each in pool.containers()) == len(left)
    assert set(await _engine_ids(bench.fleet)) == left
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
        ids = [set(await _engine_ids(*where)) for where in ((bench.fleet, "g1"), (bench.fleet, "g2"), (other, "g1"))]
        assert all(ids)
        assert not ids[0] & ids[1]
        assert not ids[0] & ids[2]
        await pools[0].stop(keep_containers=False)
        assert await _engine_ids(bench.fleet) == []
        assert await remove_fleet(other) == 1
        assert set(await _engine_ids(bench.fleet, "g2")) == ids[1]
        assert (await bench.run(pools[1], "echo")).kind is RunEventKind.SUCCEEDED
    finally:
        await remove_fleet(other)


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
        while "left alone" not in pool.problem:
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
    for name in catalogue.images:
        assert (await images.build(name, catalogue, progress=lines.append)).startswith(f"localhost/swiftbot/{name}:")
    assert all(line.endswith("is there") for line in lines)
    assert all(each.present and each.size_bytes > 2**20 for each in await images.list_images(catalogue))


async def test_benchmark(built: None) -> None:
    """The benchmark measures cold and warm in one run, and leaves no container."""
    result = await bench_startup(5, 1)
    assert result["local"]["count"] == 5
    assert result["cold"]["p50"] > result["local"]["p50"] > 0
    assert set(result["local"]) == {"count", "p50", "p90", "p99", "max"}
