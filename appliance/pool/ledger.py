"""The ledger of the states of volumes that are here: which each volume has, and whether its files have changed since.

It exists apart from the rules of who may change what (`volumes`) and from the files themselves (`folders`), because
both go by it: a state that a run left, or that arrived, is in force once it is written here.
"""

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance.errors import RefusedError
from appliance.model import VersionVector
from appliance.plane.keys import check_name
from appliance.plane.records import increment
from appliance.plane.store import Store
from appliance.pool import lineage
from appliance.pool.transfer.archive import fingerprint


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
