"""Where the files of this gateway's volumes lie, and how a state that arrived takes the place of the one there.

A swap is journalled (`transfer/swap.py`): cut off at any step it is gone on with when the volume is next looked for,
so nobody ever sees half a state. What lost against another gateway's state is kept in a volume of its own.
"""

import asyncio
import contextlib
import functools
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import structlog

from appliance.errors import NotFoundError, PoolError, SwiftbotError
from appliance.pool.engine import LABEL_FLEET, LABEL_GATEWAY
from appliance.pool.ledger import Ledger, VolumeState
from appliance.pool.lineage import generation
from appliance.pool.storage import PodmanStorage
from appliance.pool.transfer.archive import no_room, unpack
from appliance.pool.transfer.manifest import Manifest
from appliance.pool.transfer.settings import TransferConfig
from appliance.pool.transfer.swap import Journal, Place

log = structlog.get_logger(__name__)

T = TypeVar("T")

LABEL_KEPT = "swiftbot.kept"
"""Of a volume that keeps a state which lost against another gateway's: the name of the volume it was of."""


def podman_name(fleet: str, gateway: str, name: str) -> str:
    """Name of a gateway's volume at Podman."""
    return f"swiftbot-{fleet}-{gateway}-{name}"


class Folders:
    """The folders of one gateway's volumes at Podman. Whoever calls holds the volume's `writing`.

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
        storage: PodmanStorage,
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
            self._refuse("kept volume removed", volume=name, kept=each.name, reason="pool.transfer.backups")
            await self._storage.remove_volume(each.name)
        backup = f"{self._prefix}{name}.kept-{time.time_ns():020d}-{generation(state.version)}"
        await self._storage.ensure_volume(backup, {**self._labels, LABEL_KEPT: name})
        self._refuse("volume state kept aside", volume=name, kept=backup, version=state.version)
        return backup


async def _whole(work: Callable[[], T]) -> T:
    """Run on a thread to the end, also when whoever waits is cancelled: half a swap would be left otherwise."""
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
