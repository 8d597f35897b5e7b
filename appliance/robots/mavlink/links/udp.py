"""MAVLink over UDP: a datagram holds whole frames."""

import asyncio
from typing import Any, cast

import structlog

from appliance.errors import ConfigError
from appliance.robots.mavlink.links.base import Address, Link

log = structlog.get_logger(__name__)


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
            self._transport, self._datagrams = await loop.create_datagram_endpoint(
                lambda: _Datagrams(self), local_addr=(self.remote.host, self.remote.port)
            )
        except OSError as error:
            raise self.taken(error) from error

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

    def transmit(self, raw: bytes, to: Address) -> None:
        """Send a datagram."""
        if self._transport is not None:
            self._transport.sendto(raw, to)

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
                if str(error) != told:
                    told = str(error)
                    log.warning("MAVLink address cannot be reached", connect=str(self.remote), reason=told)
                await asyncio.sleep(self.RETRY_S)
                continue
            self._transport, told = transport, ""
            try:
                await datagrams.closed.wait()
            finally:
                self._transport = None
                transport.abort()
            await asyncio.sleep(self.RETRY_S)

    @property
    def address(self) -> Address:
        """Where it sends."""
        return self.remote.host, self.remote.port

    @property
    def others(self) -> tuple[Address, ...]:
        """The address it sends to, as the system resolved it."""
        if self._transport is None:
            return ()
        return (cast("Address", self._transport.get_extra_info("peername")[:2]),)

    def transmit(self, raw: bytes, to: Address) -> None:
        """Send a datagram."""
        if self._transport is not None and to in self.others:
            self._transport.sendto(raw)

    async def close(self) -> None:
        """Close the socket."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
            self._keeping = None
