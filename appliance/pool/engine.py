"""Everything this product asks of Podman: the seam to the outside, faked in unit tests.

It exists because podman-py is synchronous, untyped and has sharp edges (each noted where it is avoided). All of
it is confined here: calls run on a few worker threads, each with a client of its own, and whatever goes wrong
comes out as one of these errors.

    UnreachableError     the API socket is absent or does not answer
    PoolError            Podman answered that it will not
    PrerequisiteError    the image is not there

Guarantees: a container is created with `--read-only`, no capability, no new privileges, no network, and files
it makes in its bind-mounted folder belong to the service user (rootless: root inside is that user outside).

`EngineLink` reconnects: Podman is reached when it can be, known to be away when it cannot, tried again with backoff
until it is back. Containers that run need no Podman, only starting and removing do; so its absence is reported and
mended in the background, never a reason for the pool to stop.

The API itself (`client.api`) is asked where podman-py would inspect each container of a list, wait 10 s for one that
ignores SIGTERM, or hold a whole image in memory. Traps of Podman 4.3: `pull` takes no transport but a registry's over
the API, `get` gives layers uncompressed only as docker-archive, and `load` of an OCI archive needs no layer that is in
the storage already.
"""

import asyncio
import contextlib
import json
import os
import socket
import tarfile
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeVar, cast

import podman
import requests
import structlog
from msgspec import Struct
from podman.errors import APIError, ImageNotFound, NotFound, PodmanError

from appliance.errors import NotFoundError, PoolError, PrerequisiteError, SwiftbotError, UnreachableError

T = TypeVar("T")
RUNTIME_DIRS = Path("/run/user")
"""Where systemd puts the runtime directories of users who are logged in or linger."""
BUILD_REMEDY = "swiftbot images build, with --skills DIR for an image of your own"
RUNC_REMEDY = (
    'crun wants cgroup v2: put runtime = "runc" under [engine] in ~/.config/containers/containers.conf of the'
    " service user and restart podman.socket"
)
"""Podman before 4.4 takes the OCI runtime from its own configuration only, whatever a request asks for."""
# Labels of containers and volumes.
_LISTED_AGAIN = 3
_LIST_PAUSE_S = 0.2
LABEL_FLEET = "swiftbot.fleet"
LABEL_GATEWAY = "swiftbot.gateway"
LABEL_IMAGE = "swiftbot.image"
LABEL_ID = "swiftbot.id"
LABEL_STATE = "swiftbot.made"
"""Hash of all that is fixed when a container is made: image, snapshot, the runner's specification, bounds. Adopted only
if it is the same, and if the runner has loaded just the code of that snapshot."""
LABEL_SNAPSHOT = "swiftbot.snapshot"
"""Digest of the snapshot of skills and runner that a container mounts (`snapshots`)."""
LIMITING = frozenset({"memory", "pids", "cpu"})
"""cgroup controllers that must be delegated for limits to hold."""


class EngineFacts(Struct, frozen=True, kw_only=True):
    """What Podman says of itself."""

    version: str
    cgroup_version: str
    controllers: frozenset[str]
    runtime: str
    storage_driver: str
    rootless: bool

    @property
    def limits_enforced(self) -> bool:
        """Whether memory, CPU and process limits hold: rootless that takes cgroup v2 with delegation."""
        return self.cgroup_version == "v2" and self.controllers >= LIMITING


class ContainerSpec(Struct, frozen=True, kw_only=True):
    """A container to be made. `binds` are read-only unless in `writable`; `volumes` are named (name -> path)."""

    name: str
    image: str
    command: tuple[str, ...]
    labels: dict[str, str]
    binds: dict[str, str]
    writable: frozenset[str] = frozenset()
    volumes: dict[str, str]
    environment: dict[str, str]
    cpu: float
    memory_mb: int
    pids: int
    tmp_mb: int
    runtime: str = ""
    seccomp_profile: str = ""
    limits: bool = False


class Found(Struct, frozen=True, kw_only=True):
    """A container that is there."""

    id: str
    name: str
    running: bool
    labels: dict[str, str]
    image: str = ""
    """Id of its image."""


class FoundImage(Struct, frozen=True, kw_only=True):
    """An image that is there."""

    id: str
    tags: tuple[str, ...]
    size_bytes: int
    created: str


class ImageFacts(Struct, frozen=True, kw_only=True):
    """An image as it is in the storage. `layers` are the SHA-256 of the uncompressed layers, the lowest first."""

    id: str
    """SHA-256 of its configuration, hexadecimal."""
    layers: tuple[str, ...]
    size_bytes: int = 0


class FoundVolume(Struct, frozen=True, kw_only=True):
    """A named volume that is there."""

    name: str
    folder: Path
    labels: dict[str, str]


class Exit(Struct, frozen=True, kw_only=True):
    """How a container's process 1 ended."""

    code: int
    """Its exit status; 128 and the signal's number when one killed it."""
    oom: bool
    """Whether the kernel killed it because memory ran out."""


class Engine(Protocol):
    """What the pool asks of a container engine."""

    async def facts(self) -> EngineFacts:
        """Return what the engine is and can."""
        ...

    async def create(self, spec: ContainerSpec) -> str:
        """Make a container and return its id."""
        ...

    async def start(self, container: str) -> None:
        """Start it."""
        ...

    async def remove(self, container: str) -> None:
        """Kill and remove it; nothing when it is gone already."""
        ...

    async def logs(self, container: str) -> str:
        """Return the end of what it wrote."""
        ...

    async def ended(self, container: str) -> Exit | None:
        """Return how a container ended; None while it runs."""
        ...

    async def ping(self, timeout_s: float) -> None:
        """Return when the engine answers; UnreachableError when it does not within `timeout_s`."""
        ...

    def hang_up(self) -> None:
        """Ask for no sign of life any more; on the event loop."""
        ...

    async def containers(self, labels: Mapping[str, str]) -> list[Found]:
        """Return the containers that have all these labels."""
        ...

    async def images(self) -> list[FoundImage]:
        """Return all images with a tag of ours."""
        ...

    async def image(self, reference: str) -> ImageFacts:
        """Return what an image is made of; NotFoundError when it is not there."""
        ...

    async def ensure_volume(self, name: str, labels: Mapping[str, str]) -> None:
        """Make a named volume unless it is there."""
        ...

    def close(self) -> None:
        """Let go of threads and connections."""
        ...


def socket_path(url: str = "") -> Path:
    """Return the API socket's path: of `url`, or the user's own.

    Where XDG_RUNTIME_DIR is not set it is looked for where systemd puts it, which may come while this process runs.

    Raises:
        PrerequisiteError: the url is no unix one, or none is given and the user has no runtime directory (yet).
    """
    if url:
        scheme, _, path = url.partition("://")
        if scheme not in ("unix", "http+unix") or not path.startswith("/"):
            raise PrerequisiteError(f"podman_url {url!r} is no socket", remedy="write it as unix:///path/podman.sock")
        return Path(path)
    named = os.environ.get("XDG_RUNTIME_DIR")
    runtime = Path(named) if named else RUNTIME_DIRS / str(os.getuid())
    if not named and not runtime.is_dir():
        raise PrerequisiteError(
            f"XDG_RUNTIME_DIR is not set and {runtime} is not there, so Podman's API socket cannot be found",
            remedy="run as the service user with lingering (loginctl enable-linger), or set pool.podman_url",
        )
    return runtime / "podman" / "podman.sock"


class PodmanEngine:
    """Podman through podman-py on the API socket of the user that runs this.

    Transfers have one of their own, with more patience (`for_transfers`): an image of 150 MB takes Podman three seconds
    to give, which on the threads that start containers would be three seconds without starts.
    """

    def __init__(self, url: str = "", *, threads: int = 4, timeout_s: float = 60.0) -> None:
        self.path = socket_path(url)
        self._timeout_s = timeout_s
        self._threads = ThreadPoolExecutor(max_workers=threads, thread_name_prefix="podman")
        self._line: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        """The connection that signs of life come over."""
        self._local = threading.local()
        self._clients: list[Any] = []
        self.calls: Counter[str] = Counter()
        """What was asked of Podman since the start, by the first word of what it was for: a warm run asks nothing."""

    @classmethod
    def for_transfers(cls, url: str = "") -> "PodmanEngine":
        """Return a client for images and volumes."""
        return cls(url, threads=2, timeout_s=300.0)

    def _client(self) -> Any:  # podman-py is untyped in the parts used here
        client = getattr(self._local, "client", None)
        if client is None:
            client = podman.PodmanClient(base_url=f"unix://{self.path}", timeout=int(self._timeout_s))
            self._local.client = client
            self._clients.append(client)
        return client

    async def _ask(self, what: str, work: Callable[[Any], T]) -> T:
        self.calls[what.partition(" ")[0]] += 1

        def call() -> T:
            try:
                self._knock()
                return work(self._client())
            except ImageNotFound as error:
                raise PrerequisiteError(f"{what}: the image is not there", remedy=BUILD_REMEDY) from error
            except APIError as error:
                # podman-py raises this for a socket it cannot connect to as well, then without a response.
                if error.response is None:
                    raise self._unreachable(error) from error
                text = str(error.explanation or error)
                if "image not known" in text:  # Podman 4.3 says so with another status than 404
                    raise PrerequisiteError(f"{what}: the image is not there", remedy=BUILD_REMEDY) from error
                raise PoolError(f"{what}: {text}") from error
            except (requests.RequestException, OSError) as error:
                raise self._unreachable(error) from error
            except (PodmanError, ValueError, KeyError) as error:
                raise PoolError(f"{what}: {error}") from error

        return await asyncio.get_running_loop().run_in_executor(self._threads, call)

    def _knock(self) -> None:
        """Connect and hang up; OSError when nobody listens. podman-py leaks a socket each time it finds that out."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as knock:
            knock.settimeout(self._timeout_s)
            knock.connect(str(self.path))

    def _unreachable(self, error: Exception) -> UnreachableError:
        why = "is not there" if not self.path.exists() else f"does not answer ({type(error).__name__})"
        return UnreachableError(
            f"Podman's API socket {self.path} {why}",
            remedy="systemctl --user enable --now podman.socket, as the service user",
        )

    async def facts(self) -> EngineFacts:
        """Return what this Podman is and can."""

        def work(client: Any) -> EngineFacts:
            info = cast("dict[str, Any]", client.info())
            host = info["host"]
            return EngineFacts(
                version=str(info.get("version", {}).get("Version", "")),
                cgroup_version=str(host.get("cgroupVersion", "")),
                controllers=frozenset(host.get("cgroupControllers") or ()),
                runtime=str(host.get("ociRuntime", {}).get("name", "")),
                storage_driver=str(info.get("store", {}).get("graphDriverName", "")),
                rootless=bool(host.get("security", {}).get("rootless", False)),
            )

        return await self._ask("info", work)

    async def create(self, spec: ContainerSpec) -> str:
        """Make a container, not started; returns its id."""
        arguments = create_arguments(spec)

        def work(client: Any) -> str:
            return str(client.containers.create(spec.image, list(spec.command), **arguments).id)

        return await self._ask(f"create {spec.name} of {spec.image}", work)

    async def start(self, container: str) -> None:
        """Start a container."""

        def work(client: Any) -> None:
            _container(client, container).start()

        try:
            await self._ask(f"start {container[:12]}", work)
        except PoolError as error:
            if "cgroups in hybrid mode" not in error.message:
                raise
            raise PoolError(error.message, remedy=RUNC_REMEDY) from error

    async def remove(self, container: str) -> None:
        """Kill and remove a container: `remove(force=True)` alone waits 10 s for one that ignores SIGTERM."""

        def work(client: Any) -> None:
            # 404: gone already; 409: not running. One without an answer is raised, and not followed by another wait.
            client.api.post(f"/containers/{container}/kill", params={"signal": "KILL"})
            response = client.api.delete(f"/containers/{container}", params={"force": "true", "timeout": "0"})
            if response.status_code != requests.codes.not_found:
                response.raise_for_status()

        await self._ask(f"remove {container[:12]}", work)

    async def logs(self, container: str) -> str:
        """Return the last lines a container wrote, at most 2,000 characters."""

        def work(client: Any) -> str:
            parts = _container(client, container).logs(stdout=True, stderr=True, tail=30)
            data = parts if isinstance(parts, bytes) else b"".join(parts)
            return data.decode("utf-8", "replace")[-2000:].strip()

        try:
            return await self._ask(f"logs of {container[:12]}", work)
        except (PoolError, UnreachableError, PrerequisiteError):
            return ""

    async def ended(self, container: str) -> Exit | None:
        """Return how a container ended; None while it runs. PoolError when it is not there."""

        def work(client: Any) -> Exit | None:
            state = cast("dict[str, Any]", client.containers.get(container).attrs["State"])
            if state.get("Running") or str(state.get("Status")) in ("running", "stopping"):
                return None
            return Exit(code=int(state.get("ExitCode", 0)), oom=bool(state.get("OOMKilled", False)))

        return await self._ask(f"state of {container[:12]}", work)

    async def ping(self, timeout_s: float) -> None:
        """Ask Podman for a sign of life, on a connection of its own: the threads may all wait for it just then.

        The connection is kept: Podman logs a warning for each that is closed.
        """
        line, self._line = self._line, None
        try:
            async with asyncio.timeout(timeout_s):
                reader, writer = line or await asyncio.open_unix_connection(str(self.path))
                try:
                    writer.write(b"HEAD /_ping HTTP/1.1\r\nHost: d\r\n\r\n")
                    await reader.readuntil(b"\r\n\r\n")
                    self._line = (reader, writer)
                finally:
                    if self._line is None:
                        writer.close()
        except TimeoutError as error:
            raise UnreachableError(
                f"Podman has not answered within {timeout_s:g} s at its API socket {self.path}",
                remedy="systemctl --user restart podman.service, as the service user; containers that run serve on",
            ) from error
        except (OSError, EOFError, ValueError, asyncio.LimitOverrunError) as error:
            raise self._unreachable(error) from error

    def hang_up(self) -> None:
        """Close the connection that signs of life come over; on the event loop."""
        if self._line is not None:
            self._line[1].close()
            self._line = None

    async def containers(self, labels: Mapping[str, str]) -> list[Found]:
        """Return the containers, running or not, that have all these labels."""
        wanted = _filters(labels)

        def work(client: Any) -> list[Found]:
            # Through the API itself: containers.list() inspects each one again.
            response = client.api.get("/containers/json", params={"all": "true", "filters": wanted})
            response.raise_for_status()
            return [
                Found(
                    id=each["Id"],
                    name=(each.get("Names") or [""])[0],
                    running=each.get("State") == "running",
                    image=str(each.get("ImageID", "")).removeprefix("sha256:"),
                    labels=each.get("Labels") or {},
                )
                for each in response.json()
            ]

        return await self._ask("list containers", work)

    async def images(self) -> list[FoundImage]:
        """Return the images that have a tag."""

        def work(client: Any) -> list[FoundImage]:
            return [
                FoundImage(
                    id=str(each["Id"])[:12],
                    tags=tuple(each.get("RepoTags") or ()),
                    size_bytes=int(each.get("Size", 0)),
                    created=str(each.get("Created", "")),
                )
                for each in _attributes(client.images.list())
                if each.get("RepoTags")
            ]

        for _ in range(_LISTED_AGAIN):
            try:
                return await self._ask("list images", work)
            except PrerequisiteError:  # one of them was removed while Podman made the list
                await asyncio.sleep(_LIST_PAUSE_S)
        return await self._ask("list images", work)

    async def image(self, reference: str) -> ImageFacts:
        """Return what an image is made of; NotFoundError when it is not there."""
        return await self._ask(f"image {reference}", lambda client: _facts(client, reference))

    async def has_image(self, reference: str) -> bool:
        """Whether an image is there."""
        return await self._ask(f"image {reference}", lambda client: bool(client.images.exists(reference)))

    async def layers(self) -> frozenset[str]:
        """Return the SHA-256 of all uncompressed layers of the images in the storage."""

        def work(client: Any) -> frozenset[str]:
            found: set[str] = set()
            for each in _attributes(client.images.list())[:_MOST_IMAGES]:
                with contextlib.suppress(NotFoundError):  # removed just now
                    found.update(_facts(client, str(each["Id"])).layers)
            return frozenset(found)

        return await self._ask("layers of images", work)

    async def export_image(self, image_id: str, take: Callable[[str, BinaryIO], None]) -> None:
        """Have Podman give an image; `take` gets each blob's SHA-256 and its bytes, uncompressed, on a thread."""

        def work(client: Any) -> None:
            response = client.api.get(f"/images/{image_id}/get", params={"format": "docker-archive"}, stream=True)
            try:
                if response.status_code == requests.codes.not_found:
                    raise NotFoundError(f"there is no image {image_id[:12]}")
                response.raise_for_status()
                with tarfile.open(fileobj=cast("BinaryIO", response.raw), mode="r|") as tar:
                    for member in tar:
                        stem, _, suffix = member.name.partition(".")
                        if len(stem) == 64 and suffix in ("tar", "json") and member.isreg():
                            body = tar.extractfile(member)
                            if body is not None:
                                take(stem, cast("BinaryIO", body))
            finally:
                response.close()

        try:
            await self._ask(f"export image {image_id[:12]}", work)
        except tarfile.TarError as error:
            raise PoolError(f"Podman gave image {image_id[:12]} as no archive: {error}") from error

    async def load_image(self, archive: Callable[[], Iterator[bytes]]) -> None:
        """Load an OCI archive, made piece by piece; PoolError when Podman will not."""

        def work(client: Any) -> None:
            client.api.post("/images/load", data=archive(), headers=_TAR, timeout=600).raise_for_status()

        await self._ask("load image", work)

    async def remove_image(self, reference: str) -> None:
        """Take a name from an image, and remove it when that was the last; no error when it is gone."""

        def work(client: Any) -> None:
            with contextlib.suppress(ImageNotFound):
                client.images.remove(reference)

        await self._ask(f"remove image {reference}", work)

    # --- volumes ----------------------------------------------------------------------------------------------

    async def ensure_volume(self, name: str, labels: Mapping[str, str]) -> None:
        """Make a named volume unless it is there."""

        def work(client: Any) -> None:
            if not client.volumes.exists(name):
                client.volumes.create(name, labels=dict(labels))

        try:
            await self._ask(f"volume {name}", work)
        except PoolError as error:
            if "already exists" not in error.message:  # another start of this pool made it just now
                raise

    async def volume(self, name: str) -> FoundVolume:
        """Return a named volume; NotFoundError when there is none."""

        def work(client: Any) -> FoundVolume:
            try:
                return _volume(client.volumes.get(name).attrs)
            except NotFound as error:
                raise NotFoundError(f"there is no volume {name}") from error

        return await self._ask(f"volume {name}", work)

    async def volumes(self, labels: Mapping[str, str]) -> list[FoundVolume]:
        """Return the volumes that have all these labels, by name."""

        def work(client: Any) -> list[FoundVolume]:
            found = [_volume(each) for each in _attributes(client.volumes.list())]
            return sorted((each for each in found if labels.items() <= each.labels.items()), key=lambda each: each.name)

        return await self._ask("list volumes", work)

    async def remove_volume(self, name: str) -> bool:
        """Remove a volume; False when a container uses it. No error when it is gone."""

        def work(client: Any) -> bool:
            try:
                client.volumes.remove(name)
            except NotFound:
                return True
            except APIError as error:
                if error.response is None or error.response.status_code != requests.codes.conflict:
                    raise
                return False
            return True

        return await self._ask(f"remove volume {name}", work)

    def close(self) -> None:
        """Let go of threads and connections; a call in progress is waited for."""
        self._threads.shutdown(wait=True, cancel_futures=True)
        for client in self._clients:
            client.close()
        self._clients.clear()


_MOST_IMAGES = 500
_TAR = {"content-type": "application/x-tar"}


def _container(client: Any, container: str) -> Any:
    """Return podman-py's container without asking Podman for it."""
    return client.containers.prepare_model({"Id": container})


def _attributes(found: Iterable[Any]) -> list[dict[str, Any]]:
    return [each.attrs for each in found]


def _volume(found: Mapping[str, Any]) -> FoundVolume:
    return FoundVolume(
        name=str(found["Name"]), folder=Path(found["Mountpoint"]), labels=dict(found.get("Labels") or {})
    )


def _facts(client: Any, reference: str) -> ImageFacts:
    try:
        found = cast("dict[str, Any]", client.images.get(reference).attrs)
    except ImageNotFound as error:
        raise NotFoundError(f"there is no image {reference}", remedy="swiftbot images list") from error
    layers = cast("list[str]", cast("dict[str, Any]", found.get("RootFS") or {}).get("Layers") or [])
    return ImageFacts(
        id=str(found["Id"]).removeprefix("sha256:"),
        layers=tuple(str(each).removeprefix("sha256:") for each in layers),
        size_bytes=int(found.get("Size", 0)),
    )


def _filters(labels: Mapping[str, str]) -> str:
    return json.dumps({"label": [f"{key}={value}" for key, value in labels.items()]})


class Removed(Struct, frozen=True, kw_only=True):
    """What was removed of a fleet on this machine, and which of its state volumes are there still."""

    containers: int = 0
    volumes: tuple[str, ...] = ()
    kept_volumes: tuple[str, ...] = ()


async def remove_fleet(fleet: str, *, volumes: bool, containers: bool = True, url: str = "") -> Removed:
    """Remove what one fleet has on this machine.

    Args:
        fleet: its name.
        volumes: remove its state volumes too, but for those that a container uses; they hold what its skills keep.
        containers: remove its containers.
        url: Podman's API socket.

    Raises:
        UnreachableError: Podman does not answer.
        PoolError: Podman will not.
    """
    engine = PodmanEngine(url)
    labels = {LABEL_FLEET: fleet}
    try:
        found = await engine.containers(labels) if containers else []
        await asyncio.gather(*(engine.remove(each.id) for each in found))
        names = [each.name for each in await engine.volumes(labels)]
        gone = tuple([name for name in names if volumes and await engine.remove_volume(name)])
    finally:
        engine.close()
    kept = tuple(name for name in names if name not in gone)
    return Removed(containers=len(found), volumes=gone, kept_volumes=kept)


def create_arguments(spec: ContainerSpec) -> dict[str, Any]:
    """Return podman-py's arguments for a container (pure; see the traps in the comments)."""
    mounts: list[dict[str, Any]] = [
        {"type": "bind", "source": source, "target": target, "read_only": source not in spec.writable}
        for source, target in spec.binds.items()
    ]
    # `tmpfs=` is refused by podman-py: a mount does it. Executables there are nobody's business but the handler's.
    mounts.append({"type": "tmpfs", "target": "/tmp", "source": "tmpfs", "size": f"{spec.tmp_mb}m", "mode": "1777"})  # noqa: S108 - inside the container
    arguments: dict[str, Any] = {
        "name": spec.name,
        "labels": spec.labels,
        "environment": spec.environment,
        "working_dir": "/",
        "user": "0:0",
        "read_only": True,
        "read_write_tmpfs": False,
        "cap_drop": ["all"],
        # `security_opt` is sent under the wrong name: these two are sent as they should be.
        "no_new_privileges": True,
        "network_mode": "none",
        "ipc_mode": "private",
        "mounts": mounts,
        "volumes": {name: {"bind": target, "mode": "rw"} for name, target in spec.volumes.items()},
        "init": False,
        "stop_timeout": 3,
        "log_config": {"Type": "k8s-file", "Config": {"size": 2**20}},
        "shm_size": "16m",
    }
    if spec.seccomp_profile:
        arguments["seccomp_profile_path"] = spec.seccomp_profile
    if spec.runtime:
        arguments["runtime"] = spec.runtime
    if spec.limits:
        period = 100_000  # microseconds
        arguments |= {
            "pids_limit": spec.pids,
            "mem_limit": spec.memory_mb * 2**20,
            "memswap_limit": spec.memory_mb * 2**20,
            "cpu_period": period,
            "cpu_quota": int(spec.cpu * period),
        }
    return arguments


log = structlog.get_logger(__name__)

MAX_RECONNECT_S = 30.0
WATCH_S = 0.5
"""Pause between two signs of life that Podman is asked for."""
ANSWER_S = 1.2
"""How long it may take for one. Two in a row that do not come make it a problem, so within 3 s."""


class EngineLink:
    """Podman as one pool reaches it.

    Args:
        make_engine: makes the connection's object; may raise SwiftbotError, and is then tried again.
        reconnect_s: first pause before another try; doubles up to MAX_RECONNECT_S.
        on_connected: awaited each time Podman answers (again), before it counts as there.
        on_problem: called when `problem` has changed.
    """

    def __init__(
        self,
        make_engine: Callable[[], Engine],
        *,
        reconnect_s: float,
        on_connected: Callable[[Engine, EngineFacts], Awaitable[None]],
        on_problem: Callable[[], None] = lambda: None,
    ) -> None:
        self.engine: Engine | None = None
        self.facts: EngineFacts | None = None
        self._problem = "not started"
        self._on_problem = on_problem
        self._silent = False
        """Whether the problem is that Podman gives no sign of life."""
        self._make_engine = make_engine
        self._on_connected = on_connected
        self._first_pause_s = self._pause_s = reconnect_s
        self._try_at = 0.0
        self._connecting: asyncio.Task[None] | None = None

    @property
    def problem(self) -> str:
        """Why Podman cannot be used; empty when it can."""
        return self._problem

    @problem.setter
    def problem(self, text: str) -> None:
        changed, self._problem = text != self._problem, text
        if changed:
            self._on_problem()

    async def watch(self) -> None:
        """Ask Podman for signs of life for ever: one that stands still is a problem before the next start needs it."""
        missed = 0
        while True:
            if not missed:
                await asyncio.sleep(WATCH_S)
            engine = self.engine
            if engine is None:
                missed = 0
                await asyncio.sleep(WATCH_S)
                continue
            try:
                await engine.ping(ANSWER_S)
            except SwiftbotError as error:
                missed += 1
                if missed >= 2:
                    self._silent = True
                    self.lost(error)
                    await asyncio.sleep(WATCH_S)
                continue
            missed = 0
            if self._silent:
                # It answers again: what was put off is tried now.
                self._silent = False
                self._try_at, self._pause_s = 0.0, self._first_pause_s
                self.tend(time.monotonic())

    async def start(self, wait_s: float) -> None:
        """Connect; what takes longer than `wait_s` goes on in the background."""
        self._connecting = asyncio.create_task(self._connect(), name="connect to Podman")
        await asyncio.wait({self._connecting}, timeout=wait_s)

    @property
    def unfinished(self) -> "list[asyncio.Task[None]]":
        """The attempt to connect that is in progress."""
        return [self._connecting] if self._connecting is not None and not self._connecting.done() else []

    def cancel(self) -> None:
        """Give up connecting."""
        for task in self.unfinished:
            task.cancel()

    async def close(self) -> None:
        """Let go of threads and connections."""
        engine, self.engine = self.engine, None
        if engine is not None:
            engine.hang_up()
            await asyncio.to_thread(engine.close)

    def there(self) -> tuple[Engine, EngineFacts]:
        """Return Podman and what it said of itself; PoolError when it was never reached."""
        if self.engine is None or self.facts is None:
            raise PoolError(self.problem or "Podman is not connected")
        return self.engine, self.facts

    def lost(self, error: SwiftbotError) -> None:
        """Note that Podman did not answer."""
        if not self.problem:
            self.problem = str(error)
            self._pause_s = self._first_pause_s
            self._try_at = time.monotonic() + self._pause_s
            log.warning("Podman is away", reason=str(error))

    def tend(self, now: float) -> None:
        """Try to reconnect when it is time to."""
        if self.problem and now >= self._try_at and not self.unfinished:
            self._connecting = asyncio.create_task(self._connect(), name="connect to Podman")

    async def _connect(self) -> None:
        try:
            self.engine = self.engine or self._make_engine()
            self.facts = await self.engine.facts()
            await self._on_connected(self.engine, self.facts)
        except SwiftbotError as error:
            if self.problem != str(error):
                log.warning("Podman cannot be used", reason=str(error))
            self.problem = str(error)
            self._try_at = time.monotonic() + self._pause_s
            self._pause_s = min(2 * self._pause_s, MAX_RECONNECT_S)
            return
        self.problem = ""
        self._pause_s = self._first_pause_s
