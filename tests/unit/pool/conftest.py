"""Pools without containers, runners without pools, and skills that do what tests say."""

import asyncio
import contextlib
import json
import shutil
import signal
import sys
import tempfile
import textwrap
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.pool.starter import RUNNER
from appliance.skills.catalogue import Catalogue, load_catalogue
from tests.unit.pool.bench import Bench, until
from tests.unit.pool.fake_engine import environment

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
    if do == "meet":
        place = Path(ctx.params["place"])
        (place / str(os.getpid())).touch()
        while len(list(place.iterdir())) < 2:
            time.sleep(0.005)
        return {}
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
    if do == "vast":
        return {"x": "y" * (50 * 2**20)}
    if do == "vast log":
        ctx.log("hello", data="y" * (17 * 2**20))
    if do == "vast partial":
        ctx.partial({"x": "y" * (17 * 2**20)})
    if do == "vast notice":
        ctx.notify("a", "y" * (17 * 2**20))
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
    if do == "no text":
        name = os.fsdecode(b"caf\\xe9")
        where = ctx.params["where"]
        if where == "people":
            ctx.progress(0.5, name)
            ctx.log(name, file=name)
            return {"whole": 2**70, "text": "caf\\u00e9"}
        if where == "result":
            return {"x": name}
        if where == "checkpoint":
            ctx.checkpoint({"x": name})
        if where == "call":
            ctx.put_artifact(name, b"x")
        raise FileNotFoundError(2, "No such file", name)
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


PROMISING = "def run(ctx):\n    return ctx.params['result']\n"
PROMISES = """
produces = ["number", "findings"]

[results.count]
type = "integer"
required = false
"""


def write_skill(root: Path, name: str, handler: str, *, image: str = "base", more: str = "") -> None:
    """Write a skill's folder; `more` is TOML that its manifest has besides."""
    folder = root / name
    folder.mkdir(parents=True)
    (folder / "handler.py").write_text(textwrap.dedent(handler))
    (folder / "skill.toml").write_text(
        f'id = "{name}"\ndomain = "coordination"\nsummary = "A test."\nruns = "compute"\n'
        f'image = "{image}"\ncpu = 0.2\nmemory_mb = 64\n{more}\n'
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
    write_skill(root, "promising", PROMISING, more=PROMISES)
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
        env={"PYTHONPATH": str(RUNNER.parent), **environment()},
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
