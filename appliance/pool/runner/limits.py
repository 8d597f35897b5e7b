"""The limits of a child, so that one that loops, forks, fills memory or writes without end takes nothing with it.

Limits of processes hold on every machine; those of the container (cgroup v2) come on top where there are any.
"""

import contextlib
import math
import os
import resource
from pathlib import Path

HEADROOM = 512 * 2**20
"""Address space on top of `memory_mb`: thread stacks and allocator arenas are reserved, hardly ever touched."""
MAX_FILES = 256
"""Open files of a run."""
CORES = os.cpu_count() or 1
LOCKED = 2**20
"""Bytes that a run may lock into memory."""


def _cap(which: int, value: int) -> None:
    hard = resource.getrlimit(which)[1]
    value = value if hard == resource.RLIM_INFINITY else min(value, hard)
    with contextlib.suppress(ValueError, OSError):  # a stricter limit is already in force
        resource.setrlimit(which, (value, value))


def address_space() -> int:
    """Return this process's address space, bytes."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()


def limit_ahead(processes: int) -> None:
    """Set what is the same for every run."""
    _cap(resource.RLIMIT_NOFILE, MAX_FILES)
    _cap(resource.RLIMIT_CORE, 0)
    _cap(resource.RLIMIT_MEMLOCK, LOCKED)
    _cap(resource.RLIMIT_MSGQUEUE, 0)
    if processes:
        _cap(resource.RLIMIT_NPROC, processes)
    with contextlib.suppress(OSError):
        # Out of memory, the kernel takes the run and leaves the zygote.
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def limit_run(*, base: int, memory_mb: int, file_mb: int, timeout_s: float) -> None:
    """Set what a run's order and its skill say.

    Args:
        base: address space before the run, bytes.
        memory_mb: memory that it may take on top.
        file_mb: longest file that it may write; how many of them a volume has room for is watched (`disk.py`).
        timeout_s: its deadline. A busy loop that blocks signals still ends: CPU seconds of all cores over that time.
    """
    _cap(resource.RLIMIT_AS, base + memory_mb * 2**20 + HEADROOM)
    _cap(resource.RLIMIT_FSIZE, file_mb * 2**20)
    _cap(resource.RLIMIT_CPU, math.ceil(timeout_s * CORES) + 5)
