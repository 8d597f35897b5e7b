"""Flower on the same work: same model, training loop, samples and machine, no emulation of devices.

It lives in an environment of its own (`make flower`, 5 GB: PyTorch with what it drags in). Simulated, its clients are
Ray actors of one machine; deployed, they are a process each that starts another one for every message. Only clips: its
environment has no decoder for recordings.
"""

import asyncio
import contextlib
import io
import json
import os
import shutil
import signal
import sys
import time
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from statistics import median
from typing import Any

import anyio
import anyio.to_thread
import numpy as np
import psutil
from numpy.typing import NDArray
from PIL import Image

from appliance.errors import DeadlineError, PoolError, PrerequisiteError
from appliance.ports import free_port
from appliance.skills._lib.learning import loading, partition
from appliance.skills._lib.learning.seeds import seed as derive
from workshop.bench.learning.virtual import BY
from workshop.bench.pooled import workspace

Progress = Callable[[str], None]
REMEDY = "make flower, or SWIFTBOT_FLOWER_PYTHON=a Python that has flwr and torch"
PATIENCE_S = 900.0
"""For one round: a deployed one takes 2 minutes with 16 clients."""
GRACE_S = 10.0
SEED = 1
_SIDE = Path(__file__).with_name("flower_side")
_SKILLS = Path(loading.__file__).parents[2]
_PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "flowerbench"
version = "1.0.0"
license = { file = "LICENSE" }
dependencies = []

[tool.flwr.app]
publisher = "swiftbot"

[tool.flwr.app.components]
serverapp = "flowerbench.app:server"
clientapp = "flowerbench.app:client"

[tool.flwr.app.config]
"""
_JPEG = b"\xff\xd8\xff"


def find_python() -> Path | None:
    """Return a Python that has Flower: as told by SWIFTBOT_FLOWER_PYTHON, or that of `make flower`."""
    told = os.environ.get("SWIFTBOT_FLOWER_PYTHON", "")
    if told:
        return Path(told)
    prefix = Path(sys.prefix)
    for folder in (prefix.parent / "flower", prefix / ".flower", prefix.parent / ".flower"):
        if (folder / "bin" / "flower-superlink").exists() and (folder / "bin" / "python").exists():
            return folder / "bin" / "python"
    return None


async def run(settings: Mapping[str, Any], data: Path, held: Sequence[int], progress: Progress) -> dict[str, Any]:
    """Measure rounds of Flower.

    Returns:
        `version`, `round_s` of each round, `first_s`, `later_p50_s`, `train_s` (the longest epoch of each round),
        `replies` of each, `peak_mb` (what all its processes held together, shared pages counted once for each).

    Raises:
        PrerequisiteError: it is not installed.
        PoolError, DeadlineError: it did not work; the message has the end of its log.
    """
    python = find_python()
    if python is None:
        raise PrerequisiteError("Flower is not installed", remedy=REMEDY)
    clients, rounds = int(settings["clients"]), int(settings["rounds"])
    with workspace() as folder:
        await anyio.to_thread.run_sync(write_samples, data, folder / "data", clients)
        told = folder / "rounds.jsonl"
        side = {
            "skills": str(_SKILLS), "data": str(folder / "data"), "model": str(settings["workload"]),
            "clients": clients, "rounds": rounds, "seed": SEED, "told": str(told),
        }  # fmt: skip
        await anyio.Path(folder / "settings.json").write_text(json.dumps(side))
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
        environment |= {
            "SWIFTBOT_FLOWER": str(folder / "settings.json"), "FLWR_TELEMETRY_ENABLED": "0",
            "FLWR_HOME": str(folder / "flwr"), "RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1",
            "PATH": f"{python.parent}:{os.environ.get('PATH', '')}", "HOME": str(folder),
        }  # fmt: skip
        way = _simulated if settings["way"] == "simulation" else _deployed
        async with way(python, folder, clients, environment) as processes:
            peak_mb = await _followed(processes, told, rounds, progress, folder)
        lines = [json.loads(line) for line in (await anyio.Path(told).read_text()).splitlines()]
    took = [round(float(line["took_s"]), 3) for line in lines]
    return {
        "way": settings["way"],
        "held": list(held),
        "round_s": took,
        "first_s": took[0],
        "later_p50_s": round(median(took[1:] or took), 3),
        "replies": [line["replies"] for line in lines],
        "train_s": [round(max(line["train_s"], default=0.0), 3) for line in lines],
        "peak_mb": round(peak_mb),
    }


def write_samples(data: Path, target: Path, clients: int) -> None:
    """Write a file for each client with its clips, (n, 16, 40, 40) of uint8, and their classes."""
    target.mkdir(parents=True)
    listing = loading.read(data, "train")
    parts = partition.split(listing.items, by=BY, of=clients, seed=derive(SEED, 0, "", "partition"))
    for number, part in enumerate(parts):
        items = [listing.items[int(index)] for index in part]
        arrays = np.stack([_pictures(listing.folder / item.path) for item in items])
        targets = np.array([listing.classes.index(item.label) for item in items])
        np.savez(target / f"{number}.npz", arrays=arrays, targets=targets, classes=len(listing.classes))


def _pictures(path: Path) -> NDArray[np.uint8]:
    """Return the pictures of a drawn clip, which is Motion JPEG; other codecs need a decoder that is not here."""
    starts = path.read_bytes().split(_JPEG)[1:]
    if not starts:
        raise PoolError(f"{path} is no Motion JPEG", remedy="compare with Flower on the drawn clips")
    side = (loading.SIDE, loading.SIDE)
    found = [np.asarray(Image.open(io.BytesIO(_JPEG + each)).convert("L").resize(side)) for each in starts]
    return np.stack([found[at] for at in loading.spread(len(found), loading.FRAMES)])


@asynccontextmanager
async def _simulated(
    python: Path, folder: Path, clients: int, environment: Mapping[str, str]
) -> AsyncGenerator[list[asyncio.subprocess.Process]]:
    del clients
    processes = [await _spawn(folder / "simulation.log", environment, str(python), "-P", str(_SIDE / "app.py"))]
    try:
        yield processes
    finally:
        await _end(processes)


@asynccontextmanager
async def _deployed(
    python: Path, folder: Path, clients: int, environment: Mapping[str, str]
) -> AsyncGenerator[list[asyncio.subprocess.Process]]:
    """A SuperLink, a SuperNode for each client, and the command that starts the run."""
    port, bins = free_port(), python.parent
    app = folder / "app"
    await anyio.to_thread.run_sync(_write_app, app)
    home = folder / "flwr"
    home.mkdir()
    (home / "config.toml").write_text(
        f'[superlink]\ndefault = "here"\n\n[superlink.here]\naddress = "127.0.0.1:{port}"\ninsecure = true\n'
    )
    processes: list[asyncio.subprocess.Process] = []
    try:
        link = (str(bins / "flower-superlink"), "--insecure", "--host", "127.0.0.1", "--port", str(port),
                "--disable-runtime-dependency-installation")  # fmt: skip
        processes.append(await _spawn(folder / "superlink.log", environment, *link))
        await _listens(port, processes[0], folder / "superlink.log")
        for number in range(clients):
            node = (str(bins / "flower-supernode"), "--insecure", "--superlink", f"127.0.0.1:{port}",
                    "--port", str(free_port()), "--node-config",
                    f"partition-id={number} num-partitions={clients}")  # fmt: skip
            processes.append(await _spawn(folder / f"supernode-{number}.log", environment, *node))
        start = await _spawn(folder / "run.log", environment, str(bins / "flwr"), "run", str(app), "here")
        async with asyncio.timeout(PATIENCE_S):
            code = await start.wait()
        if code:
            raise PoolError(f"flwr run failed: {await _tail(folder / 'run.log')}")
        yield processes
    finally:
        await _end(processes)


def _write_app(app: Path) -> None:
    shutil.copytree(_SIDE, app / "flowerbench")
    (app / "pyproject.toml").write_text(_PROJECT)
    (app / "LICENSE").write_text("for measurements alone\n")


async def _listens(port: int, process: asyncio.subprocess.Process, log: Path) -> None:
    give_up = time.monotonic() + 120.0
    while process.returncode is None and time.monotonic() < give_up:
        with contextlib.suppress(OSError):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.close()
            return
        await asyncio.sleep(0.2)
    raise PoolError(f"Flower's SuperLink does not listen: {await _tail(log)}")


async def _spawn(log: Path, environment: Mapping[str, str], *command: str) -> asyncio.subprocess.Process:
    with log.open("wb") as out:
        return await asyncio.create_subprocess_exec(
            *command, stdin=asyncio.subprocess.DEVNULL, stdout=out, stderr=out, env=dict(environment),
            cwd=log.parent, start_new_session=True,
        )  # fmt: skip


async def _followed(
    processes: Sequence[asyncio.subprocess.Process], told: Path, rounds: int, progress: Progress, folder: Path
) -> float:
    """Wait for all rounds; returns the most memory that all processes held, MB."""
    done, quiet_at, peak = 0, time.monotonic(), 0.0
    file = anyio.Path(told)
    while done < rounds:
        lines = (await file.read_text()).splitlines() if await file.exists() else []
        if len(lines) > done:
            done, quiet_at = len(lines), time.monotonic()
            progress(f"round {done} of {rounds}")
            continue
        peak = max(peak, await anyio.to_thread.run_sync(_held_mb, [each.pid for each in processes]))
        ended = [each for each in processes if each.returncode is not None]
        if ended or time.monotonic() - quiet_at > PATIENCE_S:
            names = sorted([log.name async for log in anyio.Path(folder).glob("*.log")])[:4]
            logs = " | ".join([await _tail(folder / name) for name in names])
            if ended:
                raise PoolError(f"Flower ended after {done} rounds: {logs}"[:2000])
            raise DeadlineError(f"no round of Flower within {PATIENCE_S:.0f} s: {logs}"[:2000])
        await asyncio.sleep(0.5)
    return peak


def _held_mb(pids: Sequence[int]) -> float:
    """Return the resident memory of processes and all that they started, MB."""
    total = 0
    for pid in pids:
        with contextlib.suppress(psutil.NoSuchProcess):
            root = psutil.Process(pid)
            for each in (root, *root.children(recursive=True)):
                with contextlib.suppress(psutil.NoSuchProcess):
                    total += each.memory_info().rss
    return total / 2**20


async def _tail(log: Path) -> str:
    with contextlib.suppress(OSError):
        return (await anyio.Path(log).read_text(errors="replace")).strip()[-400:]
    return "no log"


async def _end(processes: Sequence[asyncio.subprocess.Process]) -> None:
    """End process groups and what they have started in sessions of their own."""
    with anyio.CancelScope(shield=True):
        every: list[psutil.Process] = []
        for process in processes:
            with contextlib.suppress(psutil.NoSuchProcess):
                every += psutil.Process(process.pid).children(recursive=True)
        for process in reversed(processes):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GRACE_S):
                await asyncio.gather(*(process.wait() for process in processes))
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        for each in every:
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
        await asyncio.gather(*(process.wait() for process in processes))
