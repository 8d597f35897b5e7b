"""Notices that this process stood still: frozen, suspended with its machine, or starved of the processor.

A gateway that stands still for a lease is taken for dead and succeeded, and does not know it: when it runs again it
first finds the requests that waited for it, and would order writes that its successor has ordered since, from
records that are stale. So after standing still it orders no write for a lease (whoever asked asks again, at the
right gateway by then), and compares its shard with the others' before it answers as an owner.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import structlog

log = structlog.get_logger(__name__)


def clock() -> float:
    """Seconds, those of a suspended machine among them."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Standstill(NamedTuple):
    """When a process stood still: since what moment of `clock`, and for how many seconds."""

    since: float
    lasted_s: float


class Pulse:
    """Beats on a thread of its own: what only holds up the event loop makes nobody take this gateway for dead."""

    def __init__(self, lease_s: float, *, clock: Callable[[], float] = clock) -> None:
        self.on_stalled: list[Callable[[Standstill], None]] = []
        """Called on the event loop after the process stood still, once for each standstill and told which."""
        self._lease_s = lease_s
        self._clock = clock
        self._lock = threading.Lock()
        self._last = clock()
        self._until = self._last
        self._stalls = 0
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def start(self) -> None:
        """Begin to beat."""
        self._loop = asyncio.get_running_loop()
        self._last = self._clock()
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)
        self._thread.start()

    @property
    def stalls(self) -> int:
        """How often the process stood still; what was learned at another count may be out of date."""
        self._beat()
        return self._stalls

    @property
    def doubtful(self) -> bool:
        """Whether the process stood still within the last lease: requests sent before may only arrive now."""
        return self._beat() < self._until

    def _run(self) -> None:
        while not self._closing.wait(self._lease_s / 4):
            self._beat()

    def _beat(self) -> float:
        """Look at the clock, from any thread; whoever does so first after a stall finds it."""
        with self._lock:
            now = self._clock()
            since, stood_s, self._last = self._last, now - self._last, now
            # Silent for a quarter of a lease before it stopped: the others may know after three more.
            stalled = self._thread is not None and stood_s >= self._lease_s * 0.75
            if stalled:
                self._until = now + self._lease_s
                self._stalls += 1
        if stalled:
            log.warning("this process stood still; it may have been succeeded", seconds=round(stood_s, 3))
            # The loop may be gone when the process ends without closing: then nobody listens.
            with contextlib.suppress(RuntimeError):
                if self._loop is not None:
                    self._loop.call_soon_threadsafe(self._tell, Standstill(since, stood_s))
        return now

    def _tell(self, standstill: Standstill) -> None:
        for callback in tuple(self.on_stalled):
            callback(standstill)

    def close(self) -> None:
        """Beat no more."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
