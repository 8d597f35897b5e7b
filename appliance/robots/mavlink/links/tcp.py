"""MAVLink over TCP: a stream, in which a frame may come in pieces."""

import asyncio
from typing import cast

import structlog

from appliance.errors import ConfigError
from appliance.robots.mavlink.dialect import Stream
from appliance.robots.mavlink.links.base import Address, Link

log = structlog.get_logger(__name__)

MAX_CONNECTIONS = 64
"""Of one listening port; more are refused and counted."""
MAX_UNSENT = 256 * 1024
"""Bytes that may wait for an end that does not read; beyond it frames are dropped and counted, as on a radio link."""
MAX_READ = 16 * 1024
"""Bytes taken from one connection before the others have their turn: some 300 frames."""
FIRST_RETRY_S = 0.5
LAST_RETRY_S = 10.0


class _TcpLink(Link):
    """Connections by the address of their other end."""

    def _begin(self) -> None:
        self._writers: dict[Address, asyncio.StreamWriter] = {}
        self._unsent: dict[Address, bytearray] = {}
        """Frames that go out together at the end of this turn of the loop: a system call costs more than a frame."""

    @property
    def others(self) -> tuple[Address, ...]:
        """The other ends of all connections: none of them speaks by accident."""
        return tuple(self._writers)

    def _write(self, raw: bytes, to: Address) -> bool:
        """Send a frame on its connection, unless that is gone or stuck."""
        writer = self._writers.get(to)
        if writer is None or writer.is_closing():
            return False
        unsent = self._unsent.get(to)
        if writer.transport.get_write_buffer_size() + (len(unsent) if unsent else 0) > MAX_UNSENT:
            self.count("not_read")
            return False
        if not self._unsent:
            asyncio.get_running_loop().call_soon(self._flush)
        if unsent is None:
            unsent = self._unsent[to] = bytearray()
        unsent += raw
        return True

    def _flush(self) -> None:
        """Send what was written in this turn of the loop."""
        unsent, self._unsent = self._unsent, {}
        for to, frames in unsent.items():
            writer = self._writers.get(to)
            if writer is not None and not writer.is_closing():
                writer.write(frames)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Read one connection to its end."""
        peer = writer.get_extra_info("peername")
        if peer is None:  # gone before it was looked at
            writer.transport.abort()
            return
        address = cast("Address", peer[:2])
        stream = Stream(self.codec)
        self._writers[address] = writer
        log.info("MAVLink connection", link=str(self.remote), peer=f"{address[0]}:{address[1]}")
        try:
            while data := await reader.read(MAX_READ):
                await self.pace(address, self.take(stream.feed(data), address))
        except OSError as error:
            log.info("MAVLink connection broke", link=str(self.remote), reason=str(error))
        finally:
            del self._writers[address]
            self.take(stream.end(), address)
            writer.transport.abort()


class TcpServer(_TcpLink):
    """Listens for connections."""

    _server: asyncio.Server | None = None
    _serving: "set[asyncio.Task[None]]"

    async def open(self) -> None:
        """Bind the port."""
        self._begin()
        self._serving = set()
        try:
            self._server = await asyncio.start_server(self._connected, self.remote.host, self.remote.port)
        except OSError as error:
            raise self.taken(error) from error

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._writers) >= MAX_CONNECTIONS:
            self.count("too_many_connections")
            writer.transport.abort()
            return
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - asyncio calls this in a task of its own
        self._serving.add(task)
        try:
            await self._serve(reader, writer)
        finally:
            self._serving.discard(task)

    @property
    def address(self) -> Address:
        """Host and port bound."""
        if self._server is None:
            raise ConfigError("the MAVLink port is closed")
        return cast("Address", self._server.sockets[0].getsockname()[:2])

    async def close(self) -> None:
        """Close the port and all connections."""
        if self._server is not None:
            self._server.close()
            for writer in list(self._writers.values()):
                writer.transport.abort()
            await asyncio.gather(*self._serving, return_exceptions=True)
            await self._server.wait_closed()
            self._server = None


class TcpClient(_TcpLink):
    """Connects, and connects again for as long as it is open."""

    _keeping: "asyncio.Task[None] | None" = None

    async def open(self) -> None:
        """Begin; the other end need not be there."""
        self._begin()
        self._keeping = asyncio.create_task(self._keep(), name=f"MAVLink {self.remote}")

    async def _keep(self) -> None:
        pause_s, told = FIRST_RETRY_S, ""
        while True:
            try:
                reader, writer = await asyncio.open_connection(self.remote.host, self.remote.port)
            except OSError as error:
                self.problem = str(error)
                if str(error) != told:
                    told = str(error)
                    log.warning("MAVLink address cannot be reached", connect=str(self.remote), reason=told)
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, LAST_RETRY_S)
                continue
            pause_s, told, self.problem = FIRST_RETRY_S, "", ""
            await self._serve(reader, writer)
            await asyncio.sleep(pause_s)

    @property
    def address(self) -> Address:
        """Where it connects to."""
        return self.remote.host, self.remote.port

    async def close(self) -> None:
        """Close the connection."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
            self._keeping = None
