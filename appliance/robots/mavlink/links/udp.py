"""MAVLink over UDP: a datagram holds whole frames."""

import asyncio
import socket
from typing import Any, cast

import structlog

from appliance.errors import ConfigError
from appliance.robots.mavlink.links.base import Address, Link

log = structlog.get_logger(__name__)

MAX_UNSENT = 256 * 1024
"""Bytes of datagrams that may wait for the system to take them; more are dropped, as on a radio link."""
RECEIVE_BYTES = 4 * 2**20
"""Asked of the system for datagrams that wait to be read: half a second of 100,000 frames. It gives what it allows."""


def _full(transport: asyncio.DatagramTransport) -> bool:
    """Whether as much waits to be sent as may."""
    waiting: int = cast("Any", transport).get_write_buffer_size()  # both loops have it
    return waiting > MAX_UNSENT


def _widen(transport: asyncio.DatagramTransport) -> None:
    """Ask for room for a burst; the system's own is 200 kB, which 800 small datagrams fill."""
    sock = transport.get_extra_info("socket")
    if sock is not None:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)


class _Datagrams(asyncio.DatagramProtocol):
    """asyncio's side of a UDP link."""

    def __init__(self, link: Link) -> None:
        self.closed = asyncio.Event()
        self._link = link

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self.closed.set()

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        self._link.feed(data, (addr[0], addr[1]))

    def error_received(self, exc: Exception) -> None:
        # An ICMP refusal: the other end is gone, which its missing heartbeat will tell.
        self._link.count("unreachable")
        log.debug("MAVLink peer refuses datagrams", error=str(exc))


class UdpServer(Link):
    """Listens; whoever sends is answered where it sent from."""

    _transport: asyncio.DatagramTransport | None = None
    _datagrams: _Datagrams | None = None

    async def open(self) -> None:
        """Bind the port."""
        loop = asyncio.get_running_loop()
        try:
            sock = await self._bound(loop)
        except OSError as error:
            raise self.taken(error) from error
        self._transport, self._datagrams = await loop.create_datagram_endpoint(lambda: _Datagrams(self), sock=sock)
        _widen(self._transport)

    async def _bound(self, loop: asyncio.AbstractEventLoop) -> socket.socket:
        """A socket at the port: bound here, since an event loop may leave behind one that it could not bind."""
        found = await loop.getaddrinfo(self.remote.host, self.remote.port, type=socket.SOCK_DGRAM)
        family, kind, protocol, _, address = found[0]
        sock = socket.socket(family, kind, protocol)
        try:
            sock.setblocking(False)
            sock.bind(address)
        except OSError:
            sock.close()
            raise
        return sock

    @property
    def address(self) -> Address:
        """Host and port bound."""
        if self._transport is None:
            raise ConfigError("the MAVLink port is closed")
        return cast("Address", self._transport.get_extra_info("sockname")[:2])

    @property
    def others(self) -> tuple[Address, ...]:
        """Nobody is known before it was heard."""
        return ()

    def _write(self, raw: bytes, to: Address) -> bool:
        """Send a datagram."""
        if self._transport is None or _full(self._transport):
            return False
        self._transport.sendto(raw, to)
        return True

    async def close(self) -> None:
        """Close the socket."""
        if self._transport is not None and self._datagrams is not None:
            self._transport.abort()
            self._transport = None
            await self._datagrams.closed.wait()


class UdpClient(Link):
    """Sends to one address from a port of the system's choice; only that address is heard.

    The socket is made anew after an error: an interface may come up later than the gateway, or change its address.
    """

    RETRY_S = 2.0

    _transport: asyncio.DatagramTransport | None = None
    _other: Address | None = None
    _keeping: "asyncio.Task[None] | None" = None

    async def open(self) -> None:
        """Begin; the other end need not be there."""
        self._keeping = asyncio.create_task(self._keep(), name=f"MAVLink {self.remote}")

    async def _keep(self) -> None:
        loop = asyncio.get_running_loop()
        told = ""
        while True:
            try:
                transport, datagrams = await loop.create_datagram_endpoint(
                    lambda: _Datagrams(self), remote_addr=(self.remote.host, self.remote.port)
                )
            except OSError as error:
                self.problem = str(error)
                if str(error) != told:
                    told = str(error)
                    log.warning("MAVLink address cannot be reached", connect=str(self.remote), reason=told)
                await asyncio.sleep(self.RETRY_S)
                continue
            self._transport, told, self.problem = transport, "", ""
            _widen(transport)
            self._other = cast("Address", transport.get_extra_info("peername")[:2])
            try:
                await datagrams.closed.wait()
            finally:
                self._transport = self._other = None
                transport.abort()
            await asyncio.sleep(self.RETRY_S)

    @property
    def address(self) -> Address:
        """Where it sends."""
        return self.remote.host, self.remote.port

    @property
    def others(self) -> tuple[Address, ...]:
        """The address it sends to, as the system resolved it."""
        return () if self._other is None else (self._other,)

    def _write(self, raw: bytes, to: Address) -> bool:
        """Send a datagram."""
        if self._transport is None or to != self._other or _full(self._transport):
            return False
        self._transport.sendto(raw)
        return True

    async def close(self) -> None:
        """Close the socket."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
            self._keeping = None
