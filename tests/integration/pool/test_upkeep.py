"""What becomes of containers over their lives, on real Podman: modes, replacement, quarantine, drain, lack of memory.

And what a warm start is made of: one message on a connection that is there, nothing of Podman's, no other thread.
"""

import asyncio
import io
import secrets
import tarfile
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace
from pool_bench import HANDLER, Bench, engine_ids

from appliance.errors import RefusedError
from appliance.model import ContainerState, Need, Phase, RunEvent, RunEventKind
from appliance.model.pool_api import DecisionsAsk, ReleaseAsk
from appliance.pool import images, manager
from appliance.pool.container import Connection, PooledContainer
from appliance.pool.engine import PodmanEngine
from appliance.pool.pool import Pool
from appliance.pool.pressure import Reading
from appliance.pool.settings import PoolConfig, PressureConfig
from appliance.skills.catalogue import Catalogue, ImageSpec

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

GROWING = (
    HANDLER
    + """
    if do == "grow":
        (ctx.volume("notes") / "grow").touch()
        return {}

import threading

KEPT = []

def grow():
    while not Path("/volumes/notes/grow").exists():
        time.sleep(0.01)
    KEPT.append(b"x" * (96 * 2**20))

threading.Thread(target=grow, daemon=True).start()
"""
)


@pytest.fixture
def probe(request: pytest.FixtureRequest) -> tuple[str, str]:
    """Return the skill of all tests, or what a test says itself."""
    return getattr(request, "param", (HANDLER, ""))


async def until(true: Callable[[], bool], what: str) -> None:
    """Wait for something, generously; fails with what it was."""
    try:
        async with asyncio.timeout(90):
            while not true():
                await asyncio.sleep(0.02)
    except TimeoutError:
        pytest.fail(f"not within 90 s: {what}")


async def gone(bench: Bench, containers: int) -> None:
    """Wait until Podman has so many containers of the fleet and no more."""
    async with asyncio.timeout(90):
        while len(await engine_ids(bench.fleet)) != containers:
            await asyncio.sleep(0.1)


async def whys(pool: Pool, what: str) -> list[str]:
    """Return why containers were started or retired, newest first."""
    told = await pool.verbs.decisions(DecisionsAsk())
    return [each.why for each in told.decisions if each.what == what]


# --- what a warm start is made of ---------------------------------------------------------------------------------


async def test_a_warm_start_is_one_message(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """From selection to the handler's first line: one frame on a kept connection, no Podman, no other thread."""
    for name in ("SWEEP_S", "FIRST_SWEEP_S"):
        monkeypatch.setattr(manager, name, 1e9)  # what comes by the clock is nobody's start
    pool = await bench.pool(capacity=1, probe_s=1e9, pressure=PressureConfig(watch=False))
    await bench.ready(pool)
    seen: Counter[str] = Counter()

    def count(owner: type, name: str) -> None:
        real = getattr(owner, name)

        def counted(*args: Any, **more: Any) -> Any:
            seen[name] += 1
            return real(*args, **more)

        monkeypatch.setattr(owner, name, counted)

    count(type(asyncio.get_running_loop()), "run_in_executor")
    count(PodmanEngine, "_ask")
    count(Connection, "send")
    count(PooledContainer, "_open")
    for number in range(20):
        await bench.ready(pool)
        seen.clear()
        at_start: list[dict[str, int]] = []
        request = bench.request("echo", number)
        decision = await pool.select(request.need, allow_remote=False)
        final = await pool.run(
            request,
            decision,
            lambda event, told=at_start: told.append(dict(seen)) if event.kind is RunEventKind.STARTED else None,
        )
        assert (final.kind, final.phase) == (RunEventKind.SUCCEEDED, Phase.LOCAL_WARM)
        assert at_start == [{"send": 1}]
        await bench.ready(pool)
        assert dict(seen) == {"send": 1, "_open": 1}, "the connection of the next one is opened after the run"


# --- the baselines ------------------------------------------------------------------------------------------------


async def test_mode_cold(bench: Bench) -> None:
    """Each run has a container of its own, which is gone afterwards; nothing is started ahead, whatever the floor."""
    pool = await bench.pool(mode="cold", floor={"base": 2})
    finals = [await bench.run(pool, "echo", number) for number in range(2)]
    assert {each.phase for each in finals} == {Phase.COLD}
    assert len({each.container for each in finals}) == 2
    await until(lambda: not pool.containers(), "all are given up")
    await gone(bench, 0)


async def test_mode_local(bench: Bench) -> None:
    """The paper's: what was started is used again, and beside the floor nothing is started ahead."""
    pool = await bench.pool(mode="local", floor={})
    first = await bench.run(pool, "echo")
    assert first.phase is Phase.COLD
    await bench.ready(pool)
    second = await bench.run(pool, "echo", 2)
    assert (second.phase, second.container) == (Phase.LOCAL_WARM, first.container)
    assert await whys(pool, "start") == ["a run waits for it"]


# --- replacement --------------------------------------------------------------------------------------------------


async def test_replaced_after_so_many_runs(bench: Bench) -> None:
    """A container that has had its runs goes, another takes its place, and no run is lost between them."""
    pool = await bench.pool(capacity=1, max_runs=3)
    containers: list[str] = []
    for number in range(7):
        await bench.ready(pool)
        final = await bench.run(pool, "echo", number)
        assert final.kind is RunEventKind.SUCCEEDED, final.failure
        containers.append(final.container)
    assert [containers.count(each) for each in dict.fromkeys(containers)] == [3, 3, 1]
    assert await whys(pool, "retire") == ["it has had 3 runs"] * 2
    await gone(bench, 1)


@pytest.mark.parametrize("probe", [(GROWING, 'volumes = ["notes"]\n')], indirect=True)
async def test_replaced_when_it_has_grown(bench: Bench) -> None:
    """A container whose runner takes more and more for itself goes after a run, with the reason."""
    pool = await bench.pool(capacity=1, max_growth_mb=48.0, probe_s=0.2)
    await bench.ready(pool)
    first = await bench.run(pool, "grow")
    assert first.kind is RunEventKind.SUCCEEDED, first.failure
    number, last = 1, first
    async with asyncio.timeout(90):
        while last.container == first.container:  # until its probe has seen it
            await bench.ready(pool)
            number += 1
            last = await bench.run(pool, "echo", number)
            assert last.kind is RunEventKind.SUCCEEDED, last.failure
    assert any("its runner has grown by" in each for each in await whys(pool, "retire"))


# --- an image that does not start ---------------------------------------------------------------------------------


async def podman(*command: str, stdin: bytes = b"") -> str:
    """Run the command `podman` and return what it said."""
    process = await asyncio.create_subprocess_exec(
        "podman", *command,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    told, _ = await process.communicate(stdin)
    assert process.returncode == 0, told.decode(errors="replace")
    return told.decode().strip()


async def test_an_image_that_keeps_failing_is_left_alone(bench: Bench) -> None:
    """Without Python it is started thrice in vain, then no more, with the reason; mended and released it serves."""
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
    base, mine = (images.reference(each, PoolConfig()) for each in (whole.images["base"], spec))
    empty = io.BytesIO()
    with tarfile.open(fileobj=empty, mode="w") as file:
        file.addfile(tarfile.TarInfo("nothing"))
    await podman("import", "-", mine, stdin=empty.getvalue())
    broken = await podman("image", "inspect", "--format", "{{.Id}}", mine)
    try:
        pool = await bench.pool(floor={name: 1, "base": 1}, quarantine_s=3600.0)
        await until(lambda: f"3 starts of image {name} failed" in pool.problem, "it is left alone")
        assert "python3" in pool.problem, "the reason is shown"
        need = Need(image=name, cpu=0.2, memory_mb=64)
        with pytest.raises(RefusedError, match=f"3 starts of image {name} failed"):
            await pool.select(need, allow_remote=False)
        assert len(await whys(pool, "fail")) == 3, "no further start in vain"
        await until(
            lambda: any(c.state is ContainerState.READY and c.image == "base" for c in pool.containers()),
            "the other image is not concerned",
        )
        await podman("tag", base, mine)
        released = await pool.verbs.release_quarantine(ReleaseAsk(image=name))
        assert "python3" in released.reason
        await until(
            lambda: any(c.state is ContainerState.READY and c.image == name for c in pool.containers()), "it serves"
        )
        final = await pool.run(
            replace(bench.request("echo"), need=need), await pool.select(need, allow_remote=False), lambda _: None
        )
        assert (final.kind, final.phase) == (RunEventKind.SUCCEEDED, Phase.LOCAL_WARM)
        await until(lambda: pool.problem == "", "all is well")
        await gone(bench, 2)
        await pool.stop(keep_containers=False)
    finally:
        await podman("rmi", "--ignore", mine, broken)  # it has lost its name to the one that mends it


# --- drain, and memory --------------------------------------------------------------------------------------------


async def test_drain_with_a_deadline(bench: Bench) -> None:
    """Draining takes nothing new, lets what ends in time end, and cancels the rest at the deadline."""
    pool = await bench.pool(floor={"base": 2}, capacity=2)
    await bench.ready(pool, 2)
    seen: list[RunEvent] = []
    endless = asyncio.create_task(bench.run(pool, "sleep", 1, seen=seen))
    await until(lambda: any(each.kind is RunEventKind.PROGRESS for each in seen), "it runs")
    quick = asyncio.create_task(bench.run(pool, "call", 2))
    await until(lambda: quick.done() or sum(c.state is ContainerState.BUSY for c in pool.containers()) == 2, "both run")
    await pool.drain(1.0)
    assert (await quick).kind is RunEventKind.SUCCEEDED
    final = await endless
    assert final.failure is not None
    assert final.failure.code == "cancelled"
    with pytest.raises(RefusedError, match="draining"):
        await pool.select(bench.request("echo").need, allow_remote=False)


async def test_memory_runs_short(bench: Bench) -> None:
    """The kernel says that memory is short: idle containers go, one that works stays, and they come back afterwards."""
    says = Reading(available_mb=8192.0, some=0.0)
    marks = PressureConfig(every_s=0.05, settle_s=0.1, calm_s=0.5, least_mb=256)
    pool = await bench.pool(
        floor={"base": 3}, capacity=4, memory_mb=1024, pressure=marks, read_memory=lambda: says, cancel_grace_s=2.0
    )
    await bench.ready(pool, 3)
    seen: list[RunEvent] = []
    working = asyncio.create_task(bench.run(pool, "sleep", seen=seen))
    await until(lambda: any(each.kind is RunEventKind.PROGRESS for each in seen), "it runs")
    says = Reading(available_mb=10.0, some=40.0)
    await until(lambda: len(pool.containers()) == 1, "the idle ones are given up")
    await gone(bench, 1)
    assert "40 % of the last 10 s" in pool.squeeze
    assert not working.done()
    assert "the budget has shrunk" in await whys(pool, "retire")
    says = Reading(available_mb=8192.0, some=0.0)
    assert await pool.cancel("t/s1/1")
    assert (await working).kind is RunEventKind.FAILED
    await bench.ready(pool, 3)
    await until(lambda: not pool.squeeze, "all is well again")
