"""Put and get on loopback: 16 gateways' planes beside 16 nodes of the `kademlia` package, in turns in one run.

Both sides have real sockets, store the same keys and values, and are asked through a node at random each time. In one
process a side has one event loop for all its nodes; with a process for each, as gateways run, every message wakes
another process. They do not promise the same: a put here is a compare-and-set ordered by the key's owner
and synced to the disks of three gateways before it is acknowledged, where kademlia's last writer wins in memory and
nothing is ever on a disk. So that the same work is compared too, `put_unsynced` is ours without syncing, and
`kademlia_durable` the package with a storage that has a value on the disk before it answers; a get asks the owner here
and takes any copy there, so `get_any_copy` is one that takes the first copy here too.
"""

import asyncio
import contextlib
import importlib.util
import json
import os
import random
import secrets
import sys
import tempfile
from collections.abc import AsyncGenerator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any, Literal, Protocol

import msgspec

from appliance.errors import SwiftbotError
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig
from appliance.ports import free_port
from workshop.bench.dht import node
from workshop.bench.dht.node import NodeOptions
from workshop.bench.figures import ratio, summary

KSIZE = 5
"""Copies of a value there; the package's own default, 20, would store it on every node."""
REMEDY = "make ray (its environment has kademlia too), or SWIFTBOT_KADEMLIA_PYTHON=a Python that has kademlia"
_SIDE = Path(__file__).with_name("kademlia_side.py")
Layout = Literal["one process", "a process each"]
_BLOCK = 50
"""Operations of one side before it is the other's turn."""
_WARM = 2
"""Turns of each side before any that counts: nodes meet, make links and files once, and run for days."""
_KINDS = ("put", "get", "get_any_copy", "put_unsynced")
LINE_S = 60.0
_VALUE = "x" * 400
_FIRST_PORT, _LAST_PORT = 20_000, 30_000


def find_python() -> Path | None:
    """Return a Python that has kademlia: as told by SWIFTBOT_KADEMLIA_PYTHON, this one, or that of `make ray`."""
    told = os.environ.get("SWIFTBOT_KADEMLIA_PYTHON", "")
    if told:
        return Path(told)
    if importlib.util.find_spec("kademlia") is not None:
        return Path(sys.executable)
    prefix = Path(sys.prefix)
    for folder in (prefix.parent / "ray", prefix / ".ray"):
        if any(folder.glob("lib/python3*/site-packages/kademlia")):
            return folder / "bin" / "python"
    return None


async def run(
    *, nodes: int, count: int, layout: Layout = "one process", progress: Callable[[str], None]
) -> dict[str, Any]:
    """Measure `count` puts and gets on both sides, after some that do not count.

    Returns:
        `swiftbot`, `kademlia` and `kademlia_durable`: what each did of `put`, `get`,
        `get_any_copy` and `put_unsynced`, each count, p50, p90, p99 and max in ms; `cpu_ms_each` (one process),
        processor time of an operation, which other work on the machine changes less. The ratios of the medians and of
        p99. `kademlia` is `missing`, with how to install it, where it is not there.

    Raises:
        SwiftbotError: a side could not be started, or a gateway has not what was put.
    """
    python = find_python()
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="swiftbot-bench-")))
        progress(f"{nodes} gateways on loopback, {layout}")
        sides: dict[str, Side] = {"swiftbot": await _our_side(stack, nodes, folder, layout)}
        ops: dict[str, tuple[str, ...]] = {"swiftbot": ("put", "get", "get_any_copy", "put_unsynced")}
        result: dict[str, Any] = {"nodes": nodes, "layout": layout, "value_bytes": len(_VALUE)}
        if python is None:
            progress(f"kademlia is not installed: {REMEDY}")
            result["kademlia"] = {"missing": "kademlia is not installed", "remedy": REMEDY}
        else:
            progress(f"{nodes} nodes of kademlia, twice, {layout}")
            sides["kademlia"], ops["kademlia"] = await _kademlia(stack, python, nodes, layout), ("put", "get")
            durable = folder / "kademlia"
            durable.mkdir()
            sides["kademlia_durable"] = await _kademlia(stack, python, nodes, layout, durable=durable)
            ops["kademlia_durable"] = ("put",)
        progress(f"{_WARM * _BLOCK} operations of each kind that do not count")
        for block in range(_WARM):
            for what in _KINDS:
                for name, side in sides.items():
                    if what in ops[name]:
                        await side.do(what, _keys(f"warm-{block}", what))
        times: dict[str, dict[str, list[float]]] = {name: {what: [] for what in ops[name]} for name in sides}
        for block in range(-(-count // _BLOCK)):
            progress(f"{min(count, (block + 1) * _BLOCK)} of {count}")
            for what in _KINDS:
                keys = _keys(str(block), what)
                for name, side in sides.items():
                    if what in ops[name]:
                        times[name][what] += await side.do(what, keys)
    figures = {name: {what: summary(found) for what, found in kinds.items()} for name, kinds in times.items()}
    for name, side in sides.items():
        result[name] = figures[name] | side.about()
    if "kademlia" in sides:
        result["kademlia_over_swiftbot"] = {
            f"{name}_{part}": ratio(theirs[part], ours[part])
            for name, theirs, ours in (
                ("put", figures["kademlia"]["put"], figures["swiftbot"]["put"]),
                ("get", figures["kademlia"]["get"], figures["swiftbot"]["get"]),
                ("get_both_any_copy", figures["kademlia"]["get"], figures["swiftbot"]["get_any_copy"]),
                ("put_both_unsynced", figures["kademlia"]["put"], figures["swiftbot"]["put_unsynced"]),
                ("put_both_synced", figures["kademlia_durable"]["put"], figures["swiftbot"]["put"]),
            )
            for part in ("p50", "p99")
        }
    return result


def _keys(block: str, what: str) -> list[str]:
    """Keys of a turn; what is got is what was put in it."""
    suffix = "-u" if what == "put_unsynced" else ""
    return [f"bench/{block}-{number}{suffix}" for number in range(_BLOCK)]


class Side(Protocol):
    """One of the two."""

    async def do(self, what: str, keys: list[str]) -> list[float]:
        """Put or get these keys one after the other; returns how long each took, ms."""
        ...

    def about(self) -> dict[str, Any]:
        """What else belongs to the result."""
        ...


@asynccontextmanager
async def node_process(options: NodeOptions) -> AsyncGenerator[asyncio.subprocess.Process]:
    """A gateway's plane in a process of its own that is ready; ended afterwards."""
    command = (sys.executable, "-m", "workshop.bench.dht.node", msgspec.json.encode(options).decode())
    async with _process(*command) as process:
        await line_of(process, "ready")
        yield process


async def _our_side(stack: AsyncExitStack, nodes: int, folder: Path, layout: Layout) -> Side:
    if layout == "one process":
        return _Ours(await stack.enter_async_context(_planes(nodes, folder)))
    fleet = f"bench-{secrets.token_hex(4)}"
    endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(nodes)]
    processes: list[asyncio.subprocess.Process] = []
    for number, listen in enumerate(endpoints):
        options = NodeOptions(
            fleet=fleet, gateway=f"g{number}", folder=str(folder / f"g{number}"), listen=listen,
            connect=() if number == 0 else (endpoints[0],), members=nodes,
        )  # fmt: skip
        command = (sys.executable, "-m", "workshop.bench.dht.node", msgspec.json.encode(options).decode())
        processes.append(await stack.enter_async_context(_process(*command)))
    # All at once: one that could not start is why the others wait for it.
    await asyncio.gather(*(line_of(process, "ready") for process in processes))
    return _Processes(processes, copies=PlaneConfig().replicas)


class _Cpu:
    """Processor time of a side that is one process."""

    def __init__(self) -> None:
        self._spent: dict[str, list[float]] = {}

    def add(self, what: str, cpu_ms: float, times: int) -> None:
        """So many operations took so much."""
        spent = self._spent.setdefault(what, [0.0, 0.0])
        spent[0] += cpu_ms
        spent[1] += times

    def each(self) -> dict[str, float]:
        """Milliseconds of an operation, by kind."""
        return {what: round(cpu_ms / max(1.0, times), 3) for what, (cpu_ms, times) in self._spent.items()}


class _Ours:
    """Our side in this process."""

    def __init__(self, planes: list[Plane]) -> None:
        self._planes = planes
        self._cpu = _Cpu()

    async def do(self, what: str, keys: list[str]) -> list[float]:
        """As `Side.do`."""
        times: list[float] = []
        for key in keys:
            dht = random.choice(self._planes).dht  # noqa: S311 - spreads load
            told = await node.do(dht, {"op": what, "keys": [key], "value": _VALUE})
            if told["failed"]:
                raise SwiftbotError(f"{key} was put and is not there")
            times += told["ms"]
            self._cpu.add(what, told["cpu_ms"], 1)
        return times

    def about(self) -> dict[str, Any]:
        """As `Side.about`."""
        return {"copies": self._planes[0].config.replicas, "cpu_ms_each": self._cpu.each()}


@asynccontextmanager
async def _planes(nodes: int, folder: Path) -> AsyncGenerator[list[Plane]]:
    """Gateways' planes, linked with each other and reconciled."""
    first = f"tcp/127.0.0.1:{free_port()}"
    planes: list[Plane] = []
    fleet = f"bench-{secrets.token_hex(4)}"
    try:
        for number in range(nodes):
            # Port 0 would do for the others, but gossip tells endpoints as they were configured.
            listen = first if number == 0 else f"tcp/127.0.0.1:{free_port()}"
            config = PlaneConfig(listen=(listen,), connect=() if number == 0 else (first,))
            data = folder / f"g{number}"
            planes.append(await Plane.open(config, fleet=fleet, gateway=f"g{number}", data_dir=data))
        async with asyncio.timeout(LINE_S):
            while not all(  # noqa: ASYNC110 - no single event says so of all
                len(each.members()) == nodes and each.dht.settling.reconciled() for each in planes
            ):
                await asyncio.sleep(0.05)
        yield planes
    finally:
        for plane in planes:
            await plane.close()


class _Processes:
    """A side of processes that obey, each with one node or all of them."""

    def __init__(self, processes: list[asyncio.subprocess.Process], **about: Any) -> None:
        self._processes = processes
        self._about = about
        self._failed = 0
        self._cpu = _Cpu()

    async def do(self, what: str, keys: list[str]) -> list[float]:
        """As `Side.do`; what takes the time is measured within the process."""
        if len(self._processes) == 1:
            return await self._ask(self._processes[0], what, keys)
        times: list[float] = []
        for key in keys:
            times += await self._ask(random.choice(self._processes), what, [key])  # noqa: S311 - spreads load
        return times

    async def all(self, what: str) -> None:
        """Have every process do something, one after the other."""
        for process in self._processes:
            await self._ask(process, what, [])

    async def _ask(self, process: asyncio.subprocess.Process, what: str, keys: list[str]) -> list[float]:
        if process.stdin is None:
            raise SwiftbotError("a side has no pipes")
        process.stdin.write(json.dumps({"op": what, "keys": keys, "value": _VALUE}).encode() + b"\n")
        told = await line_of(process, what)
        self._failed += int(told["failed"])
        self._cpu.add(what, float(told["cpu_ms"]), len(keys))
        return [float(each) for each in told["ms"]]

    def about(self) -> dict[str, Any]:
        """As `Side.about`."""
        # Of several, the others work for the one that is asked.
        cpu = {"cpu_ms_each": self._cpu.each()} if len(self._processes) == 1 else {}
        return {**self._about, "failed": self._failed, **cpu}


async def _kademlia(
    stack: AsyncExitStack, python: Path, nodes: int, layout: Layout, *, durable: Path | None = None
) -> Side:
    port = random.randrange(_FIRST_PORT, _LAST_PORT)  # noqa: S311 - a range of UDP ports that is likely free
    each = [(nodes, port)] if layout == "one process" else [(1, port + number) for number in range(nodes)]
    processes: list[asyncio.subprocess.Process] = []
    version = ""
    for count, at in each:
        # -P: this folder is no place to import from.
        command = (str(python), "-P", str(_SIDE), str(count), str(KSIZE), str(at), str(port))
        command += () if durable is None else (str(durable),)
        process = await stack.enter_async_context(_process(*command, plain=True))
        processes.append(process)
        version = str((await line_of(process, "ready"))["version"])
    side = _Processes(processes, copies=KSIZE, version=version)
    if len(processes) > 1:
        await side.all("bootstrap")  # the first nodes learn of the last only in a second round
    return side


@asynccontextmanager
async def _process(*command: str, plain: bool = False) -> AsyncGenerator[asyncio.subprocess.Process]:
    """A process with pipes; ended afterwards. `plain`: another Python, which must not see this one's packages."""
    hidden = ("PYTHON", "VIRTUAL_ENV") if plain else ()
    environment = {key: value for key, value in os.environ.items() if not hidden or not key.startswith(hidden)}
    process = await asyncio.create_subprocess_exec(
        *command, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        limit=2**24, env=environment,
    )  # fmt: skip
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def line_of(process: asyncio.subprocess.Process, event: str) -> dict[str, Any]:
    """Return the next line of a side, which must be of that event; SwiftbotError otherwise."""
    if process.stdout is None or process.stderr is None:
        raise SwiftbotError("a side has no pipes")
    try:
        async with asyncio.timeout(LINE_S):
            line = await process.stdout.readline()
    except TimeoutError:
        raise SwiftbotError(f"a side told no {event} within {LINE_S:g} s") from None
    if not line:
        problem = (await process.stderr.read(2**16)).decode(errors="replace").strip()
        raise SwiftbotError(f"a side ended: {problem[-400:] or 'without a word'}", remedy=REMEDY)
    told: dict[str, Any] = json.loads(line)
    if told.get("event") != event:
        raise SwiftbotError(f"a side told {str(told)[:80]}, not {event}")
    return told
