"""Ends of MAVLink links of each kind, for tests: a station that listens, and who is at the other end of its link."""

import asyncio
import contextlib
import os
import pty
import socket
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any, cast

import msgspec

from appliance.model import RobotInfo, Site, TaskRecord, TaskRequest
from appliance.model.robot_api import MavlinkLink
from appliance.ports import free_port
from appliance.robots.mavlink.dialect import Codec, make
from appliance.robots.mavlink.node import MavlinkNode
from appliance.robots.mavlink.tunnel import MAX_PAYLOAD, PAYLOAD_TYPE
from appliance.robots.settings import RobotsConfig
from appliance.robots.task_listener import Tasks
from tests.unit.robots.conftest import FakeSession, FakeStore

BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}

STATION = BEAT | {"autopilot": 8, "type": 6}
"""A ground station's heartbeat: from then on what it asks is listened to."""

KEY = bytes(range(32))


class Wire(FakeSession):
    """A plane that nobody listens to: a real one is in tests/integration."""

    unsent = 0

    def subscribe_typed(self, *_: object, **__: object) -> "Wire":
        """Subscribe."""
        return self

    def watch_alive(self, *_: object) -> "Wire":
        """Watch."""
        return self

    def declare_alive(self, _: str) -> "Wire":
        """Declare."""
        return self

    def serve(self, *_: object, **__: object) -> "Wire":
        """Serve."""
        return self

    def close(self) -> None:
        """Close."""


@asynccontextmanager
async def station(port: int, *more: MavlinkLink, **changes: Any) -> AsyncIterator[tuple[MavlinkNode, dict[str, int]]]:
    """Open a station on a UDP port, with further links."""
    refused: dict[str, int] = {}

    async def submit(request: TaskRequest) -> TaskRecord:
        return TaskRecord(id=request.id, instruction=request.instruction)

    async def look(task: str) -> TaskRecord:
        return TaskRecord(id=task, instruction="")

    made = MavlinkNode(
        RobotsConfig(mavlink=(MavlinkLink(listen=f"udp://127.0.0.1:{port}"), *more), **changes),
        session=cast("Any", Wire()),
        store=FakeStore(),
        gateway="gw-1",
        site=Site(),
        refused=refused,
        tasks=Tasks(submit=submit, cancel=lambda task, _: look(task), look=look),
    )
    await made.start()
    try:
        yield made, refused
    finally:
        await made.stop()


@asynccontextmanager
async def sender(port: int) -> AsyncIterator[Callable[[bytes], None]]:
    """Open a socket that sends to a port."""
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        asyncio.DatagramProtocol, remote_addr=("127.0.0.1", port)
    )
    try:
        yield transport.sendto
    finally:
        transport.close()


async def until(holds: Callable[[], object], act: Callable[[], object] = lambda: None) -> None:
    """Wait until something is so, doing something again and again meanwhile."""
    async with asyncio.timeout(60):
        while not holds():
            act()
            await asyncio.sleep(0.02)


LINKS = ("udp listen", "udp connect", "tcp listen", "tcp connect", "serial")


class Outside:
    """Who is at the other end of a gateway's link of some kind, and brings what the test wants."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._port = 0
        self._datagrams: Callable[[bytes], None] | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._master = -1
        self._left = bytearray()

    async def prepare(self, closing: AsyncExitStack) -> MavlinkLink:
        """Return the link that a gateway is to open; what it connects to is there already."""
        if self.kind == "serial":
            self._master, slave = pty.openpty()
            closing.callback(os.close, self._master)
            closing.callback(os.close, slave)
            tty.setraw(self._master)
            os.set_blocking(self._master, False)
            return MavlinkLink(connect=f"serial:{os.ttyname(slave)}:57600")
        scheme, _, way = self.kind.partition(" ")
        if way == "listen":
            self._port = free_port(socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM)
            return MavlinkLink(listen=f"{scheme}://127.0.0.1:{self._port}")
        if scheme == "udp":
            outside = self

            class Waiting(asyncio.DatagramProtocol):
                def connection_made(self, transport: asyncio.BaseTransport) -> None:
                    self.transport = cast("asyncio.DatagramTransport", transport)

                def datagram_received(self, _: bytes, address: Any) -> None:
                    outside._datagrams = lambda raw: self.transport.sendto(raw, address)

            transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                Waiting, local_addr=("127.0.0.1", 0)
            )
            closing.callback(transport.close)
            return MavlinkLink(connect=f"udp://127.0.0.1:{transport.get_extra_info('sockname')[1]}")

        def accept(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self._writer = writer
            closing.callback(writer.close)

        server = await asyncio.start_server(accept, "127.0.0.1", 0)
        closing.callback(server.close)
        return MavlinkLink(connect=f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}")

    async def meet(self, made: MavlinkNode, closing: AsyncExitStack) -> None:
        """Come to the gateway, or wait until it has come."""
        if self.kind == "udp listen":
            self._datagrams = await closing.enter_async_context(sender(self._port))
        elif self.kind == "tcp listen":
            _, self._writer = await asyncio.open_connection("127.0.0.1", self._port)
            closing.callback(self._writer.close)
        elif self.kind == "serial":
            await until(lambda: not any(each.problem for each in made.link_list().links))
        else:
            await until(lambda: self._datagrams or self._writer)

    def write(self, *raws: bytes) -> None:
        """Send some frames, or go on with what a serial port has not taken yet."""
        for raw in raws:
            if self._datagrams is not None:
                self._datagrams(raw)
            elif self._writer is not None:
                self._writer.write(raw)
            elif len(self._left) < 2**16:
                self._left += raw
        if self._left:
            with contextlib.suppress(BlockingIOError):
                del self._left[: os.write(self._master, self._left)]


@asynccontextmanager
async def beside(
    kind: str, signing: str = "", **changes: Any
) -> AsyncIterator[tuple[MavlinkNode, dict[str, int], Outside, Callable[[bytes], None]]]:
    """Open a station with a link of that kind, whose other end the test has, and another link with a vehicle."""
    port, outside = free_port(socket.SOCK_DGRAM), Outside(kind)
    async with AsyncExitStack() as closing:
        link = msgspec.structs.replace(await outside.prepare(closing), signing=signing)
        made, refused = await closing.enter_async_context(station(port, link, **changes))
        await outside.meet(made, closing)
        vehicle = await closing.enter_async_context(sender(port))
        yield made, refused, outside, vehicle


def tunnel_of(codec: Codec, payload: bytes) -> bytes:
    """Return a TUNNEL frame for the gateway with that payload."""
    return codec.pack(
        make(
            "TUNNEL", target_system=242, target_component=191, payload_type=PAYLOAD_TYPE,
            payload_length=len(payload), payload=list(payload.ljust(MAX_PAYLOAD, b"\0")),
        )
    )  # fmt: skip


async def understood(made: MavlinkNode, outside: Outside, system: int = 78) -> None:
    """Wait until a frame is heard from this end."""
    codec = Codec(system, 1)
    await until(
        lambda: any(each.system == system for link in made.link_list().links for each in link.senders),
        lambda: outside.write(codec.pack(make("HEARTBEAT", **BEAT)) + bytes(280)),
    )


async def served(made: MavlinkNode, vehicle: Callable[[bytes], None], outside: Outside) -> None:
    """Wait until a vehicle on another link is a robot, while this one brings what it has left."""
    codec = Codec(77, 1)

    def act() -> None:
        vehicle(codec.pack(make("HEARTBEAT", **BEAT)))
        outside.write()

    await until(lambda: "drone_77" in made.vehicles.attached, act)


def states_told(made: MavlinkNode) -> list[RobotInfo]:
    """Return what was told of robots, in order."""
    session = cast("Wire", made._session)
    return [msgspec.json.decode(value, type=RobotInfo) for key, value in session.puts if key.endswith("/state")]
