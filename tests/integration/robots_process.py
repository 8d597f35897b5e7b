"""A gateway process with MAVLink links of each kind: bytes go in at its sockets, and what users see comes out."""

import asyncio
import json
import socket
import sys
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any

import zenoh
from fleets import PLAIN, fleet_in
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import RobotInfo
from appliance.model.robot_api import LinkAdd, LinkFacts, MavlinkLink
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from appliance.robots.mavlink.dialect import Codec, make
from appliance.robots.settings import RobotsConfig

BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}
STATION = BEAT | {"type": 6, "autopilot": 8}


class Process:
    """The gateway, and a client of its fleet."""

    def __init__(self, fleet: FleetState, client: FleetClient) -> None:
        self.fleet, self.client = fleet, client
        self.gateway = fleet.gateways[0]
        self._sockets: list[socket.socket] = []

    async def link(self, scheme: str) -> int:
        """Open a link that listens; return its port."""
        port = free_port(socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM)
        await self.client.robot_link_add(
            self.gateway, LinkAdd(link=MavlinkLink(listen=f"{scheme}://127.0.0.1:{port}"), by="a test")
        )
        return port

    async def facts(self, port: int) -> LinkFacts:
        """One link as `swiftbot robots links` shows it."""
        lists, _ = await self.client.robot_links(self.gateway)
        return next(each for each in lists[self.gateway].links if each.url.endswith(f":{port}"))

    def refused(self) -> dict[str, int]:
        """The gateway's counters of bad input, as `swiftbot fleet` shows them."""
        return dict(self.client.plane.registry.gateways[self.gateway].refused)

    def robots(self) -> dict[str, RobotInfo]:
        """The robots of the list."""
        return dict(self.client.plane.registry.robots)

    def connect(self, scheme: str, port: int) -> socket.socket:
        """Connect to a link; closed at the end."""
        kind = socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM
        it = socket.socket(socket.AF_INET, kind)
        it.connect(("127.0.0.1", port))
        it.setblocking(False)
        self._sockets.append(it)
        return it

    async def until(
        self, holds: Callable[[], object], act: Callable[[], object] = lambda: None, limit_s: float = 30.0
    ) -> None:
        """Wait until something is so, doing something again and again meanwhile."""
        async with asyncio.timeout(limit_s):
            while not holds():
                act()
                await asyncio.sleep(0.1)

    def close(self) -> None:
        """Close all sockets."""
        for each in self._sockets:
            with closing(each):
                pass


def read_frames(it: socket.socket) -> list[Any]:
    """Return the messages that have come at a socket."""
    data = bytearray()
    while True:
        try:
            data += it.recv(65536)
        except (BlockingIOError, ConnectionRefusedError):
            break
    return [each for each in Codec(1, 1).read(bytes(data)) if hasattr(each, "raw")]


def beats(system: int, component: int = 1, **changes: int) -> Callable[[], bytes]:
    """Return a maker of one sender's heartbeats."""
    codec = Codec(system, component)
    return lambda: codec.pack(make("HEARTBEAT", **(BEAT | changes)))


@asynccontextmanager
async def gateway_process(folder: Path, robots: RobotsConfig | None = None, **order: Any) -> AsyncGenerator[Process]:
    """Run a gateway as users run it; ended and cleaned up afterwards."""
    base = replace(PLAIN, robots=robots or RobotsConfig())
    wanted = {"gateways": 1, "zenoh": 0, "base": base, "pool": PoolConfig(floor={}), "sim_rate": 1.0} | order
    async with fleet_in(folder, **wanted) as fleet, FleetClient(fleet.endpoint) as client:
        await client.gateway()
        it = Process(fleet, client)
        try:
            yield it
        finally:
            it.close()


async def swiftbot(fleet: FleetState, *arguments: str) -> tuple[int, str]:
    """Run `swiftbot` for this fleet; return its exit status and all that it printed."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli", *arguments, "--dir", fleet.directory,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    printed, _ = await process.communicate()
    return process.returncode or 0, printed.decode()


def open_zenoh(fleet: FleetState) -> zenoh.Session:
    """Open a plain session, as a robot's own program does."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps(fleet.endpoints))
    return zenoh.open(config)
