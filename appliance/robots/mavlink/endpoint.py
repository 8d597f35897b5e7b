"""A UDP port on which MAVLink vehicles are heard and answered.

Frames are checked and counted here, once, before anybody acts on them: what is damaged, of an unknown dialect or
signed is counted by kind and dropped, and the stream goes on. Who a frame is from is for the caller to judge.
"""

import asyncio
from collections.abc import Callable
from typing import Any, cast

import structlog

from appliance.errors import ConfigError
from appliance.robots.mavlink.dialect import Codec, Damage, Frame, Message

log = structlog.get_logger(__name__)

Address = tuple[str, int]


class Endpoint(asyncio.DatagramProtocol):
    """One bound UDP socket. `on_frame(frame, address)` runs on the event loop for each good frame."""

    def __init__(
        self, codec: Codec, on_frame: Callable[[Frame, Address], None], refused: dict[str, int] | None = None
    ) -> None:
        self.codec = codec
        self.received = 0
        self.refused: dict[str, int] = {} if refused is None else refused
        self._on_frame = on_frame
        self._transport: asyncio.DatagramTransport | None = None
        self._closed = asyncio.Event()

    @classmethod
    async def open(
        cls,
        listen: Address,
        codec: Codec,
        on_frame: Callable[[Frame, Address], None],
        refused: dict[str, int] | None = None,
    ) -> "Endpoint":
        """Bind the port; ConfigError with the remedy when it is taken or not this machine's."""
        loop = asyncio.get_running_loop()
        host, port = listen
        try:
            _, protocol = await loop.create_datagram_endpoint(
                lambda: cls(codec, on_frame, refused), local_addr=(host, port)
            )
        except OSError as error:
            raise ConfigError(
                f"MAVLink cannot listen on udp://{host}:{port}: {error.strerror or error}",
                remedy="another ground station or gateway has the port: stop it, or set another robots.mavlink listen",
            ) from error
        return protocol

    @property
    def address(self) -> Address:
        """Host and port bound; port 0 in the settings becomes the one given by the system."""
        if self._transport is None:
            raise ConfigError("the MAVLink port is closed")
        return cast("Address", self._transport.get_extra_info("sockname")[:2])

    def send(self, message: Message, to: Address) -> bytes:
        """Send one message and return its frame; datagrams may be lost, so nothing is raised for that."""
        raw = self.codec.pack(message)
        if self._transport is not None:
            self._transport.sendto(raw, to)
        return raw

    async def close(self) -> None:
        """Close the socket; the port is free when it returns."""
        if self._transport is not None:
            self._transport.abort()
            self._transport = None
            await self._closed.wait()

    def count(self, kind: str) -> None:
        """Count one piece of bad input."""
        self.refused[kind] = self.refused.get(kind, 0) + 1

    def feed(self, data: bytes, address: Address) -> None:
        """Take in bytes as if they had come in a datagram."""
        for each in self.codec.read(data):
            if isinstance(each, Damage):
                self.count(each.kind)
            else:
                self.received += 1
                self._on_frame(each, address)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport (asyncio)."""
        self._transport = cast("asyncio.DatagramTransport", transport)

    def connection_lost(self, exc: Exception | None) -> None:
        """Note that the socket is closed (asyncio)."""
        del exc
        self._closed.set()

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        """Take in a datagram (asyncio)."""
        self.feed(data, (addr[0], addr[1]))

    def error_received(self, exc: Exception) -> None:
        """Count an ICMP refusal: a vehicle that is gone, which its heartbeat will tell (asyncio)."""
        self.count("unreachable")
        log.debug("MAVLink peer refuses datagrams", error=str(exc))
