"""A pool of the benchmark's own in this process, with a skill that does as ordered: nothing, or a service time."""

import secrets
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Collection, Generator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import anyio
from msgspec import Struct

from appliance.errors import PoolError, PrerequisiteError
from appliance.model import ContainerState, Need, RunEvent, RunEventKind, RunRequest, Site
from appliance.pool.engine import ContainerSpec, Engine, PodmanEngine
from appliance.pool.pool import Call, Pool
from appliance.pool.selection import Candidate
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue


@contextmanager
def workspace(prefix: str = "swiftbot-bench-") -> Generator[Path]:
    """A new folder; it stays where it is when an error ends the benchmark, whose remedy names the logs in it."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    try:
        yield folder
    except Exception:  # the folder stays: the error names the logs in it
        raise
    except BaseException:  # cancelled by the caller
        shutil.rmtree(folder, ignore_errors=True)
        raise
    else:
        shutil.rmtree(folder, ignore_errors=True)


T = TypeVar("T")
WARM_UP_S = 60.0
PAUSE_S = 0.02
"""Between two warm runs, in all ways that are compared: each finds the last one swept up, and is alone."""
FLEET = "bench"
"""Fleets of benchmarks are called so, and have a random number behind it."""
SWEEP = "list containers"
"""What the keeper asks every half minute, whatever runs: are there containers that nobody knows?"""
PLAIN = (SWEEP, "list images")
SKILL = "bench_nothing"
_MANIFEST = """
id = "{skill}"
domain = "coordination"
summary = "Do nothing, to measure how long it takes to begin."
runs = "compute"
image = "{image}"
cpu = 0.1
memory_mb = 64
"""
_HANDLER = """
import time


def run(ctx):
    time.sleep(float(ctx.params.get("service_ms", 0.0)) / 1e3)
    return {}
"""


class WatchedEngine(PodmanEngine):
    """Podman, with an account of what was asked of it."""

    def __init__(self, url: str = "") -> None:
        super().__init__(url)
        self.requests: Counter[str] = Counter()
        """By kind: the first words of what was asked, without the container."""
        self.created: list[str] = []
        """Ids of all containers made."""

    async def _ask(self, what: str, work: Callable[[Any], T]) -> T:
        self.requests[what if what in PLAIN else what.split(" ", 1)[0]] += 1
        return await super()._ask(what, work)

    async def create(self, spec: ContainerSpec) -> str:
        """Make a container; its id is noted."""
        container = await super().create(spec)
        self.created.append(container)
        return container


def fleet_name() -> str:
    """Return the name of a fleet of the benchmark's own."""
    return f"{FLEET}-{secrets.token_hex(4)}"


def write_skill(folder: Path, image: str, *, skill: str = SKILL, handler: str = _HANDLER, more: str = "") -> Path:
    """Write a skill of the benchmark, with `more` lines in its manifest; returns the folder of skills it is in."""
    where = folder / "skills" / skill
    where.mkdir(parents=True)
    (where / "skill.toml").write_text(_MANIFEST.format(skill=skill, image=image) + more)
    (where / "handler.py").write_text(handler)
    return where.parent


def need_of(image: str) -> Need:
    """Return what the benchmark's skill asks for."""
    return Need(image=image, cpu=0.1, memory_mb=64)


@asynccontextmanager
async def pool(
    config: PoolConfig, image: str, *, make_engine: Callable[[], Engine] | None = None
) -> AsyncGenerator[Pool]:
    """A pool of its own fleet, with a skill that does nothing, gone afterwards."""

    async def nobody(need: Need, avoid: Collection[str]) -> list[Candidate]:
        del need, avoid
        return []

    async def nothing(call: Call) -> dict[str, Any]:
        raise PoolError(f"{call.name} is not served here")

    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
        skills = write_skill(Path(folder), image)
        it = Pool(
            config,
            gateway="bench",
            fleet=fleet_name(),
            run_dir=Path(folder) / "run",
            data_dir=Path(folder) / "data",
            catalogue=load_catalogue([skills]),
            site=Site(),
            find_remote=nobody,
            on_call=nothing,
            on_change=lambda _: None,
            make_engine=make_engine,
        )
        try:
            await it.start()
            if it.problem:
                raise PrerequisiteError(it.problem, remedy="swiftbot doctor tells more")
            yield it
        finally:
            await it.stop(keep_containers=False)


async def warm(it: Pool, image: str, count: int) -> None:
    """Wait until so many containers are ready.

    Raises:
        PrerequisiteError: they do not start.
    """
    until = time.monotonic() + WARM_UP_S
    while sum(each.state is ContainerState.READY and each.image == image for each in it.containers()) < count:
        if time.monotonic() > until or it.problem:
            raise PrerequisiteError(it.problem or f"{count} containers of {image} did not start in {WARM_UP_S:g} s")
        await anyio.sleep(0.02)


class Took(Struct, frozen=True, kw_only=True):
    """One run, milliseconds from asking for a container: to the handler's first line, and to its result."""

    start_ms: float
    round_trip_ms: float


async def once(it: Pool, image: str, number: int) -> Took:
    """Run the skill that does nothing once.

    Raises:
        PoolError: it did not work.
    """
    need = need_of(image)
    request = RunRequest(task="bench", subtask=f"n{number}", attempt=1, skill=SKILL, need=need, deadline_s=10.0)
    started: list[float] = []

    def note(event: RunEvent) -> None:
        if event.kind is RunEventKind.STARTED and event.startup_ms is not None:
            started.append(event.startup_ms)

    entered_ns = time.monotonic_ns()
    decision = await it.select(need, allow_remote=False)
    selected_ns = time.monotonic_ns()
    final = await it.run(request, decision, note)
    ended_ns = time.monotonic_ns()
    if final.kind is not RunEventKind.SUCCEEDED or not started:
        reason = final.failure.message if final.failure else "it never started"
        raise PoolError(f"run {number} did not work: {reason}")
    # `startup_ms` begins when the pool is asked to run; selecting belongs to it.
    return Took(start_ms=started[0] + (selected_ns - entered_ns) / 1e6, round_trip_ms=(ended_ns - entered_ns) / 1e6)
