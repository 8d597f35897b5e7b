"""Thousands of subtasks through one gateway, some of which misbehave: does anything leak?

The gateway runs in this process, whole (Zenoh, store, executor, pool), so that its descriptors, threads, tasks and
memory can be counted from within; its containers are real. Among the runs are handlers that raise, exit, are killed,
leave processes and files behind, return what is no JSON, print much, are cancelled or exceed their deadline; and now
and then a container is killed from outside. Containers are replaced after `max_runs` as ever.
"""

import asyncio
import gc
import os
import random
import tempfile
import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import psutil
from msgspec import Struct
from msgspec.structs import asdict

from appliance.config import GatewayConfig
from appliance.errors import DeadlineError, PoolError, SwiftbotError
from appliance.gateway import Gateway
from appliance.llm.settings import LlmConfig
from appliance.model import ContainerState, Need, RunEvent, RunEventKind, RunRequest, keyspace
from appliance.model.task_api import RunAsk
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import LABEL_FLEET, PodmanEngine
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from workshop.bench import pooled
from workshop.bench.figures import summary
from workshop.local_fleet import remove_containers

SAMPLES = 6
SAMPLE_S = 0.25
"""Probes and pushes come and go in between: the least of a few samples is what stays."""


class Census(Struct, frozen=True, kw_only=True):
    """Counts at one moment of rest; memory in MB."""

    runs: int = 0
    """Runs done by then."""
    containers: int = 0
    conmon: int = 0
    """Podman's monitor processes, one a container."""
    volumes: int = 0
    runner_sockets: int = 0
    """Folders with a runner's socket."""
    descriptors: int = 0
    """Open files of the process, connections among them."""
    children: int = 0
    threads: int = 0
    tasks: int = 0
    """Asyncio tasks."""
    rss_mb: float = 0.0
    podman_rss_mb: float = 0.0
    podman_descriptors: int = 0


COUNTED = ("containers", "conmon", "volumes", "runner_sockets", "descriptors", "children", "threads", "tasks")
"""What must be the same before and after."""
SLACK = {"descriptors": 4, "threads": 4, "tasks": 2}
"""Threads are made when first needed, up to a few, and Podman's have a connection each; a probe may be under way. What
leaks with every run, or with every container, is beyond it after a few hundred runs."""
GROWTH_MB = 8.0
"""Resident memory may grow by so much between a third of the way and the end: allocators keep what they once had."""


async def take(runs: int, *, fleet: str, run_dir: Path, engine: PodmanEngine) -> Census:
    """Count, when the gateway in this process rests."""
    gc.collect()
    own = psutil.Process()
    found: list[tuple[int, int, int, int]] = []
    for _ in range(SAMPLES):
        found.append(
            (
                len(os.listdir("/proc/self/fd")),  # noqa: PTH208 - counted, not opened
                len(await asyncio.to_thread(own.children)),
                own.num_threads(),
                len(asyncio.all_tasks()),
            )
        )
        await asyncio.sleep(SAMPLE_S)
    descriptors, children, threads, tasks = (min(each) for each in zip(*found, strict=True))
    service = await asyncio.to_thread(podman_service)
    return Census(
        runs=runs,
        containers=len(await engine.containers({LABEL_FLEET: fleet})),
        conmon=await asyncio.to_thread(conmons, fleet),
        volumes=await volumes(fleet),
        runner_sockets=await asyncio.to_thread(lambda: sum(1 for _ in run_dir.glob("*/runner.sock"))),
        descriptors=descriptors,
        children=children,
        threads=threads,
        tasks=tasks,
        rss_mb=round(own.memory_info().rss / 2**20, 1),
        podman_rss_mb=round(service.memory_info().rss / 2**20, 1) if service else 0.0,
        podman_descriptors=service.num_fds() if service else 0,
    )


def conmons(fleet: str) -> int:
    """Return how many monitor processes a fleet's containers have; they know their container's name."""
    count = 0
    for process in psutil.process_iter(["name", "cmdline"]):
        line: list[str] = process.info["cmdline"] or []
        count += process.info["name"] == "conmon" and any(each.startswith(f"swiftbot-{fleet}-") for each in line)
    return count


async def volumes(fleet: str) -> int:
    """Return how many volumes a fleet has."""
    process = await asyncio.create_subprocess_exec(
        "podman", "volume", "ls", "--quiet", "--filter", f"label={LABEL_FLEET}={fleet}",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    told, _ = await process.communicate()
    return len(told.split())


def podman_service() -> psutil.Process | None:
    """Return the process that serves this user's API socket, if there is one."""
    for process in psutil.process_iter(["name", "cmdline", "uids"]):
        line: list[str] = process.info["cmdline"] or []
        ours = process.info["name"] == "podman" and process.info["uids"].real == os.getuid()
        if ours and line[1:3] == ["system", "service"]:
            return process
    return None


def compare(counts: list[Census]) -> dict[str, Any]:
    """Return what leaked, by comparing the last census with the first, and whether memory is flat from a third on.

    The first one is taken after the first runs, when everything that is made once has been made.
    """
    first, last = counts[0], counts[-1]
    before, after = asdict(first), asdict(last)
    grown = {name: after[name] - before[name] for name in COUNTED}
    leaks = {name: more for name, more in grown.items() if more > SLACK.get(name, 0)}
    settled = next(each for each in counts if each.runs >= last.runs / 3)
    growth_mb = round(last.rss_mb - settled.rss_mb, 1)
    return {
        "before": before,
        "after": after,
        "leaks": leaks,
        "rss_growth_mb": growth_mb,
        "rss_growth_from_runs": settled.runs,
        "podman_rss_growth_mb": round(last.podman_rss_mb - settled.podman_rss_mb, 1),
        "flat": growth_mb <= GROWTH_MB,
    }


CONTAINERS = 4
MAX_RUNS = 100
"""A container is replaced after so many, so that ten thousand runs go through a hundred containers."""
CHECKPOINTS = 10
KILL_EVERY = 500
"""Runs after which a container is killed from outside."""
PATIENCE_S = 60.0
SKILL = "bench_soak"
_MANIFEST = 'volumes = ["bench_state"]\n'
_HANDLER = """
import os, signal, time


def run(ctx):
    do = ctx.params["do"]
    if do == "raise":
        raise ValueError("as told")
    if do == "exit":
        os._exit(3)
    if do == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if do == "leave":
        with open("/tmp/left", "wb") as file:
            file.write(bytes(2**20))
        if os.fork() == 0:
            os.setsid()
            time.sleep(60)
    if do == "garbage":
        return {"it": object()}
    if do == "print":
        for number in range(400):
            print("a line of a handler that talks a lot", number)
    if do in ("sleep", "cancel"):
        time.sleep(30)
    return {"did": do}
"""
SHARES = {
    "raise": 0.02, "exit": 0.01, "die": 0.01, "leave": 0.01, "garbage": 0.005, "print": 0.005, "cancel": 0.002,
    "sleep": 0.001,
}  # fmt: skip
"""What part of the runs does what; the rest do nothing and succeed."""
SUCCEED = frozenset({"nothing", "leave", "print"})


class _Done(Struct, frozen=True, kw_only=True):
    """How a run ended."""

    do: str
    ended: str
    """`succeeded`, `failed: <code>`, or the error its order got."""
    start_ms: float = float("inf")


async def run(
    count: int, *, at_once: int = 3, image: str = "base", seed: int = 1, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Put `count` subtasks through one gateway.

    Args:
        count: runs.
        at_once: how many are wanted at the same time (a closed loop).
        image: image of the containers.
        seed: which runs misbehave.
        progress: told each tenth.

    Returns:
        `census` (see `compare`) and all `checkpoints`; `ended`: how runs ended, by what they did;
        `unexpected`: ends that should not be; `start`: milliseconds; `runs_per_s`; `lost`: runs without an end.

    Raises:
        PrerequisiteError, PoolError: Podman or the image is not there, or the gateway never comes to rest.
    """
    generator = random.Random(seed)  # noqa: S311 - a mixture, not secrets
    names = [*SHARES, "nothing"]
    weights = [*SHARES.values(), 1.0 - sum(SHARES.values())]
    dos = generator.choices(names, weights, k=count)
    counts: list[Census] = []
    done: list[_Done] = []
    busy_s = 0.0
    async with _gateway(image) as gateway:
        soak = _Soak(gateway, image)
        try:
            await soak.rest()
            done += await soak.work([*["nothing"] * 2 * CONTAINERS, *SHARES], at_once=at_once)  # whatever is made once
            await soak.rest()
            counts.append(await soak.census(0))
            per_checkpoint = max(1, -(-count // CHECKPOINTS))
            for begin in range(0, count, per_checkpoint):
                began = time.monotonic()
                part = dos[begin : begin + per_checkpoint]
                done += await soak.work(part, at_once=at_once, kill_every=min(KILL_EVERY, count))
                busy_s += time.monotonic() - began
                await soak.rest()
                counts.append(await soak.census(begin + len(part)))
                last = counts[-1]
                progress(
                    f"{last.runs} runs, {last.runs / busy_s:.0f}/s: {last.descriptors} descriptors, "
                    f"{last.threads} threads, {last.tasks} tasks, {last.containers} containers, {last.rss_mb:.0f} MB"
                )
        finally:
            soak.close()
    return {
        "runs": count,
        "containers": CONTAINERS,
        "max_runs": MAX_RUNS,
        "killed_from_outside": soak.killed,
        "runs_per_s": round(count / busy_s, 1),
        "start": summary([each.start_ms for each in done if each.do == "nothing" and each.ended == "succeeded"]),
        "census": compare(counts),
        "checkpoints": counts,
        **_ends(done),
    }


def _ends(done: list[_Done]) -> dict[str, Any]:
    ended: dict[str, Counter[str]] = {}
    unexpected: Counter[str] = Counter()
    for each in done:
        ended.setdefault(each.do, Counter())[each.ended] += 1
        # A run in a container that is killed from outside may fail whatever it does; it must only end.
        if (each.ended == "succeeded") != (each.do in SUCCEED):
            unexpected[f"{each.do} {each.ended}"] += 1
    return {
        "ended": {do: dict(counter) for do, counter in sorted(ended.items())},
        "unexpected": dict(unexpected),
        "lost": sum(each.ended == "lost" for each in done),
    }


@asynccontextmanager
async def _gateway(image: str) -> AsyncGenerator[Gateway]:
    with tempfile.TemporaryDirectory(prefix="swiftbot-soak-") as folder:
        skills = pooled.write_skill(Path(folder), image, skill=SKILL, handler=_HANDLER, more=_MANIFEST)
        config = GatewayConfig(
            id="gw-1",
            fleet=pooled.fleet_name(),
            data_dir=f"{folder}/data",
            run_dir=f"{folder}/run",
            skills=(str(skills),),
            keep_containers=False,
            plane=PlaneConfig(listen=(f"tcp/127.0.0.1:{free_port()}",)),
            llm=LlmConfig(tiers=("rules",)),
            pool=PoolConfig(mode="local", floor={image: CONTAINERS}, capacity=CONTAINERS, max_runs=MAX_RUNS),
        )
        gateway = Gateway(config)
        await gateway.start()
        try:
            yield gateway
        finally:
            try:
                await gateway.stop()
            finally:
                await remove_containers(config.fleet, progress=lambda _: None)  # and volumes


class _Soak:
    """Orders runs of a gateway in this process and hears of their ends."""

    def __init__(self, gateway: Gateway, image: str) -> None:
        self._gateway = gateway
        self._need = Need(image=image, cpu=0.1, memory_mb=64)
        self._engine = PodmanEngine(gateway.config.pool.podman_url, threads=1)
        self._open: dict[str, tuple[asyncio.Future[str], list[float]]] = {}
        self._number = self._ended = 0
        self.killed = 0
        plane = gateway.plane
        self._closer = plane.session.subscribe_typed(keyspace.RUN_EVENT, self._take, "soak")

    def close(self) -> None:
        """Hear no more."""
        self._closer.close()
        self._engine.close()

    def _take(self, key: str, event: RunEvent | None) -> None:
        del key
        if event is None or event.subtask not in self._open:
            return
        ended, started = self._open[event.subtask]
        if event.kind is RunEventKind.STARTED and event.startup_ms is not None:
            started.append(event.startup_ms)
        elif event.kind is RunEventKind.SUCCEEDED and not ended.done():
            ended.set_result("succeeded")
        elif event.kind is RunEventKind.FAILED and not ended.done():
            ended.set_result(f"failed: {event.failure.code if event.failure else '?'}")

    async def work(self, dos: list[str], *, at_once: int, kill_every: int = 0) -> list[_Done]:
        """Run all of them, so many at a time."""
        waiting = iter(dos)
        done: list[_Done] = []

        async def worker() -> None:
            for do in waiting:
                done.append(await self._one(do))
                self._ended += 1
                if kill_every and self._ended % kill_every == 0:
                    await self._kill_one()

        async with asyncio.TaskGroup() as group:
            for _ in range(at_once):
                group.create_task(worker())
        return done

    async def _one(self, do: str) -> _Done:
        self._number += 1
        name = f"s{self._number}"
        ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        started: list[float] = []
        self._open[name] = (ended, started)
        request = RunRequest(
            task="soak", subtask=name, attempt=1, skill=SKILL, need=self._need, params={"do": do},
            deadline_s=0.3 if do == "sleep" else 20.0,
        )  # fmt: skip
        try:
            async with asyncio.timeout(PATIENCE_S):
                await self._gateway.executor.run(request)
                if do == "cancel":
                    await asyncio.sleep(0.05)
                    await self._gateway.executor.cancel(RunAsk(task="soak", subtask=name, attempt=1))
                end = await ended
        except TimeoutError:
            end = "lost"
        except SwiftbotError as error:
            end = f"refused: {error.code}"
        finally:
            del self._open[name]
        return _Done(do=do, ended=end, start_ms=started[0] if started else float("inf"))

    async def _kill_one(self) -> None:
        """Remove a container behind the gateway's back."""
        found = await self._engine.containers({LABEL_FLEET: self._gateway.config.fleet})
        running = [each for each in found if each.running]
        if running:
            await self._engine.remove(running[self._number % len(running)].id)
            self.killed += 1

    async def rest(self) -> None:
        """Wait until nothing runs and the pool is full again.

        Raises:
            PoolError: the pool has a problem.
            DeadlineError: it does not come to rest.
        """
        until = time.monotonic() + PATIENCE_S
        while True:
            containers = self._gateway.pool.containers()
            ready = sum(each.state is ContainerState.READY for each in containers)
            if ready == len(containers) == CONTAINERS and self._gateway.executor.running == 0:
                found = await self._engine.containers({LABEL_FLEET: self._gateway.config.fleet})
                if len(found) == CONTAINERS:
                    return
            if time.monotonic() > until:
                states = Counter(each.state.value for each in containers)
                raise DeadlineError(f"the pool does not come to rest: {dict(states)}, {len(containers)} containers")
            if self._gateway.pool.problem:
                raise PoolError(self._gateway.pool.problem, remedy="swiftbot doctor tells more")
            await asyncio.sleep(0.1)

    async def census(self, runs: int) -> Census:
        """Count what there is."""
        config = self._gateway.config
        return await take(runs, fleet=config.fleet, run_dir=Path(config.run_dir), engine=self._engine)
