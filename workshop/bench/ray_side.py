"""The other side of the comparison, a pool of Ray actors; runs under the Python that has Ray, and needs nothing else.

    python ray_side.py WARM COLD ACTORS PAUSE_S FOLDER

It prints JSON lines: {"event": "ready" | "warm" | "cold", ...}, times in milliseconds by CLOCK_MONOTONIC, which all
processes of a machine share.
"""

import importlib
import json
import sys
import time
from typing import Any

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


def main(warm: int, cold: int, actors: int, pause_s: float, folder: str) -> None:
    """Measure, and end Ray."""
    ray: Any = importlib.import_module("ray")
    began_ns = time.monotonic_ns()
    ray.init(
        num_cpus=max(4, actors + 2),
        include_dashboard=False,
        log_to_driver=False,
        logging_level="error",
        object_store_memory=100 * 2**20,
        _temp_dir=folder,
    )
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


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]), sys.argv[5])
