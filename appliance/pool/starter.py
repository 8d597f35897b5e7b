"""Makes, adopts and removes this gateway's containers: what a container of an image is, in one place.

It exists apart from the pool so that policy (when, how many, whom to give up) and mechanism (labels, mounts,
waiting for the runner) can be read each on its own.
"""

import asyncio
import contextlib
import hashlib
import json
import secrets
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import IdentityError, NotFoundError, PoolError, PrerequisiteError, SwiftbotError
from appliance.identity.parts import ALL, InForce, Kind
from appliance.model import ContainerInfo, ContainerState, Need
from appliance.pool import images
from appliance.pool.container import SOCKET, PooledContainer
from appliance.pool.engine import (
    LABEL_FLEET,
    LABEL_GATEWAY,
    LABEL_ID,
    LABEL_IMAGE,
    LABEL_SNAPSHOT,
    LABEL_STATE,
    ContainerSpec,
    Engine,
    EngineFacts,
    Found,
)
from appliance.pool.settings import PoolConfig
from appliance.pool.signed import may_be_in
from appliance.pool.snapshots import Snapshot, Snapshots, unexpected
from appliance.pool.volumes import State
from appliance.skills.catalogue import SKILLS, Catalogue, SkillManifest

log = structlog.get_logger(__name__)

RUNNER = Path(__file__).resolve().parent / "runner"
SPEC = "spec.json"
"""The specification of a container's runner, in the container's folder."""
PRELOAD_PART = 0.4
"""Part of the time for a start that loading may take; it happens twice where it is rehearsed first."""
IMPORT_S = 10.0
"""Longest import of one module or handler, for images that do not ask for more (`load_s`)."""
FOLDERS = "/folders"
CACHE = "/cache"
"""Where containers find the folders of the gateway's machine, and what they cache."""
ADOPT_TIMEOUT_S = 2.0
MAX_RESULT_BYTES = 48 * 1024
"""Of a run, as JSON, where nothing else is said; `tasks.max_result_bytes`."""
LABEL_SIZE = "swiftbot.size"


class Size(Struct, frozen=True, kw_only=True):
    """What a container is given."""

    cpu: float
    memory_mb: int
    volumes: tuple[str, ...]


class Starter:
    """Makes containers for one gateway of one fleet, and takes over those it finds.

    `open` comes first. Containers mount a snapshot of the skills and the runner, never the live folders, and each is
    asked what it has loaded: one that has loaded anything else is not used, and `refused["loaded code"]` counts it.
    """

    def __init__(
        self,
        config: PoolConfig,
        *,
        gateway: str,
        fleet: str,
        run_dir: Path,
        data_dir: Path,
        catalogue: Catalogue,
        site: dict[str, Any],
        refused: Counter[str],
        on_death: Callable[[PooledContainer], None],
        state: State,
        parts: InForce = ALL,
        max_result_bytes: int = MAX_RESULT_BYTES,
    ) -> None:
        self._max_result_bytes = max_result_bytes
        self._state = state
        self._parts = parts
        self._config = config
        self._gateway = gateway
        self._fleet = fleet
        self._run_dir = run_dir
        self._data_dir = data_dir
        self._catalogue = catalogue
        self._site = site
        self._proven: set[str] = set()
        self._unsigned: set[str] = set()
        self._sizes: dict[str, Size] = {}
        self._preloads_mb: dict[str, int] = {}
        self._on_death = on_death
        self._labels = {LABEL_FLEET: fleet, LABEL_GATEWAY: gateway}
        self._refused = refused
        self._snapshots = Snapshots(data_dir / "snapshots")
        self._taken: Snapshot | None = None
        self._roots = _roots(catalogue)
        self._seccomp = _digest(config.seccomp_file())

    async def open(self) -> None:
        """Take the snapshot that all containers mount from now on; ConfigError when that cannot be done."""
        self._taken = await asyncio.to_thread(self._snapshots.take, self._roots, may_be_in(self._parts))
        names = {root: name for name, root in self._roots.items()}
        for skill in self._catalogue.skills.values():
            # Edited since the catalogue was read: its handler is not in the snapshot, so no container is told of it.
            if skill.implemented and f"{names[skill.folder.parent]}/{skill.folder.name}" in self._taken.left_out:
                self._refused["unsigned skill"] += 1
                self._unsigned.add(skill.id)

    @property
    def _snapshot(self) -> Snapshot:
        if self._taken is None:
            raise PoolError("no snapshot of the skills has been taken")
        return self._taken

    def skills(self, image: str) -> list[SkillManifest]:
        """Return the skills that a container of an image can run: its own and those of compatible images."""
        served = {image, *self._catalogue.images[image].compatible}
        skills = self._catalogue.skills.values()
        return [each for each in skills if each.implemented and each.image in served and each.id not in self._unsigned]

    def size(self, image: str, need: Need | None = None) -> Size:
        """Return what a container of an image gets: enough for each of its skills, and for `need`."""
        least = self._least(image)
        if need is None:
            return least
        memory_mb = max(least.memory_mb, need.memory_mb + self._preload_mb(image))
        volumes = least.volumes if not need.volumes else tuple(sorted({*least.volumes, *need.volumes}))
        return Size(cpu=max(least.cpu, need.cpu), memory_mb=memory_mb, volumes=volumes)

    def _least(self, image: str) -> Size:
        """Return what each container of an image gets; asked for each run that waits, so it is worked out once."""
        if image not in self._sizes:
            own = [each for each in self._catalogue.skills.values() if each.image == image]
            memory_mb = max(self._config.container_memory_mb, *(each.memory_mb for each in own), 0)
            # Those of compatible images' skills too: one that runs without its volume would lose what it writes.
            volumes = {name for each in self.skills(image) for name in each.volumes}
            self._sizes[image] = Size(
                cpu=max(self._config.cpu, *(each.cpu for each in own), 0.0),
                memory_mb=memory_mb + self._preload_mb(image),
                volumes=tuple(sorted(volumes)),
            )
        return self._sizes[image]

    def _preload_mb(self, image: str) -> int:
        if image not in self._preloads_mb:
            self._preloads_mb[image] = sum(skill.preload_mb for skill in self.skills(image))
        return self._preloads_mb[image]

    def start_timeout_s(self, image: str) -> float:
        """Return how long a container of an image may take from its creation to its runner's first answer, seconds."""
        return max(self._config.start_timeout_s, self._catalogue.images[image].load_s / PRELOAD_PART)

    def new(self, image: str, need: Need | None = None) -> PooledContainer:
        """Return a container that is yet to be started."""
        size = self.size(image, need)
        name = secrets.token_hex(6)
        info = ContainerInfo(
            id=name,
            gateway=self._gateway,
            image=image,
            state=ContainerState.STARTING,
            cpu=size.cpu,
            memory_mb=size.memory_mb,
            volumes=tuple(each for each in size.volumes if self._state.newest_here(each)),
            compatible=self._catalogue.images[image].compatible,
            since_ns=time.time_ns(),
        )
        return PooledContainer(info, self._run_dir / name, mounts=size.volumes, on_death=self._on_death)

    def look_at_state(self, container: PooledContainer) -> bool:
        """Bring up to date which of its volumes hold the newest state here; whether that changed anything."""
        here = tuple(each for each in container.mounts if self._state.newest_here(each))
        if here == container.info.volumes:
            return False
        container.info = replace(container.info, volumes=here)
        return True

    async def start(self, container: PooledContainer, engine: Engine, facts: EngineFacts) -> None:
        """Create and start it and wait for its runner; what is left of a failed one is removed.

        Raises:
            PoolError, PrerequisiteError, UnreachableError: it could not be started, with the reason.
        """
        began = time.monotonic()
        image = container.info.image
        spec = self._spec(container, facts, await asyncio.to_thread(self._make_folders, image))
        runner = {**self._told(image), "proven": self._made(image) in self._proven}
        await asyncio.to_thread(_write, container.folder, runner)

        async def alive() -> None:
            found = await engine.containers({**self._labels, LABEL_ID: container.id})
            if not any(each.running for each in found):
                raise PoolError(f"container {container.id} of {container.info.image} ended at once")

        try:
            for volume in spec.volumes:
                await engine.ensure_volume(volume, self._labels)
            container.engine_id = await self._create(image, spec, engine)
            await engine.start(container.engine_id)

            timeout_s = self.start_timeout_s(image)
            await container.connect(timeout_s=timeout_s, alive=alive)
            await self._check_code(container, timeout_s=timeout_s)
        except BaseException as error:
            text = await engine.logs(container.engine_id) if container.engine_id else ""
            await self._discard(container, engine)
            if text and isinstance(error, SwiftbotError):
                raise PoolError(f"{error.message}; it wrote: {text[-600:]}", remedy=error.remedy) from error
            raise
        cold_ms = (time.monotonic() - began) * 1e3
        container.info = replace(container.info, cold_ms=cold_ms)
        if not container.problems:
            self._proven.add(self._made(container.info.image))
        for what, problem in container.problems.items():
            log.warning("not preloaded", container=container.id, image=container.info.image, what=what, reason=problem)

    async def _check_code(self, container: PooledContainer, *, timeout_s: float) -> None:
        """Ask a container what it has loaded; PoolError, counted, when that is not the code of the snapshot."""
        loaded = await container.hello(timeout_s=timeout_s)
        wrong = unexpected(loaded, self._snapshot.files)
        if loaded and not wrong:
            return
        self._refused["loaded code"] += 1
        log.warning("container has loaded other code", container=container.id, image=container.info.image, files=wrong)
        names = ", ".join(wrong[:3]) + (f" and {len(wrong) - 3} others" if len(wrong) > 3 else "")
        what = f"has loaded other code than snapshot {self._snapshot.digest[:12]} holds: {names}"
        raise PoolError(f"container {container.id} {what if wrong else 'does not say what code it has loaded'}")

    async def _create(self, image: str, spec: ContainerSpec, engine: Engine) -> str:
        """Create the container; an image that is not there is asked of the other gateways first."""
        try:
            return await engine.create(await self._signed(spec, engine))
        except (PrerequisiteError, NotFoundError):
            try:
                await self._state.bring_image(spec.image)
            except SwiftbotError as error:
                raise PrerequisiteError(
                    f"image {spec.image} is not on {self._gateway}: {error.message}",
                    remedy=images.build_command(self._catalogue.images[image]),
                ) from error
            log.info("image brought", image=spec.image)
            return await engine.create(await self._signed(spec, engine))

    async def _signed(self, spec: ContainerSpec, engine: Engine) -> ContainerSpec:
        """Return a specification that names its image by its id; IdentityError, counted, where that is not signed."""
        if not self._parts.checked:
            return spec
        found = await engine.image(spec.image)
        try:
            self._parts.check(Kind.IMAGE, spec.image, found.id)
        except IdentityError:
            self._refused["unsigned image"] += 1
            raise
        # A tag may be given to another image before the container is made.
        return replace(spec, image=found.id)

    async def _discard(self, container: PooledContainer, engine: Engine) -> None:
        with contextlib.suppress(SwiftbotError):
            await self.remove(container, engine)

    async def remove(self, container: PooledContainer, engine: Engine | None) -> None:
        """End a container and remove all that is its own; SwiftbotError when Podman will not or is away."""
        container.close()
        if engine is not None and container.engine_id:
            await engine.remove(container.engine_id)
        await asyncio.to_thread(shutil.rmtree, container.folder, ignore_errors=True)

    async def own(self, engine: Engine) -> list[Found]:
        """Return what Podman has of this gateway's containers, running or not."""
        return await engine.containers(self._labels)

    async def adopt(self, engine: Engine) -> list[PooledContainer]:
        """Take over this gateway's running containers that are as they would be made now; remove the others.

        Raises:
            SwiftbotError: Podman does not tell what there is.
        """
        found = await engine.containers(self._labels)
        adopted = [each for each in await asyncio.gather(*(self._adopt(each, engine) for each in found)) if each]
        await asyncio.to_thread(self._forget_folders, {each.id for each in adopted})
        await self.forget_snapshots(await self.own(engine))
        return adopted

    async def forget_snapshots(self, found: Iterable[Found]) -> None:
        """Remove the snapshots that none of these containers of this gateway mounts, but the one of now."""
        keep = {self._snapshot.digest, *(each.labels.get(LABEL_SNAPSHOT, "") for each in found)}
        try:
            for digest in await asyncio.to_thread(self._snapshots.forget, keep):
                log.info("old snapshot of skills removed", snapshot=digest[:12])
        except OSError as error:
            log.warning("old snapshots of skills were left", reason=str(error))

    async def _adopt(self, found: Found, engine: Engine) -> PooledContainer | None:
        name, image = found.labels.get(LABEL_ID, ""), found.labels.get(LABEL_IMAGE, "")
        reason = ""
        container: PooledContainer | None = None
        if not found.running:
            reason = "not running"
        elif not name or image not in self._catalogue.images:
            reason = "not of this catalogue"
        elif (size := _read_size(found)) is None:
            reason = "its label does not say what it was given"
        else:
            container = self.new(image)
            container.folder = self._run_dir / Path(name).name
            container.engine_id = found.id
            container.mounts = size.volumes
            container.info = replace(container.info, id=name, cpu=size.cpu, memory_mb=size.memory_mb)
            self.look_at_state(container)
            if self._parts.checked and not self._parts.has(Kind.IMAGE, self.reference(image), found.image):
                reason = "made of an image that is not signed"
            elif found.labels.get(LABEL_STATE) != self._made(image):
                reason = "made of another image, other code or with other settings"
            else:
                reason = await self._take_over(container)
        if not reason:
            return container
        log.info("not adopted", container=name or found.name, reason=reason)
        if container is not None:
            container.close()
        with contextlib.suppress(SwiftbotError):
            await engine.remove(found.id)
        return None

    async def _take_over(self, container: PooledContainer) -> str:
        """Connect to a container that runs; returns why it cannot be had, empty when it can."""

        async def alive() -> None:
            """Not asked: Podman has just said so."""

        until = time.monotonic() + self._config.cancel_grace_s + ADOPT_TIMEOUT_S
        try:
            await container.connect(timeout_s=ADOPT_TIMEOUT_S, alive=alive)
            # The run of the gateway before us is being ended by the runner, which has seen it hang up.
            while reply := (await container.ping(timeout_s=ADOPT_TIMEOUT_S)).get("run"):
                if time.monotonic() > until:
                    return f"run {reply} of the gateway before does not end"
                await asyncio.sleep(0.05)
            await self._check_code(container, timeout_s=ADOPT_TIMEOUT_S)
        except SwiftbotError as error:
            return error.message
        return ""

    def _forget_folders(self, known: set[str]) -> None:
        for folder in self._run_dir.iterdir() if self._run_dir.is_dir() else ():
            if folder.is_dir() and folder.name not in known:
                shutil.rmtree(folder, ignore_errors=True)

    def reference(self, image: str) -> str:
        """Return the full name that Podman knows an image by."""
        return images.reference(self._catalogue.images[image], self._config)

    def _made(self, image: str) -> str:
        config = self._config
        told = json.dumps(self._told(image), sort_keys=True)
        folders = sorted(self._folders(image).items())
        bounds = (config.tmp_mb, config.pids, config.runtime, self._seccomp, folders)
        parts = (self.reference(image), self._snapshot.digest, told, bounds)
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]

    def _mounted(self, image: str) -> dict[str, Path]:
        """Return the folders of code that containers of an image mount, by their names in the snapshot."""
        used = {RUNNER, SKILLS, *(each.folder.parent for each in self.skills(image))}
        return {name: root for name, root in self._roots.items() if root in used}

    def _folders(self, image: str) -> dict[str, Path]:
        """Return the machine's folders that skills of an image read, by name."""
        names = sorted({name for each in self.skills(image) for name in each.folders})
        given = self._config.folders
        return {
            name: Path(given[name]).expanduser().resolve() if name in given else self._data_dir / "folders" / name
            for name in names
        }

    def _make_folders(self, image: str) -> dict[str, Path]:
        """Make the folders of an image that are the gateway's own; returns those of its skills that can be mounted."""
        if cache := self._cache(image):
            cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        found: dict[str, Path] = {}
        for name, path in self._folders(image).items():
            if name not in self._config.folders:
                path.mkdir(mode=0o700, parents=True, exist_ok=True)
            if path.is_dir():
                found[name] = path
            else:
                log.warning("folder is not mounted", folder=name, path=str(path), reason="it is not there")
        return found

    def _cache(self, image: str) -> Path | None:
        """Return the folder that containers of an image cache in; None where no skill of it wants one."""
        if not any(each.cache for each in self.skills(image)):
            return None
        return self._data_dir / "cache" / image

    def _told(self, image: str) -> dict[str, Any]:
        """Return the specification of the runners of an image, the same each time: see `runner/spec.py`."""
        mounted = self._mounted(image)
        inside = {root: f"/{name}" for name, root in mounted.items()}
        skills = self.skills(image)
        modules = [*self._catalogue.images[image].preload, *(name for each in skills for name in each.preload)]
        return {
            "skills": {
                each.id: {
                    "folder": f"{inside[each.folder.parent]}/{each.folder.name}",
                    "loads": each.loads,
                    "preload_mb": each.preload_mb,
                    "preload_s": each.preload_s,
                    "file_mb": each.file_mb,
                }
                for each in skills
            },
            "roots": {name: f"/{name}" for name in mounted},
            "modules": list(dict.fromkeys(modules)),
            "site": self._site,
            "volumes": "/volumes",
            "reserve_mb": self._config.transfer.reserve_mb,
            "max_result_bytes": self._max_result_bytes,
            "import_s": max(IMPORT_S, self._catalogue.images[image].load_s),
            "patience_s": PRELOAD_PART * self.start_timeout_s(image),
            "folders": FOLDERS,
            "cache": CACHE if self._cache(image) else "",
        }

    def _spec(self, container: PooledContainer, facts: EngineFacts, folders: dict[str, Path]) -> ContainerSpec:
        config, info = self._config, container.info
        snapshot = self._snapshot
        mounts = {str(snapshot.folder / name): f"/{name}" for name in self._mounted(info.image)}
        own = {str(container.folder): "/run/swiftbot"}
        if cache := self._cache(info.image):
            own[str(cache)] = CACHE
        binds = {**own, **mounts, **{str(path): f"{FOLDERS}/{name}" for name, path in folders.items()}}
        processes = 0 if facts.limits_enforced else config.user_processes
        inside = "/run/swiftbot"
        command = ("python3", "-s", "-m", "runner.main", "--socket", f"{inside}/{SOCKET}", "--spec", f"{inside}/{SPEC}")
        size = Size(cpu=info.cpu, memory_mb=info.memory_mb, volumes=container.mounts)
        labels = {
            LABEL_ID: info.id,
            LABEL_IMAGE: info.image,
            LABEL_STATE: self._made(info.image),
            LABEL_SNAPSHOT: snapshot.digest,
            LABEL_SIZE: msgspec.json.encode(size).decode(),
        }
        return ContainerSpec(
            name=f"swiftbot-{self._fleet}-{self._gateway}-{info.id}",
            image=self.reference(info.image),
            command=(*command, "--processes", str(processes)),
            labels=self._labels | labels,
            binds=binds,
            writable=frozenset(own),
            volumes={f"swiftbot-{self._fleet}-{self._gateway}-{name}": f"/volumes/{name}" for name in container.mounts},
            environment={
                "PYTHONDONTWRITEBYTECODE": "1",
                # `runner` is below /, what handlers share (`_lib`) below /skills.
                "PYTHONPATH": "/:/skills",
                "LANG": "C.UTF-8",
                # BLAS would start a thread a core in the zygote, and threads do not live through a fork.
                "OPENBLAS_NUM_THREADS": "1",
            },
            cpu=info.cpu,
            memory_mb=info.memory_mb,
            pids=config.pids,
            tmp_mb=config.tmp_mb,
            runtime=config.runtime or ("runc" if facts.cgroup_version == "v1" else ""),
            seccomp_profile=config.seccomp_file(),
            limits=facts.limits_enforced,
        )


def _read_size(found: Found) -> Size | None:
    """Return what a container was given, by its label; None where that says nothing of the kind."""
    try:
        return msgspec.json.decode(found.labels.get(LABEL_SIZE, ""), type=Size)
    except msgspec.DecodeError:
        return None


def _digest(profile: str) -> str:
    """Return what tells one seccomp profile from another, wherever it lies; empty for Podman's own."""
    try:
        return hashlib.sha256(Path(profile).read_bytes()).hexdigest() if profile else ""
    except OSError:
        return profile  # Podman says what is wrong with it when a container starts


def _write(folder: Path, runner: dict[str, Any]) -> None:
    folder.mkdir(mode=0o700, parents=True)
    (folder / SPEC).write_text(json.dumps(runner), encoding="utf-8")


def _roots(catalogue: Catalogue) -> dict[str, Path]:
    """Return the folders that a container may load code from, by the names that they have in a snapshot and in it."""
    others = dict.fromkeys(each.folder.parent for each in catalogue.skills.values() if each.implemented)
    others.pop(SKILLS, None)
    numbered = {f"skills-{number}": root for number, root in enumerate(sorted(others), start=1)}
    return {"runner": RUNNER, "skills": SKILLS, **numbered}
