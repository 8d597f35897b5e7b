"""Gateways for tests of transfers: real planes, real Podman, no daemon around them."""

import asyncio
import contextlib
import hashlib
import io
import json
import os
import secrets
import tarfile
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import PodmanEngine, remove_fleet
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes.registry import Volumes
from appliance.pool.volumes.store import podman_name
from appliance.pool.volumes.transfers import Transfers

MIB = 2**20


class Side:
    """One gateway's plane, volumes and transfers."""

    def __init__(self, plane: Plane, volumes: Volumes, transfers: Transfers, storage: PodmanEngine, fleet: str) -> None:
        self.plane, self.volumes, self.transfers, self.storage, self.fleet = plane, volumes, transfers, storage, fleet

    async def folder(self, name: str) -> Path:
        """Where a volume's files lie, made if it is not there."""
        own = podman_name(self.fleet, self.plane.gateway, name)
        await self.storage.ensure_volume(own, {"swiftbot.fleet": self.fleet, "swiftbot.gateway": self.plane.gateway})
        return (await self.storage.volume(own)).folder

    async def change(self, name: str, write: Callable[[Path], object]) -> None:
        """Change a volume as a run does."""
        folder = await self.folder(name)
        async with self.volumes.use([name]):
            await asyncio.to_thread(write, folder)

    async def stop(self) -> None:
        """Stop it."""
        await self.transfers.close()
        await self.volumes.close()
        await self.plane.close()
        self.storage.close()


class Sides:
    """Gateways in this process; all listen, and each is given the others' endpoints."""

    def __init__(self, folder: Path, ports: list[int]) -> None:
        self.folder, self.fleet = folder, f"test-{secrets.token_hex(4)}"
        self.endpoints = [f"tcp/127.0.0.1:{port}" for port in ports]
        self.there: dict[int, Side] = {}

    async def start(self, number: int, *, podman: str = "", **settings: Any) -> Side:
        """Start one gateway, `podman` an API socket of its own if need be."""
        side = await open_side(
            self.folder / f"g{number}",
            fleet=self.fleet,
            gateway=f"g{number}",
            listen=self.endpoints[number],
            connect=tuple(each for each in self.endpoints if each != self.endpoints[number]),
            podman=podman,
            **settings,
        )
        self.there[number] = side
        return side

    async def settled(self, members: int = 0) -> None:
        """Wait until every gateway sees every other and has reconciled with them."""
        async with asyncio.timeout(30):
            while not all(
                len(side.plane.members()) == (members or len(self.there)) and side.plane.dht.settling.reconciled()
                for side in self.there.values()
            ):
                await asyncio.sleep(0.01)

    async def stop(self, number: int) -> None:
        """Stop one."""
        await self.there.pop(number).stop()


async def open_side(
    folder: Path, *, fleet: str, gateway: str, listen: str, connect: tuple[str, ...], podman: str = "", **settings: Any
) -> Side:
    """Open one gateway's plane and what transfers need, in this process."""
    folder.mkdir(parents=True, exist_ok=True)
    config = TransferConfig(**{"reserve_mb": 0, "patience_s": 10.0, **settings})
    plane = await Plane.open(
        PlaneConfig(listen=(listen,), connect=connect), fleet=fleet, gateway=gateway, data_dir=folder
    )
    storage = PodmanEngine.for_transfers(podman)
    volumes = Volumes(config, fleet=fleet, gateway=gateway, store=plane.store, records=plane.dht, storage=storage)
    transfers = Transfers(config, plane=plane, volumes=volumes, storage=storage, data_dir=folder)
    await volumes.start()
    await transfers.start()
    return Side(plane, volumes, transfers, storage, fleet)


@contextlib.asynccontextmanager
async def sides(folder: Path, ports: list[int]) -> AsyncIterator[Sides]:
    """Gateways of a fleet of the test's own, removed afterwards."""
    made = Sides(folder, ports)
    try:
        yield made
    finally:
        for number in list(made.there):
            await made.stop(number)
        await remove_fleet(made.fleet, volumes=True)


def tree(folder: Path) -> dict[str, tuple[int, str]]:
    """All that is in a folder: path -> (mode, digest of the content or target of the link)."""
    found: dict[str, tuple[int, str]] = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        if path.is_symlink():
            what = str(path.readlink())
        else:
            what = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        found[path.relative_to(folder).as_posix()] = (mode, what)
    return found


def small_image(reference: str, layers: list[dict[str, bytes]]) -> tuple[bytes, str]:
    """Return an OCI archive of an image with these files in its layers, and the image's id."""
    blobs: dict[str, bytes] = {}

    def keep(data: bytes) -> str:
        digest = hashlib.sha256(data).hexdigest()
        blobs[digest] = data
        return f"sha256:{digest}"

    def describe(kind: str, data: bytes) -> dict[str, Any]:
        return {"mediaType": f"application/vnd.oci.image.{kind}", "digest": keep(data), "size": len(data)}

    bodies = [_tar(files) for files in layers]
    config = {
        "architecture": "amd64",
        "os": "linux",
        "config": {},
        "rootfs": {"type": "layers", "diff_ids": [f"sha256:{hashlib.sha256(each).hexdigest()}" for each in bodies]},
        "history": [{"created_by": "a test"} for _ in bodies],
    }
    packed = json.dumps(config).encode()
    manifest = {
        "schemaVersion": 2,
        "mediaType": "application/vnd.oci.image.manifest.v1+json",
        "config": describe("config.v1+json", packed),
        "layers": [describe("layer.v1.tar", each) for each in bodies],
    }
    named = describe("manifest.v1+json", json.dumps(manifest).encode())
    named["annotations"] = {"org.opencontainers.image.ref.name": reference}
    index = json.dumps({"schemaVersion": 2, "manifests": [named]}).encode()
    files = {"oci-layout": b'{"imageLayoutVersion":"1.0.0"}', "index.json": index}
    files |= {f"blobs/sha256/{digest}": data for digest, data in blobs.items()}
    return _tar(files), hashlib.sha256(packed).hexdigest()


def _tar(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as tar:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return out.getvalue()


def fill(megabytes: int) -> Callable[[Path], None]:
    """Files of that size: one large, many small, a link, a folder; half of it compressible."""

    def write(folder: Path) -> None:
        (folder / "maps").mkdir(exist_ok=True)
        (folder / "weights.bin").write_bytes(os.urandom(megabytes * MIB // 2))
        (folder / "maps" / "log.txt").write_bytes(b"x=1.25 y=3.50 theta=0.10\n" * (megabytes * MIB // 2 // 25))
        for number in range(50):
            (folder / "maps" / f"tile-{number}").write_bytes(os.urandom(500))
        if not (folder / "latest").is_symlink():
            (folder / "latest").symlink_to("maps/log.txt")

    return write


@contextlib.asynccontextmanager
async def podman_service(place: Path) -> AsyncIterator[str]:
    """A Podman with a storage of its own in a new folder, as another machine has; the URL of its API socket."""
    place.mkdir()
    options = ["--root", str(place / "root"), "--runroot", str(place / "run"), "--storage-driver", "overlay"]
    process = await asyncio.create_subprocess_exec(
        "podman", *options, "system", "service", "--time", "0", f"unix://{place}/podman.sock"
    )
    try:
        async with asyncio.timeout(60):
            while not (place / "podman.sock").exists():
                assert process.returncode is None
                await asyncio.sleep(0.05)
        yield f"unix://{place}/podman.sock"
    finally:
        process.terminate()
        await process.wait()
        # Files of layers belong to the user's further ids, and the storage is mounted on itself.
        sweep = f"umount -l {place}/root/overlay; rm -rf {place}"
        remove = await asyncio.create_subprocess_exec("podman", "unshare", "sh", "-c", sweep)
        await remove.wait()


async def same(one: Side, other: Side, name: str) -> bool:
    """Whether a volume is the same at both."""
    return await asyncio.to_thread(tree, await one.folder(name)) == await asyncio.to_thread(
        tree, await other.folder(name)
    )


async def moved(side: Side, least_bytes: int) -> None:
    """Wait until so much of a transfer has arrived."""
    async with asyncio.timeout(60):
        while not any(each.done_bytes >= least_bytes for each in side.transfers.active()):
            await asyncio.sleep(0.001)
