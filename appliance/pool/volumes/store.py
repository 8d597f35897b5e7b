"""The volumes of this machine: which state each has, where its files lie, and how another state takes their place.

It exists apart from the rules of who may change what (`volumes`).

    Ledger   which state each volume has, and whether its files have changed since: a state that a run left, or that
             arrived, is in force once it is written there
    Folders  where the files lie; what lost against another gateway's state is kept in a volume of its own
    Place    puts a new state in the place of the old one, so that either is whole whenever the power goes

Containers have the volume's folder mounted, so the folder itself must stay: what is in it is moved out, and the new
moved in, by renames on one file system, after a journal on the disk says which. A journal that is found when a volume
is next looked for is gone on with, forward; there is nothing to undo. So nobody ever sees half a state.
"""

import asyncio
import contextlib
import ctypes
import functools
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import NotFoundError, PoolError, RefusedError, SwiftbotError
from appliance.model import VersionVector
from appliance.model.keys import check_name
from appliance.model.transfer_api import Manifest
from appliance.plane.records import increment
from appliance.plane.store import Store
from appliance.pool.engine import LABEL_FLEET, LABEL_GATEWAY, PodmanEngine
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes import lineage
from appliance.pool.volumes.archive import fingerprint, no_room, unpack
from appliance.pool.volumes.lineage import generation

WORK = ".swiftbot"
"""Folder beside the volume's own, of the same file system and removed with the volume."""
_libc = ctypes.CDLL(None, use_errno=True)


class Journal(Struct, frozen=True, kw_only=True):
    """A swap that has begun: everything needed to end it."""

    old: tuple[bytes, ...]
    """Names in the volume before, as the file system has them."""
    new: tuple[bytes, ...]
    """Names in the new state."""
    version: VersionVector
    writer: str
    keep: str = ""
    """Name of the volume that the old state is kept in; empty: it is removed."""


class Place:
    """Where a volume lies (`root`, its mount point) and the work area beside it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.work = root.parent / WORK
        self.incoming = self.work / "incoming"
        self.outgoing = self.work / "outgoing"
        self._journal = self.work / "journal"

    def prepare(self) -> Path:
        """Return the empty folder for a new state; what an earlier try left is removed."""
        shutil.rmtree(self.work, ignore_errors=True)
        self.incoming.mkdir(parents=True, mode=0o700)
        self.outgoing.mkdir(mode=0o700)
        return self.incoming

    def begin(self, version: VersionVector, writer: str, *, keep: str = "") -> Journal:
        """Decide, on the disk, that what lies in `incoming` takes the place; from here on it will. Blocks."""
        journal = Journal(
            old=_names(self.root),
            new=_names(self.incoming),
            version=version,
            writer=writer,
            keep=keep,
        )
        sync(self.incoming)
        draft = self.work / "journal.draft"
        with draft.open("wb") as out:
            out.write(msgspec.json.encode(journal))
            out.flush()
            os.fsync(out.fileno())
        draft.replace(self._journal)
        sync_folder(self.work)
        return journal

    def journal(self) -> Journal | None:
        """Return the swap that has begun and not ended; None when there is none that counts."""
        try:
            return msgspec.json.decode(self._journal.read_bytes(), type=Journal)
        except (FileNotFoundError, NotADirectoryError, msgspec.DecodeError):
            return None

    def steps(self, journal: Journal) -> Iterator[tuple[Path, Path]]:
        """The renames that are still to be done, each (from, to), each asked for after the one before was done."""
        for raw in journal.old:
            name = os.fsdecode(raw)
            old, out = self.root / name, self.outgoing / name
            is_new = raw in journal.new and not os.path.lexists(self.incoming / name)
            if os.path.lexists(old) and not is_new and not os.path.lexists(out):
                yield old, out
        for name in map(os.fsdecode, journal.new):
            if os.path.lexists(self.incoming / name):
                yield self.incoming / name, self.root / name

    def finish(self, journal: Journal) -> None:
        """Do what is still to be done. Blocks."""
        for source, target in self.steps(journal):
            source.rename(target)
        sync_folder(self.root)
        sync_folder(self.outgoing)

    def forget(self) -> None:
        """The swap is done and noted: remove the journal, then all that is left. Blocks."""
        self._journal.unlink(missing_ok=True)
        shutil.rmtree(self.work, ignore_errors=True)


def _names(folder: Path) -> tuple[bytes, ...]:
    return tuple(sorted(os.fsencode(each.name) for each in folder.iterdir()))


def sync_folder(folder: Path) -> None:
    """Have a folder's entries on the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync(folder: Path) -> None:
    """Have all that was written to a folder's file system on the disk: syncfs(2), one call for however many files."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if _libc.syncfs(handle) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    finally:
        os.close(handle)


class VolumeState(Struct, frozen=True, kw_only=True):
    """The state of a volume that is here, as the ledger keeps it."""

    version: VersionVector
    writer: str
    """The gateway whose run made it."""
    fingerprint: str
    size_bytes: int
    told: bool
    """Whether the fleet's record has it, or a newer one."""


NOTHING = VolumeState(version={}, writer="", fingerprint="", size_bytes=0, told=True)


class Volume:
    """A volume and who is at it."""

    def __init__(self) -> None:
        self.state = NOTHING
        self.users = 0
        self.uses = 0
        """Runs so far: tells whether one was there in between."""
        self.replacing = False
        self.changed = asyncio.Condition()
        self.writing = asyncio.Lock()
        """Held while its state is looked at, packed or replaced."""
        self.folder: Path | None = None


class Ledger:
    """The states of one gateway's volumes, kept over a restart.

    Args:
        store: where it is kept (`plane.store`).
        gateway: this gateway's id: changes found here are its own.
        most_files: files of a volume that are looked at, at most.
        refuse: counts and logs what is wrong.
        on_set: called after a state was set.
    """

    def __init__(
        self,
        store: Store,
        *,
        gateway: str,
        most_files: int,
        refuse: Callable[..., None],
        on_set: Callable[[], None],
    ) -> None:
        self._store, self._gateway, self._most_files = store, gateway, most_files
        self._refuse, self._on_set = refuse, on_set
        self._volumes: dict[str, Volume] = {}

    async def load(self) -> None:
        """Read what was kept; an entry that is damaged is left out."""
        for key, value in await self._store.scan(lineage.KEY):
            try:
                state = msgspec.json.decode(value, type=VolumeState)
            except msgspec.DecodeError as error:
                self._refuse("volume ledger damaged", key=key, reason=str(error))
                continue
            self.volume(key.removeprefix(lineage.KEY)).state = state

    def volume(self, name: str) -> Volume:
        """Return a volume, which may have no state here; PayloadError when no volume can have that name."""
        if name not in self._volumes:
            self._volumes[check_name(name, "volume")] = Volume()
        return self._volumes[name]

    def known(self, name: str) -> Volume | None:
        """Return a volume if anything was ever asked of it here."""
        return self._volumes.get(name)

    def __iter__(self) -> Iterator[tuple[str, Volume]]:
        """Go through all volumes by name; others may come meanwhile."""
        return iter(sorted(self._volumes.items()))

    async def set(self, name: str, state: VolumeState) -> None:
        """Write down which state a volume has."""
        await self._store.put(f"{lineage.KEY}{name}", msgspec.json.encode(state))
        self.volume(name).state = state
        self._on_set()

    async def measure(self, folder: Path) -> tuple[str, int]:
        """Return the mark of a folder's files (their names, times and sizes), and their bytes; OSError."""
        return await asyncio.to_thread(fingerprint, folder, most_files=self._most_files)

    async def look(self, name: str, folder: Path) -> bool:
        """Look whether a volume's files have changed; if so it has a new version of ours, which nobody was told of.

        Raises:
            RefusedError: they cannot be looked at.
        """
        try:
            mark, size = await self.measure(folder)
        except OSError as error:
            raise RefusedError(f"volume {name} cannot be looked at: {error}", remedy=f"look at {folder}") from error
        state = self.volume(name).state
        empty = not state.version and not await asyncio.to_thread(_holds_anything, folder)
        if mark == state.fingerprint or empty:
            return False
        version = increment(state.version, self._gateway)
        await self.set(
            name, VolumeState(version=version, writer=self._gateway, fingerprint=mark, size_bytes=size, told=False)
        )
        return True


def _holds_anything(folder: Path) -> bool:
    return next(folder.iterdir(), None) is not None


log = structlog.get_logger(__name__)

T = TypeVar("T")

LABEL_KEPT = "swiftbot.kept"
"""Of a volume that keeps a state which lost against another gateway's: the name of the volume it was of."""


def podman_name(fleet: str, gateway: str, name: str) -> str:
    """Name of a gateway's volume at Podman."""
    return f"swiftbot-{fleet}-{gateway}-{name}"


class Folders:
    """The folders of one gateway's volumes at Podman. The caller holds the volume's `writing`.

    Args:
        config: table `[pool.transfer]`.
        fleet: name of the fleet.
        gateway: this gateway's id.
        storage: Podman.
        ledger: where a state that took another's place is written down.
        refuse: counts and logs what is wrong.
    """

    def __init__(
        self,
        config: TransferConfig,
        *,
        fleet: str,
        gateway: str,
        storage: PodmanEngine,
        ledger: Ledger,
        refuse: Callable[..., None],
    ) -> None:
        self._config, self._storage, self._ledger, self._refuse = config, storage, ledger, refuse
        self._prefix = podman_name(fleet, gateway, "")
        self._labels = {LABEL_FLEET: fleet, LABEL_GATEWAY: gateway}

    async def find(self) -> list[str]:
        """Return the names of the volumes that Podman has, and note where they lie."""
        names: list[str] = []
        for each in await self._storage.volumes(self._labels):
            if LABEL_KEPT not in each.labels and each.name.startswith(self._prefix):
                name = each.name.removeprefix(self._prefix)
                self._ledger.volume(name).folder = each.folder
                names.append(name)
        return names

    async def folder(self, name: str) -> Path | None:
        """Where a volume's files lie, a swap that was interrupted ended; None when Podman has no such volume."""
        volume = self._ledger.volume(name)
        if volume.folder is None or not await asyncio.to_thread(volume.folder.is_dir):
            try:
                found = await self._storage.volume(f"{self._prefix}{name}")
            except NotFoundError:
                return None
            volume.folder = found.folder
        place = Place(volume.folder)
        journal = await asyncio.to_thread(place.journal)
        if journal is not None:
            log.info("a volume's swap is gone on with", volume=name)
            await self._finish(name, place, journal)
        return volume.folder

    async def make(self, name: str) -> Path:
        """Where a volume's files lie, made if Podman has no such volume."""
        folder = await self.folder(name)
        if folder is None:
            await self._storage.ensure_volume(f"{self._prefix}{name}", self._labels)
            folder = await self.folder(name)
        if folder is None:
            raise NotFoundError(f"volume {name} was removed while it was made", remedy="try again")
        return folder

    async def swap(
        self, name: str, folder: Path, manifest: Manifest, archive: Path, *, aside: VolumeState | None
    ) -> None:
        """Put a state that arrived in the place of ours, which is kept aside when it is named.

        Raises:
            RefusedError: there is no room for it. Nothing has changed.
            PayloadError: the archive is not a state's. Nothing has changed.
            PoolError: it could not be ended; it is gone on with when the volume is next looked for.
        """
        keep = await self._make_backup(name, aside) if aside is not None else ""
        place = Place(folder)
        most_bytes = self._config.most_mb * 2**20

        def work() -> Journal:
            try:
                incoming = place.prepare()
                unpack(archive, incoming, most_files=self._config.most_files, most_bytes=most_bytes)
                journal = place.begin(manifest.version, manifest.writer, keep=keep)
            except OSError as error:
                place.forget()
                raise no_room(error, f"volume {name}") from error
            except SwiftbotError:
                place.forget()
                raise
            return journal

        try:
            journal = await _whole(work)
        except SwiftbotError as error:
            self._refuse("volume not unpacked", volume=name, reason=str(error))
            if keep:  # nothing was begun, so nothing is in it
                with contextlib.suppress(SwiftbotError):
                    await self._storage.remove_volume(keep)
            raise
        await self._finish(name, place, journal)

    async def _finish(self, name: str, place: Place, journal: Journal) -> None:
        """Do a swap that is decided; what fails is gone on with when the volume is next looked for."""
        try:
            await _whole(functools.partial(place.finish, journal))
        except OSError as error:
            raise PoolError(
                f"volume {name} could not be swapped to the end: {error}", remedy=f"look at {place.work}"
            ) from error
        # The old state to where it is kept, the new one into the ledger.
        if journal.keep:
            await self._storage.ensure_volume(journal.keep, {**self._labels, LABEL_KEPT: name})
            kept = await self._storage.volume(journal.keep)
            await _whole(functools.partial(_move_all, place.outgoing, kept.folder))
        mark, size = await self._ledger.measure(place.root)
        await self._ledger.set(
            name,
            VolumeState(version=journal.version, writer=journal.writer, fingerprint=mark, size_bytes=size, told=True),
        )
        await asyncio.to_thread(place.forget)

    async def _make_backup(self, name: str, state: VolumeState) -> str:
        """Make the volume that keeps our state, which lost; the oldest beyond the bound is removed."""
        kept = [
            each
            for each in await self._storage.volumes({**self._labels, LABEL_KEPT: name})
            if each.labels.get(LABEL_KEPT) == name
        ]
        for each in kept[: max(0, len(kept) - self._config.backups + 1)]:
            if await self._storage.remove_volume(each.name):
                self._refuse("kept volume removed", volume=name, kept=each.name, reason="pool.transfer.backups")
            else:
                log.warning("a kept volume is in use and stays", volume=name, kept=each.name)
        backup = f"{self._prefix}{name}.kept-{time.time_ns():020d}-{generation(state.version)}"
        await self._storage.ensure_volume(backup, {**self._labels, LABEL_KEPT: name})
        self._refuse("volume state kept aside", volume=name, kept=backup, version=state.version)
        return backup


async def _whole(work: Callable[[], T]) -> T:
    """Run on a thread to the end, also when the caller is cancelled: half a swap would be left otherwise."""
    running = asyncio.ensure_future(asyncio.to_thread(work))
    try:
        return await asyncio.shield(running)
    except asyncio.CancelledError:
        await asyncio.wait([running])
        raise


def _move_all(source: Path, target: Path) -> None:
    for each in source.iterdir():
        if not (target / each.name).exists():
            shutil.move(each, target / each.name)
