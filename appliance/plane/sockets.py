"""Sockets of this process's links, given up in time: a setting that Zenoh does not offer, made from outside.

When a link breaks while its send buffer is full, Zenoh 1.10 waits for the kernel to give the socket up before it
forgets what it knew of the other side; by default that takes the kernel a quarter of an hour. If the two meet again
before, one side goes on with what it knew and the other begins anew: keys are sent as numbers that mean other keys
there, and questions arrive at the wrong door, for good (zenoh issue 1886). With TCP_USER_TIMEOUT (tcp(7)) the kernel
gives up after the lease, when Zenoh takes the other side for dead as well.
"""

import asyncio
import contextlib
import ipaddress
import os
import socket
import stat
from collections.abc import Set
from typing import Any, ClassVar
from urllib.parse import urlsplit

EVERY_S = 0.5
"""How often new sockets are looked for, half a lease: a link that hangs at once is let go before it is missed. A look
takes 0.1 to 0.3 ms."""

CALM_S = 10.0
"""Least time before a link is broken again: where once does not help, a second time at once would only do harm."""

Address = tuple[str, int]
"""IP address and port."""


class SocketWatch:
    """Sets the time limit on every TCP socket of this process. `lease_ms`: after which unacknowledged data ends it."""

    _running: ClassVar[dict[asyncio.AbstractEventLoop, "SocketWatch"]] = {}
    """One for all sessions of a loop: each look is at the sockets of the whole process."""

    def __init__(self, lease_ms: int) -> None:
        self._users = 0
        self._lease_ms = lease_ms
        self._known: dict[int, int] = {}
        """Descriptor -> inode of the sockets that have been looked at."""
        self._task: asyncio.Task[None] | None = None

    @classmethod
    def shared(cls, lease_ms: int) -> "SocketWatch":
        """The watch of the running loop's sessions, the shortest lease of theirs; each closes it when it ends."""
        loop = asyncio.get_running_loop()
        watch = cls._running.get(loop)
        if watch is None:
            watch = cls._running[loop] = cls(lease_ms)
            watch._task = asyncio.create_task(watch._keep_looking(), name="socket watch")
        elif lease_ms < watch._lease_ms:
            watch._lease_ms, watch._known = lease_ms, {}
        watch._users += 1
        # Also at listening sockets, from which accepted ones inherit it.
        with contextlib.suppress(OSError):
            watch.look()
        return watch

    async def _keep_looking(self) -> None:
        while True:
            await asyncio.sleep(EVERY_S)
            with contextlib.suppress(OSError):  # no descriptor is left to list them with: next time
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
        handle = _taken(number)
        if handle is None:
            return False
        with handle:
            if handle.family not in (socket.AF_INET, socket.AF_INET6) or handle.type != socket.SOCK_STREAM:
                return False
            try:
                handle.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, self._lease_ms)
            except OSError:
                return False
        return True

    def shut(self, ends: Set[tuple[Address, Address]]) -> int:
        """Break the TCP connections with these (local, remote) ends and no others; returns how many.

        Zenoh makes its links anew at once.
        """
        with contextlib.suppress(OSError):
            self.look()
        broken = 0
        for number in self._known:
            handle = _taken(number)
            if handle is None:
                continue
            with contextlib.suppress(OSError), handle:
                if handle.family not in (socket.AF_INET, socket.AF_INET6) or handle.type != socket.SOCK_STREAM:
                    continue
                # A listening socket has no other end: the question for it raises.
                if (_address(handle.getsockname()), _address(handle.getpeername())) in ends:
                    handle.shutdown(socket.SHUT_RDWR)
                    broken += 1
        return broken

    def close(self) -> None:
        """One session less; look no more once there is none."""
        self._users -= 1
        if self._users == 0 and self._task is not None:
            self._task.cancel()
            self._running.pop(self._task.get_loop(), None)


def _taken(number: int) -> socket.socket | None:
    """A descriptor's socket, by a copy of the descriptor; None when it is none any more.

    Zenoh's threads close sockets at any time, and the number may be a file's by now.
    """
    try:
        copy = os.dup(number)
    except OSError:
        return None
    try:
        return socket.socket(fileno=copy)
    except OSError:
        os.close(copy)
        return None


def address_of(locator: str) -> Address | None:
    """The address in a Zenoh locator such as `tcp/127.0.0.1:7447`; None for one that is no address."""
    try:
        parts = urlsplit(f"//{locator.partition('/')[2].partition('?')[0].partition('#')[0]}")
        return None if parts.hostname is None or parts.port is None else _address((parts.hostname, parts.port))
    except ValueError:
        return None


def _address(name: Any) -> Address:
    """A socket's name as an address; IPv4 in an IPv6 socket is IPv4. ValueError when it is none."""
    host = ipaddress.ip_address(str(name[0]).partition("%")[0])
    mapped = host.ipv4_mapped if isinstance(host, ipaddress.IPv6Address) else None
    return str(mapped or host), int(name[1])
