"""This process: systemd's notifications, its root tasks (`Supervisor`), the garbage collector, CPU and memory in use.

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
import contextlib
import gc
import os
import socket
import time
from collections.abc import Awaitable, Callable, Coroutine, Generator
from contextlib import contextmanager
from typing import Any

import psutil
import structlog
from msgspec import Struct

log = structlog.get_logger(__name__)


NOTIFY_S = 1.0
"""How long systemd may take to accept a notification."""


def _notify(state: str) -> None:
    """Send a line to systemd, as sd_notify(3) does; nothing without systemd, or when it does not listen."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):  # a name in the kernel alone
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as connection:
        connection.settimeout(NOTIFY_S)
        connection.connect(address)
        connection.sendall(state.encode())


def ready() -> None:
    """The service can work."""
    _notify("READY=1")


def alive() -> None:
    """It still turns."""
    _notify("WATCHDOG=1")


def stopping() -> None:
    """It is on its way out; the drain deadline is systemd's TimeoutStopSec."""
    _notify("STOPPING=1")


def watchdog_s() -> float:
    """Half the interval within which systemd wants to hear `alive`, seconds; 0 without a watchdog."""
    return int(os.environ.get("WATCHDOG_USEC", "0")) / 2e6


async def keep_alive() -> None:
    """Tell systemd that the event loop turns, until cancelled; returns at once without a watchdog."""
    interval_s = watchdog_s()
    while interval_s:
        alive()
        await asyncio.sleep(interval_s)


class Supervisor:
    """Starts the root tasks of a daemon, each by name. One that ends by an error is logged, and ends the process."""

    def __init__(self) -> None:
        self._tasks: list[asyncio.Task[object]] = []
        self._crash: BaseException | None = None
        self._crashed = asyncio.Event()

    def start(self, name: str, work: Coroutine[Any, Any, object]) -> Callable[[], Awaitable[None]]:
        """Run something until it ends or is stopped; returns what stops it."""
        task = asyncio.create_task(work, name=name)
        self._tasks.append(task)
        task.add_done_callback(self._ended)

        async def stop() -> None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

        return stop

    def _ended(self, task: asyncio.Task[object]) -> None:
        self._tasks.remove(task)
        if task.cancelled() or (error := task.exception()) is None:
            return
        log.error("a root task broke: this process ends", task=task.get_name(), exc_info=error)
        self._crash = self._crash or error
        self._crashed.set()

    async def crashed(self) -> BaseException:
        """Wait until one of the tasks has ended by an error; returns that."""
        await self._crashed.wait()
        assert self._crash is not None  # noqa: S101 - set before the event is
        return self._crash

    async def close(self) -> None:
        """Cancel what still runs, the last that was started first, and wait for each."""
        for task in reversed(self._tasks.copy()):
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


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
