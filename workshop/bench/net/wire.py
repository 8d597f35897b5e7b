"""The wire: a process that carries Ethernet frames between network interfaces, and loses, delays or reorders them.

    python wire.py SEED PORT=INTERFACE...

It reads a table of rules (JSON, one a line) on its standard input and answers each with what it has counted so far. It
exists because `tc netem`, which does the same in the kernel, is not part of every kernel; frames are real frames here
too, so TCP meets real losses and sends again. It needs CAP_NET_RAW in the network namespace of the interfaces.
"""

import heapq
import random
import select
import socket
import sys
import time
from collections import Counter

import msgspec

from workshop.bench.net.faults import CLEAN, Rule, Table, due_s

_ALL = 3
"""ETH_P_ALL."""
_OUTGOING = 4
"""PACKET_OUTGOING: what this process itself has sent."""
_BROADCAST = 1
"""The bit of a MAC address that says several are meant."""
_BATCH = 64
_FRAME = 65_600
_RECEIVE_BUFFER = 8 * 2**20
MOST_WAITING = 100_000
"""Frames under way; beyond it they are lost, as on any wire whose queue is full."""


class Wire:
    """Frames between ports. A port is known by the MAC address that first sends from it."""

    def __init__(self, interfaces: dict[str, str], seed: int) -> None:
        self._sockets: dict[str, socket.socket] = {}
        self._ports: dict[int, str] = {}
        self._places: dict[bytes, str] = {}
        self._rules: Table = {}
        self._waiting: list[tuple[float, int, str, bytes]] = []
        self._number = 0
        self._generator = random.Random(seed)  # noqa: S311 - noise, not secrets
        self._poll = select.epoll()
        self.counts: Counter[str] = Counter()
        for port, interface in interfaces.items():
            raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ALL))
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            raw.bind((interface, 0))
            raw.setblocking(False)
            self._sockets[port] = raw
            self._ports[raw.fileno()] = port
            self._poll.register(raw.fileno(), select.EPOLLIN)

    def run(self) -> None:
        """Carry frames until the standard input ends."""
        self._poll.register(sys.stdin.fileno(), select.EPOLLIN)
        while True:
            wait_s = max(0.0, self._waiting[0][0] - time.monotonic()) if self._waiting else 1.0
            for handle, _ in self._poll.poll(wait_s):
                if handle in self._ports:
                    self._take(self._ports[handle])
                elif not self._told():
                    return
            now = time.monotonic()
            while self._waiting and self._waiting[0][0] <= now:
                _, _, port, frame = heapq.heappop(self._waiting)
                self._send(port, frame)

    def _told(self) -> bool:
        line = sys.stdin.buffer.readline()
        if not line:
            return False
        self._rules = msgspec.json.decode(line, type=Table)
        sys.stdout.buffer.write(msgspec.json.encode(dict(self.counts)) + b"\n")
        sys.stdout.buffer.flush()
        return True

    def _take(self, port: str) -> None:
        raw = self._sockets[port]
        for _ in range(_BATCH):
            try:
                frame, address = raw.recvfrom(_FRAME)
            except BlockingIOError:
                return
            except OSError:  # the interface is being taken away
                return
            if address[2] == _OUTGOING:
                continue
            self._places[frame[6:12]] = port
            place = self._places.get(frame[:6])
            if place is not None and not frame[0] & _BROADCAST:
                self._pass(port, place, frame)
            else:
                for other in self._sockets:
                    if other != port:
                        self._pass(port, other, frame)

    def _pass(self, port: str, other: str, frame: bytes) -> None:
        rule: Rule = self._rules.get(port, {}).get(other, CLEAN)
        now = time.monotonic()
        due = due_s(rule, now, self._generator)
        if due is None or len(self._waiting) >= MOST_WAITING:
            self.counts["cut" if rule.cut else "lost"] += 1
        elif due <= now:
            self.counts["passed"] += 1
            self._send(other, frame)
        else:
            self.counts["delayed"] += 1
            self._number += 1
            heapq.heappush(self._waiting, (due, self._number, other, frame))

    def _send(self, port: str, frame: bytes) -> None:
        try:
            self._sockets[port].send(frame)
        except (BlockingIOError, OSError):  # full, or the interface is being taken away
            self.counts["not sent"] += 1


if __name__ == "__main__":
    Wire(dict(each.split("=", 1) for each in sys.argv[2:]), int(sys.argv[1])).run()  # pyright: ignore[reportArgumentType]
