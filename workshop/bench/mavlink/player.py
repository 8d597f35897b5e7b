"""Plays a log into two TCP ports of a router, from a process of its own, and keeps what comes out of them.

`python -m workshop.bench.mavlink.player FILE` with a Play as JSON in FILE; it writes what each port sent to files and
prints a Played. It only moves bytes, so that it costs the machine as little as may be beside the router.
"""

import socket
import struct
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
from msgspec import Struct

_HEAD = struct.Struct("<dH")
_IDLE_S = 6.0
"""Nothing came for so long but a few heartbeats: it is over."""
_BEATS = 400
"""Bytes of the router's own that are no sign of progress."""
_CONNECT_S = 20.0


class Play(Struct, frozen=True, kw_only=True):
    """What is played: for each of two ports a file of records, one to greet with first, and one for what comes back."""

    ports: tuple[int, int]
    records: tuple[str, str]
    greetings: tuple[bytes, bytes]
    outputs: tuple[str, str]
    speed: float = 0.0
    """1 for real time; 0 for as fast as it is taken."""
    rounds: int = 1
    wanted: tuple[int, int] = (0, 0)
    """Bytes that are to come out of each port at least, before silence counts as the end."""
    patience_s: float = 60.0


class Played(Struct, frozen=True, kw_only=True):
    """How it went, seconds since the first record was sent."""

    sent_s: float
    received_s: float
    """When the last bytes came."""


def save(path: Path, records: Sequence[tuple[float, bytes]]) -> None:
    """Write records for a player."""
    with path.open("wb") as file:
        for at_s, raw in records:
            file.write(_HEAD.pack(at_s, len(raw)) + raw)


def load(path: Path) -> list[tuple[float, bytes]]:
    """Read what `save` wrote."""
    data, at, found = path.read_bytes(), 0, list[tuple[float, bytes]]()
    while at < len(data):
        at_s, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        found.append((at_s, data[at : at + length]))
        at += length
    return found


class _Side:
    """One port."""

    def __init__(self, play: Play, index: int) -> None:
        self.records = load(Path(play.records[index]))
        self.output = Path(play.outputs[index])
        self.heard = bytearray()
        self._play = play
        deadline = time.monotonic() + _CONNECT_S
        while True:
            try:
                self.socket = socket.create_connection(("127.0.0.1", play.ports[index]))
                break
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket.sendall(play.greetings[index])

    def receive(self) -> None:
        """Take in what comes, until the socket is closed."""
        try:
            while data := self.socket.recv(1 << 18):
                self.heard += data
        except OSError:
            return

    def send(self, began: float) -> None:
        """Send the records at their times, or at once."""
        if not self._play.speed:
            whole = b"".join(raw for _, raw in self.records)
            for _ in range(self._play.rounds):
                self.socket.sendall(whole)
            return
        waiting = bytearray()
        for at_s, raw in self.records:
            due = began + at_s / self._play.speed
            if due > time.monotonic():
                if waiting:
                    self.socket.sendall(waiting)
                    waiting.clear()
                time.sleep(max(0.0, due - time.monotonic()))
            waiting += raw
        self.socket.sendall(waiting)


def run(play: Play) -> Played:
    """Play."""
    sides = [_Side(play, index) for index in (0, 1)]
    readers = [threading.Thread(target=side.receive, daemon=True) for side in sides]
    for reader in readers:
        reader.start()
    time.sleep(1.0)  # both are known to the router by now
    for side in sides:
        side.heard.clear()
    began = time.monotonic()
    senders = [threading.Thread(target=side.send, args=(began,)) for side in sides]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join()
    sent = last = time.monotonic()
    before = 0
    while time.monotonic() - sent < play.patience_s:
        now, heard = time.monotonic(), sum(len(side.heard) for side in sides)
        if heard > before + _BEATS:
            before, last = heard, now
        if all(len(side.heard) >= least for side, least in zip(sides, play.wanted, strict=True)):
            last = now
            time.sleep(0.2)  # what should not come would come now
            break
        if now - last > _IDLE_S:
            break
        time.sleep(0.005)
    for side in sides:
        side.socket.close()
        side.output.write_bytes(side.heard)
    return Played(sent_s=sent - began, received_s=max(last, sent) - began)


if __name__ == "__main__":
    told = run(msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=Play))
    sys.stdout.write(msgspec.json.encode(told).decode())
