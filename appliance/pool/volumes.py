"""The ledger of this gateway's state volumes: whose state is the newest, and which runs use them.

A skill's volume outlives its containers, and a run elsewhere may change it there. So each state has a version
vector: a run that changed the volume counts one up for its gateway, and the fleet's newest version is a small
record in the DHT (`volume/{name}`). A run on an older state is prevented by asking that record before it begins;
where a partition made two, `lineage` says which stands, and the other is kept aside, never lost.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import AbstractAsyncContextManager
from typing import Protocol

from appliance.model import VersionVector, VolumeInfo
from appliance.plane.store import Store
from appliance.plane.versions import Record
from appliance.pool.engine import PodmanEngine
from appliance.pool.transfer.settings import TransferConfig


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


class Volumes:
    """State volumes of one gateway.

    Args:
        config: table `[pool.transfer]`.
        fleet: name of the fleet.
        gateway: this gateway's id.
        store: where the ledger is kept (`plane.store`).
        records: the fleet's records (`plane.dht`).
        make_engine: Podman, to make volumes and ask where they are.
    """

    def __init__(
        self,
        config: TransferConfig,
        *,
        fleet: str,
        gateway: str,
        store: Store,
        records: Records,
        make_engine: Callable[[], PodmanEngine],
    ) -> None:
        self._config, self._fleet, self._gateway = config, fleet, gateway
        self._store, self._records, self._make_engine = store, records, make_engine
        self.refused: Counter[str] = Counter()

    async def start(self) -> None:
        """Read the ledger, finish what was interrupted, and note volumes that changed unseen (a killed gateway)."""

    async def close(self) -> None:
        """Write what is not yet told to the fleet, briefly; let go of Podman."""

    def use(self, names: Iterable[str]) -> AbstractAsyncContextManager[None]:
        """A run uses these volumes: meanwhile they are neither replaced nor moved.

            async with volumes.use(need.volumes):
                ... the run, to its end

        At the end each volume is looked at (a walk over its files' times and sizes, on a thread); one that changed
        gets a new version, written to the fleet's record before the context ends. So tell a run's last event after
        that: what follows on another gateway then finds the newest state. Any number of runs may use one volume.

        Raises:
            RefusedError: the volume is being replaced and that does not end within `use_wait_s`.
        """
        raise NotImplementedError

    def newest_here(self, name: str) -> bool:
        """Whether no newer state than ours is known of (from what was heard; no question is asked)."""
        raise NotImplementedError

    def hear(self, gateway: str, volumes: Iterable[VolumeInfo]) -> None:
        """Take note of what another gateway's status says of its volumes."""
        raise NotImplementedError

    def where(self, name: str) -> tuple[str, ...]:
        """Gateways known to hold the newest state of a volume, this one among them where it does."""
        raise NotImplementedError

    def size_bytes(self, names: Iterable[str]) -> int:
        """Bytes of these volumes' newest states together that are not here: what `Transfers.cost_ms` is asked with."""
        raise NotImplementedError

    def infos(self) -> tuple[VolumeInfo, ...]:
        """Volumes whose newest state is here, for GatewayStatus.volumes."""
        raise NotImplementedError
