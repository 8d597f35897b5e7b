"""A container engine without containers: each is the real runner as a plain process, so only Podman is faked.

It exists because the pool's books (reservations, queue, replacement, adoption) are worth testing in a second,
with real sockets, real forks and real deaths, on a machine that has no Podman.
"""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
import textwrap
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import PoolError, PrerequisiteError, UnreachableError
from appliance.model import ContainerInfo, ContainerState, Need, RunEvent, RunRequest, Site
from appliance.pool import images
from appliance.pool.engine import ContainerSpec, EngineFacts, Found, FoundImage
from appliance.pool.pool import Call, Pool
from appliance.pool.pressure import Reading
from appliance.pool.selection import Candidate
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import RUNNER
from appliance.pool.state import ALONE, State
from appliance.skills.catalogue import Catalogue, load_catalogue

HANDLER = """
import os, signal, subprocess, sys, time
from pathlib import Path

STATE = {"runs": 0}

def run(ctx):
    do = ctx.params.get("do", "echo")
    if do == "echo":
        STATE["runs"] += 1
        ctx.progress(0.5, "half")
        ctx.log("hello", colour="red")
        print("printed")
        ctx.partial({"so": "far"})
        return {"params": ctx.params, "inputs": ctx.inputs, "robot": ctx.robot, "site": ctx.site.get("name"),
                "runs": STATE["runs"], "scratch": str(ctx.scratch), "here": os.getcwd(), "pid": os.getpid()}
    if do == "call":
        answer = ctx.command("goto", timeout_s=5, x=1)
        reference = ctx.put_artifact("a.bin", b"\\x00\\xff", "application/x")
        return {"answer": {**answer, "blobs": {k: len(v) for k, v in answer["blobs"].items()}},
                "reference": reference, "back": ctx.get_artifact(reference) == b"\\x00\\xff"}
    if do == "call error":
        try:
            ctx.command("fly")
        except ctx.CallError as error:
            return {"code": error.code, "message": error.message, "retryable": error.retryable}
    if do == "uncaught call error":
        ctx.command("fly")
    if do == "fail":
        raise ctx.Fail("no light", remedy="switch it on", retryable=True)
    if do == "raise":
        raise ValueError("bad value")
    if do == "save when due":
        ctx.checkpoint({"first": 1})
        Path(ctx.params["pid"]).write_text(str(os.getpid()))
        while not ctx.checkpoint_due():
            time.sleep(0.005)
        ctx.checkpoint({"last": 2})
        return {"due": ctx.checkpoint_due()}
    if do == "sleep":
        Path(ctx.params["pid"]).write_text(str(os.getpid()))
        time.sleep(60)
    if do == "clean up":
        try:
            ctx.progress(0.1)
            time.sleep(60)
        except ctx.Cancelled:
            ctx.log("cleaned")
            raise
    if do == "stubborn":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        Path(ctx.params["pid"]).write_text(str(os.getpid()))
        time.sleep(60)
    if do == "grandchild":
        child = subprocess.Popen(["sleep", "60"])
        Path(ctx.params["pid"]).write_text(str(child.pid))
        return {}
    if do == "segv":
        print("last words", flush=True)
        time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGSEGV)
    if do == "exit":
        os._exit(3)
    if do == "sys.exit":
        sys.exit(4)
    if do == "long checkpoint":
        ctx.checkpoint({"x": "y" * 2**20})
    if do == "list checkpoint":
        ctx.checkpoint([1])
    if do == "resume":
        return ctx.resume
    if do == "calls in steps":
        begun = (ctx.resume or {"done": 0})["done"]
        for step in range(begun, 3):
            ctx.notify("a", f"step {step}")
            ctx.checkpoint({"done": step + 1})
    if do == "large":
        return {"x": "y" * (5 * 2**20)}
    if do == "huge call":
        ctx.put_artifact("big", b"x" * (17 * 2**20))
    if do == "memory":
        return {"x": len(bytearray(8 * 2**30))}
    if do == "list":
        return [1]
    if do == "class":
        return {"x": object()}
    if do == "nan":
        return {"x": float("nan")}
    if do == "flood":
        for number in range(40000):
            print("line", number)
        return {}
    if do == "half frame":
        ctx._link._mark(True)
        ctx._link._socket.sendall(b"\\x00\\x00\\x01\\x00{")
        os.kill(os.getpid(), signal.SIGKILL)
    if do == "garbage":
        ctx._link._socket.sendall(b"\\x00\\x00\\x00\\x03abc")
        time.sleep(60)
    if do == "oversize":
        ctx._link._socket.sendall(b"\\xff\\xff\\xff\\xff")
        time.sleep(60)
    if do == "unknown event":
        ctx._link.send({"ev": "nonsense"})
        time.sleep(60)
    if do == "many calls":
        return {"n": [ctx.notify("a", "b")["number"] for _ in range(3)]}
"""


def write_skill(root: Path, name: str, handler: str, *, image: str = "base") -> None:
    """Write a skill's folder."""
    folder = root / name
    folder.mkdir(parents=True)
    (folder / "handler.py").write_text(textwrap.dedent(handler))
    (folder / "skill.toml").write_text(
        f'id = "{name}"\ndomain = "coordination"\nsummary = "A test."\nruns = "compute"\n'
        f'image = "{image}"\ncpu = 0.2\nmemory_mb = 64\n'
    )


@pytest.fixture
def short_dir() -> Iterator[Path]:
    """Return a folder of the test's own, in /tmp."""
    folder = Path(tempfile.mkdtemp(prefix="pool-"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def skills_dir(short_dir: Path) -> Path:
    """Return a folder with the skills `probe` (does what `do` says), `broken` (cannot be imported) and `seeing`."""
    root = short_dir / "skills"
    write_skill(root, "probe", HANDLER)
    write_skill(root, "broken", "import no_such_module\ndef run(ctx):\n    return {}\n")
    write_skill(root, "seeing", "def run(ctx):\n    return {'saw': True}\n", image="vision")
    return root


@pytest.fixture
def growing(skills_dir: Path) -> Path:
    """Add a skill whose runner takes 96 MB for itself as soon as the file exists that is returned."""
    file = skills_dir.parent / "grow"
    handler = f"""
    import threading, time
    from pathlib import Path

    KEPT = []

    def grow():
        while not Path("{file}").exists():
            time.sleep(0.01)
        KEPT.append(b"x" * (96 * 2**20))

    threading.Thread(target=grow, daemon=True).start()

    def run(ctx):
        return {{}}
    """
    write_skill(skills_dir, "growing", handler)
    return file


@pytest.fixture
def catalogue(skills_dir: Path) -> Catalogue:
    """Return the real images with the test's skills only."""
    whole = load_catalogue([skills_dir])
    skills = {name: each for name, each in whole.skills.items() if each.folder.parent == skills_dir}
    images = {
        name: type(each)(name=name, packages=each.packages, compatible=each.compatible, folder=each.folder)
        for name, each in whole.images.items()
    }
    return Catalogue(whole.domains, skills, images)


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
        self.refuse = ""
        self.missing: set[str] = set()
        """Images by name that are not there."""
        self.references: dict[str, str] = {}
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
        file.write_text(json.dumps(runner))
        scratch = self.scratch / container
        scratch.mkdir()
        self.processes[container] = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "runner.main",
            "--socket", f"{back['/run/swiftbot']}/runner.sock", "--spec", str(file),
            "--scratch", str(scratch), cwd=RUNNER.parent,
            env={"PYTHONDONTWRITEBYTECODE": "1", "PATH": os.environ["PATH"]},
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

    async def containers(self, labels: Mapping[str, str]) -> list[Found]:
        """Return those with the labels."""
        self._called("containers")
        return [
            Found(
                id=name,
                name=spec.name,
                running=name in self.processes and self.processes[name].returncode is None,
                labels=spec.labels,
            )
            for name, spec in self.specs.items()
            if labels.items() <= spec.labels.items()
        ]

    async def images(self) -> list[FoundImage]:
        """Return those that are there."""
        self._called("images")
        there = [each for name, each in self.references.items() if name not in self.missing]
        return [FoundImage(id="1", tags=(each,), size_bytes=1, created="") for each in there]

    async def ensure_volume(self, name: str, labels: Mapping[str, str]) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


async def until(true: Callable[[], bool], what: str, *, within_s: float = 60.0) -> None:
    """Wait until something holds; fails with what it was."""
    try:
        async with asyncio.timeout(within_s):
            while not true():
                await asyncio.sleep(0.005)
    except TimeoutError:
        pytest.fail(f"not within {within_s} s: {what}")


class Bench:
    """A pool on a fake engine, and what a test needs around it."""

    def __init__(self, folder: Path, catalogue: Catalogue) -> None:
        self.folder = folder
        self.catalogue = catalogue
        self.engine = FakeEngine(folder)
        self.engine.references = {name: images.reference(each, PoolConfig()) for name, each in catalogue.images.items()}
        self.pools: list[Pool] = []
        self.changes: list[tuple[ContainerInfo, ...]] = []
        self.calls: list[Call] = []
        self.offers: list[Candidate] = []
        self.avoided: list[set[str]] = []
        self.memory = Reading()

    async def answer(self, call: Call) -> dict[str, Any]:
        """Carry out a handler's call."""
        self.calls.append(call)
        match call.name:
            case "command" if call.args["verb"] == "fly":
                raise UnreachableError("no such robot", remedy="look for it")
            case "command":
                return {"at": call.args["args"], "blobs": {"a.png": b"123"}}
            case "put_artifact":
                return {"artifact": "abc", "bytes": len(call.args["data"])}
            case "get_artifact":
                return {"data": b"\x00\xff"}
            case _:
                return {"number": call.number}

    async def find_remote(self, need: Need, avoid: Collection[str]) -> list[Candidate]:
        """Offer what the test has put there for this image, and note whose will not be used."""
        self.avoided.append(set(avoid))
        return [each for each in self.offers if each.container.image == need.image]

    async def pool(self, *, gateway: str = "g1", fleet: str = "f1", state: State = ALONE, **settings: Any) -> Pool:
        """Return a started pool."""
        settings = {"floor": {}, "cancel_grace_s": 0.3, "probe_s": 0.2, "mode": "local"} | settings
        pool = Pool(
            PoolConfig(**settings),
            gateway=gateway,
            fleet=fleet,
            run_dir=self.folder / "run" / fleet / gateway,
            catalogue=self.catalogue,
            site=Site(name="yard"),
            find_remote=self.find_remote,
            on_call=self.answer,
            on_change=self.changes.append,
            state=state,
            make_engine=lambda: self.engine,
            read_memory=lambda: self.memory,
        )
        self.pools.append(pool)
        await pool.start()
        return pool

    @staticmethod
    def request(number: int = 1, *, skill: str = "probe", image: str = "base", **more: Any) -> RunRequest:
        """Return an order to run a skill; `do` and others are its parameters."""
        deadline_s = more.pop("deadline_s", 10.0)
        volumes = more.pop("volumes", ())
        return RunRequest(
            task="t",
            subtask=f"s{number}",
            attempt=1,
            skill=skill,
            need=Need(image=image, cpu=0.1, memory_mb=64, volumes=volumes),
            params=more,
            deadline_s=deadline_s,
        )

    async def run(self, pool: Pool, request: RunRequest) -> tuple[RunEvent, list[RunEvent]]:
        """Select and run; returns the last event and those before."""
        events: list[RunEvent] = []
        decision = await pool.select(request.need, allow_remote=False)
        return await pool.run(request, decision, events.append), events

    @staticmethod
    async def ready(pool: Pool, count: int, image: str = "base") -> None:
        """Wait until a pool has so many ready containers of an image."""

        def enough() -> bool:
            return sum(c.state is ContainerState.READY and c.image == image for c in pool.containers()) == count

        await until(enough, f"{count} ready containers of {image}")

    until = staticmethod(until)

    async def close(self) -> None:
        """End everything."""
        for pool in self.pools:
            await pool.stop(keep_containers=True)
        for container in list(self.engine.processes):
            await self.engine.kill(container)


@pytest.fixture
async def bench(short_dir: Path, catalogue: Catalogue) -> AsyncIterator[Bench]:
    """Return a bench with a fake engine."""
    it = Bench(short_dir, catalogue)
    yield it
    await it.close()


@pytest.fixture
async def zygote(short_dir: Path, skills_dir: Path) -> AsyncIterator[Callable[[], Awaitable[Any]]]:
    """Return a function that opens a connection to a runner with the test's skills, which is a plain process."""
    from appliance.pool.container import Connection  # noqa: PLC0415

    folder = short_dir / ("long-" * 20)
    folder.mkdir()
    skills = {name: {"folder": str(skills_dir / name)} for name in ("probe", "broken")}
    spec = {"skills": skills, "modules": ["json", "nowhere"], "site": {"name": "yard"}}
    (folder / "spec.json").write_text(json.dumps(spec))
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "runner.main", "--socket", "runner.sock", "--spec", "spec.json",
        "--scratch", str(short_dir), cwd=folder,
        env={"PYTHONPATH": str(RUNNER.parent), "PYTHONDONTWRITEBYTECODE": "1", "PATH": os.environ["PATH"]},
    )  # fmt: skip
    await until((folder / "runner.sock").exists, "the runner's socket")
    opened: list[Connection] = []

    async def connect() -> Connection:
        opened.append(await Connection.open(folder))
        return opened[-1]

    connect.process = process  # type: ignore[attr-defined]
    yield connect
    for connection in opened:
        connection.close()
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGTERM)
    await asyncio.wait_for(process.wait(), 10)
