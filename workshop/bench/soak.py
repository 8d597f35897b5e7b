"""Thousands of subtasks through one gateway, some of which misbehave: does anything leak?

The gateway runs in this process, whole (Zenoh, store, executor, pool), so that its descriptors, threads, tasks and
memory can be counted from within; its containers are real. Among the runs are handlers that raise, exit, are killed,
leave processes and files behind, return what is no JSON, print much, are cancelled or exceed their deadline; and now
and then a container is killed from outside. Containers are replaced after `max_runs` as ever.
"""

import asyncio
import random
import tempfile
import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from msgspec import Struct

from appliance.config import GatewayConfig
from appliance.errors import DeadlineError, PoolError, SwiftbotError
from appliance.gateway import Gateway
from appliance.llm.settings import LlmConfig
from appliance.model import ContainerState, Need, RunEvent, RunEventKind, RunRequest
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import LABEL_FLEET, PodmanEngine
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from appliance.tasks.api import RunAsk
from workshop.bench import census, pooled
from workshop.bench.figures import summary
from workshop.local_fleet import remove_containers

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
        `census` (see `census.compare`) and all `checkpoints`; `ended`: how runs ended, by what they did;
        `unexpected`: ends that should not be; `start`: milliseconds; `runs_per_s`; `lost`: runs without an end.

    Raises:
        PrerequisiteError, PoolError: Podman or the image is not there, or the gateway never comes to rest.
    """
    generator = random.Random(seed)  # noqa: S311 - a mixture, not secrets
    names = [*SHARES, "nothing"]
    weights = [*SHARES.values(), 1.0 - sum(SHARES.values())]
    dos = generator.choices(names, weights, k=count)
    counts: list[census.Census] = []
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
        "census": census.compare(counts),
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
        self._closer = plane.session.subscribe_typed(plane.keys.run("soak"), RunEvent, self._take)

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

    async def census(self, runs: int) -> census.Census:
        """Count what there is."""
        config = self._gateway.config
        return await census.take(runs, fleet=config.fleet, run_dir=Path(config.run_dir), engine=self._engine)
