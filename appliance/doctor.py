"""Checks every prerequisite of a gateway on this machine and names the remedy for each that is missing.

Doors: `run_checks` and `Check`. Most of what keeps a gateway from working lies outside it: rootless Podman alone needs
five things that no error message of Podman names together. A check that is not `required` is a limit to know about, not
a reason to stay down. Nothing is changed on the machine but one container that is started and removed: no look but a
trial, the only proof that runtime, ids and storage go together.

There are two seams that tests replace: `Machine` for what is asked of the machine, and the pool's `Engine` for
Podman's API socket. So each check is a plain decision over plain facts, and a machine without subordinate ids, with a
full disk or a foreign owner of its runtime folder is a line in a test and not a machine.
"""

import asyncio
import locale
import os
import pwd
import secrets
import shutil
import socket
import stat
import sys
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from ctypes import CDLL, byref, create_string_buffer
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

import psutil
from msgspec import Struct

from appliance.config import GatewayConfig
from appliance.errors import SwiftbotError
from appliance.identity.parts import DEVELOPMENT, FILE, InForce, Kind
from appliance.llm.settings import folder_of
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import LIMITING, ContainerSpec, Engine, EngineFacts, PodmanEngine
from appliance.pool.images import build_command, reference
from appliance.pool.settings import PoolConfig
from appliance.pool.signed import without_unsigned
from appliance.skills.catalogue import Catalogue, load_catalogue
from appliance.skills.sites import load_site

_TIME_ERROR = 5
"""adjtimex's state of a clock that nothing keeps in time (adjtimex(2))."""
_TIMEX_BYTES = 256
"""More than struct timex has on any architecture; all zero asks and changes nothing."""


class FileFacts(Struct, frozen=True, kw_only=True):
    """Who owns a file, its permission bits, whether we may write it; `privileged`: setuid root or capabilities."""

    owner: int
    mode: int
    writable: bool
    privileged: bool = False


class Machine(Protocol):
    """The machine as the checks see it."""

    @property
    def python(self) -> tuple[int, ...]:
        """Version of Python."""
        ...

    @property
    def uid(self) -> int:
        """Whose process this is."""
        ...

    @property
    def user(self) -> str:
        """That user's name."""
        ...

    @property
    def home(self) -> Path:
        """That user's home."""
        ...

    @property
    def environ(self) -> Mapping[str, str]:
        """The environment."""
        ...

    @property
    def encoding(self) -> str:
        """Of text to and from the terminal."""
        ...

    def which(self, program: str) -> str | None:
        """Return a program's path, None when it is not installed."""
        ...

    def read(self, path: Path) -> str | None:
        """Return a text file, None when it cannot be read."""
        ...

    def stat(self, path: Path) -> FileFacts | None:
        """Return facts of a file or folder, None when there is none."""
        ...

    def free_mb(self, path: Path) -> float:
        """Return the free space where a folder is or would be made."""
        ...

    def bind_problem(self, host: str, port: int, *, udp: bool) -> str:
        """Return why a port cannot be taken; empty when it can."""
        ...

    def listener(self, port: int, *, udp: bool) -> str:
        """Return the command line of this user's process that has a port; empty when it is not ours to see."""
        ...

    def now(self) -> float:
        """Return Unix seconds."""
        ...

    def clock_synchronised(self) -> bool | None:
        """Return whether the kernel's clock is kept in time; None when the kernel does not tell."""
        ...


class ThisMachine:
    """The machine this runs on."""

    def __init__(self) -> None:
        self.python = tuple(sys.version_info[:3])
        self.uid = os.getuid()
        self.environ = os.environ
        self.encoding = locale.getpreferredencoding(do_setlocale=False)
        try:
            entry = pwd.getpwuid(self.uid)
            self.user, self.home = entry.pw_name, Path(entry.pw_dir)
        except KeyError:  # an id without a name, as in some containers
            self.user, self.home = str(self.uid), Path.home()

    def which(self, program: str) -> str | None:
        """Return a program's path; newuidmap and its like lie where an ordinary PATH does not look."""
        return shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/bin:/sbin:/bin")

    def read(self, path: Path) -> str | None:
        """Return a text file, None when it cannot be read."""
        try:
            return path.read_text(errors="replace")
        except OSError:
            return None

    def stat(self, path: Path) -> FileFacts | None:
        """Return facts of a file or folder, None when there is none."""
        try:
            found = path.stat()
        except OSError:
            return None
        try:
            capable = bool(os.getxattr(path, "security.capability"))
        except OSError:
            capable = False
        return FileFacts(
            owner=found.st_uid,
            mode=stat.S_IMODE(found.st_mode),
            writable=os.access(path, os.W_OK),
            privileged=capable or bool(found.st_mode & stat.S_ISUID and found.st_uid == 0),
        )

    def free_mb(self, path: Path) -> float:
        """Return the free space where a folder is or would be made."""
        while not path.exists() and path != path.parent:
            path = path.parent
        return shutil.disk_usage(path).free / 2**20

    def bind_problem(self, host: str, port: int, *, udp: bool) -> str:
        """Return why a port cannot be taken; empty when it can."""
        kind = socket.SOCK_DGRAM if udp else socket.SOCK_STREAM
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=kind)[0]
            with socket.socket(family, kind) as probe:
                if not udp:  # what a server does as well: a closed connection's rest is no hindrance
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
        except OSError as error:
            return error.strerror or str(error)
        return ""

    def listener(self, port: int, *, udp: bool) -> str:
        """Return the command line of this user's process that has a port; empty when it is not ours to see."""
        kind = "udp" if udp else "tcp"
        hidden = ""
        for process in psutil.process_iter():
            words = ""
            try:
                if process.uids().real != self.uid:
                    continue
                words = " ".join(process.cmdline())
                found = process.net_connections(kind=kind)
            except psutil.AccessDenied:
                # A hardened service does not show what it has open, even to its own user: its name must do.
                hidden = hidden or (words if "swiftbot gateway" in words else "")
                continue
            except psutil.Error:  # it has ended
                continue
            if any(each.laddr and each.laddr.port == port and not each.raddr for each in found):
                return words
        return hidden

    def now(self) -> float:
        """Return Unix seconds."""
        return time.time()

    def clock_synchronised(self) -> bool | None:
        """Return whether the kernel's clock is kept in time; None when the kernel does not tell."""
        try:
            state = CDLL(None, use_errno=True).adjtimex(byref(create_string_buffer(_TIMEX_BYTES)))
        except (OSError, AttributeError):
            return None
        return None if state < 0 else state != _TIME_ERROR


SETUP = "run `make setup`"
"""The remedy for much."""


class Check(Struct, frozen=True, kw_only=True):
    """One prerequisite: what was found, and what to do when it is not `ok`."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""
    required: bool = True


def podman_checks(facts: EngineFacts) -> Iterator[Check]:
    """Yield what follows from Podman's own account."""
    yield Check(name="podman api", ok=True, detail=f"Podman {facts.version}")
    yield Check(
        name="rootless", ok=facts.rootless, detail="yes" if facts.rootless else "Podman runs as root", remedy=SETUP
    )
    yield Check(
        name="storage",
        ok=facts.storage_driver == "overlay",
        detail=facts.storage_driver,
        remedy='driver = "overlay" in ~/.config/containers/storage.conf, then podman system reset (removes images)',
    )
    missing = ", ".join(sorted(LIMITING - facts.controllers))
    yield Check(
        name="limits",
        ok=facts.limits_enforced,
        detail="memory, CPU and process limits of containers hold"
        if facts.limits_enforced
        else f"cgroup {facts.cgroup_version}: containers' memory, CPU and processes are not limited"
        + (f" ({missing} not delegated)" if facts.cgroup_version == "v2" else ""),
        remedy="boot with cgroup v2; delegate cpu, memory and pids to users (docs/operations.md)",
        required=False,
    )


async def check_images(engine: Engine, catalogue: Catalogue, config: PoolConfig) -> tuple[list[Check], str]:
    """Return whether each image of the catalogue is there, and the first one that is."""
    present = {tag for image in await engine.images() for tag in image.tags}
    checks: list[Check] = []
    usable = ""
    for name, spec in catalogue.images.items():
        full = reference(spec, config)
        found = full in present
        usable = usable or (full if found else "")
        checks.append(
            Check(
                name=f"image {name}",
                ok=found,
                detail=full if found else f"{full} is not there",
                remedy=build_command(spec),
                required=not spec.on_demand,
            )
        )
    return checks, usable


async def check_container(engine: Engine, image: str, runtime: str, seccomp_profile: str = "") -> Check:
    """Start a container as the pool does and remove it: the only proof that runtime, ids and storage go together."""
    name = f"swiftbot-doctor-{secrets.token_hex(4)}"
    spec = ContainerSpec(
        name=name,
        image=image,
        command=("/bin/true",),
        labels={"swiftbot.doctor": name},
        binds={},
        volumes={},
        environment={},
        cpu=1.0,
        memory_mb=64,
        pids=32,
        tmp_mb=4,
        runtime=runtime,
        seccomp_profile=seccomp_profile,
    )
    try:
        await engine.create(spec)
        try:
            await engine.start(name)
        finally:
            await engine.remove(name)
    except SwiftbotError as error:
        return Check(
            name="container",
            ok=False,
            detail=error.message,
            remedy=error.remedy
            or 'cgroups: runtime = "runc" in ~/.config/containers/containers.conf; overlay: see storage',
        )
    return Check(name="container", ok=True, detail=f"starts{f' with {runtime}' if runtime else ''}")


async def check_podman(make_engine: Callable[[], Engine], catalogue: Catalogue, config: PoolConfig) -> list[Check]:
    """Ask Podman through its API socket; what cannot be checked without it is reported as not checked."""
    try:
        engine = make_engine()
    except SwiftbotError as error:
        return _podman_silent(error)
    try:
        facts = await engine.facts()
        checks = list(podman_checks(facts))
        images, usable = await check_images(engine, catalogue, config)
        checks += images
        if usable:
            runtime = config.runtime or ("runc" if facts.cgroup_version == "v1" else "")
            checks.append(await check_container(engine, usable, runtime, config.seccomp_file()))
    except SwiftbotError as error:
        return _podman_silent(error)
    finally:
        engine.close()
    return checks


def _podman_silent(error: SwiftbotError) -> list[Check]:
    checks = [Check(name="podman api", ok=False, detail=error.message, remedy=error.remedy or SETUP)]
    checks += [
        Check(name=name, ok=False, detail="cannot be told: Podman does not answer", remedy="first see to: podman api")
        for name in ("storage", "images", "container")
    ]
    return checks


IDS_NEEDED = 65536
"""Subordinate ids of a user: Debian's images use ids to 65534."""
FREE_MB = 1024
"""Two images and a day's log of a small fleet."""
BUILT_AT = 1735689600.0
"""2025-01-01: no clock is right that shows less."""
CHECK_S = 20.0
"""Longest that one check may take."""
SESSION_KEY = "swiftbot/doctor/check"


def check_python(machine: Machine) -> Check:
    """Python 3.11 or later."""
    version = ".".join(str(part) for part in machine.python)
    return Check(name="python", ok=machine.python >= (3, 11), detail=version, remedy="use Debian 12's python3 or later")


def check_user(machine: Machine) -> Check:
    """An ordinary user: rootless Podman is the wall between skills and the machine."""
    return Check(
        name="user",
        ok=machine.uid != 0,
        detail=f"{machine.user} ({machine.uid})",
        remedy="run it as the service user: scripts/as_user.sh swiftbot doctor",
    )


def check_locale(machine: Machine) -> Check:
    """UTF-8, for the plan graphs and the terminal UI."""
    return Check(
        name="locale",
        ok=machine.encoding.lower().replace("-", "") == "utf8",
        detail=machine.encoding,
        remedy="export LANG=C.UTF-8",
        required=False,
    )


def check_clock(machine: Machine) -> Check:
    """A clock that is kept in time: logs are compared, and Zenoh refuses timestamps far ahead of its own."""
    if machine.now() < BUILT_AT:
        return Check(name="clock", ok=False, detail="years behind", remedy="set it: timedatectl set-time, or NTP")
    kept = machine.clock_synchronised()
    return Check(
        name="clock",
        ok=kept is not False,
        detail={True: "kept in time", False: "nothing keeps it in time", None: "set; the kernel does not tell more"}[
            kept
        ],
        remedy="apt-get install systemd-timesyncd (or chrony); gateways must agree to half a second",
        required=False,
    )


def check_programs(machine: Machine) -> Iterator[Check]:
    """Yield a check for each program that is called; id mappers must be allowed to do it as well."""
    packages = {"podman": "podman", "newuidmap": "uidmap", "newgidmap": "uidmap", "mmdebstrap": "mmdebstrap"}
    for program, package in packages.items():
        path = machine.which(program)
        ok, detail = path is not None, path or "not installed"
        if path and package == "uidmap":
            facts = machine.stat(Path(path))
            if facts is None or not facts.privileged:
                ok, detail = False, f"{path} is neither setuid root nor has capabilities"
        yield Check(
            name=program, ok=ok, detail=detail, remedy=f"apt-get install --reinstall --no-install-recommends {package}"
        )
    runtimes = [each for each in map(machine.which, ("crun", "runc")) if each]
    yield Check(
        name="runtime",
        ok=bool(runtimes),
        detail=", ".join(runtimes) or "neither crun nor runc is installed",
        remedy="apt-get install crun runc",
    )


def check_ids(machine: Machine) -> Iterator[Check]:
    """Yield whether the user has subordinate user and group ids."""
    if machine.uid == 0:
        return  # not the user that would need them; check_user says so
    for name in ("subuid", "subgid"):
        path = Path("/etc") / name
        total = 0
        for line in (machine.read(path) or "").splitlines():
            owner, _, rest = line.partition(":")
            count = rest.rpartition(":")[2]
            if owner in (machine.user, str(machine.uid)) and count.isdecimal():
                total += int(count)
        option = f"--add-{name}s"
        yield Check(
            name=name,
            ok=total >= IDS_NEEDED,
            detail=f"{total} ids in {path}" if total else f"no range in {path}",
            remedy=f"{SETUP}, or: usermod {option} FIRST-LAST {machine.user} with {IDS_NEEDED} ids nobody else has",
        )


def check_runtime_dir(machine: Machine) -> Check:
    """XDG_RUNTIME_DIR: set, there, the user's own and closed to others."""
    named = machine.environ.get("XDG_RUNTIME_DIR", "")
    facts = machine.stat(Path(named)) if named else None
    if not named:
        detail = "not set"
    elif facts is None:
        detail = f"{named} is not there"
    elif facts.owner != machine.uid or not facts.writable:
        detail = f"{named} belongs to user {facts.owner}, not {machine.uid}"
    elif facts.mode & 0o077:
        detail = f"{named} is open to others (mode {facts.mode:o})"
    else:
        return Check(name="XDG_RUNTIME_DIR", ok=True, detail=named)
    return Check(
        name="XDG_RUNTIME_DIR",
        ok=False,
        detail=detail,
        remedy=f"loginctl enable-linger {machine.user}; without systemd {SETUP}, which makes /run/user/{machine.uid}",
    )


def check_storage(machine: Machine) -> Check:
    """Where storage.conf names fuse-overlayfs, it and /dev/fuse."""
    folder = machine.environ.get("XDG_CONFIG_HOME") or f"{machine.home}/.config"
    text = (
        machine.read(Path(folder) / "containers" / "storage.conf")
        or machine.read(Path("/etc/containers/storage.conf"))
        or ""
    )
    lines = [line.strip() for line in text.splitlines()]
    if not any(line.startswith("mount_program") and "fuse-overlayfs" in line for line in lines):
        return Check(name="fuse-overlayfs", ok=True, detail="not used: overlay by the kernel")
    if machine.which("fuse-overlayfs") is None:
        return Check(name="fuse-overlayfs", ok=False, detail="not installed", remedy="apt-get install fuse-overlayfs")
    device = machine.stat(Path("/dev/fuse"))
    ok = device is not None and device.writable
    return Check(
        name="fuse-overlayfs",
        ok=ok,
        detail="installed" if ok else "/dev/fuse is not there or not open to this user",
        remedy="modprobe fuse; in a container: start it with --device /dev/fuse",
    )


def check_disk(machine: Machine, folders: Sequence[Path]) -> Iterator[Check]:
    """Yield the free space of each folder that grows; folders with the same free space count once."""
    told: set[int] = set()
    for folder in folders:
        free = machine.free_mb(folder)
        if int(free) in told:
            continue
        told.add(int(free))
        yield Check(
            name="disk",
            ok=free >= FREE_MB,
            detail=f"{free:,.0f} MB free at {folder}",
            remedy=f"free space to {FREE_MB} MB: podman image prune, old logs, or another folder in the configuration",
        )


def check_ports(machine: Machine, config: GatewayConfig) -> Iterator[Check]:
    """Yield whether each port of a gateway's configuration can be taken, or is held by the running gateway."""
    wanted: list[tuple[str, str, int, bool]] = []
    for endpoint in config.plane.listen:
        protocol, _, address = endpoint.partition("/")
        parts = urlsplit(f"//{address}")
        if parts.hostname and parts.port and protocol in ("tcp", "tls", "ws", "udp", "quic"):
            wanted.append((endpoint, parts.hostname, parts.port, protocol in ("udp", "quic")))
    for link in config.robots.mavlink:
        remote = link.remote
        if remote.listens:
            wanted.append((str(remote), remote.host, remote.port, remote.scheme == "udp"))
    for name, host, port, udp in wanted:
        problem = machine.bind_problem(host, port, udp=udp)
        holder = machine.listener(port, udp=udp) if problem else ""
        running = "swiftbot" in holder and "gateway" in holder
        yield Check(
            name=f"port {port}",
            ok=not problem or running,
            detail=f"{name} is free" if not problem else f"{name}: held by {holder or 'somebody else'} ({problem})",
            remedy=f"end what holds it (ss -l{'u' if udp else 't'}np 'sport = :{port}'), or set another port",
        )


def check_model(machine: Machine, folder: str) -> Check:
    """The local language model's folder, where one is configured."""
    if not folder:
        return Check(name="model", ok=True, detail="none configured: plans come from the other tiers", required=False)
    ok = machine.stat(Path(folder_of(folder)) / "genai_config.json") is not None
    return Check(
        name="model",
        ok=ok,
        detail=folder if ok else f"{folder} has no genai_config.json",
        remedy='set llm.local_model to "embedded" or to a folder made for onnxruntime-genai, or to "" for none',
        required=False,
    )


def check_fence(name: str) -> Check:
    """The site's fence: without one a point far outside the site is only refused beyond 200 m."""
    try:
        site = load_site(name)
    except SwiftbotError as error:
        return Check(name="site", ok=False, detail=error.message, remedy=error.remedy)
    fence = site.fence
    extent = f"{fence.x[0]:g} to {fence.x[1]:g} m, {fence.y[0]:g} to {fence.y[1]:g} m" if fence is not None else ""
    return Check(
        name="fence",
        ok=fence is not None,
        detail=f"{site.name}: {extent}" if fence is not None else f"site {site.name} has none",
        remedy="add [fence] with name, x and y to the site's file (docs/skills.md, Sites)",
        required=False,
    )


def check_keys(plane: PlaneConfig, gateway: str, fleet: str, now: float) -> Check:
    """The gateway's keys: whose they are, for how long they are good, and the roster beside them."""
    if not plane.keys:
        detail = "none: links within this machine only, on which everybody may do everything"
        return Check(name="keys", ok=True, detail=detail, required=False)
    # Imported here: whoever shows a check would load it too, and it takes 60 ms.
    from appliance.identity.credentials import Credentials  # noqa: PLC0415

    try:
        credentials = Credentials.load(Path(plane.keys).expanduser(), plane.roster_file, fleet=fleet, now=now)
        credentials.check_listener(gateway)
    except SwiftbotError as error:
        return Check(name="keys", ok=False, detail=error.message, remedy=error.remedy)
    own, problem = credentials.identity, credentials.problem(now)
    return Check(
        name="keys",
        ok=not problem,
        detail=problem or f"{own.text}, good for {own.days_left(now):.0f} days; roster {credentials.roster.number}",
        remedy=f"swiftbot keys renew {own.role} {own.name}; copy it here, and roster.json beside it",
        required=False,
    )


def check_parts(config: GatewayConfig) -> Check:
    """The signed list of parts, and whether the skills and the model of this machine are in it."""
    if not config.plane.keys:
        return Check(name="parts", ok=True, detail=DEVELOPMENT, required=False)
    from appliance.identity.bundle import Bundle  # noqa: PLC0415 - as in check_keys

    try:
        in_force = InForce.beside(
            Bundle.load(Path(config.plane.keys).expanduser()),
            config.plane.parts_file,
            Path(config.data_dir).expanduser() / FILE,
        )
        without_unsigned(_catalogue(config), in_force)
        if (model := Path(folder_of(config.llm.local_model))).is_dir() and config.llm.local_model:
            in_force.check_folder(Kind.MODEL, model)
    except SwiftbotError as error:
        return Check(name="parts", ok=False, detail=error.message, remedy=error.remedy)
    problem = in_force.problem
    return Check(
        name="parts",
        ok=not problem,
        detail=problem or f"{in_force.text}: skills and model are signed",
        remedy="sign what is to run: docs/security.md, Signed parts",
    )


async def check_session(open_session: Callable[[], Awaitable[Session]]) -> Check:
    """Open a Zenoh session on the loopback and have it answer itself."""
    try:
        session = await open_session()
        try:

            async def answer(_key: str, payload: bytes) -> bytes:
                return payload

            service = session.serve(SESSION_KEY, answer)
            await session.query(SESSION_KEY, b"ping", timeout_s=5.0)
            service.close()
        finally:
            await session.close()
    except SwiftbotError as error:
        return Check(name="zenoh", ok=False, detail=error.message, remedy=error.remedy or "see that the loopback is up")
    return Check(name="zenoh", ok=True, detail="a session opens and answers")


def _open_engine(config: PoolConfig) -> Callable[[], Engine]:
    return lambda: PodmanEngine(config.podman_url, threads=1, timeout_s=CHECK_S - 1)


def _open_session() -> Awaitable[Session]:
    # As a gateway does, but on a port of the kernel's choice and linked to nobody.
    return Session.open(PlaneConfig(listen=("tcp/127.0.0.1:0",), join_wait_s=0.0), "doctor")


def local_checks(machine: Machine, config: GatewayConfig | None) -> list[Check]:
    """All checks that need neither Podman nor Zenoh."""
    checks = [check_python(machine), check_user(machine), check_locale(machine), check_clock(machine)]
    checks += check_programs(machine)
    checks += check_ids(machine)
    checks += [check_runtime_dir(machine), check_storage(machine)]
    folders = [machine.home]
    if config is not None:
        folders += [Path(config.data_dir).expanduser(), config.record.folder]
        checks += check_ports(machine, config)
        checks.append(check_keys(config.plane, config.id, config.fleet, machine.now()))
        checks.append(check_parts(config))
    checks += check_disk(machine, folders)
    checks.append(check_model(machine, config.llm.local_model if config else ""))
    checks.append(check_fence(config.site if config else "warehouse"))
    return checks


def _catalogue(config: GatewayConfig | None) -> Catalogue:
    return load_catalogue(tuple(Path(each).expanduser() for each in config.skills) if config else ())


async def _bounded(name: str, checking: Awaitable[list[Check]]) -> list[Check]:
    try:
        async with asyncio.timeout(CHECK_S):
            return await checking
    except TimeoutError:
        return [
            Check(name=name, ok=False, detail=f"no answer within {CHECK_S:.0f} s", remedy="see its log and the load")
        ]


async def run_checks(
    config: GatewayConfig | None = None,
    *,
    machine: Machine | None = None,
    make_engine: Callable[[], Engine] | None = None,
    open_session: Callable[[], Awaitable[Session]] | None = None,
) -> tuple[Check, ...]:
    """Check every prerequisite of a gateway here.

    Args:
        config: a gateway's configuration, to check its ports and folders too.
        machine: the machine; tests give another.
        make_engine: opens Podman.
        open_session: opens a Zenoh session.
    """
    here = machine or ThisMachine()
    pool = config.pool if config else PoolConfig()
    catalogue = await asyncio.to_thread(_catalogue, config)

    async def session() -> list[Check]:
        return [await check_session(open_session or _open_session)]

    checks = await asyncio.to_thread(local_checks, here, config)
    checks += await _bounded("podman api", check_podman(make_engine or _open_engine(pool), catalogue, pool))
    checks += await _bounded("zenoh", session())
    return tuple(checks)
