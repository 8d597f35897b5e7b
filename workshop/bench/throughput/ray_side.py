"""Ray's side: trivial tasks as many as it can, and a task whose worker is killed; runs under the Python that has Ray.

    python ray_side.py SECONDS KILLS FOLDER PARALLEL...

It prints JSON lines: {"event": "ready" | "throughput" | "recovery", ...}, times in milliseconds.
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


def tell(event: str, **fields: Any) -> None:
    """Print a line."""
    sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
    sys.stdout.flush()


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


def main(seconds: float, kills: int, folder: str, parallels: list[int]) -> None:
    """Measure, and end Ray."""
    ray: Any = importlib.import_module("ray")
    ray.init(
        num_cpus=max(parallels),
        include_dashboard=False,
        log_to_driver=False,
        logging_level="error",
        object_store_memory=100 * 2**20,
        _temp_dir=folder,
    )
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
    main(float(sys.argv[1]), int(sys.argv[2]), sys.argv[3], [int(each) for each in sys.argv[4:]])
