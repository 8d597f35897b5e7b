"""How long a state volume takes from gateway to gateway, beside `podman volume export | podman volume import`.

Podman's way is what one would script by hand: it copies within one machine, unchecked, uncompressed, and into a
volume that is half new when it breaks. Ours goes through two processes and Zenoh, checks each chunk, can be gone on
with, and is on the disk (syncfs) before the old state goes. Both move the same volume in the same run.
"""

import asyncio
import contextlib
import os
import secrets
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path
from typing import Any

from appliance.errors import PrerequisiteError
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import LABEL_FLEET, LABEL_GATEWAY, PodmanEngine, remove_fleet
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes.registry import Volumes
from appliance.pool.volumes.store import podman_name
from appliance.pool.volumes.transfers import Transfers
from appliance.ports import free_port

_READY_S = 60.0
_LINE = b"2.718281828 x=1.250 y=3.500 theta=0.100 battery=0.87\n"


async def run(
    megabytes: int = 64, rounds: int = 3, *, podman_url: str = "", progress: Callable[[str], None]
) -> dict[str, Any]:
    """Move volumes of `megabytes`, half of it random and half text, in alternating rounds.

    Returns:
        Medians in milliseconds and as MB/s: `first` to a gateway that has nothing of it, `again` after a run there
        changed one small file, `podman` by export and import; `wire_share`: which part went over the network;
        `pack_ms` and `unpack_ms` as the gateway has learned them (moving averages).

    Raises:
        PrerequisiteError: Podman or the other gateway's process does not start.
    """
    fleet = f"bench-{secrets.token_hex(4)}"
    taken: dict[str, list[float]] = {"first": [], "again": [], "podman": []}
    shares: list[float] = []
    try:
        with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
            ends = [f"tcp/127.0.0.1:{port}" for port in (free_port(), free_port())]
            async with (
                _gateway(Path(folder) / "here", fleet, "here", ends, podman_url) as (plane, transfers, _, storage),
                _other(Path(folder) / "there", fleet, ends, podman_url) as change,
            ):
                async with asyncio.timeout(_READY_S):
                    while len(plane.members()) < 2 or not plane.dht.settling.reconciled():  # noqa: ASYNC110 - no event for it
                        await asyncio.sleep(0.01)
                for number in range(rounds):
                    progress(f"transfer: {megabytes} MB, round {number + 1} of {rounds}")
                    name = f"state-{number}"
                    await change(name, megabytes)
                    brought = await transfers.bring_volume(name)
                    taken["first"].append(brought.duration_ms)
                    shares.append(brought.wire_bytes / brought.size_bytes)
                    await change(name, 0)
                    taken["again"].append((await transfers.bring_volume(name)).duration_ms)
                    taken["podman"].append(await _by_podman(fleet, name, storage))
                link = transfers.link("there")
    finally:
        await remove_fleet(fleet, volumes=True, url=podman_url)
    result: dict[str, Any] = {"megabytes": megabytes, "rounds": rounds}
    for way, samples in taken.items():
        median = statistics.median(samples)
        result[f"{way}_ms"] = round(median, 1)
        result[f"{way}_mb_per_s"] = round(megabytes * 2**20 / 1e6 / median * 1e3, 1)
    handled = {"pack_ms": link.pack_bytes_per_s, "unpack_ms": link.unpack_bytes_per_s}
    for what, rate in handled.items():
        result[what] = round(megabytes * 2**20 / rate * 1e3, 1) if rate else None
    return result | {"wire_share": round(statistics.median(shares), 3)}


@contextlib.asynccontextmanager
async def _gateway(
    folder: Path, fleet: str, gateway: str, ends: list[str], podman_url: str
) -> AsyncGenerator[tuple[Plane, Transfers, Volumes, PodmanEngine]]:
    """As much of a gateway as transfers need."""
    await asyncio.to_thread(folder.mkdir)
    own, other = ends
    plane_config = PlaneConfig(listen=(own,), peers={gateway: own, "there" if gateway == "here" else "here": other})
    async with contextlib.AsyncExitStack() as stack:
        plane = await Plane.open(plane_config, fleet=fleet, gateway=gateway, data_dir=folder)
        stack.push_async_callback(plane.close)
        storage = PodmanEngine.for_transfers(podman_url)
        stack.callback(storage.close)
        config = TransferConfig()
        volumes = Volumes(config, fleet=fleet, gateway=gateway, store=plane.store, records=plane.dht, storage=storage)
        await volumes.start()
        stack.push_async_callback(volumes.close)
        transfers = Transfers(config, plane=plane, volumes=volumes, storage=storage, data_dir=folder)
        await transfers.start()
        stack.push_async_callback(transfers.close)
        yield plane, transfers, volumes, storage


@contextlib.asynccontextmanager
async def _other(
    folder: Path, fleet: str, ends: list[str], podman_url: str
) -> AsyncGenerator[Callable[[str, int], Awaitable[None]]]:
    """The gateway that has the volume, a process of its own; yields what changes a volume there."""
    command = (sys.executable, "-m", "workshop.bench.transfer", str(folder), fleet, ends[1], ends[0], podman_url)
    process = await asyncio.create_subprocess_exec(
        *command, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    stdin, stdout = process.stdin, process.stdout
    if stdin is None or stdout is None:
        raise PrerequisiteError("the other gateway's process has no pipes")

    async def expect(word: str) -> None:
        async with asyncio.timeout(_READY_S):
            while line := await stdout.readline():
                if line.decode().strip() == word:
                    return
        raise PrerequisiteError("the other gateway's process ended", remedy="see what it wrote above")

    async def change(name: str, megabytes: int) -> None:
        stdin.write(f"{name} {megabytes}\n".encode())
        await stdin.drain()
        await expect("changed")

    try:
        await expect("ready")
        yield change
    finally:
        stdin.close()
        try:
            async with asyncio.timeout(20.0):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()


async def _serve(folder: Path, fleet: str, listen: str, connect: str, podman_url: str) -> None:
    """The other process: change a volume for each line that comes, as a run does."""
    async with _gateway(folder, fleet, "there", [listen, connect], podman_url) as (_, _, volumes, storage):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        while line := await asyncio.to_thread(sys.stdin.readline):
            name, megabytes = line.split()
            own = podman_name(fleet, "there", name)
            await storage.ensure_volume(own, {LABEL_FLEET: fleet, LABEL_GATEWAY: "there"})
            place = (await storage.volume(own)).folder
            async with volumes.use([name]):
                await asyncio.to_thread(_change, place, int(megabytes))
            sys.stdout.write("changed\n")
            sys.stdout.flush()


def _change(folder: Path, megabytes: int) -> None:
    if megabytes:
        half = megabytes * 2**19
        (folder / "weights.bin").write_bytes(os.urandom(half))
        (folder / "journal.txt").write_bytes((_LINE * (half // len(_LINE) + 1))[:half])
    (folder / "note").write_bytes(os.urandom(1000))


async def _by_podman(fleet: str, name: str, storage: PodmanEngine) -> float:
    """Copy the same volume by Podman's own commands; milliseconds."""
    source, target = podman_name(fleet, "there", name), podman_name(fleet, "copy", name)
    await storage.ensure_volume(target, {LABEL_FLEET: fleet})
    began = time.monotonic()
    process = await asyncio.create_subprocess_shell(
        f"podman volume export {source} | podman volume import {target} -", stderr=asyncio.subprocess.PIPE
    )
    problem = (await process.communicate())[1].decode("utf-8", "replace")
    if process.returncode:
        raise PrerequisiteError(f"podman volume export failed: {problem[-300:]}", remedy="podman info")
    return (time.monotonic() - began) * 1e3


if __name__ == "__main__":
    asyncio.run(_serve(Path(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4], sys.argv[5]))
