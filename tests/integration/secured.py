"""A fleet with keys, for tests: two gateways in this process, and members with a certificate or none."""

import asyncio
import contextlib
import shutil
from collections.abc import AsyncIterator, Callable
from datetime import UTC, datetime
from pathlib import Path

import zenoh

from appliance.identity import credentials as credentials_module
from appliance.identity.authority import Authority
from appliance.model.roles import Role
from appliance.plane import link, node
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig

FLEET = "f"
GATEWAYS = ("g0", "g1")
ROBOTS = ("r1", "r2")
NAMES = {
    Role.GATEWAY: "g1",
    Role.RECORDER: "rec",
    Role.ROBOT: "r1",
    Role.VIEWER: "vera",
    Role.OPERATOR: "olga",
    Role.ENGINEER: "emma",
}
"""One member of each role."""


async def until(condition: Callable[[], object]) -> None:
    """Wait until something is so; the test's own timeout bounds it."""
    while not condition():
        await asyncio.sleep(0.01)


class Secured:
    """Authority, keys and gateways of a fleet."""

    def __init__(self, folder: Path, ports: list[int], protocol: str) -> None:
        self.folder = folder
        self.endpoints = {name: f"{protocol}/127.0.0.1:{port}" for name, port in zip(GATEWAYS, ports, strict=False)}
        self.authority = Authority.create(folder / "authority", FLEET, datetime.now(UTC))
        self.planes: dict[str, Plane] = {}
        for name in GATEWAYS:
            self.issue(Role.GATEWAY, name)
        for name in ROBOTS:
            self.issue(Role.ROBOT, name)
        for role, name in NAMES.items():
            if role not in (Role.GATEWAY, Role.ROBOT):
                self.issue(role, name)

    def issue(self, role: Role, name: str, **more: int) -> Path:
        """Issue keys, and give the gateways the roster."""
        out = self.folder / f"{role}-{name}.pem"
        self.authority.issue(role, name, out=out, **more)
        self.hand_out()
        return out

    def hand_out(self) -> None:
        """Give the gateways the roster."""
        target = self.folder / "roster.json"
        shutil.copy(self.authority.roster_file, self.folder / "roster.new")
        (self.folder / "roster.new").replace(target)

    def keys(self, role: Role, name: str = "") -> Path:
        """Where somebody's keys are."""
        return self.folder / f"{role}-{name or NAMES[role]}.pem"

    def client(self, role: Role, name: str = "", *, at: str = "g0") -> PlaneConfig:
        """How somebody connects to a gateway."""
        return PlaneConfig(
            mode="client", connect=(self.endpoints[at],), keys=str(self.keys(role, name)), connect_timeout_s=1.0
        )

    async def start(self, name: str) -> Plane:
        """Start a gateway."""
        config = PlaneConfig(
            listen=(self.endpoints[name],), peers=self.endpoints, keys=str(self.keys(Role.GATEWAY, name))
        )
        plane = await Plane.open(config, fleet=FLEET, gateway=name, data_dir=self.folder / f"data-{name}")
        self.planes[name] = plane
        return plane

    def look_often(self) -> None:
        """Have the gateways look for a new roster all the time."""
        credentials_module.LOOK_S, node.ROSTER_S = 0.0, 0.05
        for plane in self.planes.values():
            assert plane._proving is not None
            plane._proving.cancel()
            assert plane.session.credentials is not None
            plane.session.credentials._look_at = 0.0
            plane._proving = asyncio.create_task(plane._watch_roster(plane.session.credentials))

    async def raw(self, role: Role, name: str = "", *, at: str = "g0") -> zenoh.Session:
        """A session of somebody who does not go by this product's code, which would refuse most of it by itself."""
        config = self.client(role, name, at=at)
        credentials = await asyncio.to_thread(link.read_credentials, config, FLEET)
        return await asyncio.to_thread(link.open_raw, config, "", credentials)


@contextlib.asynccontextmanager
async def secured(folder: Path, ports: list[int], *, protocol: str = "tls") -> AsyncIterator[Secured]:
    """A fleet with keys whose two gateways see each other."""
    it = Secured(folder, ports, protocol)
    try:
        for name in GATEWAYS:
            await it.start(name)
        await until(lambda: all(len(plane.members()) == len(GATEWAYS) for plane in it.planes.values()))
        yield it
    finally:
        for plane in it.planes.values():
            await plane.close()
