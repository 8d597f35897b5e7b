"""This gateway's state volumes: whose state is the newest, and which runs use them.

A skill's volume outlives its containers, and a run elsewhere may change it there. So each state has a version
vector: a run that changed the volume counts one up for its gateway, and the fleet's newest version is a small
record in the DHT (`volume/{name}`). A run on an older state is prevented by asking that record before it begins;
where a partition made two, `lineage` says which stands, and the other is kept aside, never lost. Which state is here,
and its files, are in the `store`.

`Fleetwide` is what is known of other gateways' volumes: the fleet's records, and what statuses say. The record of a
volume is asked where it must be right (before a run, after a change); what was heard answers where an answer must cost
nothing (scores, costs, statuses).
"""

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Iterable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Protocol

import msgspec
import structlog

from appliance.errors import ConflictError, NotFoundError, PayloadError, RefusedError, SwiftbotError
from appliance.model import VersionVector, VolumeInfo, keyspace
from appliance.model.keys import check_name
from appliance.model.plane_api import Record
from appliance.model.transfer_api import Manifest
from appliance.plane.store import Store
from appliance.pool.engine import PodmanEngine
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes import lineage
from appliance.pool.volumes.lineage import Relation, VolumeRecord, generation, relation
from appliance.pool.volumes.store import Folders, Ledger, VolumeState


class Records(Protocol):
    """Replicated records with compare-and-set: `plane.dht`."""

    async def read(self, key: str) -> Record | None:
        """Return a record or None; UnreachableError when no replica answers."""
        ...

    async def write(
        self, key: str, value: bytes, *, expected: VersionVector | None, durable: bool = True
    ) -> VersionVector:
        """Compare and set; ConflictError when it has moved on."""
        ...


class Fleetwide:
    """The newest states of the fleet's volumes, as far as they are known here."""

    def __init__(self, records: Records, *, refuse: Callable[..., None]) -> None:
        self.told: dict[str, VolumeRecord] = {}
        """What the record of a volume last said."""
        self._records, self._refuse = records, refuse
        self._heard: dict[str, dict[str, VolumeInfo]] = {}
        """By gateway, then by name."""

    async def read(self, name: str) -> tuple[VolumeRecord | None, VersionVector | None]:
        """Return what the record of a volume says, None where nothing can be read, and its version to write over.

        Raises:
            UnreachableError: no replica of the record answers.
        """
        record = await self._records.read(f"{keyspace.VOLUME_RECORD.prefix}{check_name(name, 'volume')}")
        if record is None:
            return None, None
        try:
            found = self.told[name] = lineage.read(record.value)
        except PayloadError as error:
            self._refuse("volume record damaged", volume=name, reason=str(error))
            return None, record.version
        return found, record.version

    async def write(self, newest: VolumeRecord, *, expected: VersionVector | None) -> None:
        """Write the record of a volume over the version that was read.

        Raises:
            ConflictError: it has moved on.
            UnreachableError: no owner of it can be reached.
        """
        await self._records.write(
            f"{keyspace.VOLUME_RECORD.prefix}{newest.name}", msgspec.json.encode(newest), expected=expected
        )
        self.told[newest.name] = newest

    def hear(self, gateway: str, volumes: Iterable[VolumeInfo]) -> None:
        """Take note of what a gateway's status says of its volumes; nothing when it is gone."""
        infos = {each.name: each for each in volumes}
        if infos:
            self._heard[gateway] = infos
        else:
            self._heard.pop(gateway, None)

    def generations(self, name: str) -> dict[str, int]:
        """Which generation of a volume each other gateway is known to have."""
        found = {gateway: infos[name].generation for gateway, infos in self._heard.items() if name in infos}
        if newest := self.told.get(name):
            found[newest.gateway] = max(generation(newest.version), found.get(newest.gateway, 0))
        return found

    def size_bytes(self, name: str) -> int:
        """Bytes of a volume, the largest that was heard of."""
        known = [infos[name].size_bytes for infos in self._heard.values() if name in infos]
        newest = self.told.get(name)
        return max([*known, newest.size_bytes if newest else 0])


log = structlog.get_logger(__name__)

_TRIES = 8
_TELL_AGAIN_S = 2.0


class Volumes:
    """State volumes of one gateway.

    Args:
        config: table `[pool.transfer]`.
        fleet: name of the fleet.
        gateway: this gateway's id.
        store: where the ledger is kept (`plane.store`).
        records: the fleet's records (`plane.dht`).
        storage: Podman, to make volumes and ask where they are; the owner closes it.
        on_change: called when `infos` has changed.
    """

    def __init__(
        self,
        config: TransferConfig,
        *,
        fleet: str,
        gateway: str,
        store: Store,
        records: Records,
        storage: PodmanEngine,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self.refused: Counter[str] = Counter()
        """Bad input, conflicts and refusals by kind, for GatewayStatus.refused."""
        self._config, self._gateway = config, gateway
        self._ledger = Ledger(
            store,
            gateway=gateway,
            most_files=config.most_files,
            refuse=self._refuse,
            on_set=on_change,
        )
        self._folders = Folders(
            config, fleet=fleet, gateway=gateway, storage=storage, ledger=self._ledger, refuse=self._refuse
        )
        self._fleetwide = Fleetwide(records, refuse=self._refuse)
        self._telling: asyncio.Task[None] | None = None
        self._untold = asyncio.Event()

    # --- life -------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Read the ledger, finish what was interrupted, and note volumes that changed unseen (a killed gateway).

        A Podman that is away is no reason to stop: each volume is then looked at when it is first used.
        """
        await self._ledger.load()
        try:
            there = await self._folders.find()
        except SwiftbotError as error:
            log.warning("volumes are looked at when they are used", reason=str(error))
            there = []
        for name in there:
            with contextlib.suppress(SwiftbotError):
                await self._note(name)
        if not all(volume.state.told for _, volume in self._ledger):
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
            for name, volume in self._ledger:
                if not volume.state.told:
                    try:
                        await self._tell(name)
                    except SwiftbotError as error:
                        log.info("the fleet does not know of a volume's state yet", volume=name, reason=str(error))
                        self._untold.set()
            await asyncio.sleep(_TELL_AGAIN_S)

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
                volume = self._ledger.volume(name)
                await self._until(name, lambda volume=volume: not volume.replacing, "is being replaced")
                volume.users += 1
                volume.uses += 1
                used.append(name)
            yield
        finally:
            # A caller that gives up waiting for a run must not leave its change unnoted.
            await asyncio.shield(asyncio.ensure_future(self._used(used)))

    async def _used(self, names: list[str]) -> None:
        for name in names:
            volume = self._ledger.volume(name)
            volume.users -= 1
            try:
                await self._note(name)
            except SwiftbotError as error:
                self._refuse("volume not looked at", volume=name, reason=str(error))
            async with volume.changed:
                volume.changed.notify_all()

    async def _until(self, name: str, ready: Callable[[], bool], why: str) -> None:
        volume = self._ledger.volume(name)
        try:
            async with asyncio.timeout(self._config.use_wait_s), volume.changed:
                await volume.changed.wait_for(ready)
        except TimeoutError:
            self.refused["volume busy"] += 1
            raise RefusedError(
                f"volume {name} {why} on {self._gateway}", remedy="try again when that has ended"
            ) from None

    async def _note(self, name: str) -> None:
        """Look whether a volume changed; if so it has a new version, which is published to the fleet."""
        volume = self._ledger.volume(name)
        async with volume.writing:
            folder = await self._folders.folder(name)
            if folder is None or not await self._ledger.look(name, folder):
                return
        try:
            await self._tell(name)
        except SwiftbotError as error:
            log.warning("the fleet cannot be told of a volume's new state now", volume=name, reason=str(error))
            self._untold.set()

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
        volume = self._ledger.volume(name)
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
                await self._ledger.set(name, msgspec.structs.replace(state, told=True))
                return
        raise ConflictError(f"the record of volume {name} keeps moving on", remedy="it is written again in a moment")

    def has(self, name: str, newest: VolumeRecord) -> bool:
        """Whether that state, or one that stands against it, is here."""
        state = self._ledger.volume(name).state
        stands = relation(state.version, state.writer, newest.version, newest.gateway)
        return stands in (Relation.SAME, Relation.NEWER, Relation.WINS)

    # --- what is known without asking -------------------------------------------------------------------------

    def hear(self, gateway: str, volumes: Iterable[VolumeInfo]) -> None:
        """Take note of what another gateway's status says of its volumes; nothing when it is gone."""
        self._fleetwide.hear(gateway, volumes)

    def _generations(self, name: str) -> dict[str, int]:
        """Who is known to have which generation."""
        volume = self._ledger.known(name)
        mine = generation(volume.state.version) if volume else 0
        return self._fleetwide.generations(name) | {self._gateway: mine}

    def newest_here(self, name: str) -> bool:
        """Whether no newer state than ours is known of (from what was heard; no question is asked)."""
        found = self._generations(name)
        newest, volume = self._fleetwide.told.get(name), self._ledger.known(name)
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
            for name, volume in self._ledger
            if volume.state.version and self.newest_here(name)
        )

    def state(self, name: str) -> VolumeState:
        """The state that is here."""
        return self._ledger.volume(name).state

    # --- packing and replacing --------------------------------------------------------------------------------

    async def packed(self, name: str, kept: Manifest | None, pack: Callable[[Path], Manifest]) -> Manifest:
        """Return the manifest of our state: `kept`, if it is of that state, or what `pack` makes of the folder.

        Raises:
            NotFoundError: there is no state of it here.
            RefusedError: a run uses it, and what was kept is older.
        """
        volume = self._ledger.volume(name)
        async with volume.writing:
            folder = await self._folders.folder(name)
            if folder is not None and not volume.users and await self._ledger.look(name, folder):
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
            mark, size = await self._ledger.measure(folder)
            if volume.uses != uses:
                raise RefusedError(
                    f"a run on {self._gateway} began to use volume {name}", remedy="ask again when it has ended"
                )
            if mark != state.fingerprint:  # files closed to their owner were opened for a moment
                await self._ledger.set(name, msgspec.structs.replace(state, fingerprint=mark, size_bytes=size))
        return msgspec.structs.replace(made, version=state.version, writer=state.writer)

    async def replace(self, name: str, manifest: Manifest, archive: Path) -> bool:
        """Put a state that arrived in the place of ours, if it stands against ours; whether it did.

        Raises:
            RefusedError: a run uses the volume and does not end within `use_wait_s`; or there is no room.
            PayloadError: the archive is not a state's.
        """
        volume = self._ledger.volume(name)
        await self._until(name, lambda: not volume.users and not volume.replacing, "is used by a run")
        volume.replacing = True
        try:
            async with volume.writing:
                folder = await self._folders.make(name)
                if await self._ledger.look(name, folder):
                    self._untold.set()
                state = volume.state
                stands = relation(state.version, state.writer, manifest.version, manifest.writer)
                if stands not in (Relation.OLDER, Relation.LOSES):
                    return False
                aside = state if stands is Relation.LOSES else None
                await self._folders.swap(name, folder, manifest, archive, aside=aside)
        finally:
            volume.replacing = False
            async with volume.changed:
                volume.changed.notify_all()
        return True
