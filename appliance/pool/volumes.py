"""The ledger of this gateway's state volumes: whose state is the newest, and which runs use them.

A skill's volume outlives its containers, and a run elsewhere may change it there. So each state has a version
vector: a run that changed the volume counts one up for its gateway, and the fleet's newest version is a small
record in the DHT (`volume/{name}`). A run on an older state is prevented by asking that record before it begins;
where a partition made two, `lineage` says which stands, and the other is kept aside, never lost.
"""

import asyncio
import contextlib
import functools
import shutil
import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Iterable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import TypeVar

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import ConflictError, NotFoundError, PoolError, RefusedError, SwiftbotError
from appliance.model import VersionVector, VolumeInfo
from appliance.plane.keys import check_name
from appliance.plane.store import Store
from appliance.plane.versions import increment
from appliance.pool import lineage
from appliance.pool.engine import LABEL_FLEET, LABEL_GATEWAY
from appliance.pool.fleetwide import Fleetwide, Records
from appliance.pool.lineage import Relation, VolumeRecord, generation, relation
from appliance.pool.storage import PodmanStorage
from appliance.pool.transfer.archive import fingerprint, no_room, unpack
from appliance.pool.transfer.manifest import Manifest
from appliance.pool.transfer.settings import TransferConfig
from appliance.pool.transfer.swap import Journal, Place

log = structlog.get_logger(__name__)

T = TypeVar("T")

LABEL_KEPT = "swiftbot.kept"
"""Of a volume that keeps a state which lost against another gateway's: the name of the volume it was of."""
_TRIES = 8
_TELL_AGAIN_S = 2.0


class State(Struct, frozen=True, kw_only=True):
    """The state of a volume that is here, as the ledger keeps it."""

    version: VersionVector
    writer: str
    """The gateway whose run made it."""
    fingerprint: str
    size_bytes: int
    told: bool
    """Whether the fleet's record has it, or a newer one."""


NOTHING = State(version={}, writer="", fingerprint="", size_bytes=0, told=True)


class _Volume:
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


def podman_name(fleet: str, gateway: str, name: str) -> str:
    """Name of a gateway's volume at Podman."""
    return f"swiftbot-{fleet}-{gateway}-{name}"


class Volumes:
    """State volumes of one gateway.

    Args:
        config: table `[pool.transfer]`.
        fleet: name of the fleet.
        gateway: this gateway's id.
        store: where the ledger is kept (`plane.store`).
        records: the fleet's records (`plane.dht`).
        storage: Podman, to make volumes and ask where they are; the owner closes it.
    """

    def __init__(
        self,
        config: TransferConfig,
        *,
        fleet: str,
        gateway: str,
        store: Store,
        records: Records,
        storage: PodmanStorage,
    ) -> None:
        self.refused: Counter[str] = Counter()
        """Bad input, conflicts and refusals by kind, for GatewayStatus.refused."""
        self.on_change: Callable[[], None] = lambda: None
        """Called when `infos` has changed."""
        self._config, self._fleet, self._gateway = config, fleet, gateway
        self._store, self._storage = store, storage
        self._labels = {LABEL_FLEET: fleet, LABEL_GATEWAY: gateway}
        self._volumes: dict[str, _Volume] = {}
        self._fleetwide = Fleetwide(records, refuse=self._refuse)
        self._telling: asyncio.Task[None] | None = None
        self._untold = asyncio.Event()

    # --- life -------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Read the ledger, finish what was interrupted, and note volumes that changed unseen (a killed gateway).

        A Podman that is away is no reason to stop: each volume is then looked at when it is first used.
        """
        for key, value in await self._store.scan(lineage.KEY):
            try:
                state = msgspec.json.decode(value, type=State)
            except msgspec.DecodeError as error:
                self._refuse("volume ledger damaged", key=key, reason=str(error))
                continue
            self._volume(key.removeprefix(lineage.KEY)).state = state
        try:
            there = await self._storage.volumes(self._labels)
        except SwiftbotError as error:
            log.warning("volumes are looked at when they are used", reason=str(error))
            there = []
        prefix = podman_name(self._fleet, self._gateway, "")
        for each in there:
            if LABEL_KEPT not in each.labels and each.name.startswith(prefix):
                name = each.name.removeprefix(prefix)
                self._volume(name).folder = each.folder
                with contextlib.suppress(SwiftbotError):
                    await self._note(name)
        if not all(each.state.told for each in self._volumes.values()):
            self._untold.set()
        self._telling = asyncio.create_task(self._keep_telling(), name="tell of volumes")

    async def close(self) -> None:
        """Tell the fleet nothing more; what it has not heard is in the ledger for the next start."""
        if self._telling is not None:
            self._telling.cancel()
            await asyncio.gather(self._telling, return_exceptions=True)

    async def _keep_telling(self) -> None:
        while True:
            await self._untold.wait()
            self._untold.clear()
            for name, volume in list(self._volumes.items()):
                if not volume.state.told:
                    try:
                        await self._tell(name)
                    except SwiftbotError as error:
                        log.info("the fleet does not know of a volume's state yet", volume=name, reason=str(error))
                        self._untold.set()
            await asyncio.sleep(_TELL_AGAIN_S)

    def _volume(self, name: str) -> _Volume:
        if name not in self._volumes:
            self._volumes[check_name(name, "volume")] = _Volume()
        return self._volumes[name]

    def _refuse(self, what: str, **fields: object) -> None:
        self.refused[what] += 1
        log.warning(what, **fields)

    # --- runs -------------------------------------------------------------------------------------------------

    def use(self, names: Iterable[str]) -> AbstractAsyncContextManager[None]:
        """A run uses these volumes: meanwhile they are neither replaced nor packed.

            async with volumes.use(need.volumes):
                ... the run, to its end

        At the end each volume is looked at (a walk over its files' times and sizes, on a thread); one that changed
        gets a new version, written to the fleet's record before the context ends. So tell a run's last event after
        that: what follows on another gateway then finds the newest state. Any number of runs may use one volume.

        Raises:
            RefusedError: the volume is being replaced and that does not end within `use_wait_s`.
        """
        return self._use(tuple(dict.fromkeys(names)))

    @contextlib.asynccontextmanager
    async def _use(self, names: tuple[str, ...]) -> AsyncGenerator[None]:
        used: list[str] = []
        try:
            for name in names:
                volume = self._volume(name)
                await self._until(name, lambda volume=volume: not volume.replacing, "is being replaced")
                volume.users += 1
                volume.uses += 1
                used.append(name)
            yield
        finally:
            # Whoever gives up waiting for a run must not leave its change unnoted.
            await asyncio.shield(asyncio.ensure_future(self._used(used)))

    async def _used(self, names: list[str]) -> None:
        for name in names:
            volume = self._volume(name)
            volume.users -= 1
            try:
                await self._note(name)
            except SwiftbotError as error:
                self._refuse("volume not looked at", volume=name, reason=str(error))
            async with volume.changed:
                volume.changed.notify_all()

    async def _until(self, name: str, ready: Callable[[], bool], why: str) -> None:
        volume = self._volume(name)
        try:
            async with asyncio.timeout(self._config.use_wait_s), volume.changed:
                await volume.changed.wait_for(ready)
        except TimeoutError:
            self.refused["volume busy"] += 1
            raise RefusedError(
                f"volume {name} {why} on {self._gateway}", remedy="try again when that has ended"
            ) from None

    async def _note(self, name: str) -> None:
        """Look whether a volume changed; if so it has a new version, which the fleet is told."""
        volume = self._volume(name)
        async with volume.writing:
            folder = await self._folder(name)
            if folder is None or not await self._look(name, folder):
                return
        try:
            await self._tell(name)
        except SwiftbotError as error:
            log.warning("the fleet cannot be told of a volume's new state now", volume=name, reason=str(error))
            self._untold.set()

    async def _look(self, name: str, folder: Path) -> bool:
        volume = self._volume(name)
        try:
            mark, size = await asyncio.to_thread(fingerprint, folder, most_files=self._config.most_files)
        except OSError as error:
            raise RefusedError(f"volume {name} cannot be looked at: {error}", remedy=f"look at {folder}") from error
        state = volume.state
        empty = not state.version and not await asyncio.to_thread(_holds_anything, folder)
        if mark == state.fingerprint or empty:
            return False
        version = increment(state.version, self._gateway)
        await self._set(
            name, State(version=version, writer=self._gateway, fingerprint=mark, size_bytes=size, told=False)
        )
        return True

    async def _set(self, name: str, state: State) -> None:
        await self._store.put(f"{lineage.KEY}{name}", msgspec.json.encode(state))
        self._volume(name).state = state
        self.on_change()

    # --- the fleet's record -----------------------------------------------------------------------------------

    async def newest(self, name: str) -> VolumeRecord | None:
        """Return the newest state of a volume as the fleet's record has it; None while there is none.

        Raises:
            UnreachableError: no replica of the record answers.
        """
        return (await self._fleetwide.read(name))[0]

    async def _tell(self, name: str) -> None:
        """Have the fleet's record name our state, unless a newer one or the winner of two is there.

        Raises:
            UnreachableError: the record cannot be read or written.
        """
        volume = self._volume(name)
        for _ in range(_TRIES):
            state = volume.state
            theirs, seen = await self._fleetwide.read(name)
            stands = (
                Relation.NEWER
                if theirs is None
                else relation(state.version, state.writer, theirs.version, theirs.gateway)
            )
            if stands in (Relation.WINS, Relation.LOSES):
                self._refuse(
                    "volume changed on two gateways",
                    volume=name,
                    stands=state.writer if stands is Relation.WINS else theirs.gateway if theirs else "",
                    note="the other state is kept aside where it is when the one that stands comes there",
                )
            if stands in (Relation.NEWER, Relation.WINS):
                mine = VolumeRecord(name=name, version=state.version, gateway=state.writer, size_bytes=state.size_bytes)
                try:
                    await self._fleetwide.write(mine, expected=seen)
                except ConflictError:
                    continue
            if volume.state == state:
                await self._set(name, msgspec.structs.replace(state, told=True))
                return
        raise ConflictError(f"the record of volume {name} keeps moving on", remedy="it is told again in a moment")

    def has(self, name: str, newest: VolumeRecord) -> bool:
        """Whether that state, or one that stands against it, is here."""
        state = self._volume(name).state
        stands = relation(state.version, state.writer, newest.version, newest.gateway)
        return stands in (Relation.SAME, Relation.NEWER, Relation.WINS)

    # --- what is known without asking -------------------------------------------------------------------------

    def hear(self, gateway: str, volumes: Iterable[VolumeInfo]) -> None:
        """Take note of what another gateway's status says of its volumes; nothing when it is gone."""
        self._fleetwide.hear(gateway, volumes)

    def _generations(self, name: str) -> dict[str, int]:
        """Who is known to have which generation."""
        volume = self._volumes.get(name)
        mine = generation(volume.state.version) if volume else 0
        return self._fleetwide.generations(name) | {self._gateway: mine}

    def newest_here(self, name: str) -> bool:
        """Whether no newer state than ours is known of (from what was heard; no question is asked)."""
        found = self._generations(name)
        newest, volume = self._fleetwide.told.get(name), self._volumes.get(name)
        if newest is not None and volume is not None and not self.has(name, newest):
            return False
        return found[self._gateway] >= max(found.values())

    def where(self, name: str) -> tuple[str, ...]:
        """Gateways known to hold the newest state of a volume, this one among them where it does."""
        found = self._generations(name)
        highest = max(found.values())
        return tuple(sorted(each for each, count in found.items() if count == highest > 0))

    def size_bytes(self, names: Iterable[str]) -> int:
        """Bytes of these volumes' newest states together that are not here: what `Transfers.cost_ms` is asked with."""
        return sum(self._fleetwide.size_bytes(name) for name in names if not self.newest_here(name))

    def infos(self) -> tuple[VolumeInfo, ...]:
        """Volumes whose newest state is here, for GatewayStatus.volumes."""
        return tuple(
            VolumeInfo(
                name=name,
                gateway=self._gateway,
                generation=generation(volume.state.version),
                size_bytes=volume.state.size_bytes,
            )
            for name, volume in sorted(self._volumes.items())
            if volume.state.version and self.newest_here(name)
        )

    def state(self, name: str) -> State:
        """The state that is here."""
        return self._volume(name).state

    # --- packing and replacing --------------------------------------------------------------------------------

    async def packed(self, name: str, kept: Manifest | None, pack: Callable[[Path], Manifest]) -> Manifest:
        """Return the manifest of our state: `kept`, if it is of that state, or what `pack` makes of the folder.

        Raises:
            NotFoundError: there is no state of it here.
            RefusedError: a run uses it, and what was kept is older.
        """
        volume = self._volume(name)
        async with volume.writing:
            folder = await self._folder(name)
            if folder is not None and not volume.users and await self._look(name, folder):
                self._untold.set()  # changed by nobody that was seen: told soon
            state = volume.state
            if folder is None or not state.version:
                raise NotFoundError(f"there is no state of volume {name} on {self._gateway}")
            if kept is not None and kept.version == state.version:
                return kept
            if volume.users:
                self.refused["volume busy"] += 1
                raise RefusedError(f"a run on {self._gateway} uses volume {name}", remedy="ask again when it has ended")
            # Not replaced meanwhile: that takes `writing` too. A run may begin: then it is packed again.
            uses = volume.uses
            made = await asyncio.to_thread(pack, folder)
            mark, size = await asyncio.to_thread(fingerprint, folder, most_files=self._config.most_files)
            if volume.uses != uses:
                raise RefusedError(
                    f"a run on {self._gateway} began to use volume {name}", remedy="ask again when it has ended"
                )
            if mark != state.fingerprint:  # files closed to their owner were opened for a moment
                await self._set(name, msgspec.structs.replace(state, fingerprint=mark, size_bytes=size))
        return msgspec.structs.replace(made, version=state.version, writer=state.writer)

    async def replace(self, name: str, manifest: Manifest, archive: Path) -> bool:
        """Put a state that arrived in the place of ours, if it stands against ours; whether it did.

        Raises:
            RefusedError: a run uses the volume and does not end within `use_wait_s`; or there is no room.
            PayloadError: the archive is not a state's.
        """
        volume = self._volume(name)
        await self._until(name, lambda: not volume.users and not volume.replacing, "is used by a run")
        volume.replacing = True
        try:
            async with volume.writing:
                folder = await self._make(name)
                if await self._look(name, folder):
                    self._untold.set()
                state = volume.state
                stands = relation(state.version, state.writer, manifest.version, manifest.writer)
                if stands not in (Relation.OLDER, Relation.LOSES):
                    return False
                keep = ""
                if stands is Relation.LOSES:
                    keep = await self._make_backup(name, state)
                await self._swap(name, folder, manifest, archive, keep)
        finally:
            volume.replacing = False
            async with volume.changed:
                volume.changed.notify_all()
        return True

    async def _swap(self, name: str, folder: Path, manifest: Manifest, archive: Path, keep: str) -> None:
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
        """Do a swap that is decided; what fails is gone on with when the volume is next looked at."""
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
        mark, size = await asyncio.to_thread(fingerprint, place.root, most_files=self._config.most_files)
        await self._set(
            name,
            State(version=journal.version, writer=journal.writer, fingerprint=mark, size_bytes=size, told=True),
        )
        await asyncio.to_thread(place.forget)

    async def _folder(self, name: str) -> Path | None:
        """Where a volume's files lie, a swap that was interrupted ended; None when Podman has no such volume."""
        volume = self._volume(name)
        if volume.folder is None or not await asyncio.to_thread(volume.folder.is_dir):
            try:
                found = await self._storage.volume(podman_name(self._fleet, self._gateway, name))
            except NotFoundError:
                return None
            volume.folder = found.folder
        place = Place(volume.folder)
        journal = await asyncio.to_thread(place.journal)
        if journal is not None:
            log.info("a volume's swap is gone on with", volume=name)
            await self._finish(name, place, journal)
        return volume.folder

    async def _make(self, name: str) -> Path:
        folder = await self._folder(name)
        if folder is None:
            await self._storage.ensure_volume(podman_name(self._fleet, self._gateway, name), self._labels)
            folder = await self._folder(name)
        if folder is None:
            raise NotFoundError(f"volume {name} was removed while it was made", remedy="try again")
        return folder

    async def _make_backup(self, name: str, state: State) -> str:
        """Make the volume that keeps our state, which lost; the oldest beyond the bound is removed."""
        kept = [
            each
            for each in await self._storage.volumes({**self._labels, LABEL_KEPT: name})
            if each.labels.get(LABEL_KEPT) == name
        ]
        for each in kept[: max(0, len(kept) - self._config.backups + 1)]:
            self._refuse("kept volume removed", volume=name, kept=each.name, reason="pool.transfer.backups")
            await self._storage.remove_volume(each.name)
        own = podman_name(self._fleet, self._gateway, name)
        backup = f"{own}.kept-{time.time_ns():020d}-{generation(state.version)}"
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


def _holds_anything(folder: Path) -> bool:
    return next(folder.iterdir(), None) is not None


def _move_all(source: Path, target: Path) -> None:
    for each in source.iterdir():
        if not (target / each.name).exists():
            shutil.move(each, target / each.name)
