"""This process as the machine sees it: systemd's notifications, the garbage collector, CPU and memory in use.

Systemd (sd_notify) hears of readiness, the watchdog, and that a daemon stops; without systemd every call does nothing,
so daemons tell it unconditionally.

Python's collector of cycles is kept from holding up what must go on. A whole collection looks at every object there
is: 119 ms with 110,000 of them, every three seconds in a terminal UI on a fleet that puts 2,000 updates a second
(measured 2026-11-22), in which no key is served. In a gateway those of the middle generation alone took 0.9 ms each,
one in some ten replicated writes (2026-11-24). Most of those objects are the program itself, which stays for good,
and what comes has few cycles: it goes as soon as nothing refers to it.

What the machine and this process use is read no more often than it changes anything. Reading /proc costs more than all
else in a gateway's account of itself, and a share of CPU time over a twentieth of a second says little: what is read
counts for half a second, and its age goes with it.
"""

import asyncio
import gc
import os
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import cache
from typing import Any

import psutil
import sdnotify
from msgspec import Struct


@cache
def _notifier() -> Any:  # untyped library; it opens a socket, which only daemons need
    return sdnotify.SystemdNotifier()


def ready() -> None:
    """The service can work."""
    _notifier().notify("READY=1")


def alive() -> None:
    """It still turns."""
    _notifier().notify("WATCHDOG=1")


def stopping() -> None:
    """It is on its way out; the drain deadline is systemd's TimeoutStopSec."""
    _notifier().notify("STOPPING=1")


def watchdog_s() -> float:
    """Half the interval within which systemd wants to hear `alive`, seconds; 0 without a watchdog."""
    return int(os.environ.get("WATCHDOG_USEC", "0")) / 2e6


async def keep_alive() -> None:
    """Tell systemd that the event loop turns, until cancelled; returns at once without a watchdog."""
    interval_s = watchdog_s()
    while interval_s:
        alive()
        await asyncio.sleep(interval_s)


THRESHOLDS = (3000, 30, 20)
"""New objects before the youngest are looked through, and how often that is before older ones are."""


@contextmanager
def gentle_collector(*, collect: bool = True) -> Generator[None]:
    """Leave what there is by now out of all collections, and collect rarely; to be entered when imports are done.

    `collect`: what is garbage by now goes first, which takes as long as a whole collection.
    """
    before = gc.get_threshold()
    if collect:
        gc.collect()
    gc.freeze()
    gc.set_threshold(*THRESHOLDS)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


KEPT_S = 0.5


class Reading(Struct, frozen=True, kw_only=True):
    """CPU of the whole machine since the reading before, percent; resident memory of this process, MB; when."""

    cpu_percent: float
    memory_mb: float
    at: float


class Vitals:
    """The last reading, renewed when it is older than `KEPT_S` seconds."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._process = psutil.Process()
        self._last: Reading | None = None

    def read(self) -> Reading:
        """The reading that counts now."""
        now = self._clock()
        if self._last is None or now - self._last.at >= KEPT_S:
            memory_mb = round(self._process.memory_info().rss / 2**20, 1)
            self._last = Reading(cpu_percent=psutil.cpu_percent(interval=None), memory_mb=memory_mb, at=now)
        return self._last
