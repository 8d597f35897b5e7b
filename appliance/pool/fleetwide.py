"""What a gateway knows of other gateways' state volumes: the fleet's records, and what statuses say.

The record of a volume is asked where it must be right (before a run, after a change); what was heard answers where
an answer must cost nothing (scores, costs, statuses).
"""

from collections.abc import Callable, Iterable
from typing import Protocol

import msgspec

from appliance.errors import PayloadError
from appliance.model import VersionVector, VolumeInfo
from appliance.plane.keys import check_name
from appliance.plane.records import Record
from appliance.pool import lineage
from appliance.pool.lineage import VolumeRecord, generation


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
        record = await self._records.read(f"{lineage.KEY}{check_name(name, 'volume')}")
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
        await self._records.write(f"{lineage.KEY}{newest.name}", msgspec.json.encode(newest), expected=expected)
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
