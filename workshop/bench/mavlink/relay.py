"""A bad link: a UDP relay on a thread of its own that loses, doubles and delays what goes through, each way.

Delayed datagrams are overtaken by later ones, which is how they come out of order.
"""

import heapq
import itertools
import random
import selectors
import socket
import threading
import time
from typing import Any

from msgspec import Struct


class Badness(Struct, frozen=True, kw_only=True):
    """Shares of datagrams, each way, and how long a delayed one takes."""

    loss: float = 0.2
    doubled: float = 0.1
    delayed: float = 0.2
    delay_s: float = 0.08
    seed: int = 1


class BadLink:
    """Relays between all that send to `port` and one target; each sender is another one to the target, too."""

    def __init__(self, target: tuple[str, int], badness: Badness) -> None:
        self._target = target
        self._bad = badness
        self._chance = random.Random(badness.seed)  # noqa: S311 - a bad link, no secret
        self._front = _socket()
        self.port: int = self._front.getsockname()[1]
        self._ways: dict[tuple[str, int], socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._front, selectors.EVENT_READ, None)
        self._late: list[tuple[float, int, socket.socket, bytes, tuple[str, int]]] = []
        self.counts = {"taken": 0, "lost": 0, "doubled": 0, "delayed": 0}
        self._numbers = itertools.count()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bad link", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and close the sockets."""
        self._stop.set()
        self._thread.join(10.0)
        for each in (self._front, *self._ways.values()):
            each.close()
        self._selector.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            wait_s = min(0.05, self._late[0][0] - time.monotonic()) if self._late else 0.05
            for key, _ in self._selector.select(max(0.0, wait_s)):
                self._take(key.fileobj, key.data)
            while self._late and self._late[0][0] <= time.monotonic():
                _, _, way, data, to = heapq.heappop(self._late)
                _send(way, data, to)

    def _take(self, way: Any, sender: tuple[str, int] | None) -> None:
        for _ in range(64):
            try:
                data, address = way.recvfrom(65536)
            except OSError:
                return
            if sender is None:
                self._pass(self._way(address), data, self._target)
            else:
                self._pass(self._front, data, sender)

    def _way(self, sender: tuple[str, int]) -> socket.socket:
        found = self._ways.get(sender)
        if found is None:
            found = self._ways[sender] = _socket()
            self._selector.register(found, selectors.EVENT_READ, sender)
        return found

    def _pass(self, way: socket.socket, data: bytes, to: tuple[str, int]) -> None:
        bad, chance, counts = self._bad, self._chance, self.counts
        counts["taken"] += 1
        if chance.random() < bad.loss:
            counts["lost"] += 1
            return
        copies = 1
        if chance.random() < bad.doubled:
            counts["doubled"] += 1
            copies = 2
        for _ in range(copies):
            if chance.random() < bad.delayed:
                counts["delayed"] += 1
                at = time.monotonic() + chance.random() * bad.delay_s
                heapq.heappush(self._late, (at, next(self._numbers), way, data, to))
            else:
                _send(way, data, to)


def _socket() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(("127.0.0.1", 0))
    made.setblocking(False)
    return made


def _send(way: socket.socket, data: bytes, to: tuple[str, int]) -> None:
    try:
        way.sendto(data, to)
    except OSError:
        return  # a bad link says nothing
