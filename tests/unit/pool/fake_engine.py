"""A container engine without containers: each is the real runner as a plain process, so only Podman is faked.

It exists because the pool's books (reservations, queue, replacement, adoption) are worth testing in a second,
with real sockets, real forks and real deaths, on a machine that has no Podman.
"""

import asyncio
import contextlib
import hashlib
import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from appliance.errors import NotFoundError, PoolError, PrerequisiteError, UnreachableError
from appliance.pool.engine import ContainerSpec, EngineFacts, Exit, Found, FoundImage, ImageFacts


def environment() -> dict[str, str]:
    """Return what a runner's process finds in its environment.

    Its bytecode is kept where that of the tests is, and never in the tree: without it a runner takes five times as
    long to start.
    """
    kept = {"PYTHONPYCACHEPREFIX": sys.pycache_prefix} if sys.pycache_prefix else {"PYTHONDONTWRITEBYTECODE": "1"}
    return {"PATH": os.environ["PATH"], **kept}


def children_of(parent: int) -> list[int]:
    """Return the processes that a process has started itself."""
    found: list[int] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            # The name before the last bracket may hold anything; after it come the state and the parent.
            if int(stat.read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(stat.parent.name))
    return found


class FakeEngine:
    """The seam to Podman, with the runner as a plain process for a container."""

    def __init__(self, scratch: Path) -> None:
        self.scratch = scratch
        self.away = False
        self.silent = False
        """Whether it stands still: it answers no sign of life."""
        self.exits: dict[str, Exit] = {}
        """How containers ended, beside those that were killed."""
        self.refuse = ""
        self.missing: set[str] = set()
        """Images by name that are not there."""
        self.references: dict[str, str] = {}
        self.ids: dict[str, str] = {}
        """Ids of images by reference, where they are not of it."""
        self.specs: dict[str, ContainerSpec] = {}
        self.processes: dict[str, asyncio.subprocess.Process] = {}
        self.created = 0
        self.calls: Counter[str] = Counter()

    def _called(self, what: str) -> None:
        self.calls[what] += 1
        if self.away:
            raise UnreachableError("Podman's API socket is not there", remedy="start it")

    async def facts(self) -> EngineFacts:
        """Say that limits are not enforced."""
        self._called("facts")
        return EngineFacts(
            version="fake",
            cgroup_version="v1",
            controllers=frozenset(),
            runtime="runc",
            storage_driver="none",
            rootless=True,
        )

    async def create(self, spec: ContainerSpec) -> str:
        """Note it."""
        self._called("create")
        if any(f"/{name}:" in spec.image for name in self.missing):
            raise PrerequisiteError(f"create {spec.name}: the image is not there", remedy="build it")
        self.created += 1
        name = f"engine-{self.created}"
        self.specs[name] = spec
        return name

    async def start(self, container: str) -> None:
        """Start the runner, with the paths that it would see translated back."""
        self._called("start")
        if self.refuse:
            raise PoolError(f"start {container}: {self.refuse}")
        spec = self.specs[container]
        back = {target: source for source, target in spec.binds.items()}
        file = Path(back["/run/swiftbot"]) / "spec.json"
        runner = json.loads(file.read_text())
        for skill in runner["skills"].values():
            folder = Path(skill["folder"])
            skill["folder"] = str(Path(back[str(folder.parent)]) / folder.name)
        runner["roots"] = {name: back[path] for name, path in runner["roots"].items()}
        scratch = self.scratch / container
        scratch.mkdir()
        runner["folders"] = str(scratch / "folders")
        (scratch / "folders").mkdir()
        for target, source in back.items():
            if target.startswith("/folders/"):
                (scratch / target.lstrip("/")).symlink_to(source)
        runner["cache"] = back.get(runner["cache"], "")
        file.write_text(json.dumps(runner))
        self.processes[container] = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "runner.main",
            "--socket", f"{back['/run/swiftbot']}/runner.sock", "--spec", str(file),
            "--scratch", str(scratch), cwd=Path(back["/runner"]).parent,
            env=environment(),
        )  # fmt: skip

    async def remove(self, container: str) -> None:
        """Kill it."""
        self._called("remove")
        self.specs.pop(container, None)
        await self.kill(container)

    async def kill(self, container: str) -> None:
        """End a runner as if somebody had, from outside."""
        process = self.processes.pop(container, None)
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGSTOP)  # so that it starts nothing more
                runs = children_of(process.pid)
                process.kill()
                # In a container the kernel ends all others with process 1.
                for run in runs:
                    for kill in (os.killpg, os.kill):
                        with contextlib.suppress(ProcessLookupError):
                            kill(run, signal.SIGKILL)
            await process.wait()

    async def logs(self, container: str) -> str:
        """Say only whose logs these would be."""
        return f"logs of {container}"

    async def ended(self, container: str) -> Exit | None:
        """Say how it ended: as `exits` says, else killed; None while its process runs."""
        self._called("ended")
        if container in self.processes and self.processes[container].returncode is None:
            return None
        return self.exits.get(container, Exit(code=137, oom=False))

    async def ping(self, timeout_s: float) -> None:
        """Answer at once, unless it is away or stands still."""
        if self.away or self.silent:
            raise UnreachableError(f"Podman has not answered within {timeout_s:g} s", remedy="restart it")

    def hang_up(self) -> None:
        """Do nothing."""

    async def containers(self, labels: Mapping[str, str]) -> list[Found]:
        """Return those with the labels."""
        self._called("containers")
        return [
            Found(
                id=name,
                name=spec.name,
                running=name in self.processes and self.processes[name].returncode is None,
                labels=spec.labels,
                image=spec.image,
            )
            for name, spec in self.specs.items()
            if labels.items() <= spec.labels.items()
        ]

    async def images(self) -> list[FoundImage]:
        """Return those that are there."""
        self._called("images")
        there = [each for name, each in self.references.items() if name not in self.missing]
        return [FoundImage(id="1", tags=(each,), size_bytes=1, created="") for each in there]

    async def image(self, reference: str) -> ImageFacts:
        """Return what an image is: its id is that of the reference, or what a test has given it."""
        if reference not in {each for name, each in self.references.items() if name not in self.missing}:
            raise NotFoundError(f"there is no image {reference}")
        return ImageFacts(id=self.ids.get(reference, hashlib.sha256(reference.encode()).hexdigest()), layers=())

    async def ensure_volume(self, name: str, labels: Mapping[str, str]) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""
