"""The two queues between the event loop and Zenoh's threads.

Zenoh calls back on threads of its own and its sends may block while a peer is stuck. Neither may reach the event
loop: what comes in is queued and the loop is woken once for a whole burst (`Inbox`), what goes out is sent by a
thread that may wait (`Outbox`). Both are bounded by number and bytes; what does not fit is dropped and counted.
"""

import asyncio
import threading
from collections import deque
from collections.abc import Callable

import structlog

log = structlog.get_logger(__name__)

_TURN = 256
"""Deliveries per turn of the loop, so that a flood does not starve everything else."""


class Inbox:
    """Calls from any thread to the event loop's thread, in order; one wake-up however many wait.

    `on_dropped` is told on the loop's thread how many were dropped, once the burst is over.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        *,
        messages: int,
        payload_bytes: int,
        on_dropped: Callable[[int], None] | None = None,
    ) -> None:
        self._loop = loop
        self._on_dropped = on_dropped
        self._told = 0
        self._most, self._most_bytes = messages, payload_bytes
        self._waiting: deque[tuple[Callable[[], None], int]] = deque()
        self._bytes = 0
        self._woken = False
        self._lock = threading.Lock()
        self._closed = False
        self.dropped = 0

    def post(self, call: Callable[[], None], size: int = 0, *, must: bool = False) -> bool:
        """Queue a call; False when it was dropped. `must` is for the few that are never many (ends of queries)."""
        with self._lock:
            if self._closed:
                return False
            if not must and (len(self._waiting) >= self._most or self._bytes + size > self._most_bytes):
                self.dropped += 1
                return False
            self._waiting.append((call, size))
            self._bytes += size
            wake, self._woken = not self._woken, True
        if wake:
            self._wake()
        return True

    def _wake(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self._deliver)
        except RuntimeError:  # the loop was closed without closing the session: nobody is left to deliver to
            self.close()

    def _deliver(self) -> None:
        for _ in range(_TURN):
            with self._lock:
                if not self._waiting:
                    self._woken = False
                    break
                call, size = self._waiting.popleft()
                self._bytes -= size
            try:
                call()
            except Exception:  # supervision boundary: one receiver's defect must not end the others' deliveries
                log.exception("a receiver failed")
        else:
            self._loop.call_soon(self._deliver)
            return
        dropped = self.dropped
        if dropped > self._told and self._on_dropped is not None:
            self._on_dropped(dropped - self._told)
        self._told = dropped

    def close(self) -> None:
        """Forget what waits and take no more."""
        with self._lock:
            self._closed = True
            self._waiting.clear()


class Outbox:
    """Sends in order on a thread of its own, so that a stuck peer holds up that thread and never the loop."""

    def __init__(self, *, messages: int, payload_bytes: int) -> None:
        self._most, self._most_bytes = messages, payload_bytes
        self._waiting: deque[tuple[Callable[[], None], int]] = deque()
        self._bytes = 0
        self._some = threading.Condition()
        self._closed = False
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="zenoh sender", daemon=True)
        self._thread.start()

    def send(self, call: Callable[[], None], size: int) -> bool:
        """Queue a send; False when it was dropped because the queue is full."""
        with self._some:
            if self._closed or len(self._waiting) >= self._most or self._bytes + size > self._most_bytes:
                self.dropped += 1
                return False
            self._waiting.append((call, size))
            self._bytes += size
            self._some.notify()
        return True

    @property
    def waiting(self) -> int:
        """Sends that wait."""
        return len(self._waiting)

    def _run(self) -> None:
        while True:
            with self._some:
                while not self._waiting:
                    if self._closed:
                        return
                    self._some.wait()
                call, size = self._waiting.popleft()
            try:
                call()
            except Exception:  # supervision boundary: one failed send must not end the others
                log.exception("a send failed")
            with self._some:
                self._bytes -= size

    def close(self, timeout_s: float) -> None:
        """Send what waits, for at most that long. Blocks; call it off the loop."""
        with self._some:
            self._closed = True
            self._some.notify()
        self._thread.join(timeout_s)
        with self._some:
            self._waiting.clear()
