"""What training in a warm container costs, and what rounds of it come to: real training in virtual time.

Clients take turns in one container, as if each had a machine of its own: a round then takes as long as its slowest
client trains, whatever this machine has to do besides. Training, sums and judgement are the product's own handlers, on
a stand-in of clips.

Memory of the container, all its processes together, is as the kernel counts it: `private` is what they have written,
`files` what is mapped from the image, which all containers of it share.
"""

import hashlib
import tempfile
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import anyio

from appliance.errors import PoolError, PrerequisiteError
from appliance.learn.datasets.make import Clips, make_clips
from appliance.model import ContainerInfo, ContainerState, Need, RunEvent, RunEventKind, RunRequest, Site
from appliance.model.pool_api import EvictAsk
from appliance.pool import images
from appliance.pool.pool import Call, Pool
from appliance.pool.selection import Candidate
from appliance.pool.settings import PoolConfig
from appliance.skills._lib.learning.weights import WEIGHT_UNIT
from appliance.skills.catalogue import Catalogue, load_catalogue
from workshop.bench.figures import summary
from workshop.bench.pooled import SKILL, fleet_name, need_of, write_skill

IMAGE = "learn"
START_S = 300.0
REST_S = 0.1
"""Between two runs: the child of the next is forked ahead meanwhile."""
HANDLER = """
from pathlib import Path


def run(ctx):
    total = {"Pss_Anon": 0, "Pss_File": 0}
    for file in Path("/proc").glob("[0-9]*/smaps_rollup"):
        for line in file.read_text().splitlines()[1:]:
            name, _, value = line.partition(":")
            if name in total:
                total[name] += int(value.split()[0])
    return total
"""
Progress = Callable[[str], None]


class Trainer:
    """A pool with containers that train; files of its handlers are kept in memory.

    Args:
        pool: the pool.
        catalogue: its skills.
        rest_s: before each run; with several runs at a time none is needed.
    """

    def __init__(self, pool: Pool, catalogue: Catalogue, *, rest_s: float = REST_S) -> None:
        self.pool = pool
        self._rest_s = rest_s
        self.files: dict[str, bytes] = {}
        self.peak_mb: dict[str, float] = {}
        """By skill: the most memory that a run of it held, what it shares with the container included."""
        self._catalogue = catalogue
        self._runs = 0

    async def call(self, call: Call) -> dict[str, Any]:
        """Keep and return files."""
        if call.name == "get_artifact":
            return {"data": self.files[call.args["ref"]["artifact"]]}
        if call.name != "put_artifact":
            raise PoolError(f"{call.name} is not served here")
        data: bytes = call.args["data"]
        digest = hashlib.sha256(data).hexdigest()
        self.files[digest] = data
        return {"artifact": digest, "name": call.args["name"], "bytes": len(data), "gateway": "bench"}

    async def run(self, skill: str, **params: Any) -> tuple[dict[str, Any], RunEvent]:
        """Run a skill; returns its result and its first event, which has the time of its start.

        Raises:
            PoolError: it failed, with the reason.
        """
        self._runs += 1
        manifest = self._catalogue.skills.get(skill)
        need = need_of(IMAGE)
        if manifest is not None and skill != SKILL:
            need = Need(image=IMAGE, cpu=manifest.cpu, memory_mb=manifest.memory_mb)
        request = RunRequest(
            task="bench", subtask=f"n{self._runs}", attempt=1, skill=skill, need=need, params=params, deadline_s=3600.0
        )
        started: list[RunEvent] = []

        def note(event: RunEvent) -> None:
            if event.kind is RunEventKind.STARTED:
                started.append(event)

        await anyio.sleep(self._rest_s)
        final = await self.pool.run(request, await self.pool.select(need, allow_remote=False), note)
        if final.kind is not RunEventKind.SUCCEEDED or final.result is None or not started:
            raise PoolError(f"{skill}: {final.failure.message if final.failure else 'it never started'}")
        self.peak_mb[skill] = max(self.peak_mb.get(skill, 0.0), final.peak_mb or 0.0)
        return final.result, started[0]


async def run(
    model: str = "clips",
    clients: int = 16,
    rounds: int = 40,
    *,
    by: str = "dirichlet:0.5",
    every: int = 10,
    seed: int = 1,
    data: Clips | None = None,
    progress: Progress = lambda _: None,
) -> dict[str, Any]:
    """Measure a container that trains, then train for some rounds.

    Args:
        model: what is trained; the data are clips.
        clients: how many train in each round.
        rounds: how many.
        by: how the data are shared out.
        every: after how many rounds the model is judged, on sites that no client has.
        seed: of the run and its data.
        data: sizes of the stand-in.
        progress: told what is being done.

    Returns:
        `image_mb`; `cold_ms`, first (rehearsed) and again; `container_mb` (`private`, and `files`, which containers
        share); `start_ms` of warm runs; `first_step_ms` from the handler's first line; `epoch_ms` and `samples_s`;
        `round_ms` in virtual time; `aggregate_ms`; `peak_mb` by skill; `accuracy` by round; `update_bytes`.

    Raises:
        PoolError, PrerequisiteError, UnreachableError: the image is not built, a container does not start, a run fails.
    """
    state = {each.name: each for each in await images.list_images(load_catalogue())}[IMAGE]
    if not state.present:
        raise PrerequisiteError(f"{state.reference} is not there", remedy="swiftbot images build learn")
    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as scratch:
        folder = Path(scratch)
        progress("drawing clips")
        await anyio.to_thread.run_sync(make_clips, folder / "learning" / "clips", data or Clips(seed=seed))
        result: dict[str, Any] = {"model": model, "clients": clients, "by": by}
        result["image_mb"] = round(state.size_bytes / 2**20)
        catalogue = load_catalogue([write_skill(folder, IMAGE, handler=HANDLER)])
        trainer = await open_trainer(folder, catalogue, data=folder / "learning")
        try:
            progress("starting containers")
            result["cold_ms"] = await _starts(trainer.pool)
            kept, _ = await trainer.run(SKILL)
            result["container_mb"] = {
                name: round(kept[key] / 1024, 1) for name, key in (("private", "Pss_Anon"), ("files", "Pss_File"))
            }
            result |= await _rounds(trainer, model, clients, rounds, by=by, every=every, seed=seed, progress=progress)
            result["peak_mb"] = trainer.peak_mb
        finally:
            await trainer.pool.stop(keep_containers=False)
    return result


async def open_trainer(
    folder: Path, catalogue: Catalogue, *, data: Path, containers: int = 1, rest_s: float = REST_S
) -> Trainer:
    """Return a trainer whose containers are being started; the caller stops its pool.

    Args:
        folder: of the pool: what was decoded is kept there, and found again.
        catalogue: its skills.
        data: folder of data sets.
        containers: how many.
        rest_s: as of `Trainer`.
    """

    async def nobody(need: Need, avoid: Collection[str]) -> list[Candidate]:
        del need, avoid
        return []

    async def call(asked: Call) -> dict[str, Any]:
        return await trainer.call(asked)

    pool = Pool(
        PoolConfig(floor={IMAGE: containers}, capacity=containers + 1, mode="local", folders={"learning": str(data)}),
        gateway="bench",
        fleet=fleet_name(),
        run_dir=folder / "run",
        data_dir=folder / "data",
        catalogue=catalogue,
        site=Site(),
        find_remote=nobody,
        on_call=call,
        on_change=lambda _: None,
    )
    trainer = Trainer(pool, catalogue, rest_s=rest_s)
    await pool.start()
    return trainer


async def _starts(pool: Pool) -> dict[str, float]:
    """Start a container as one that was never seen, then another; returns how long each took."""
    first = await _ready(pool)
    await pool.verbs.evict(EvictAsk(container=first.id))
    again = await _ready(pool, besides=first.id)
    return {"first": round(first.cold_ms or 0.0), "again": round(again.cold_ms or 0.0)}


async def _ready(pool: Pool, *, besides: str = "") -> ContainerInfo:
    """Return a container that is ready, besides one of that id."""
    until = time.monotonic() + START_S
    while True:
        for each in pool.containers():
            if each.state is ContainerState.READY and each.id != besides:
                return each
        if time.monotonic() > until or pool.problem:
            raise PrerequisiteError(pool.problem or f"no container of {IMAGE} started in {START_S:g} s")
        await anyio.sleep(0.05)


async def _rounds(
    trainer: Trainer, model: str, clients: int, rounds: int, *, by: str, every: int, seed: int, progress: Progress
) -> dict[str, Any]:
    base: dict[str, Any] | None = None
    starts: list[float] = []
    first_steps: list[float] = []
    epochs: list[float] = []
    round_ms: list[float] = []
    sums: list[float] = []
    accuracy: dict[str, float] = {}
    samples = seconds = 0.0
    update_bytes = 0
    for number in range(rounds):
        updates: list[dict[str, Any]] = []
        slowest = 0.0
        for client in range(clients):
            told, started = await trainer.run(
                "train_local", run="bench", round=number, client=f"c{client}", model=model, base=base, seed=seed,
                data={"name": "clips"}, part={"by": by, "index": client, "of": clients},
            )  # fmt: skip
            samples, seconds = samples + told["samples"], seconds + told["train_s"]
            slowest = max(slowest, told["train_s"])
            epochs.append(told["train_s"] * 1e3)
            if number:  # in the first round data are decoded
                starts.append(started.startup_ms or 0.0)
                first_steps.append(told["first_step_s"] * 1e3)
            update_bytes = sum(each["bytes"] for each in told["shards"])
            update = {"manifest": told["manifest"], "shards": told["shards"]}
            updates.append({"client": f"c{client}", "weight": told["samples"] * WEIGHT_UNIT, **update})
        began = time.monotonic()
        made, _ = await trainer.run(
            "aggregate", run="bench", round=number, model=model, base=base, updates=updates, seed=seed
        )
        sums.append((time.monotonic() - began - REST_S) * 1e3)
        round_ms.append(slowest * 1e3)
        base = {"manifest": made["manifest"], "shards": made["shards"]}
        if (number + 1) % every == 0 or number + 1 == rounds:
            judged, _ = await trainer.run("evaluate", model=model, base=base, data={"name": "clips"}, seed=seed)
            accuracy[str(number + 1)] = round(judged["accuracy"], 4)
            progress(f"round {number + 1}: accuracy {judged['accuracy']:.3f} on {judged['items']} clips of other sites")
    return {
        "start_ms": summary(starts),
        "first_step_ms": summary(first_steps),
        "epoch_ms": summary(epochs),
        "samples_s": round(samples / max(1e-6, seconds), 1),
        "round_ms": summary(round_ms),
        "aggregate_ms": summary(sums),
        "update_bytes": update_bytes,
        "accuracy": accuracy,
    }
