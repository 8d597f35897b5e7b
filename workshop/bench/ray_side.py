"""Ray's side of the comparisons; runs under the Python that has Ray, and needs nothing else.

    python ray_side.py startup WARM COLD ACTORS PAUSE_S FOLDER
    python ray_side.py throughput SECONDS KILLS FOLDER PARALLEL...

`startup` is a pool of actors, warm and new ones; `throughput` is trivial tasks, as many as it can, and tasks whose
worker is killed. It prints JSON lines: {"event": "ready" | "warm" | "cold" | "throughput" | "recovery", ...}, times in
milliseconds by CLOCK_MONOTONIC, which all processes of a machine share.
"""

import importlib
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0
ORDER: dict[str, Any] = {"run": "bench/n/1", "skill": "bench_nothing", "params": {}, "inputs": {}, "site": {}}


class Nothing:
    """The handler that does nothing, as an actor."""

    def run(self, order: dict[str, Any]) -> tuple[int, dict[str, Any]]:
        """Return when the first line was reached, CLOCK_MONOTONIC nanoseconds, and no result."""
        began_ns = time.monotonic_ns()
        del order
        return began_ns, {}


def tell(event: str, **fields: Any) -> None:
    """Print a line."""
    sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
    sys.stdout.flush()


def nothing(number: int) -> int:
    """Do nothing."""
    return number


def once_more(folder: str, number: int) -> int:
    """Say which process this is and stay, the first time; end at once, the next."""
    path = Path(folder) / f"run-{number}"
    if path.exists():
        return 2
    part = path.with_suffix(".part")
    part.write_text(str(os.getpid()))
    part.rename(path)
    time.sleep(PATIENCE_S)
    return 1


def flood(ray: Any, task: Any, seconds: float, parallel: int) -> tuple[int, float]:
    """Keep so many tasks under way for a while; returns how many ended, and in which time."""
    began = time.monotonic()
    under_way = [task.remote(number) for number in range(parallel)]
    ended = 0
    while time.monotonic() - began < seconds:
        done, under_way = ray.wait(under_way, num_returns=1)
        ray.get(done)
        ended += len(done)
        under_way += [task.remote(0) for _ in done]
    took_s = time.monotonic() - began
    ray.get(under_way)
    return ended, took_s


def kill_one(ray: Any, task: Any, folder: str, number: int) -> float:
    """Kill the worker of a task; returns milliseconds from then to the result of the next attempt."""
    found = task.remote(folder, number)
    path = Path(folder) / f"run-{number}"
    until = time.monotonic() + PATIENCE_S
    while not path.exists() and time.monotonic() < until:
        time.sleep(0.005)
    os.kill(int(path.read_text()), signal.SIGKILL)
    killed = time.monotonic()
    ray.get(found)
    return (time.monotonic() - killed) * 1e3


def begin(processors: int, folder: str) -> Any:
    """Start Ray; return its module."""
    ray: Any = importlib.import_module("ray")
    ray.init(
        num_cpus=processors,
        include_dashboard=False,
        log_to_driver=False,
        logging_level="error",
        object_store_memory=100 * 2**20,
        _temp_dir=folder,
    )
    return ray


def startup(warm: int, cold: int, actors: int, pause_s: float, folder: str) -> None:
    """Measure warm and new actors, and end Ray."""
    began_ns = time.monotonic_ns()
    ray = begin(max(4, actors + 2), folder)
    kind: Any = ray.remote(num_cpus=0)(Nothing)
    try:
        pool = [kind.remote() for _ in range(actors)]
        for actor in pool * 3:
            ray.get(actor.run.remote(ORDER))
        tell("ready", version=str(ray.__version__), took_ms=(time.monotonic_ns() - began_ns) / 1e6)
        started: list[float] = []
        ended: list[float] = []
        for number in range(warm):
            time.sleep(pause_s)
            sent_ns = time.monotonic_ns()
            first_ns, _ = ray.get(pool[number % actors].run.remote(ORDER))
            ended.append((time.monotonic_ns() - sent_ns) / 1e6)
            started.append((first_ns - sent_ns) / 1e6)
        tell("warm", start_ms=started, round_trip_ms=ended)
        started = []
        for _ in range(cold):
            sent_ns = time.monotonic_ns()
            actor = kind.remote()
            first_ns, _ = ray.get(actor.run.remote(ORDER))
            started.append((first_ns - sent_ns) / 1e6)
            ray.kill(actor)
        tell("cold", start_ms=started)
    finally:
        ray.shutdown()


def throughput(seconds: float, kills: int, folder: str, parallels: list[int]) -> None:
    """Measure tasks per second and the recovery from a kill, and end Ray."""
    ray = begin(max(parallels), folder)
    try:
        task: Any = ray.remote(nothing)
        again: Any = ray.remote(max_retries=3)(once_more)
        ray.get([task.remote(number) for number in range(4 * max(parallels))])
        tell("ready", version=str(ray.__version__))
        rates: dict[str, float] = {}
        for parallel in parallels:
            ended, took_s = flood(ray, task, seconds, parallel)
            rates[str(parallel)] = ended / took_s
        tell("throughput", rates=rates)
        tell("recovery", times_ms=[kill_one(ray, again, folder, number) for number in range(kills)])
    finally:
        ray.shutdown()


if __name__ == "__main__":
    given = sys.argv[2:]
    if sys.argv[1] == "startup":
        startup(int(given[0]), int(given[1]), int(given[2]), float(given[3]), given[4])
    else:
        throughput(float(given[0]), int(given[1]), given[2], [int(text) for text in given[3:]])
