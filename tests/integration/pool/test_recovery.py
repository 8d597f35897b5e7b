"""The pool after the worst moments, on real containers: killed in mid-start, Podman restarted, an image deleted.

What is looked for each time: runs that can end do, the pool says what is wrong, and it mends itself.
"""

import asyncio
import contextlib
import os
import secrets
import signal
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from msgspec.structs import replace
from pool_bench import HANDLER, Bench, engine_ids

from appliance.errors import PrerequisiteError, RefusedError
from appliance.model import ContainerState, Need, Phase, RunEvent, RunEventKind
from appliance.model.pool_api import EvictAsk
from appliance.pool import images
from appliance.pool.pool import Pool
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import Catalogue, ImageSpec

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

NAP = """
    if do == "nap":
        ctx.progress(0.1, "asleep")
        time.sleep(ctx.params.get("s", 3))
        return {"slept": True}
    if do == "keep":
        path = Path("/volumes/notes/lines")
        lines = path.read_text().splitlines() if path.exists() else []
        path.write_text("\\n".join([*lines, ctx.params["line"]]))
        ctx.progress(0.5, "written")
        time.sleep(ctx.params.get("s", 0))
        return {"lines": path.read_text().splitlines()}
"""
GATEWAY = """
import asyncio, os, sys
from pathlib import Path
from appliance.model import *
from appliance.model.pool_api import EvictAsk
from appliance.pool.pool import Pool
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue

async def main(fleet, folder, moment, delay_s):
    async def none(*_): return []
    floor = {"base": 4 if moment == "start" else 2}
    pool = Pool(PoolConfig(floor=floor, capacity=4, starts_at_once=4, mode="local"), gateway="g1", fleet=fleet,
        run_dir=Path(folder) / "run" / fleet / "g1", data_dir=Path(folder) / "data" / fleet / "g1",
        catalogue=load_catalogue([Path(folder) / "skills"]),
        site=Site(), find_remote=none, on_call=none, on_change=lambda c: None)
    await pool.start()
    while not pool.containers():
        await asyncio.sleep(0.005)
    if moment != "start":
        while sum(c.state == "ready" for c in pool.containers()) < 2:
            await asyncio.sleep(0.02)
    if moment == "removal":
        await pool.verbs.evict(EvictAsk(image="base"))
    if moment == "volume":
        need = Need(image="base", cpu=0.2, memory_mb=64, volumes=("notes",))
        params = {"do": "keep", "line": "one", "s": 60}
        request = RunRequest(task="t", subtask="s", attempt=1, skill="probe", need=need, params=params)
        written = asyncio.Event()
        run = asyncio.create_task(
            pool.run(request, await pool.select(need, allow_remote=False),
                     lambda event: written.set() if event.kind == "progress" else None))
        await written.wait()
    print("now", flush=True)
    await asyncio.sleep(60)

asyncio.run(main(*sys.argv[1:4], float(sys.argv[4])))
"""


@pytest.fixture
def probe() -> tuple[str, str]:
    """Return a skill that can nap, and write into a state volume of its own."""
    return HANDLER + NAP, 'volumes = ["notes"]\n'


async def _until(true: Callable[[], bool], what: str, *, within_s: float = 60.0) -> None:
    try:
        async with asyncio.timeout(within_s):
            while not true():
                await asyncio.sleep(0.02)
    except TimeoutError:
        pytest.fail(f"not within {within_s} s: {what}")


async def _command(*command: str) -> str:
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    told, _ = await process.communicate()
    assert process.returncode == 0, f"{command}: {told.decode(errors='replace')}"
    return told.decode(errors="replace")


async def _killed_gateway(bench: Bench, moment: str, delay_s: float) -> None:
    """Run a gateway's pool as a process of its own and kill it `delay_s` after a moment has come."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", GATEWAY, bench.fleet, str(bench.folder), moment, str(delay_s),
        stdout=asyncio.subprocess.PIPE, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        async with asyncio.timeout(60):
            while b"now" not in (line := await process.stdout.readline()):
                assert line, "the gateway ended early"
        await asyncio.sleep(delay_s)  # not waiting for something: the moment is what the test varies
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)
        await process.wait()


async def _whole(bench: Bench, pool: Pool, ready: int) -> None:
    """Wait until the pool is full and Podman has what is in the books, nothing more; a run works."""
    await bench.ready(pool, ready)
    async with asyncio.timeout(90):
        while len(await engine_ids(bench.fleet)) != len(pool.containers()):
            await asyncio.sleep(0.2)
    folder = bench.folder / "run" / bench.fleet / "g1"
    assert {each.name for each in folder.iterdir()} == {each.id for each in pool.containers()}
    final = await bench.run(pool, "echo", 99)
    assert (final.kind, final.phase) == (RunEventKind.SUCCEEDED, Phase.LOCAL_WARM)


@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.15, 0.3])
async def test_killed_in_the_middle_of_starts(bench: Bench, delay_s: float) -> None:
    """A gateway killed while four containers start: what runs is adopted, what is half made goes, none is left over."""
    await _killed_gateway(bench, "start", delay_s)
    pool = await bench.pool(floor={"base": 2}, capacity=4)
    await _whole(bench, pool, 2)


@pytest.mark.parametrize("delay_s", [0.0, 0.1])
async def test_killed_in_the_middle_of_removals(bench: Bench, delay_s: float) -> None:
    """A gateway killed while it removes containers: what is half removed goes, and the pool fills again."""
    await _killed_gateway(bench, "removal", delay_s)
    pool = await bench.pool(floor={"base": 2}, capacity=4)
    await _whole(bench, pool, 2)


async def test_killed_while_a_volume_changes(bench: Bench) -> None:
    """A gateway killed while a run has a state volume: the run ends, the volume keeps what was written, runs go on."""
    await _killed_gateway(bench, "volume", 0.0)
    pool = await bench.pool(floor={"base": 1}, capacity=4)
    await bench.ready(pool, 1)
    need = Need(image="base", cpu=0.2, memory_mb=64, volumes=("notes",))
    request = bench.request("keep")
    params = {"do": "keep", "line": "two"}
    final = await pool.run(
        replace(request, need=need, params=params), await pool.select(need, allow_remote=False), lambda _: None
    )
    assert final.result == {"lines": ["one", "two"]}


class Service:
    """A Podman API service of the test's own."""

    def __init__(self, path: Path) -> None:
        self.url = f"unix://{path}"
        self._path = path
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Start it and wait for its socket."""
        self._process = await asyncio.create_subprocess_exec(
            "podman", "system", "service", "--time=0", self.url,
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        await _until(self._path.is_socket, "the service's socket")

    async def kill(self) -> None:
        """Kill it; its socket stays behind as after a crash."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
            await self._process.wait()
            self._process = None


@pytest.fixture
async def service(podman: Path, folder: Path) -> AsyncIterator[Service]:
    """Return a running Podman API service, ended afterwards."""
    it = Service(folder.parent / "api.sock")
    await it.start()
    yield it
    await it.kill()


async def test_podman_restarted_in_mid_run(bench: Bench, service: Service) -> None:
    """Podman's service dies in mid-run: the run ends well, warm runs go on, and the pool heals when it is back."""
    pool = await bench.pool(floor={"base": 2}, capacity=2, podman_url=service.url, reconnect_s=0.1)
    await bench.ready(pool, 2)
    seen: list[RunEvent] = []
    run = asyncio.create_task(bench.run(pool, "nap", seen=seen))
    await _until(lambda: any(each.kind is RunEventKind.PROGRESS for each in seen), "the run")
    await service.kill()
    (idle,) = [each.id for each in pool.containers() if each.state is ContainerState.READY]
    warm = await bench.run(pool, "echo", 2)
    assert (warm.kind, warm.phase) == (RunEventKind.SUCCEEDED, Phase.LOCAL_WARM)
    await _until(
        lambda: any(each.id == idle and each.state is ContainerState.READY for each in pool.containers()), "it"
    )
    await pool.verbs.evict(EvictAsk(container=idle))
    await _until(lambda: "api.sock" in pool.problem, "the pool says that Podman is away")
    assert (await run).result == {"slept": True}
    await service.start()
    await _until(lambda: pool.problem == "", "the pool has reconnected")
    await bench.ready(pool, 2)
    async with asyncio.timeout(60):
        while len(await engine_ids(bench.fleet)) != 2:
            await asyncio.sleep(0.2)


def _own_image(bench: Bench) -> tuple[str, str, str]:
    """Have the skill `probe` run in an image of the test's own; returns its name, and how Podman calls base and it."""
    name = f"t{secrets.token_hex(4)}"
    folder = bench.folder / "images" / name
    folder.mkdir(parents=True)
    (folder / "image.toml").write_text(f'name = "{name}"\npackages = ["python3"]\n')
    skill = bench.folder / "skills" / "probe"
    (skill / "skill.toml").write_text((skill / "skill.toml").read_text().replace('"base"', f'"{name}"'))
    whole = bench.catalogue
    spec = ImageSpec(name=name, packages=("python3",), folder=folder)
    skills = {**whole.skills, "probe": replace(whole.skills["probe"], image=name)}
    bench.catalogue = Catalogue(whole.domains, skills, {**whole.images, name: spec})
    return name, images.reference(whole.images["base"], PoolConfig()), images.reference(spec, PoolConfig())


async def test_an_image_deleted_under_the_pool(bench: Bench) -> None:
    """Its warm containers serve on; then the pool says what is missing, and heals when the image is there again."""
    name, base, mine = _own_image(bench)
    await _command("podman", "tag", base, mine)
    try:
        pool = await bench.pool(floor={name: 1}, capacity=2, quarantine_s=600.0)
        await bench.ready(pool, 1)
        await _command("podman", "rmi", mine)
        need = Need(image=name, cpu=0.2, memory_mb=64)
        request = replace(bench.request("echo"), need=need)
        final = await pool.run(request, await pool.select(need, allow_remote=False), lambda _: None)
        assert (final.kind, final.phase) == (RunEventKind.SUCCEEDED, Phase.LOCAL_WARM)
        await _until(lambda: any(each.state is ContainerState.READY for each in pool.containers()), "ready again")
        await pool.verbs.evict(EvictAsk(image=name))
        await _until(lambda: f"image {mine} is not on g1" in pool.problem, "the pool says so")
        assert "swiftbot images build" in pool.problem
        with pytest.raises(RefusedError, match="is not on g1"):
            await pool.select(need, allow_remote=False)
        await _command("podman", "tag", base, mine)
        await _until(lambda: pool.problem == "", "the pool has found it")
        await bench.ready(pool, 1)
        for each in bench.pools:
            await each.stop(keep_containers=False)
    finally:
        await _command("podman", "rmi", "--ignore", mine)


async def test_an_image_removed_by_force_with_its_containers(bench: Bench) -> None:
    """A run in mid-run ends as retryable; the pool says what is missing, and heals when the image is there again."""
    name, base, mine = _own_image(bench)

    async def make() -> None:
        # Not a further name of the base's: only an image of its own is removed with its containers.
        made = (await _command("podman", "create", base, "true")).split()[-1]
        await _command("podman", "commit", "--change", f"LABEL made={name}", made, mine)
        await _command("podman", "rm", made)

    await make()
    try:
        # Nothing is started but for runs, or Podman would find the image in use again before it has removed it.
        pool = await bench.pool(floor={}, capacity=2, quarantine_s=600.0)
        need = Need(image=name, cpu=0.2, memory_mb=64)
        request = replace(bench.request("nap"), need=need, params={"do": "nap", "s": 200}, deadline_s=250.0)
        seen: list[RunEvent] = []
        run = asyncio.create_task(pool.run(request, await pool.select(need, allow_remote=False), seen.append))
        await _until(lambda: any(each.kind is RunEventKind.PROGRESS for each in seen), "the run")
        await _command("podman", "rmi", "--force", mine)
        final = await run
        assert final.failure is not None
        # Told to stop by Podman it says so itself, unless it was killed before that.
        assert final.failure.code in ("stopped", "pool")
        assert final.failure.retryable
        await _until(lambda: not pool.containers(), "it is forgotten")
        request = replace(bench.request("echo", 2), need=need)
        with pytest.raises(PrerequisiteError, match="is not on g1"):
            await pool.run(request, await pool.select(need, allow_remote=False), lambda _: None)
        assert f"image {mine} is not on g1" in pool.problem
        assert await engine_ids(bench.fleet) == []
        await make()
        await _until(lambda: pool.problem == "", "the pool has found it")
        after = await pool.run(request, await pool.select(need, allow_remote=False), lambda _: None)
        assert (after.kind, after.phase) == (RunEventKind.SUCCEEDED, Phase.COLD), after.failure
        for each in bench.pools:
            await each.stop(keep_containers=False)
    finally:
        await _command("podman", "rmi", "--ignore", mine)
