"""Gateways as processes that can be killed, stopped and started again, one by one, with a recorder beside them."""

import asyncio
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from appliance import config as configuration
from appliance.client import Endpoint, FleetClient
from appliance.config import GatewayConfig
from appliance.connection import Process
from appliance.errors import DeadlineError, SwiftbotError, UnreachableError
from appliance.llm.settings import LlmConfig
from appliance.model.roles import Role
from appliance.plane.settings import AUTHENTICATED
from appliance.pool.settings import PoolConfig
from appliance.record.settings import RecordConfig
from workshop import keyring, local_fleet

Progress = Callable[[str], None]
START_S = 180.0
STOP_S = 20.0


class Site(Struct, frozen=True, kw_only=True):
    """Where a gateway runs: its endpoint, and what its command is run by (to enter a network namespace)."""

    endpoint: str
    enter: tuple[str, ...] = ()


class Arena:
    """The gateways of one run.

    Args:
        fleet: name of the fleet, unique.
        directory: of their configurations, data and logs.
        sites: where each gateway runs, by its name.
        pool: of every gateway.
        skills: folder of the run's own skills.
        base: further settings of every gateway.
        command: what runs a gateway, with the path of its configuration behind.
        recorder: whether a recorder runs beside them.
        robots: names of the robots that take part; with keys, theirs are made too.

    Where an endpoint is `tls` or `quic`, a new authority issues keys for all (`swiftbot keys`).
    """

    def __init__(
        self,
        *,
        fleet: str,
        directory: Path,
        sites: Mapping[str, Site],
        pool: PoolConfig,
        skills: Path | None = None,
        base: GatewayConfig | None = None,
        command: Sequence[str] = (sys.executable, "-m", "appliance.cli", "gateway", "--config"),
        recorder: bool = True,
        robots: Sequence[str] = (),
    ) -> None:
        self._robots = tuple(robots)
        self.fleet = fleet
        self.directory = directory
        self.sites = dict(sites)
        self.processes: dict[str, Process] = {}
        self.record_dir = directory / "record"
        self._recorder: Process | None = None
        self._pool = pool
        self._skills = skills
        self._gateway_command = tuple(command)
        self._records = recorder
        self._base = base or GatewayConfig(id="gw-1", llm=LlmConfig(tiers=("rules",)))

    @property
    def names(self) -> tuple[str, ...]:
        """All gateways, up or not."""
        return tuple(self.sites)

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Of all gateways."""
        return tuple(each.endpoint for each in self.sites.values())

    def up(self) -> tuple[str, ...]:
        """Gateways whose process runs."""
        return tuple(name for name, each in self.processes.items() if local_fleet.alive(each))

    def prepare(self) -> None:
        """Write the configurations."""
        (self.directory / "logs").mkdir(parents=True, exist_ok=True)
        if self.secured:
            self._issue()
        for name, site in self.sites.items():
            config = replace(
                self._base,
                id=name,
                fleet=self.fleet,
                data_dir=str(self.directory / name / "data"),
                skills=(str(self._skills),) if self._skills else (),
                plane=replace(
                    self._base.plane,
                    listen=(site.endpoint,),
                    peers={each: at.endpoint for each, at in self.sites.items()},
                    keys=self.keys(Role.GATEWAY, name),
                ),
                pool=self._pool,
                record=RecordConfig(directory=str(self.record_dir), keys=self.keys(Role.RECORDER)),
            )
            path = self._config(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(configuration.dump(config))
            if self.secured and name == next(iter(self.sites)):
                keyring.sign_parts(self.directory / "keys", config)

    @property
    def secured(self) -> bool:
        """Whether links are authenticated, so that everybody needs keys."""
        return any(each.endpoint.partition("/")[0] in AUTHENTICATED for each in self.sites.values())

    def keys(self, role: Role, name: str = keyring.BENCH) -> str:
        """File with the keys of somebody; empty where links need none."""
        return str(keyring.file_of(self.directory / "keys", role, name)) if self.secured else ""

    def _issue(self) -> None:
        """Make new keys for all that take part."""
        hosts = {name: site.endpoint.partition("/")[2].rpartition(":")[0] for name, site in self.sites.items()}
        keyring.issue(self.directory / "keys", self.fleet, gateways=hosts, robots=self._robots)

    def _config(self, name: str) -> Path:
        return self.directory / name / "gateway.toml"

    def start(self, name: str) -> Process:
        """Start a gateway."""
        command = (*self.sites[name].enter, *self._gateway_command, str(self._config(name)))
        process = local_fleet.spawn(name, command, self.directory / "logs" / f"{name}.log")
        self.processes[name] = process
        return process

    def record(self) -> None:
        """Start the recorder."""
        command = (sys.executable, "-m", "appliance.cli", "record", "--config", str(self._config(self.names[0])))
        self._recorder = local_fleet.spawn("recorder", command, self.directory / "logs" / "recorder.log")

    def signal(self, name: str, number: signal.Signals) -> None:
        """Signal a gateway's process; it must be alive."""
        os.kill(self.processes[name].pid, number)

    async def kill(self, name: str) -> None:
        """SIGKILL a gateway, and wait until it is gone."""
        self.signal(name, signal.SIGKILL)
        await local_fleet.end([self.processes[name]], grace_s=5.0)

    async def start_all(self, *, progress: Progress, ready: int) -> None:
        """Start every gateway and wait until each has so many containers ready.

        Raises:
            DeadlineError: they were not within 180 s; the message says who.
        """
        self.prepare()
        for name in self.names:
            self.start(name)
        if self._records:
            self.record()
        progress(f"{len(self.names)} gateways of fleet {self.fleet} start")
        async with await self.client() as client:
            await self.settled(client, ready=ready)

    async def client(self, endpoints: Sequence[str] = (), *, wait_s: float = START_S, gateway: str = "") -> FleetClient:
        """Return a client of the fleet, linked to any of the endpoints; with keys of an engineer, or of a gateway."""
        keys = self.keys(Role.GATEWAY, gateway) if gateway else self.keys(Role.ENGINEER)
        until = time.monotonic() + wait_s
        while True:
            connect = tuple(endpoints) or self.endpoints
            client = FleetClient(Endpoint(fleet=self.fleet, connect=connect, keys=keys))
            try:
                return await client.open()
            except (UnreachableError, SwiftbotError):
                if time.monotonic() > until:
                    raise
                await asyncio.sleep(0.2)

    async def settled(self, client: FleetClient, *, ready: int, wait_s: float = START_S) -> None:
        """Wait until every gateway is seen with so many containers ready; DeadlineError with those that are not."""
        until = time.monotonic() + wait_s
        while True:
            known = client.plane.registry.gateways
            missing = [
                f"{name}: {known[name].ready if name in known else 'not seen'}"
                for name in self.names
                if name not in client.plane.members() or name not in known or known[name].ready < ready
            ]
            if not missing:
                return
            if time.monotonic() > until:
                raise DeadlineError(
                    f"containers ready within {wait_s:g} s: {'; '.join(missing)}",
                    remedy=f"see {self.directory}/logs",
                )
            await asyncio.sleep(0.2)

    async def stop(self, *, progress: Progress) -> None:
        """End everything that runs, and remove the containers."""
        for name in self.up():
            self.signal(name, signal.SIGCONT)
        await local_fleet.end([self.processes[name] for name in self.up()], grace_s=STOP_S)
        if self._recorder is not None:
            await local_fleet.end([self._recorder], grace_s=STOP_S)
        if self._skills is not None:
            await local_fleet.remove_containers(self.fleet, progress=progress, volumes=True)


def loopback(count: int, *, secured: bool = False) -> dict[str, Site]:
    """Return sites for so many gateways on this machine's loopback, with keys or without."""
    protocol = "tls" if secured else "tcp"
    return {
        f"gw-{number + 1}": Site(endpoint=f"{protocol}/127.0.0.1:{local_fleet.free_port()}") for number in range(count)
    }
