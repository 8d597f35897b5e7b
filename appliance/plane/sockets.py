"""Sockets of this process's links, given up in time: a setting that Zenoh does not offer, made from outside.

When a link breaks while its send buffer is full, Zenoh 1.10 waits for the kernel to give the socket up before it
forgets what it knew of the other side; by default that takes the kernel a quarter of an hour. If the two meet again
before, one side goes on with what it knew and the other begins anew: keys are sent as numbers that mean other keys
there, and questions arrive at the wrong door, for good (zenoh issue 1886). With TCP_USER_TIMEOUT (tcp(7)) the kernel
gives up after the lease, when Zenoh takes the other side for dead as well.
"""

import asyncio
import contextlib
import os
import socket
import stat
import time

EVERY_S = 0.5
"""How often new sockets are looked for, half a lease: a link that hangs at once is let go before it is missed. A look
takes 0.1 to 0.3 ms."""

CALM_S = 10.0
"""Least time between two resets: where one does not help, a second at once would only do harm."""


class SocketWatch:
    """Sets the time limit on every TCP socket of this process. `lease_ms`: after which unacknowledged data ends it."""

    def __init__(self, lease_ms: int) -> None:
        self._lease_ms = lease_ms
        self._known: dict[int, int] = {}
        """Descriptor -> inode of the sockets that have been looked at."""
        self._task: asyncio.Task[None] | None = None
        self._reset_at = -CALM_S

    def start(self) -> None:
        """Begin to look; also at listening sockets, from which accepted ones inherit it."""
        self.look()
        self._task = asyncio.create_task(self._keep_looking(), name="socket watch")

    async def _keep_looking(self) -> None:
        while True:
            await asyncio.sleep(EVERY_S)
            self.look()

    def look(self) -> int:
        """Set it on the sockets that are new; returns on how many."""
        found: dict[int, int] = {}
        changed = 0
        for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are all that is wanted
            number = int(name)
            try:
                about = os.fstat(number)
            except OSError:  # closed meanwhile
                continue
            if not stat.S_ISSOCK(about.st_mode):
                continue
            found[number] = about.st_ino
            if self._known.get(number) != about.st_ino:
                changed += self._set(number)
        self._known = found
        return changed

    def _set(self, number: int) -> bool:
        try:
            copy = os.dup(number)
        except OSError:
            return False
        with socket.socket(fileno=copy) as handle:
            if handle.family not in (socket.AF_INET, socket.AF_INET6) or handle.type != socket.SOCK_STREAM:
                return False
            try:
                handle.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, self._lease_ms)
            except OSError:
                return False
        return True

    def reset(self) -> int:
        """Break every TCP connection of this process, so that both ends forget what they knew; returns how many.

        Zenoh makes its links anew at once. Other connections (to a language model, to a vehicle) break too and are
        made anew by whoever uses them: so this is for links that are known to be mixed up, and at most each `CALM_S`.
        """
        now = time.monotonic()
        if now < self._reset_at + CALM_S:
            return 0
        self._reset_at = now
        broken = 0
        for number in self._known:
            with contextlib.suppress(OSError), socket.socket(fileno=os.dup(number)) as handle:
                if handle.family in (socket.AF_INET, socket.AF_INET6) and handle.type == socket.SOCK_STREAM:
                    handle.getpeername()  # a listening socket has none, and is left alone
                    handle.shutdown(socket.SHUT_RDWR)
                    broken += 1
        return broken

    def close(self) -> None:
        """Look no more."""
        if self._task is not None:
            self._task.cancel()
