"""A whole fleet on this machine: gateways, recorder and simulated robots, each a process of its own.

What `swiftbot up` starts is what runs on separate machines: the same daemons with the same configuration
files, only that they share a host. The state file in the fleet's directory names every process with its start
time, so that `down` ends exactly those, and commands find the endpoints.
"""

import asyncio
import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import msgspec
import psutil
from msgspec import Struct

from appliance import config as configuration
from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState, Process, read_state
from appliance.errors import (
    ConfigError,
    DeadlineError,
    NotFoundError,
    PrerequisiteError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model.keys import check_name
from appliance.model.robot_api import MavlinkLink
from appliance.model.roles import Role
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from appliance.record.settings import RecordConfig
from appliance.skills.catalogue import load_catalogue
from workshop import keyring

Progress = Callable[[str], None]
MOST_DRONES = 240
"""MAVLink has 255 systems; a gateway is one, ground stations are others."""
OWN_PROCESS = 8
"""Up to so many simulated MAVLink vehicles have a process each, which can be killed; more are in one."""
DRONES = "drones"
"""The name of that process."""


class Ended(Struct, frozen=True, kw_only=True):
    """What `down` has ended and removed, and which state volumes it has left."""

    fleet: str
    directory: str
    processes: int
    containers: int
    removed_volumes: tuple[str, ...]
    kept_volumes: tuple[str, ...]
    problem: str = ""
    """Why containers and volumes were left as they are; empty when Podman did all."""


class Simulated(Struct, frozen=True, kw_only=True):
    """A simulated robot."""

    name: str
    kind: Literal["copter", "rover", "mobile"]
    """The first two speak MAVLink; a mobile robot with arm and camera speaks Zenoh."""
    start: str = ""
    """Its home, a place or a point "x, y"; empty: the usual one of its kind."""
    spot: int = 0
    at: str = ""
    """Where it stands at first, a point "x, y"; empty: at home."""
    battery_percent: float = 100.0
    holding: str = ""

    @property
    def options(self) -> tuple[str, ...]:
        """Those of `swiftbot sim` that both kinds have."""
        given = {"--start": self.start, "--at": self.at}
        texts = (each for name, text in given.items() if text for each in (name, text))
        return (*texts, "--spot", str(self.spot), "--battery", f"{self.battery_percent:g}")


class Order(Struct, frozen=True, kw_only=True):
    """What to start."""

    fleet: str = "local"
    directory: Path
    gateways: int = 3
    mavlink: int = 1
    zenoh: int = 1
    robots: tuple[Simulated, ...] = ()
    """Simulated robots by name, instead of numbers of copters and mobile robots."""
    site: str = "warehouse"
    skills: tuple[Path, ...] = ()
    """Folders with further skills, beside those that `base` names."""
    sim_rate: float = 1.0
    """How many times faster than real the simulated robots move."""
    pool: PoolConfig = PoolConfig()
    pools: dict[str, PoolConfig] = {}
    """Pools of single gateways, by name, instead of `pool`."""
    secured: bool = False
    """Whether everybody gets keys, from an authority that is made for it."""
    base: GatewayConfig | None = None
    """Configuration that the gateways' own are made from."""

    @property
    def simulated(self) -> tuple[Simulated, ...]:
        """All its robots."""
        drones = (Simulated(name=f"drone_{at + 1}", kind="copter", spot=at) for at in range(self.mavlink))
        rovers = (Simulated(name=f"rover_{at + 1}", kind="mobile", spot=at) for at in range(self.zenoh))
        return self.robots or (*drones, *rovers)

    def pool_of(self, gateway: str) -> PoolConfig:
        """The pool of one gateway."""
        return self.pools.get(gateway, self.pool)


def keys_folder(directory: Path) -> Path:
    """Where the keys of a local fleet are."""
    return directory / "keys"


def alive(process: Process) -> bool:
    """Whether that very process still runs."""
    try:
        found = psutil.Process(process.pid)
        return abs(found.create_time() - process.started) < 1.0 and found.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


async def up(order: Order, *, progress: Progress, timeout_s: float = 60.0) -> FleetState:
    """Start a fleet and wait until it can work.

    Raises:
        ConfigError: one of that name runs already, or a name, a number or a skill is wrong.
        PrerequisiteError: a process ended at once; the message has the end of its log.
        DeadlineError: it was not ready in time; the message says what was missing.
    """
    check_name(order.fleet, "fleet")
    if not 1 <= order.gateways <= 16:
        raise ConfigError(f"{order.gateways} gateways", remedy="a local fleet has 1 to 16")
    if not 0 <= order.mavlink <= MOST_DRONES:
        raise ConfigError(f"{order.mavlink} MAVLink vehicles", remedy=f"a local fleet has 0 to {MOST_DRONES}")
    if order.secured and any(each.kind == "mobile" for each in order.simulated):
        raise ConfigError(
            "simulated Zenoh robots share a world on keys that no role may use",
            remedy="leave them out of a secured fleet",
        )
    if len(order.robots) > OWN_PROCESS:
        raise ConfigError(f"{len(order.robots)} robots by name", remedy=f"at most {OWN_PROCESS} can be named")
    load_catalogue(order.skills)  # so that a mistake in a manifest is reported here, and not in each gateway's log
    directory = order.directory
    try:
        running = [each for each in read_state(directory).processes if alive(each)]
    except NotFoundError:
        running = []
    if running:
        raise ConfigError(
            f"a fleet runs in {directory} ({len(running)} processes)",
            remedy="use it, or end it with `swiftbot down`, or give another --fleet or --dir",
        )
    starting = _Starting(order)
    try:
        try:
            state = starting.start_all(progress)
        except OSError as error:
            raise ConfigError(
                f"{error.filename or directory} cannot be written: {error.strerror}",
                remedy="give a writable --dir with space left",
            ) from error
        await _wait_ready(state, order, progress, timeout_s)
    except BaseException:
        await end(starting.processes, grace_s=10.0)
        if starting.processes:
            await remove_containers(order.fleet, progress=progress)
        raise
    return state


class _Starting:
    """Writes the configuration files and starts the processes."""

    def __init__(self, order: Order) -> None:
        self._order = order
        self.processes: list[Process] = []

    def start_all(self, progress: Progress) -> FleetState:
        order, directory = self._order, self._order.directory
        (directory / "logs").mkdir(parents=True, exist_ok=True)
        record_dir = directory / "record"
        ports = [free_port() for _ in range(order.gateways)]
        endpoints = tuple(f"{'tls' if order.secured else 'tcp'}/127.0.0.1:{port}" for port in ports)
        names = tuple(f"gw-{number + 1}" for number in range(order.gateways))
        mobile = [each for each in order.simulated if each.kind == "mobile"]
        vehicles = [each for each in order.simulated if each.kind != "mobile"]
        udp_ports = [free_port(socket.SOCK_DGRAM) for _ in vehicles]
        if order.secured:
            hosts = dict.fromkeys(names, "127.0.0.1")
            keyring.issue(keys_folder(directory), order.fleet, gateways=hosts)
        for index, name in enumerate(names):
            links = tuple(
                MavlinkLink(listen=f"udp://127.0.0.1:{udp_ports[at]}", names={str(at + 1): vehicle.name})
                for at, vehicle in enumerate(vehicles)
                if at % order.gateways == index
            )
            config = self._config(names, endpoints, index, links, record_dir)
            path = directory / name / "gateway.toml"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(configuration.dump(config))
            if order.secured and not index:
                keyring.sign_parts(keys_folder(directory), config)
            self._spawn(name, "gateway", "--config", str(path))
        self._spawn("recorder", "record", "--config", str(directory / names[0] / "gateway.toml"))
        moving = ("--site", order.site, "--rate", str(order.sim_rate))
        if len(vehicles) > OWN_PROCESS:
            to = (each for port in udp_ports for each in ("--to", f"udp://127.0.0.1:{port}"))
            self._spawn(DRONES, "sim", "mavlink", *to, "--system", "1", *moving)
        else:
            for at, vehicle in enumerate(vehicles):
                link = ("--to", f"udp://127.0.0.1:{udp_ports[at]}", "--system", str(at + 1), "--kind", vehicle.kind)
                self._spawn(vehicle.name, "sim", "mavlink", *link, *vehicle.options, *moving)
        connect = tuple(each for endpoint in endpoints for each in ("--connect", endpoint))
        for robot in mobile:
            holding = ("--holding", robot.holding) if robot.holding else ()
            fleet = ("--name", robot.name, "--fleet", order.fleet, *connect)
            self._spawn(robot.name, "sim", "zenoh", *fleet, *robot.options, *holding, *moving)
        state = FleetState(
            fleet=order.fleet,
            directory=str(directory),
            endpoints=endpoints,
            gateways=names,
            robots=tuple(each.name for each in (*vehicles, *mobile)),
            record_dir=str(record_dir),
            keys=self._keys(Role.ENGINEER, keyring.BENCH),
            processes=tuple(self.processes),
        )
        path = directory / "fleet.json"
        temporary = path.with_suffix(".new")
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(state)))
        temporary.replace(path)
        progress(f"started {len(self.processes)} processes of fleet {order.fleet}")
        return state

    def _config(
        self,
        names: tuple[str, ...],
        endpoints: tuple[str, ...],
        index: int,
        links: tuple[MavlinkLink, ...],
        record_dir: Path,
    ) -> GatewayConfig:
        name = names[index]
        base = self._order.base or GatewayConfig(id=name)
        return msgspec.structs.replace(
            base,
            id=name,
            fleet=self._order.fleet,
            data_dir=str(self._order.directory / name / "data"),
            site=self._order.site,
            skills=tuple(dict.fromkeys((*base.skills, *(str(each.resolve()) for each in self._order.skills)))),
            plane=PlaneConfig(
                listen=(endpoints[index],),
                peers=dict(zip(names, endpoints, strict=True)),
                voters=names,
                keys=self._keys(Role.GATEWAY, name),
            ),
            pool=self._order.pool_of(name),
            robots=msgspec.structs.replace(base.robots, mavlink=links),
            record=RecordConfig(directory=str(record_dir), keys=self._keys(Role.RECORDER, keyring.BENCH)),
            tasks=msgspec.structs.replace(
                # They share this machine's processors: none is relieved by another.
                base.tasks,
                migration=msgspec.structs.replace(base.tasks.migration, cpu_high=0.0),
            ),
        )

    def _keys(self, role: Role, name: str) -> str:
        """File with somebody's keys; empty in a fleet without."""
        return str(keyring.file_of(keys_folder(self._order.directory), role, name)) if self._order.secured else ""

    def _spawn(self, name: str, *arguments: str) -> None:
        log = self._order.directory / "logs" / f"{name}.log"
        self.processes.append(spawn(name, (sys.executable, "-m", "appliance.cli", *arguments), log))


def spawn(name: str, command: Sequence[str], log_file: Path) -> Process:
    """Start a process in a session of its own, which writes to that file; FileNotFoundError when there is no such."""
    with log_file.open("ab") as log:
        pid = os.posix_spawnp(
            command[0],
            tuple(command),
            os.environ,
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, "/dev/null", os.O_RDONLY, 0),
                (os.POSIX_SPAWN_DUP2, log.fileno(), 1),
                (os.POSIX_SPAWN_DUP2, log.fileno(), 2),
            ],
            setsid=True,
        )
    return Process(name=name, pid=pid, started=psutil.Process(pid).create_time(), log=str(log_file))


async def _wait_ready(state: FleetState, order: Order, progress: Progress, timeout_s: float) -> None:
    """Wait until every gateway has warm containers, every robot is online and the recorder writes."""
    give_up = time.monotonic() + timeout_s
    told = ""
    async with await _connect(state, give_up) as client:
        while True:
            _check_alive(state)
            missing = _missing(client, state, order)
            if not missing:
                progress("the fleet is ready")
                return
            if time.monotonic() > give_up:
                raise DeadlineError(
                    f"the fleet was not ready within {timeout_s:.0f} s: {'; '.join(missing)}",
                    remedy=f"see {state.directory}/logs and `swiftbot doctor`",
                )
            if missing[0] != told:
                told = missing[0]
                progress(told)
            await asyncio.sleep(0.1)


async def _connect(state: FleetState, give_up: float) -> FleetClient:
    """Connect as soon as a gateway listens."""
    while True:
        _check_alive(state)
        client = FleetClient(state.endpoint)
        try:
            return await client.open()
        except UnreachableError:
            if time.monotonic() > give_up:
                raise
            await asyncio.sleep(0.1)


def _check_alive(state: FleetState) -> None:
    for process in state.processes:
        if not alive(process):
            raise PrerequisiteError(f"{process.name} ended: {_tail(Path(process.log))}", remedy=f"see {process.log}")


def _missing(client: FleetClient, state: FleetState, order: Order) -> list[str]:
    registry = client.plane.registry
    missing: list[str] = []
    for name in state.gateways:
        pool = order.pool_of(name)
        wanted = min(sum(pool.floor.values()), pool.capacity) if pool.mode != "cold" else 0
        status = registry.gateways.get(name)
        if status is None:
            missing.append(f"waiting for {name}")
        elif status.pool_problem:
            missing.append(f"{name}: {status.pool_problem}")
        elif status.ready < wanted:
            missing.append(f"{name} warms containers: {status.ready} of {wanted}")
    for robot in state.robots:
        info = registry.robots.get(robot)
        if info is None or not info.online:
            missing.append(f"waiting for {robot}")
    if not any(Path(state.record_dir).glob("*.mcap")):
        missing.append("waiting for the recorder")
    return missing


def _tail(path: Path, lines: int = 5) -> str:
    try:
        return " | ".join(path.read_text(errors="replace").splitlines()[-lines:])[-1000:]
    except OSError:
        return "no log"


async def down(
    directory: Path, *, progress: Progress, volumes: bool = False, fleet: str = "", grace_s: float = 30.0
) -> Ended:
    """End a fleet: its processes, gateways last, and its containers; its state volumes stay unless told otherwise.

    Args:
        directory: where it was started.
        progress: told what is being done.
        volumes: remove its state volumes too, with all that skills keep in them.
        fleet: whose state volumes to remove where none runs in the directory; those that are in use stay.
        grace_s: from SIGTERM to SIGKILL.

    Raises:
        NotFoundError: none was started there, and there is no state volume to remove.
    """
    try:
        state = read_state(directory)
    except NotFoundError:
        left = await _remove(fleet, progress=progress, volumes=True, containers=False) if volumes and fleet else None
        if left is None or not (left.removed_volumes or left.kept_volumes or left.problem):
            raise
        return msgspec.structs.replace(left, directory=str(directory))
    robots = [each for each in state.processes if each.name in (*state.robots, DRONES)]
    gateways = [each for each in state.processes if each.name in state.gateways]
    rest = [each for each in state.processes if each not in robots and each not in gateways]
    for group, what in ((robots, "robots"), (gateways, "gateways"), (rest, "recorder")):
        if group:
            progress(f"stopping {what}")
            await end(group, grace_s=grace_s)
    ended = await _remove(state.fleet, progress=progress, volumes=volumes)
    (directory / "fleet.json").unlink(missing_ok=True)
    return msgspec.structs.replace(ended, directory=str(directory), processes=len(state.processes))


async def remove_containers(fleet: str, *, progress: Progress, volumes: bool = False) -> None:
    """Remove the warm containers of a fleet, and if asked its state volumes; what cannot be removed is reported."""
    await _remove(fleet, progress=progress, volumes=volumes)


async def _remove(fleet: str, *, progress: Progress, volumes: bool, containers: bool = True) -> Ended:
    from appliance.pool.engine import Removed, remove_fleet  # noqa: PLC0415 - podman-py is slow to import

    removed, problem = Removed(), ""
    try:
        removed = await remove_fleet(fleet, volumes=volumes, containers=containers)
    except SwiftbotError as error:
        problem = str(error)
        progress(f"containers and state volumes were left: {error}")
    if removed.containers:
        progress(f"removed {counted(removed.containers, 'container')}")
    if removed.volumes:
        progress(f"removed {counted(len(removed.volumes), 'state volume')}")
    if removed.kept_volumes:
        progress(f"kept {counted(len(removed.kept_volumes), 'state volume')}")
    return Ended(
        fleet=fleet,
        directory="",
        processes=0,
        containers=removed.containers,
        removed_volumes=removed.volumes,
        kept_volumes=removed.kept_volumes,
        problem=problem,
    )


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural where it is not one."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


async def end(processes: list[Process], *, grace_s: float) -> None:
    """SIGTERM, wait, SIGKILL; only the very processes that were started."""
    for process in processes:
        _signal(process, signal.SIGTERM)
    until = time.monotonic() + grace_s
    while time.monotonic() < until and any(alive(each) for each in processes):
        _reap(processes)
        await asyncio.sleep(0.05)
    for process in processes:
        _signal(process, signal.SIGKILL)
    await asyncio.sleep(0.05)
    _reap(processes)


def _signal(process: Process, number: signal.Signals) -> None:
    """Signal that very process; one that ends just now needs none."""
    if alive(process):
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, number)


def _reap(processes: list[Process]) -> None:
    for process in processes:
        try:
            os.waitpid(process.pid, os.WNOHANG)
        except ChildProcessError:
            continue
