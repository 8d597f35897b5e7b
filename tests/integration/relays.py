"""A link that a test can cut and mend, and routers in the test's process for it to lie between."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from appliance.plane.node import run_router
from appliance.plane.settings import PlaneConfig


class Relay:
    """Passes bytes between its clients and a port, until it is cut; then nothing, until it is mended."""

    def __init__(self, port: int, to: int) -> None:
        self._port, self._to = port, to
        self._server: asyncio.Server | None = None
        self._links: set[asyncio.StreamWriter] = set()

    async def mend(self) -> None:
        """Listen."""
        self._server = await asyncio.start_server(self._link, "127.0.0.1", self._port)

    async def cut(self) -> None:
        """Break all links and take no new ones."""
        if self._server is not None:
            self._server.close()
            for writer in self._links:
                writer.transport.abort()
            await self._server.wait_closed()
            self._server = None

    async def _link(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            other_reader, other_writer = await asyncio.open_connection("127.0.0.1", self._to)
        except OSError:
            writer.close()
            return
        self._links |= {writer, other_writer}
        try:
            await asyncio.gather(self._pass(reader, other_writer), self._pass(other_reader, writer))
        finally:
            self._links -= {writer, other_writer}

    @staticmethod
    async def _pass(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
        writer.close()


@asynccontextmanager
async def router(listen: str, *connect: str, lease_ms: int = 1000) -> AsyncIterator[None]:
    """A router in this process."""
    stop, opened = asyncio.Event(), asyncio.get_running_loop().create_future()
    config = PlaneConfig(mode="router", listen=(listen,), connect=connect, lease_ms=lease_ms)
    running = asyncio.create_task(run_router(config, stop=stop, ready=opened.set_result, alive=lambda: None))
    try:
        await opened
        yield
    finally:
        stop.set()
        await running
