"""A gateway that is watched by a sampling profiler: `python -m workshop.bench.throughput.sampled FILE`.

Each 2 ms of processor time that the process uses (4 where the kernel ticks so), in whatever thread, the stack of the
event loop's thread is noted.
Where that stands in the loop itself, the time went to other threads: Zenoh's and SQLite's. What was found is written
beside the gateway's data when it ends. Sampling costs about 1 %; a tracing profiler would make small functions look
expensive.
"""

import signal
import sys
import time
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import msgspec
import uvloop

from appliance import config as configuration
from appliance import gateway as daemon
from appliance import logs

EVERY_S = 0.002
FILE = "profile.json"
TOP = 25


class Sampler:
    """Counts functions on the stack of the main thread."""

    def __init__(self) -> None:
        self.samples = 0
        self.idle = 0
        self._own: Counter[str] = Counter()
        self._all: Counter[str] = Counter()

    def start(self) -> None:
        """Begin to sample."""
        signal.signal(signal.SIGPROF, self._take)
        signal.setitimer(signal.ITIMER_PROF, EVERY_S, EVERY_S)

    def stop(self) -> None:
        """Sample no more."""
        signal.setitimer(signal.ITIMER_PROF, 0.0)

    def _take(self, number: int, frame: FrameType | None) -> None:
        del number
        self.samples += 1
        names: list[str] = []
        while frame is not None:
            names.append(_name(frame))
            frame = frame.f_back
        if not names or names[0].endswith((":run", ":main", ":<module>")):
            self.idle += 1
            return
        self._own[names[0]] += 1
        self._all.update(set(names))

    def told(self) -> dict[str, Any]:
        """Return shares of the processor time: of functions alone, and with what they call."""
        whole = max(1, self.samples)
        return {
            "cpu_s": round(time.process_time(), 1),
            "samples": self.samples,
            "other_threads": round(self.idle / whole, 3),
            "own": {name: round(count / whole, 3) for name, count in self._own.most_common(TOP)},
            "with_callees": {
                name: round(count / whole, 3)
                for name, count in self._all.most_common(3 * TOP)
                if "appliance/" in name and "bench/" not in name
            },
        }


def _name(frame: FrameType) -> str:
    path = frame.f_code.co_filename
    short = "/".join(Path(path).parts[-3:]) if "appliance" in path else Path(path).name
    return f"{short}:{frame.f_code.co_name}"


def main(path: Path) -> None:
    """Run the gateway until SIGTERM, then write what was sampled."""
    loaded = configuration.load(path)
    logs.configure(level=loaded.log_level, style=loaded.log_format)
    sampler = Sampler()
    sampler.start()
    try:
        uvloop.run(daemon.run(loaded))
    finally:
        sampler.stop()
        (Path(loaded.data_dir) / FILE).write_bytes(msgspec.json.encode(sampler.told()))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
