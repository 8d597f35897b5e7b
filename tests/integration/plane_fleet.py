"""Gateways in this process whose planes hold records together, for tests."""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import msgspec

from appliance.plane.node import Plane
from appliance.plane.records import Resolver, by_bytes
from appliance.plane.settings import PlaneConfig


async def until(condition: Callable[[], object]) -> None:
    """Wait until something is so; the test's own timeout bounds it."""
    while not condition():
        await asyncio.sleep(0.01)


class Fleet:
    """Gateways in this process, each with its own endpoint and file; all have the same table of them."""

    def __init__(self, folder: Path, ports: list[int], **settings: float) -> None:
        self.folder = folder
        self.endpoints = [f"tcp/127.0.0.1:{port}" for port in ports]
        self.settings = settings
        self.planes: dict[int, Plane] = {}

    async def start(self, number: int, resolver: Resolver = by_bytes) -> Plane:
        """Start one gateway."""
        peers = {f"g{each}": endpoint for each, endpoint in enumerate(self.endpoints)}
        config = msgspec.convert({"listen": (self.endpoints[number],), "peers": peers, **self.settings}, PlaneConfig)
        plane = await Plane.open(
            config, fleet="f", gateway=f"g{number}", data_dir=self.folder / f"g{number}", resolver=resolver
        )
        self.planes[number] = plane
        return plane

    async def stop(self, number: int) -> None:
        """Stop one gateway."""
        await self.planes.pop(number).close()

    async def settled(self) -> None:
        """Wait until every gateway sees every other and has reconciled with them."""
        await until(
            lambda: all(
                len(plane.members()) == len(self.planes) and plane.dht.settling.reconciled()
                for plane in self.planes.values()
            )
        )

    def owned_by(self, number: int, prefix: str = "task") -> str:
        """A new key that belongs to a gateway."""
        ring = self.planes[number].ring
        while True:
            key = f"{prefix}/{random.randrange(10**9)}"  # noqa: S311 - any key will do
            if ring.owner(key) == f"g{number}":
                return key


@contextlib.asynccontextmanager
async def fleet_of(folder: Path, ports: list[int], **settings: float) -> AsyncIterator[Fleet]:
    """Gateways of a test's own, none started yet; all are stopped at its end."""
    made = Fleet(folder, ports, **settings)
    try:
        yield made
    finally:
        for number in list(made.planes):
            await made.stop(number)
