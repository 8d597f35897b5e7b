"""Pools on real Podman for tests: a fleet of the test's own, with one skill that does what its parameters say."""

import asyncio
import secrets
import textwrap
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from appliance.model import ContainerState, Need, RunEvent, RunRequest, Site
from appliance.pool.engine import PodmanEngine
from appliance.pool.pool import Call, Pool
from appliance.pool.pressure import Reading
from appliance.pool.selection import Candidate
from appliance.pool.settings import PoolConfig
from appliance.pool.volumes import ALONE, State
from appliance.skills.catalogue import Catalogue

HANDLER = """
import ctypes, errno, os, socket, subprocess, threading, time
from pathlib import Path

def attempt(work):
    try:
        work()
    except OSError as error:
        return type(error).__name__ + ": " + str(error.strerror)
    return "done"

def run(ctx):
    do = ctx.params["do"]
    if do == "echo":
        return {"robot": ctx.robot}
    if do == "call":
        return {"answer": ctx.command("goto", x=1)["blobs"]["a"] == b"\\x00\\xff"}
    if do == "sleep":
        ctx.progress(0.1, "asleep")
        time.sleep(60)
    if do == "leave":
        Path("/tmp/left").write_text("x")
        Path("/dev/shm/left").write_text("x")
        if os.fork() == 0:
            os.setsid()
            time.sleep(60)
        return {}
    if do == "look":
        return {"files": sorted(os.listdir("/tmp") + os.listdir("/dev/shm")),
                "processes": sorted(int(each) for each in os.listdir("/proc") if each.isdigit()), "me": os.getpid()}
    if do == "kernel":
        libc = ctypes.CDLL(None, use_errno=True)
        def ask(call):
            def child():
                ctypes.set_errno(0)
                return 0 if call() >= 0 else ctypes.get_errno()
            pid = os.fork()  # what works changes only the child
            if pid == 0:
                os._exit(child())
            return errno.errorcode.get(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), "done")
        thread = threading.Thread(target=lambda: None)
        thread.start()
        thread.join()
        return {
            "user namespace": ask(lambda: libc.unshare(0x10000000)),
            "mount": ask(lambda: libc.mount(b"none", b"/tmp", b"tmpfs", 0, None)),
            "ptrace": ask(lambda: libc.ptrace(0, 0, 0, 0)),
            "clone into a namespace": ask(lambda: libc.syscall(56, 0x10000000 | 17, 0, 0, 0, 0)),
            "clone3": ask(lambda: libc.syscall(435, None, 0)),
            "io_uring": ask(lambda: libc.syscall(425, 1, bytes(120))),
            "keyctl": ask(lambda: libc.syscall(250, 0, -3, 1)),
            "program": subprocess.run(["/bin/true"]).returncode,
        }
    if do == "harden":
        lines = Path("/proc/self/status").read_text().splitlines()
        status = dict(line.split(":\\t", 1) for line in lines if ":\\t" in line)
        return {
            "root": attempt(lambda: Path("/x").write_text("x")),
            "usr": attempt(lambda: Path("/usr/x").write_text("x")),
            "skills": attempt(lambda: Path("/skills/x").write_text("x")),
            "runner": attempt(lambda: Path("/runner/x").write_text("x")),
            "tmp": attempt(lambda: Path("/tmp/x").write_text("x")),
            "fill": attempt(lambda: Path("/tmp/y").write_bytes(bytes(80 * 2**20))),
            "net": attempt(lambda: socket.create_connection(("192.0.2.1", 80), 2)),
            "interfaces": [name for _, name in socket.if_nameindex()],
            "caps": [status[key] for key in ("CapEff", "CapPrm", "CapBnd", "CapInh", "CapAmb")],
            "nnp": status["NoNewPrivs"], "seccomp": status["Seccomp"],
            "chown": attempt(lambda: os.chown("/tmp/x", 1, 1)),
            "mount": next(each[3] for each in map(str.split, open("/proc/mounts")) if each[1] == "/"),
        }
"""


def write_probe(folder: Path, handler: str, manifest: str = "") -> Path:
    """Write the skill `probe`, with further lines of its manifest; returns the folder of skills it is in."""
    skill = folder / "skills" / "probe"
    skill.mkdir(parents=True)
    (skill / "handler.py").write_text(textwrap.dedent(handler))
    (skill / "skill.toml").write_text(
        'id = "probe"\ndomain = "coordination"\nsummary = "A test."\nruns = "compute"\n'
        'image = "base"\ncpu = 0.2\nmemory_mb = 64\n' + manifest
    )
    return skill.parent


class Bench:
    """Pools of one fleet of the test's own."""

    def __init__(self, folder: Path, catalogue: Catalogue) -> None:
        self.folder, self.catalogue = folder, catalogue
        self.fleet = f"test-{secrets.token_hex(4)}"
        self.pools: list[Pool] = []

    async def pool(
        self,
        *,
        gateway: str = "g1",
        fleet: str = "",
        read_memory: Callable[[], Reading] | None = None,
        state: State = ALONE,
        **settings: Any,
    ) -> Pool:
        """Return a started pool; `read_memory` is what the kernel says of memory, `state` where state comes from."""

        async def nobody(need: Need, avoid: Collection[str]) -> list[Candidate]:
            return []

        async def answer(call: Call) -> dict[str, Any]:
            return {"blobs": {"a": b"\x00\xff"}}

        fleet = fleet or self.fleet
        pool = Pool(
            PoolConfig(**{"floor": {"base": 1}, "mode": "local", "cancel_grace_s": 0.5} | settings),
            gateway=gateway,
            fleet=fleet,
            run_dir=self.folder / "run" / fleet / gateway,
            data_dir=self.folder / "data" / fleet / gateway,
            catalogue=self.catalogue,
            site=Site(),
            find_remote=nobody,
            on_call=answer,
            on_change=lambda _: None,
            read_memory=read_memory,
            state=state,
        )
        self.pools.append(pool)
        await pool.start()
        return pool

    @staticmethod
    async def ready(pool: Pool, count: int = 1) -> None:
        """Wait for so many ready containers."""
        async with asyncio.timeout(60):
            while sum(each.state is ContainerState.READY for each in pool.containers()) < count:
                assert not pool.problem, pool.problem
                await asyncio.sleep(0.02)

    @staticmethod
    def request(do: str, number: int = 1, **more: Any) -> RunRequest:
        """Return an order."""
        need = Need(image="base", cpu=0.2, memory_mb=64)
        params = {"do": do}
        return RunRequest(task="t", subtask=f"s{number}", attempt=1, skill="probe", need=need, params=params, **more)

    async def run(
        self, pool: Pool, do: str, number: int = 1, *, seen: list[RunEvent] | None = None, **more: Any
    ) -> RunEvent:
        """Select and run; returns the last event."""
        request = self.request(do, number, **more)
        decision = await pool.select(request.need, allow_remote=False)
        return await pool.run(request, decision, (seen if seen is not None else []).append)


async def engine_ids(fleet: str, gateway: str = "g1") -> list[str]:
    """Return Podman's ids of a gateway's containers."""
    engine = PodmanEngine(threads=1)
    try:
        found = await engine.containers({"swiftbot.fleet": fleet, "swiftbot.gateway": gateway})
    finally:
        engine.close()
    return [each.id for each in found]
